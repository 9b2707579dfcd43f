"""Replies of a Modbus device as samples. Pure: raw batches in, samples out."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from triaxcal_drivers.interface import RawBatch, RawFlag, SampleBlock
from triaxcal_drivers.modbus.model import (
    READING_CHANNELS,
    Channel,
    Counter,
    FifoStream,
    ModbusProfile,
    Order,
    PollStream,
    TimeStamp,
    words_of,
)
from triaxcal_drivers.registers import TYPES
from triaxcal_drivers.two_senders import Senders, by_counter, by_levels

# Wrapping counters and time stamps of a device laid on one line that never goes
# back.

Int64 = NDArray[np.int64]
NEAR_START_S = 10.0
"""A device that restarted is heard again within this time of its own."""
FASTEST = 100.0
"""A counter that went on so many times as fast as the rate, and by more than
`NEAR_START_S`, has started anew. Simulated devices run at up to sixty times."""


@dataclass(frozen=True)
class Clockwork:
    """What a stream's samples carry. ``repeat_window``: so many samples may
    come again after a repeated reply.

    ``counted``: without a counter, samples follow one another at the period;
    else they are placed by arrival.
    """

    period_ns: float
    counter_bits: int | None
    stamp_bits: int | None
    tick_ns: float = 1.0
    repeat_window: int = 1
    counted: bool = False


@dataclass(frozen=True)
class Arrivals:
    """Samples in the order received. ``counter``, ``stamp`` raw (n,);
    ``skipped`` (n,) samples known to be lost before each (for streams without a
    counter); ``arrival_ns`` (n,) host time, less the age in the FIFO;
    ``broken`` (n,) whether a request failed between the sample before and this
    one, ``after_gap`` (n,) whether the device was lost."""

    counter: Int64 | None
    stamp: Int64 | None
    skipped: Int64
    arrival_ns: Int64
    broken: NDArray[np.bool_]
    after_gap: NDArray[np.bool_]


@dataclass(frozen=True)
class Placed:
    """``new`` (n,) marks the samples that are not repeats; ``counter``,
    ``time_ns`` are of those alone."""

    new: NDArray[np.bool_]
    counter: Int64
    time_ns: Int64
    missing: int
    restarts: int = 0
    """Those that were no known gaps."""


class Timeline:
    """Places samples; the result does not depend on how they are cut into
    calls."""

    def __init__(self, clockwork: Clockwork) -> None:
        self._clock = clockwork
        self._last: tuple[int, int, int] | None = None  # raw counter, raw stamp, arrival of the last sample
        self._progress = self._newest = self._ticks = 0  # since the epoch began
        self._origin = 0  # the counter at which the epoch began
        self._next_counter = 0
        self._anchor_ns = 0
        self._newest_ns: int | None = None

    def place(self, a: Arrivals) -> Placed:
        n = len(a.arrival_ns)
        if n == 0:
            return Placed(np.zeros(0, dtype=bool), np.zeros(0, np.int64), np.zeros(0, np.int64), 0)
        elapsed_ns = np.diff(a.arrival_ns, prepend=self._last[2] if self._last else a.arrival_ns[0])
        steps, ticks, restart = self._steps(a, elapsed_ns)
        first = int(self._last is None)
        restarts = int(np.count_nonzero((restart & ~a.after_gap)[first:]))
        restart = restart | a.after_gap
        if self._last is None:
            restart[0] = True
            self._next_counter = int(a.counter[0]) if a.counter is not None else 0
        edges = np.unique(np.concatenate(([0], np.flatnonzero(restart), [n])))
        new = np.zeros(n, dtype=bool)
        counter, time_ns, missing = np.zeros(n, np.int64), np.zeros(n, np.int64), 0
        for lo, hi in pairwise(edges.tolist()):
            if restart[lo]:
                self._begin(int(a.arrival_ns[lo]), int(elapsed_ns[lo]))
                steps[lo], ticks[lo] = 1, 0
            missing += self._run(slice(lo, hi), steps, ticks, a.arrival_ns, new, counter, time_ns)
        self._last = (
            int(a.counter[-1]) if a.counter is not None else 0,
            int(a.stamp[-1]) if a.stamp is not None else 0,
            int(a.arrival_ns[-1]),
        )
        return Placed(new, counter[new], time_ns[new], missing, restarts)

    def _steps(self, a: Arrivals, elapsed_ns: Int64) -> tuple[Int64, Int64, NDArray[np.bool_]]:
        """Of each sample to the one before: samples, ticks of the time stamp,
        and whether it restarted."""
        n = len(a.arrival_ns)
        no_ticks = np.zeros(n, np.int64)
        last_counter, last_stamp, _ = self._last or (0, 0, 0)
        near = NEAR_START_S * 1e9
        if a.stamp is None and a.counter is None:
            return 1 + a.skipped, no_ticks, np.zeros(n, dtype=bool)
        if a.counter is None and a.stamp is not None:
            ticks = _signed_steps(a.stamp, last_stamp, self._clock.stamp_bits or 64)
            at_start = a.broken & (a.stamp * self._clock.tick_ns < near)
            too_far = ticks * self._clock.tick_ns < -self._clock.repeat_window * self._clock.period_ns
            return ticks, ticks.copy(), (ticks < 0) & (at_start | too_far)
        assert a.counter is not None
        modulus = 1 << (self._clock.counter_bits or 16)
        steps = np.diff(a.counter, prepend=last_counter) % modulus
        if a.stamp is None:
            near_steps = min(round(near / self._clock.period_ns), modulus // 8)
            restart = a.broken & (a.counter < near_steps) & (steps >= near_steps)
            steps = np.where(steps >= modulus - self._clock.repeat_window, steps - modulus, steps)
            restart |= steps * self._clock.period_ns > FASTEST * np.maximum(elapsed_ns, 0) + near
            return steps, no_ticks, restart
        ticks = _signed_steps(a.stamp, last_stamp, self._clock.stamp_bits or 64)
        by_stamp = ticks * (self._clock.tick_ns / self._clock.period_ns)
        steps = steps + (np.rint((by_stamp - steps) / modulus) * modulus).astype(np.int64)
        contradicts = np.abs(by_stamp - steps) > 2 + 0.05 * np.abs(by_stamp)
        at_start = (steps < 0) & a.broken & (a.stamp * self._clock.tick_ns < near)
        return steps, ticks, contradicts | at_start | (steps < -self._clock.repeat_window)

    def _begin(self, arrival_ns: int, elapsed_ns: int) -> None:
        """A new epoch: the first, or after a restart."""
        self._origin = self._next_counter
        self._progress = self._newest = -1
        self._ticks = 0
        if self._newest_ns is None:
            self._anchor_ns = arrival_ns
        else:
            self._anchor_ns = self._newest_ns + max(elapsed_ns, round(self._clock.period_ns))

    def _run(
        self,
        part: slice,
        steps: Int64,
        ticks: Int64,
        arrival_ns: Int64,
        new: NDArray[np.bool_],
        counter: Int64,
        time_ns: Int64,
    ) -> int:
        """Place the samples of one epoch, or of its part in this call; returns
        how many are missing."""
        by_stamp_alone = self._clock.counter_bits is None and self._clock.stamp_bits is not None
        progress = self._progress + np.cumsum(steps[part])
        passed = self._ticks + np.cumsum(ticks[part])
        newest = np.maximum.accumulate(np.concatenate(([self._newest], progress)))
        is_new = progress > newest[:-1]
        missing = 0
        if by_stamp_alone:
            counter[part] = self._next_counter + np.cumsum(is_new) - 1
        else:
            counter[part] = self._origin + progress
            missing = int((progress - newest[:-1] - 1)[is_new].sum())
        if self._clock.stamp_bits is not None:
            at_ns = self._anchor_ns + np.rint(passed * self._clock.tick_ns).astype(np.int64)
        elif self._clock.counter_bits is not None or self._clock.counted:
            at_ns = self._anchor_ns + np.rint(progress * self._clock.period_ns).astype(np.int64)
        else:
            at_ns = arrival_ns[part].copy()
        new[part] = is_new
        if is_new.any():
            time_ns[part] = at_ns
            chosen = np.flatnonzero(is_new) + part.start
            time_ns[chosen] = self._never_back(time_ns[chosen])
            self._newest_ns = int(time_ns[chosen[-1]])
            self._next_counter = int(counter[chosen[-1]]) + 1
        self._progress, self._newest, self._ticks = int(progress[-1]), int(newest[-1]), int(passed[-1])
        return missing

    def _never_back(self, time_ns: Int64) -> Int64:
        """Each at least 1 ns after the one before it."""
        index = np.arange(len(time_ns))
        if self._newest_ns is not None:
            time_ns = np.concatenate(([max(int(time_ns[0]), self._newest_ns + 1)], time_ns[1:]))
        return np.maximum.accumulate(time_ns - index) + index


def _signed_steps(raw: Int64, last: int, bits: int) -> Int64:
    """Differences of a wrapping number, each the shorter way round."""
    with np.errstate(over="ignore"):
        steps = np.diff(raw, prepend=np.int64(last))
    if bits >= 64:
        return steps
    half = 1 << (bits - 1)
    return ((steps + half) & ((1 << bits) - 1)) - half


Bytes = NDArray[np.uint8]


class ModbusDecoder:
    """Decodes one stream. A failed request (exception, silence, malformed
    reply) counts as an error."""

    def __init__(self, profile: ModbusProfile, stream: str) -> None:
        self._stream = profile.streams[stream]
        self._word_order: Order = profile.word_order
        self._swap_bytes = profile.byte_order == "little"
        self._period_ns = 1e9 / profile.sampling.rate_hz
        self._source = self._stream.function << 16 | self._stream.address
        self._timeline = Timeline(_clockwork(self._stream, self._period_ns))
        self._errors = self._errors_at_last = 0
        self._gaps = self._gaps_at_last = 0
        self._lost_raw: int | None = None
        self._lost = self._lost_at_last = 0
        self._senders = self._watched()

    def _watched(self) -> Senders | None:
        """By every sample of a FIFO, by the newest ones of a block that is
        polled; by stamps where there is no counter. None where there is
        neither."""
        counter, stamp = self._stream.counter, self._stream.time_stamp
        if counter and isinstance(self._stream, FifoStream):
            return Senders(1 << counter.modulus_bits, by_counter)
        if counter:
            return Senders(1 << counter.modulus_bits, partial(by_levels, period_ns=self._period_ns))
        if stamp:
            counts = 1 << min(8 * TYPES[stamp.type].size, 62)
            return Senders(counts, partial(by_levels, period_ns=stamp.unit_s * 1e9))
        return None

    def _two_senders(
        self, records: Bytes, counts: NDArray[np.int64] | None, arrival_ns: NDArray[np.int64], placed: Placed
    ) -> bool:
        if self._senders is None or counts is None:
            return False
        faults = placed.missing or placed.restarts or not placed.new.all()
        message = np.zeros(len(counts), np.int64)
        return self._senders.are_two(arrival_ns, message, counts, records.astype(np.float64), suspect=bool(faults))

    def feed(self, batch: RawBatch) -> SampleBlock:
        mine = batch.source == self._source
        failed = (batch.flags & (RawFlag.ERROR | RawFlag.INVALID) != 0) | (batch.length != 2 * self._stream.words)
        good = mine & ~failed
        starts = (np.cumsum(batch.length, dtype=np.int64) - batch.length)[good]
        data = np.frombuffer(batch.payload, dtype=np.uint8)
        replies = data[starts[:, None] + np.arange(2 * self._stream.words)]
        if self._swap_bytes:
            replies = replies.reshape(len(replies), -1, 2)[:, :, ::-1].reshape(len(replies), -1)
        host_ns = batch.time_ns[good]
        errors = np.cumsum(mine & failed)[good]
        gaps = np.cumsum((batch.flags & RawFlag.LOST_BEFORE) != 0)
        gaps_before, all_gaps = self._gaps + gaps[good], self._gaps + (int(gaps[-1]) if len(gaps) else 0)
        total = int((mine & failed).sum())
        if isinstance(self._stream, FifoStream):
            # A count past the window is no reply of this device: an error like
            # any other.
            broken = self._number(replies, self._stream.header.count) > self._stream.record_capacity
            errors, total = errors + np.cumsum(broken), total + int(broken.sum())
            replies, host_ns, errors, gaps_before = (each[~broken] for each in (replies, host_ns, errors, gaps_before))
            records, arrivals_ns, skipped, of = self._records(self._stream, replies, host_ns)
        else:
            records, arrivals_ns = replies, host_ns
            skipped, of = np.zeros(len(replies), np.int64), np.arange(len(replies))
        block = self._samples(records, arrivals_ns, skipped, self._errors + errors[of], gaps_before[of], total)
        self._errors, self._gaps = self._errors + total, all_gaps
        return block

    def _records(
        self, stream: FifoStream, replies: Bytes, host_ns: NDArray[np.int64]
    ) -> tuple[Bytes, NDArray[np.int64], NDArray[np.int64], NDArray[np.intp]]:
        """The windows' records one after the other, when each was taken by the
        host's clock, samples lost before each, and the window each is of."""
        count = self._number(replies, stream.header.count)
        inside = np.arange(stream.record_capacity) < count[:, None]
        body = replies[:, 2 * stream.record_start :].reshape(
            len(replies), stream.record_capacity, 2 * stream.record_words
        )
        of, index = np.nonzero(inside)
        behind = count[of] - 1 - index  # records taken later than this one, in the device at that moment
        if stream.header.remaining is not None:
            behind = behind + self._number(replies, stream.header.remaining)[of]
        arrival_ns = host_ns[of] - np.rint(behind * self._period_ns).astype(np.int64)
        return body[inside], arrival_ns, self._skipped(stream, replies, of), of

    def _skipped(self, stream: FifoStream, replies: Bytes, of: NDArray[np.intp]) -> NDArray[np.int64]:
        """Samples lost to overflow between each record and the one before it,
        by the device's own count."""
        if stream.header.lost is None or not len(replies):
            return np.zeros(len(of), np.int64)
        raw = self._number(replies, stream.header.lost)
        first = raw[0] if self._lost_raw is None else self._lost_raw
        lost = np.diff(raw, prepend=first) % 2**16
        lost[lost >= 2**15] = 0  # went back: the device restarted
        so_far = self._lost + np.cumsum(lost)
        self._lost_raw, self._lost = int(raw[-1]), int(so_far[-1])
        skipped = np.diff(so_far[of], prepend=self._lost_at_last)
        if len(of):
            self._lost_at_last = int(so_far[of[-1]])
        return skipped

    def _samples(
        self,
        records: Bytes,
        arrival_ns: NDArray[np.int64],
        skipped: NDArray[np.int64],
        errors_before: NDArray[np.int64],
        gaps_before: NDArray[np.int64],
        errors: int,
    ) -> SampleBlock:
        stream = self._stream
        broken = np.diff(errors_before, prepend=self._errors_at_last) > 0
        after_gap = np.diff(gaps_before, prepend=self._gaps_at_last) > 0
        if len(errors_before):
            self._errors_at_last, self._gaps_at_last = int(errors_before[-1]), int(gaps_before[-1])
        counter = (
            self._value(records, stream.counter).astype(np.int64) & (1 << stream.counter.modulus_bits) - 1
            if stream.counter
            else None
        )
        stamp = self._value(records, stream.time_stamp).astype(np.int64) if stream.time_stamp else None
        placed = self._timeline.place(
            Arrivals(
                counter,
                stamp,
                skipped,
                arrival_ns,
                broken,
                after_gap,
            )
        )
        kept = records[placed.new]
        with np.errstate(over="ignore", invalid="ignore"):  # a scale may be any
            values = {
                name: self._value(kept, channel).astype(np.float64) * channel.scale + channel.offset
                for name, channel in stream.channels.items()
            }
        return SampleBlock(
            placed.time_ns,
            placed.counter,
            np.stack([values.pop(name) for name in READING_CHANNELS], axis=1),
            values,
            missing=placed.missing,
            # A block of the newest sample is read oftener than that changes; a
            # record comes out of a FIFO once.
            duplicates=len(records) - len(kept) if isinstance(stream, FifoStream) else 0,
            errors=errors,
            restarts=placed.restarts,
            two_senders=self._two_senders(records, stamp if counter is None else counter, arrival_ns, placed),
        )

    @staticmethod
    def _number(replies: Bytes, word: int) -> NDArray[np.int64]:
        return replies[:, 2 * word].astype(np.int64) << 8 | replies[:, 2 * word + 1]

    def _value(self, records: Bytes, field: Channel | Counter | TimeStamp) -> NDArray[Any]:
        """The field's raw numbers (n,), in the field's own type."""
        words = records[:, 2 * field.word : 2 * (field.word + words_of(field.type))]
        order = (field.word_order if isinstance(field, Channel) else None) or self._word_order
        if order == "little":
            words = words.reshape(len(words), words_of(field.type), 2)[:, ::-1].reshape(words.shape)
        return TYPES[field.type].decode_all(words)


def _clockwork(stream: PollStream | FifoStream, period_ns: float) -> Clockwork:
    fifo = isinstance(stream, FifoStream)
    return Clockwork(
        period_ns,
        stream.counter.modulus_bits if stream.counter else None,
        8 * TYPES[stream.time_stamp.type].size if stream.time_stamp else None,
        stream.time_stamp.unit_s * 1e9 if stream.time_stamp else 1.0,
        stream.record_capacity if isinstance(stream, FifoStream) else 1,
        counted=fifo,
    )
