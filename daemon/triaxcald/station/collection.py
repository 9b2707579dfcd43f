"""The raw records of one phase, on their way to disk and down the pipelines,
until there are poses enough."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import AsyncGenerator, Callable, Sequence
from contextlib import aclosing, suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol, cast

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald import text
from triaxcald.decoded import DecodedStream
from triaxcald.errors import NoPoses, RecordingError, TwoAnswer
from triaxcald.recording.schema import Phase
from triaxcald.recording.writer import RecordingWriter
from triaxcald.schema.codes import Code, Stage
from triaxcald.station.config import Plan
from triaxcald.station.guidance import Guide, guide
from triaxcald.station.listening import RawRecords
from triaxcald.station.reconnect import Streaming
from triaxcald.station.tray import Instruction

if TYPE_CHECKING:  # a mere recording needs no metrology
    from triaxcald.station.on_demand import OnDemand

LOOK_SAMPLES_S, LOOK_HOST_S = 0.5, 0.1
"""Shortest time between two evaluations of the poses, by the samples' time and by the
host's; both have to pass."""
LOOK_SHARE = 5.0
"""Pause after an evaluation as a multiple of its duration, so that no samples get
lost."""
RESTARTED_S = 3.0
"""A second restart of a unit takes longer than this."""
SILENCE_SHARE = 0.25
"""Share of the time-out that one batch without a sample may add. A sending device
brings several batches in that time."""


DECODE_S = 1.0
"""Time for which records are collected before they are decoded, if no operator is
guided by them: the cost of a batch hardly depends on its size."""


class Progress(Protocol):
    """Receives the progress of the units of a station, as values."""

    def stage(self, unit: str, stage: Stage) -> None:
        """A stage of the work on the unit begins."""

    def note(self, unit: str, text: str) -> None:
        """A remark for people alone."""

    def lost(self, unit: str, code: Code, reason: str) -> None:
        """The unit is lost, and waited for; ``reason`` is one line."""

    def back(self, unit: str) -> None:
        """A lost unit is back."""

    def poses(self, unit: str, phase: Phase, guide: Guide) -> None:
        """State of a pose acquisition, several times a second."""

    def instruction(self, instruction: Instruction | None) -> None:
        """The next pose of the fixture that turns all units; None if no unit lacks
        one."""


