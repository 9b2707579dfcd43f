"""Raw records on their way to disk, with what was lost of them."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import aclosing
from dataclasses import dataclass, field, replace
from typing import Any

from triaxcal_drivers.host_clock import HOST, SteadyClock
from triaxcal_drivers.interface import Gap, RawBatch
from triaxcald.recording.schema import RawDigest
from triaxcald.recording.writer import RecordingWriter

OVERRUN = "the disk did not keep up"


@dataclass
class RawRecords:
    """``ends_with`` is what the recording ends with. ``gaps_s`` is how long
    nothing could be received, all in all; ``last_ns`` host time of the last
    record."""

    phase: str
    ends_with: str = field(default="", kw_only=True)
    digest: RawDigest = field(init=False)
    gaps: int = field(default=0, kw_only=True)
    gaps_s: float = field(default=0.0, kw_only=True)
    last_ns: int | None = field(default=None, kw_only=True)
    clock: SteadyClock = field(default=HOST, kw_only=True)

    def __post_init__(self) -> None:
        self.digest = RawDigest(self.ends_with)

    async def written(
        self, stream: AsyncGenerator[RawBatch], writer: RecordingWriter | None
    ) -> AsyncGenerator[RawBatch]:
        """The batches of a stream, which is closed in the end, once they are on
        their way to disk, and without those that it had no room for."""
        unwritten: Gap | None = None
        away = None if writer is None else writer.resumes
        stepped_ns = self.clock.steps_ns()
        async with aclosing(stream):
            async for batch in stream:
                if away is not None and (len(batch) or batch.gap is not None):
                    away = replace(away, to_ns=int(batch.time_ns[0]) if batch.gap is None else batch.gap.from_ns)
                    if batch.gap is None:
                        batch = batch.after(away)
                    else:
                        self._note(writer, away)
                    away = None
                self._note(writer, batch.gap)
                if (steps_ns := self.clock.steps_ns()) != stepped_ns and writer is not None:
                    writer.event("clock_step", {"by_s": (steps_ns - stepped_ns) / 1e9})
                stepped_ns = steps_ns
                if unwritten is not None and len(batch):
                    unwritten = replace(unwritten, to_ns=int(batch.time_ns[0]))
                    batch = batch.after(unwritten)
                if writer is not None and len(batch) and not writer.raw(self.phase, batch):
                    unwritten = _unwritten(unwritten, batch)
                    continue
                if unwritten is not None and len(batch):
                    self._note(writer, unwritten)
                    unwritten = None
                self.digest.update(self.phase, batch)
                if len(batch):
                    self.last_ns = int(batch.time_ns[-1])
                yield batch

    def _note(self, writer: RecordingWriter | None, gap: Gap | None) -> None:
        if gap is None:
            return
        detail: dict[str, Any] = {"from_ns": gap.from_ns, "cause": gap.cause}
        if gap.to_ns is not None:
            self.gaps += 1
            self.gaps_s += max(gap.to_ns - gap.from_ns, 0) * 1e-9  # between two recorders the clock may go back
            detail |= {"to_ns": gap.to_ns, "lost": gap.lost}
        if writer is not None:
            writer.event("interrupted" if gap.to_ns is None else "gap", detail)


def _unwritten(before: Gap | None, batch: RawBatch) -> Gap:
    """The gap that grows while the disk has no room."""
    lost = len(batch) + (before.lost or 0 if before else 0)
    from_ns = int(batch.time_ns[0]) if before is None else before.from_ns
    return Gap(from_ns, None, OVERRUN, lost)
