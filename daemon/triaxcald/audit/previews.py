"""The thinned samples that a recording has for the eye, made again from its raw
records."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import triaxcal_drivers as td
from triaxcald.audit.differences import Difference, Kind
from triaxcald.recording.reader import Recording
from triaxcald.recording.schema import PREVIEWS, Decimator, PreviewEncoder, preview_channels


@dataclass(frozen=True)
class Thinned:
    """The messages of one topic, one after the other, each by its SHA-256."""

    sha256: tuple[bytes, ...]


class Previews:
    """Takes the decoded samples of both streams in the order in which they
    came."""

    def __init__(self, profile: td.Profile) -> None:
        self._encoder = PreviewEncoder(preview_channels(profile))
        self._decimators = {topic: Decimator() for topic in PREVIEWS}
        self._digests: dict[str, list[bytes]] = {topic: [] for topic in PREVIEWS}

    def feed(self, stream: str, block: td.SampleBlock) -> None:
        topic = PREVIEWS[0] if stream == td.READINGS else PREVIEWS[1]
        for i in self._decimators[topic].pick(block):
            self._digests[topic].append(hashlib.sha256(self._encoder.encode(block, i)).digest())

    def thinned(self) -> dict[str, Thinned]:
        return {topic: Thinned(tuple(digests)) for topic, digests in self._digests.items()}


def check(recording: Recording, again: Mapping[str, Thinned], *, cut_short: bool = False) -> list[Difference]:
    """All of them in their order, but for as many as are said to have been lost
    on the way to the disk. A recording that was ``cut_short`` may lack the last
    ones: they are written after their raw records."""
    stored: dict[str, list[bytes]] = {topic: [] for topic in again}
    for topic, message in recording.messages():
        if topic in stored:
            stored[topic].append(hashlib.sha256(message.data).digest())
    lost = dict.fromkeys(again, 0)
    for loss in recording.losses():
        if loss.where in lost:
            lost[loss.where] += loss.records
    found = []
    for topic, thinned in again.items():
        of = thinned.sha256
        if cut_short and not lost[topic]:
            of = of[: len(stored[topic])]
        kept = len(of) - lost[topic]
        if len(stored[topic]) != kept:
            found.append(Difference(topic, Kind.VALUE, "messages", len(stored[topic]), kept))
        elif not _is_part(stored[topic], of):
            found.append(Difference(topic, Kind.NOT_OF_RAW))
    return sorted(found, key=lambda d: d.part)


def _is_part(some: Sequence[bytes], of: Sequence[bytes]) -> bool:
    """Whether ``some`` is ``of`` with parts left out."""
    left = iter(of)
    return all(one in left for one in some)
