"""The raw records of one phase, on their way to disk and down the pipelines,
until there are poses enough."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import AsyncGenerator, Callable, Sequence
from contextlib import aclosing, suppress
from dataclasses import dataclass, field
from typing import Any, Protocol, cast

import triaxcal as tc
from triaxcal_drivers.errors import DeviceRestarted, DeviceSilent
from triaxcal_drivers.interface import RawBatch
from triaxcal_drivers.profile import CORRECTED, READINGS, Bundle
from triaxcal_drivers.stall_clock import StallTolerantTimer
from triaxcal_drivers.two_senders import RECORDS
from triaxcald import text
from triaxcald.decoded import DecodedStream
from triaxcald.errors import NoPoses, RecordingError, TwoAnswer
from triaxcald.recording.schema import Phase
from triaxcald.recording.writer import RecordingWriter
from triaxcald.station.config import Plan
from triaxcald.station.guidance import Guide, guide
from triaxcald.station.listening import RawRecords
from triaxcald.station.reconnect import Streaming

LOOK_SAMPLES_S, LOOK_HOST_S = 0.5, 0.1
"""The poses so far are looked at so often, by the samples' time and by the
host's, whichever is longer."""
LOOK_SHARE = 5.0
"""A look is followed by a pause of so many times what it took, or samples would
be lost meanwhile."""
RESTARTED_S = 3.0
"""A unit takes longer to restart once more."""
SILENCE_SHARE = 0.25
"""Of a silence, what one batch without a sample may add. A device that sends
brings several in that time."""


DECODE_S = 1.0
"""Records are decoded together so seldom where nobody is guided by them: what
it costs to decode a batch hardly depends on how many are in it."""


class Progress(Protocol):
    """Who shows the operator how it goes."""

    def stage(self, unit: str, text: str) -> None: ...
    def lost(self, unit: str, trouble: str) -> None: ...
    def poses(self, unit: str, phase: Phase, guide: Guide) -> None: ...


