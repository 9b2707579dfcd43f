"""Recording of a bus, across interruptions."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Callable
from contextlib import aclosing
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

import triaxcal_drivers as td
from triaxcald.recording.schema import RawDigest
from triaxcald.recording.writer import RecordingWriter
from triaxcald.station.reconnect import RetryPolicy, until_open

# Raw records on their way to disk, with a count of the lost ones.

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
    clock: td.host_clock.SteadyClock = field(default=td.host_clock.HOST, kw_only=True)

    def __post_init__(self) -> None:
        self.digest = RawDigest(self.ends_with)

    async def written(
        self, stream: AsyncGenerator[td.RawBatch], writer: RecordingWriter | None
    ) -> AsyncGenerator[td.RawBatch]:
        """Batches of a stream after their hand-over to the writer, without those that
        it drops; closes the stream at the end."""
        unwritten: td.Gap | None = None
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

    def _note(self, writer: RecordingWriter | None, gap: td.Gap | None) -> None:
        if gap is None:
            return
        detail: dict[str, Any] = {"from_ns": gap.from_ns, "cause": gap.cause}
        if gap.to_ns is not None:
            self.gaps += 1
            self.gaps_s += max(gap.to_ns - gap.from_ns, 0) * 1e-9  # between two recorders the clock may go back
            detail |= {"to_ns": gap.to_ns, "lost": gap.lost}
        if writer is not None:
            writer.event("interrupted" if gap.to_ns is None else "gap", detail)


def _unwritten(before: td.Gap | None, batch: td.RawBatch) -> td.Gap:
    """The growing gap of a writer that drops records."""
    lost = len(batch) + (before.lost or 0 if before else 0)
    from_ns = int(batch.time_ns[0]) if before is None else before.from_ns
    return td.Gap(from_ns, None, OVERRUN, lost)


SETTLED_S = 1.0
"""A bus is back once it brings a frame, or works for this time without an error."""
SLEPT_S = 0.1  # reading two clocks takes microseconds, on a busy machine some milliseconds
SLEPT = "this machine slept"
IDENTIFIERS_MOST = 1 << 16
"""Number of identifiers that are counted separately: a bus in use has some hundred, and
random identifiers must not fill the memory."""


class ReconnectingBus:
    """A bus whose frames continue after an interruption.

    Silence is no loss, since no node has to send: only a failure of the bus or a
    sleep of this machine is one. So a gap begins at the last frame or the last look
    at a quiet bus, whichever is later, and ends when the bus is open again. ``tell``
    receives the reason of an interruption, and None when it is over.
    """

    def __init__(
        self,
        listener: td.can.BusListener,
        policy: RetryPolicy,
        tell: Callable[[str | None], None],
        *,
        now_ns: Callable[[], int] = td.host_clock.HOST.now_ns,
        slept_ns: Callable[[], int] = td.host_clock.slept_ns,
    ) -> None:
        self._listener, self._policy, self._tell = listener, policy, tell
        self._now_ns, self._slept_ns = now_ns, slept_ns
        self._opened_ns = 0

    async def stream(self) -> AsyncGenerator[td.RawBatch, None]:
        """The listener's batches. An empty batch with an open gap reports an
        interruption, another one its end; the first record after it carries
        RawFlag.LOST_BEFORE. Raises BusError once the policy gives up."""
        heard_ns, asleep_ns, lost = self._now_ns(), self._slept_ns(), False
        while True:
            try:
                async with aclosing(self._listener.stream()) as stream:
                    async for batch in stream:
                        # A thread that stalls between its two clock readings gets too
                        # small a value.
                        before_ns, asleep_ns = asleep_ns, max(asleep_ns, self._slept_ns())
                        if asleep_ns - before_ns > SLEPT_S * 1e9:
                            yield td.RawBatch.of([]).after(td.Gap(heard_ns, heard_ns + asleep_ns - before_ns, SLEPT))
                            lost = True
                        lost = lost or (batch.gap is not None and not len(batch))
                        if lost and len(batch):
                            batch, lost = batch.after(batch.gap), False
                        yield batch
                        heard_ns = int(batch.time_ns[-1]) if len(batch) else self._now_ns()
                return
            except td.BusError as e:
                gap = td.Gap(heard_ns, None, str(e))
            yield td.RawBatch.of([]).after(gap)
            self._tell(gap.cause)
            await until_open(self._again, self._policy, lambda trouble: self._tell(str(trouble)))
            heard_ns, asleep_ns, lost = self._opened_ns, self._slept_ns(), True
            yield td.RawBatch.of([]).after(replace(gap, to_ns=heard_ns))
            self._tell(None)

    async def _again(self) -> None:
        await self._listener.close()
        await self._listener.open()
        self._opened_ns = self._now_ns()
        await self._listener.settled(SETTLED_S)


@dataclass
class Listened(RawRecords):
    """All records of a bus on their way to disk. ``frames`` and ``errors``
    (error frames) count them, ``seconds`` by the host's time."""

    frames: int = field(default=0, init=False)
    errors: int = field(default=0, init=False)
    seconds: float = field(default=0.0, init=False)
    _seen: set[int] = field(default_factory=set, init=False)

    @property
    def counts(self) -> dict[str, int]:
        """``identifiers`` are the different ones, `IDENTIFIERS_MOST` at
        most."""
        return {"frames": self.frames, "identifiers": len(self._seen), "errors": self.errors}

    async def for_seconds(self, bus: ReconnectingBus, writer: RecordingWriter, seconds: float | None) -> None:
        """Record for ``seconds`` of the host's time (None: without end), however many
        frames come. Raises BusError once the policy gives up."""
        now_s = asyncio.get_running_loop().time
        begun_s = now_s()
        try:
            async with asyncio.timeout(seconds) as limit, aclosing(self.written(bus.stream(), writer)) as written:
                async for batch in written:
                    self._count(batch)
        except TimeoutError:
            if not limit.expired():
                raise
        finally:
            self.seconds = now_s() - begun_s

    def _count(self, batch: td.RawBatch) -> None:
        error = (batch.flags & td.RawFlag.ERROR) != 0
        errors = int(np.count_nonzero(error))
        self.errors += errors
        self.frames += len(batch) - errors
        if len(self._seen) < IDENTIFIERS_MOST:
            self._seen.update(np.unique(batch.identifiers[~error]).tolist()[: IDENTIFIERS_MOST - len(self._seen)])