@dataclass
class Recorded(RawRecords):
    """Records of a unit on their way to disk. ``streams`` are decoded meanwhile: the
    readings, and the corrected output if the device has one.

    ``where`` is the place of the unit, for messages; ``latest`` are the last values
    of the readings' other channels.
    """

    phase: Phase
    bundle: td.Bundle
    where: str
    latest: dict[str, float] = field(default_factory=dict, init=False)
    _restarted_ns: int | None = field(default=None, init=False)
    _undecoded: list[td.RawBatch] = field(default_factory=list, init=False)
    _decoded_ns: int | None = field(default=None, init=False)
    _device: Streaming | None = field(default=None, init=False)
    _writer: RecordingWriter | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.streams: dict[str, DecodedStream] = {s: self._decoded(s) for s in self._names()}

    def _names(self) -> list[str]:
        return [s for s in (td.READINGS, td.CORRECTED) if s in self.bundle.profile.streams]

    def _decoded(self, stream: str) -> DecodedStream:
        return DecodedStream(self.bundle, stream)

    def checkpoint(self) -> dict[str, Any]:
        """Checkpoint of all streams, for `roll_back`."""
        self._decode()
        return {name: stream.checkpoint() for name, stream in self.streams.items()}

    def roll_back(self, checkpoint: dict[str, Any]) -> None:
        """Return all streams to a checkpoint. No more records may follow."""
        self._undecoded = []
        for name, stream in self.streams.items():
            stream.roll_back(checkpoint[name])

    async def records(
        self, device: Streaming, writer: RecordingWriter | None, seconds: float | None = None
    ) -> AsyncGenerator[td.RawBatch]:
        """Batches from the bus, after their hand-over to the writer.

        They are decoded at once or some batches later, but at once if the readings may
        have reached ``seconds``. A batch that the writer drops is not decoded either,
        so an audit sees the same records as the station. Raises TwoAnswer if two units
        send.
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
            except BaseException:  # this error has priority over those of the remaining batches
                with suppress(RecordingError, TwoAnswer):
                    self._decode()
                raise
            self._decode()

    def _is_due(self, batch: td.RawBatch, seconds: float | None) -> bool:
        """Whether the collected batches are due for decoding."""
        if self._decoded_ns is None or not len(batch) or batch.gap is not None:
            return True
        # The host's clock may be set back: a negative time is due too.
        since_s = (int(batch.time_ns[-1]) - self._decoded_ns) * 1e-9
        if not 0 <= since_s < self._decode_s:
            return True
        if seconds is None:
            return False
        readings = self.streams[td.READINGS]
        if not readings.host_seconds:  # the rate of the unit's own time is not known yet
            return True
        rate = readings.seconds / readings.host_seconds
        return readings.seconds + max(rate, 1.0) * since_s >= seconds

    def _decode(self) -> None:
        """Decode all collected batches. Raises TwoAnswer if two units send."""
        if not self._undecoded or self._device is None:
            return
        device, writer, mixed = self._device, self._writer, None
        batch, self._undecoded = td.RawBatch.joined(self._undecoded), []
        if len(batch):
            self._decoded_ns = int(batch.time_ns[-1])
        for name, decoded in self.streams.items():
            block = decoded.feed(batch)
            mixed = name if block.two_senders else mixed
            # A restart loses the settings of the opening, and it may be another unit.
            if block.restarts and self._tells_restart(batch):
                device.complain(td.DeviceRestarted(f"{self.where}: stream {name}: it has started anew"))
            if len(block) and name == td.READINGS:
                self.latest = {channel: float(values[-1]) for channel, values in block.channels.items()}
            if writer is not None and len(block):
                writer.preview("/preview/readings" if name == td.READINGS else "/preview/corrected", block)
        if mixed is not None:  # raised last: the file has the whole batch
            raise TwoAnswer(text.two_senders(self.where, mixed))

    def _tells_restart(self, batch: td.RawBatch) -> bool:
        """Whether a restart leads to a reconnection. Two units that send at once look
        like endless restarts; after one reconnection the stream continues long enough
        to detect them."""
        after_s = max(RESTARTED_S, 2 * td.two_senders.RECORDS / self.bundle.profile.sampling.rate_hz)
        now_ns, before_ns = int(batch.time_ns[-1]), self._restarted_ns
        if before_ns is not None and now_ns - before_ns < after_s * 1e9:
            return False
        self._restarted_ns = now_ns
        return True

    def _watch(self, stream: str, clock_s: Callable[[], float]) -> _Watch:
        return _Watch(self.streams[stream], f"{self.where}: stream {stream}", self._timeout_s, clock_s)

    @property
    def _timeout_s(self) -> float:
        """Twice the driver's time-out: the driver has the better error if nothing comes
        at all."""
        return 2 * self.bundle.profile.sampling.silence_timeout_s

    @property
    def _decode_s(self) -> float:
        """Time for which records are collected before decoding, short enough for the
        watch."""
        return min(DECODE_S, SILENCE_SHARE * self._timeout_s)

    async def for_seconds(
        self,
        device: Streaming,
        writer: RecordingWriter,
        seconds: float | None,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """Record ``seconds`` of the readings' own time (None: without end). A device
        that sends no complete reading is reconnected."""
        readings = self.streams[td.READINGS]
        watch = self._watch(td.READINGS, clock_s)
        async with aclosing(self.records(device, writer, seconds)) as records:
            async for batch in records:
                if _interrupted(batch):
                    watch = self._watch(td.READINGS, clock_s)
                if self._undecoded:
                    continue
                watch.look(device)
                if seconds is not None and readings.seconds >= seconds:
                    return


class Collection(Recorded):
    """`Recorded` with a search for poses, which guides the operator at once."""

    def __post_init__(self) -> None:
        from triaxcald.raw_to_poses import Pipeline  # a mere recording needs no metrology

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
        nominal_offset: Sequence[float] = (0.0, 0.0, 0.0),
        tell: Callable[[Guide], None],
        apart_from: tc.Floats | None = None,
        targets: Sequence[tc.planning.Direction] | None = None,
        on_demand: OnDemand | None = None,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """Record until ``stream`` shows ``wanted`` distinct poses, and of the readings
        the first pose once more if the plan wants it.

        ``tell`` receives the guidance. ``apart_from`` and ``targets`` as in `guide`.
        With ``on_demand`` as many poses are wanted as it says; while it decides,
        nothing new is told, so that the present pose is held. A device that sends no
        complete sample of ``stream`` is reconnected. Raises NoPoses if no new pose
        comes for ``plan.patience_s``, and the errors of the device's stream. A missing
        repeat alone is no error.
        """
        pipeline = self.pipelines[stream]
        looked_s, next_host_s, news_s, found = 0.0, 0.0, 0.0, 0
        lost_s = self.gaps_s  # the time of an interruption does not count as time without a pose
        counted_s: tuple[float, ...] = ()
        planned = stream == td.READINGS and apart_from is None
        if planned and targets is None:
            tc.planning.directions(wanted)  # computed once, before samples can get lost
        watch = self._watch(stream, clock_s)
        async with aclosing(self.records(device, writer)) as records:
            async for batch in records:
                if _interrupted(batch):
                    watch = self._watch(stream, clock_s)
                watch.look(device)
                now_s, host_s = pipeline.seconds, clock_s()
                if now_s - looked_s < LOOK_SAMPLES_S or host_s < next_host_s:
                    continue
                if on_demand is not None and on_demand.deciding():
                    continue
                looked_s = now_s
                state = guide(
                    pipeline.held(),
                    wanted=wanted if on_demand is None else on_demand.wanted,
                    hold_s=plan.hold_s,
                    apart_deg=plan.apart_deg,
                    now_s=now_s,
                    nominal_scale_factor=nominal_scale_factor,
                    nominal_offset=nominal_offset,
                    plan=planned,
                    repeat=plan.repeat and planned,
                    counted_s=counted_s,
                    apart_from=apart_from,
                    targets=targets,
                    best_first=on_demand is not None,
                )
                counted_s = state.counted_s
                poses = len(counted_s)
                if on_demand is not None and on_demand.is_due(state.found, poses, complete=state.complete):
                    on_demand.begin(state.found, poses, pipeline.sound_poses())
                    if on_demand.deciding():
                        continue
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
                        f"no new still pose for {plan.patience_s:g} s; {found} of {state.wanted} are there",
                        wanted=state.missing,
                    )


def _interrupted(batch: td.RawBatch) -> bool:
    """Whether an interruption begins; the stream after it gets a new time-out."""
    return batch.gap is not None and batch.gap.to_ns is None


class _Watch:
    """Detects a silent stream of a device that sends others.

    The time counts from the first look: before it the driver may have discarded old
    samples. Between two looks at most `SILENCE_SHARE` of the time-out counts, since
    samples wait unread while this process is stalled.
    """

    def __init__(self, decoded: DecodedStream, stream: str, timeout_s: float, clock_s: Callable[[], float]) -> None:
        self._decoded, self._stream, self._timeout_s, self._clock_s = decoded, stream, timeout_s, clock_s
        self._samples, self._timer = -1, td.stall_clock.StallTolerantTimer(0.0, 0.0)
        self._before: Counter[str] = Counter()

    def look(self, device: Streaming) -> None:
        """Complain to the device after a time-out without a sample, and begin anew."""
        now_s, samples = self._clock_s(), self._decoded.counts["samples"]
        if samples != self._samples:
            self._samples, self._timer = (
                samples,
                td.stall_clock.StallTolerantTimer(now_s, SILENCE_SHARE * self._timeout_s),
            )
            self._before = Counter(self._decoded.counts)
        elif self._timer.update(now_s) > self._timeout_s:
            self._samples, self._timer = -1, td.stall_clock.StallTolerantTimer(0.0, 0.0)
            what = text.no_sample(self._timeout_s, self._decoded.counts - self._before)
            device.complain(td.DeviceSilent(f"{self._stream}: {what}"))
