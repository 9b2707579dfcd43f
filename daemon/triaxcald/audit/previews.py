"""The thinned samples that a recording has for the eye, made again from its raw records."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass

from triaxcal_drivers.interface import SampleBlock
from triaxcal_drivers.profile import READINGS, Profile
from triaxcald.audit.differences import Difference, Kind
from triaxcald.inputs import preview_channels
from triaxcald.recording.reader import Recording
from triaxcald.recording.schema import PREVIEWS, Decimator, PreviewEncoder


@dataclass(frozen=True)
class Thinned:
    """The messages of one topic, one after the other."""

    messages: int
    sha256: str


class Previews:
    """Takes the decoded samples of both streams in the order in which they came."""

    def __init__(self, profile: Profile) -> None:
        self._encoder = PreviewEncoder(preview_channels(profile))
        self._decimators = {topic: Decimator() for topic in PREVIEWS}
        self._digests = {topic: hashlib.sha256() for topic in PREVIEWS}
        self._counts = dict.fromkeys(PREVIEWS, 0)

    def feed(self, stream: str, block: SampleBlock) -> None:
        topic = PREVIEWS[0] if stream == READINGS else PREVIEWS[1]
        for i in self._decimators[topic].pick(block):
            self._counts[topic] += 1
            self._digests[topic].update(self._encoder.encode(block, i))

    def thinned(self) -> dict[str, Thinned]:
        return {topic: Thinned(self._counts[topic], self._digests[topic].hexdigest()) for topic in PREVIEWS}


def check(recording: Recording, again: Mapping[str, Thinned]) -> list[Difference]:
    """Where none were lost on the way to the disk."""
    counts, digests = dict.fromkeys(again, 0), {topic: hashlib.sha256() for topic in again}
    for topic, message in recording.messages():
        if topic in counts:
            counts[topic] += 1
            digests[topic].update(message.data)
    lost = {loss.where for loss in recording.losses()}
    found = []
    for topic in again.keys() - lost:
        if counts[topic] != again[topic].messages:
            found.append(Difference(topic, Kind.VALUE, "messages", counts[topic], again[topic].messages))
        elif digests[topic].hexdigest() != again[topic].sha256:
            found.append(Difference(topic, Kind.NOT_OF_RAW))
    return sorted(found, key=lambda d: d.part)
