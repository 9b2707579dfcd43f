"""Which segments of a recording are kept, and which make room."""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from triaxcald.recording.manifest import Manifest, Segment

SEGMENT_BYTES, SEGMENT_S = 256 * 2**20, 3600.0
"""What damage to one file costs at most, and the least that retention takes: an
hour of a busy bus is some hundred MiB."""
Reason = Literal["age", "disk"]


@dataclass(frozen=True)
class Retention:
    """Segments that were closed more than ``keep_s`` ago go (None: no age is too
    much); and the oldest go while less than ``free_bytes`` of the disk are
    free."""

    keep_s: float | None = None
    free_bytes: int = 0


class Surplus(NamedTuple):
    segment: Segment
    reason: Reason


def surplus(
    segments: Sequence[Segment],
    retention: Retention,
    *,
    age_ns: Callable[[Segment], int | None],
    free_bytes: int | None,
    kept: Collection[str],
) -> list[Surplus]:
    """What has to go, the oldest first. The one that is being written stays,
    and so do the files ``kept``. ``age_ns`` is None for one that does not say
    from when it is: it is as old as any. ``free_bytes`` of the disk, None where
    that is not known."""
    found: list[Surplus] = []
    free = retention.free_bytes if free_bytes is None else free_bytes
    for segment in segments:
        if segment.state == "open" or segment.file in kept:
            continue
        if retention.keep_s is not None and _too_old(age_ns(segment), retention.keep_s):
            found.append(Surplus(segment, "age"))
        elif free < retention.free_bytes:
            found.append(Surplus(segment, "disk"))
        else:
            continue
        free += segment.bytes
    return found


def _too_old(age_ns: int | None, keep_s: float) -> bool:
    return age_ns is None or age_ns > keep_s * 1e9


def delete(manifest: Manifest, chosen: Iterable[Surplus]) -> list[Surplus]:
    """Those that are gone; one that cannot be removed stays, and the next may
    go. What is still in the manifest, and not on the disk, is gone too."""
    gone = []
    for one in chosen:
        try:
            manifest.path_of(one.segment).unlink(missing_ok=True)
        except OSError:
            continue
        gone.append(one)
    return gone


# What a recording holds, as digests: so that an outcome can name it, and an audit
# can miss nothing. No I/O.

Document = dict[str, Any]


class Inventory:
    """Grows with a recording, record by record, in the order of the file."""

    def __init__(self) -> None:
        self._attachments: list[Document] = []
        self._metadata: list[Document] = []
        self._topics: dict[str, tuple[int, hashlib._Hash]] = {}
        self._declared: dict[str, set[str]] = {}

    def channel(self, topic: str, encoding: str, metadata: Mapping[str, str], kind: tuple[str, str, bytes]) -> None:
        """A topic as it is declared; ``kind`` is its schema's name, encoding
        and data. Each way counts once."""
        said = [topic, encoding, *(f"{key}\0{value}" for key, value in sorted(metadata.items())), *kind[:2]]
        text = "\0".join(said).encode() + b"\0" + kind[2]
        self._declared.setdefault(topic, set()).add(hashlib.sha256(text).hexdigest())

    def attachment(self, name: str, media_type: str, time_ns: int, data: bytes) -> None:
        self._attachments.append(
            {"name": name, "media_type": media_type, "time_ns": time_ns, "sha256": hashlib.sha256(data).hexdigest()}
        )

    def metadata(self, name: str, record: Mapping[str, str]) -> None:
        text = "".join(f"{key}\0{value}\0" for key, value in sorted(record.items()))
        self._metadata.append({"name": name, "sha256": hashlib.sha256(text.encode()).hexdigest()})

    def message(self, topic: str, log_time_ns: int, publish_time_ns: int, data: bytes) -> None:
        count, digest = self._topics.get(topic) or (0, hashlib.sha256())
        digest.update(struct.pack("<QQQ", log_time_ns, publish_time_ns, len(data)))
        digest.update(data)
        self._topics[topic] = count + 1, digest

    def document(self) -> Document:
        """Attachments in the order of the file, metadata by name, messages by
        topic."""
        topics = sorted(self._topics.items())
        return {
            "attachments": list(self._attachments),
            "metadata": sorted(self._metadata, key=lambda m: str(m["name"])),
            "topics": [
                {"name": name, "messages": n, "sha256": d.hexdigest(), "declared": self._declaration(name)}
                for name, (n, d) in topics
            ],
        }

    def _declaration(self, topic: str) -> str:
        return hashlib.sha256("".join(sorted(self._declared.get(topic, ()))).encode()).hexdigest()