@dataclass
class Recorded(RawRecords):
    """``streams`` are decoded on the way: the readings, and the corrected output
    where the device has one.

    ``where`` says where the unit is, for messages; ``latest`` are the last
    values of the readings' other channels.
    """

    phase: Phase
    bundle: Bundle
    where: str
    latest: dict[str, float] = field(default_factory=dict, init=False)
    _restarted_ns: int | None = field(default=None, init=False)
    _undecoded: list[RawBatch] = field(default_factory=list, init=False)
    _decoded_ns: int | None = field(default=None, init=False)
    _device: Streaming | None = field(default=None, init=False)
    _writer: RecordingWriter | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.streams: dict[str, DecodedStream] = {s: self._decoded(s) for s in self._names()}

    def _names(self) -> list[str]:
        return [s for s in (READINGS, CORRECTED) if s in self.bundle.profile.streams]

    def _decoded(self, stream: str) -> DecodedStream:
        return DecodedStream(self.bundle, stream)

    def mark(self) -> dict[str, Any]:
        """What the streams have come to so far, for `back_to`."""
        self._decode()
        return {name: stream.mark() for name, stream in self.streams.items()}

    def back_to(self, mark: dict[str, Any]) -> None:
        """As if nothing had come since. No more records may come."""
        self._undecoded = []
        for name, stream in self.streams.items():
            stream.back_to(mark[name])

    async def records(
        self, device: Streaming, writer: RecordingWriter | None, seconds: float | None = None
    ) -> AsyncGenerator[RawBatch]:
        """What comes off the bus, once it is on its way to disk. It is decoded
        by then or some batches later, but at once where the readings may have
        come to so many ``seconds``.

        What the disk has no room for goes to neither, so that an audit sees
        what the station saw. Raises TwoAnswer where two units send.
        """
        stream = cast(Any, device.stream(list(self.streams)))
        async with aclosing(self.written(stream, writer)) as written:
            self._device, self._writer = device, writer
            try:
                async for batch in written:
                    self._undecoded.append(batch)
                    if self._is_due(batch, seconds):
                        self._decode()
                    yield batch
            except BaseException:  # which says more than what the rest would
                with suppress(RecordingError, TwoAnswer):
                    self._decode()
                raise
            self._decode()

    def _is_due(self, batch: RawBatch, seconds: float | None) -> bool:
        """Whether what has come is to be decoded by now."""
        if self._decoded_ns is None or not len(batch) or batch.gap is not None:
            return True
        # By the host's clock, which nobody promises to run on: back is due too.
        since_s = (int(batch.time_ns[-1]) - self._decoded_ns) * 1e-9
        if not 0 <= since_s < self._decode_s:
            return True
        if seconds is None:
            return False
        readings = self.streams[READINGS]
        if not readings.host_seconds:  # how fast the unit's own time goes is not known yet
            return True
        pace = readings.seconds / readings.host_seconds
        return readings.seconds + max(pace, 1.0) * since_s >= seconds

    def _decode(self) -> None:
        """All that waits for it. Raises TwoAnswer if two units send."""
        if not self._undecoded or self._device is None:
            return
        device, writer, mixed = self._device, self._writer, None
        batch, self._undecoded = RawBatch.joined(self._undecoded), []
        if len(batch):
            self._decoded_ns = int(batch.time_ns[-1])
        for name, decoded in self.streams.items():
            block = decoded.feed(batch)
            mixed = name if block.two_senders else mixed
            # What it was told when it was opened is gone, and it may be another unit.
            if block.restarts and self._tells_restart(batch):
                device.complain(DeviceRestarted(f"{self.where}: stream {name}: it has started anew"))
            if len(block) and name == READINGS:
                self.latest = {channel: float(values[-1]) for channel, values in block.channels.items()}
            if writer is not None and len(block):
                writer.preview("/preview/readings" if name == READINGS else "/preview/corrected", block)
        if mixed is not None:  # all of the batch is in the file
            raise TwoAnswer(text.two_senders(self.where, mixed))

    def _tells_restart(self, batch: RawBatch) -> bool:
        """Whether a restart is to be acted upon. Two units that send at once look
        like restarts without end, and opening the unit each time would keep them
        from being told: after one, the stream goes on for long enough."""
        after_s = max(RESTARTED_S, 2 * RECORDS / self.bundle.profile.sampling.rate_hz)
        now_ns, before_ns = int(batch.time_ns[-1]), self._restarted_ns
        if before_ns is not None and now_ns - before_ns < after_s * 1e9:
            return False
        self._restarted_ns = now_ns
        return True

    def _watch(self, stream: str, clock_s: Callable[[], float]) -> _Watch:
        return _Watch(self.streams[stream], f"{self.where}: stream {stream}", self._timeout_s, clock_s)

    @property
    def _timeout_s(self) -> float:
        """Twice what the driver waits, which knows better what is the matter
        where nothing comes at all."""
        return 2 * self.bundle.profile.sampling.silence_timeout_s

    @property
    def _decode_s(self) -> float:
        """So long records may wait to be decoded together; not so long that a
        watch looks too seldom."""
        return min(DECODE_S, SILENCE_SHARE * self._timeout_s)

    async def for_seconds(
        self,
        device: Streaming,
        writer: RecordingWriter,
        seconds: float | None,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """Records so many seconds of the readings' own time; for ever where
        None. A device that sends, but no whole reading, hears of it."""
        readings = self.streams[READINGS]
        watch = self._watch(READINGS, clock_s)
        async with aclosing(self.records(device, writer, seconds)) as records:
            async for batch in records:
                if _interrupted(batch):
                    watch = self._watch(READINGS, clock_s)
                if self._undecoded:
                    continue
                watch.look(device)
                if seconds is not None and readings.seconds >= seconds:
                    return


class Collection(Recorded):
    """The same, searched for poses on the way: whoever turns the unit is told
    at once."""

    def __post_init__(self) -> None:
        from triaxcald.pipeline import Pipeline  # whoever only records needs none of the metrology

        self.pipelines = {s: Pipeline(self.bundle, s) for s in self._names()}
        super().__post_init__()

    def _decoded(self, stream: str) -> DecodedStream:
        return self.pipelines[stream]

    @property
    def _decode_s(self) -> float:
        return 0.0

    async def until_posed(
        self,
        device: Streaming,
        writer: RecordingWriter | None,
        plan: Plan,
        *,
        stream: str,
        wanted: int,
        nominal_scale_factor: Sequence[float] | None,
        tell: Callable[[Guide], None],
        apart_from: tc.Floats | None = None,
        targets: Sequence[tc.planning.Direction] | None = None,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """Records until ``stream`` shows ``wanted`` distinct poses, and of the
        readings the first of them once more, if the plan says so; ``tell`` is
        told how it goes. ``apart_from`` and ``targets`` as in `guide`. A device
        that sends, but no whole sample of ``stream``, hears of it.

        Raises NoPoses when no new pose has come for the plan's patience, and
        what the device's stream raises. Where only the repeat does not come, it
        goes on without.
        """
        pipeline = self.pipelines[stream]
        looked_s, next_host_s, news_s, found = 0.0, 0.0, 0.0, 0
        lost_s = self.gaps_s  # time in which the unit was not there is no time without a pose
        counted_s: tuple[float, ...] = ()
        if stream == READINGS and targets is None:
            tc.planning.directions(wanted)  # put in order once, before there are samples to lose
        watch = self._watch(stream, clock_s)
        async with aclosing(self.records(device, writer)) as records:
            async for batch in records:
                if _interrupted(batch):
                    watch = self._watch(stream, clock_s)
                watch.look(device)
                now_s, host_s = pipeline.seconds, clock_s()
                if now_s - looked_s < LOOK_SAMPLES_S or host_s < next_host_s:
                    continue
                looked_s = now_s
                state = guide(
                    pipeline.held(),
                    wanted=wanted,
                    hold_s=plan.hold_s,
                    apart_deg=plan.apart_deg,
                    now_s=now_s,
                    nominal_scale_factor=nominal_scale_factor,
                    plan=stream == READINGS,
                    repeat=plan.repeat and stream == READINGS,
                    counted_s=counted_s,
                    apart_from=apart_from,
                    targets=targets,
                )
                counted_s = state.counted_s
                took_s = clock_s() - host_s
                next_host_s = host_s + took_s + max(LOOK_HOST_S, LOOK_SHARE * took_s)
                tell(state)
                if state.complete:
                    return
                news_s, lost_s = news_s + self.gaps_s - lost_s, self.gaps_s
                if state.found > found:
                    found, news_s = state.found, now_s
                if now_s - news_s > plan.patience_s:
                    if state.repeat_due:
                        return
                    raise NoPoses(
                        f"no new still pose for {plan.patience_s:g} s; {found} of {wanted} are there",
                        wanted=state.missing,
                    )


def _interrupted(batch: RawBatch) -> bool:
    """Whether an interruption begins: what comes after it is another stream,
    which has its own time to bring a sample."""
    return batch.gap is not None and batch.gap.to_ns is None


class _Watch:
    """Sees that one stream goes on; a device may go on sending another and
    never this one.

    The time counts from the first look: before that the driver may have been
    discarding what was sampled earlier. From one look to the next no more of it
    counts than `SILENCE_SHARE`: where this process was kept from looking,
    samples wait unread.
    """

    def __init__(self, decoded: DecodedStream, stream: str, timeout_s: float, clock_s: Callable[[], float]) -> None:
        self._decoded, self._stream, self._timeout_s, self._clock_s = decoded, stream, timeout_s, clock_s
        self._samples, self._timer = -1, StallTolerantTimer(0.0, 0.0)
        self._before: Counter[str] = Counter()

    def look(self, device: Streaming) -> None:
        """Complains to the device, and begins anew, where none came for too
        long."""
        now_s, samples = self._clock_s(), self._decoded.counts["samples"]
        if samples != self._samples:
            self._samples, self._timer = samples, StallTolerantTimer(now_s, SILENCE_SHARE * self._timeout_s)
            self._before = Counter(self._decoded.counts)
        elif self._timer.update(now_s) > self._timeout_s:
            self._samples, self._timer = -1, StallTolerantTimer(0.0, 0.0)
            what = text.no_sample(self._timeout_s, self._decoded.counts - self._before)
            device.complain(DeviceSilent(f"{self._stream}: {what}"))
