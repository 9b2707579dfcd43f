"""Which segments of a recording are kept, and which make room."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

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
