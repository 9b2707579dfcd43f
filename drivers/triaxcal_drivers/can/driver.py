"""The entry point ``can``, and from raw CAN records to samples: put together by
counter, or in time where no counter says so, in order, the same however the
records are cut."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from triaxcal_drivers.can.adapter import Identifier
from triaxcal_drivers.can.layout import NODES, Layout, stream_layout
from triaxcal_drivers.can.model import CanBus, CanProfile
from triaxcal_drivers.errors import ProfileError
from triaxcal_drivers.hints import nearest
from triaxcal_drivers.interface import EXTENDED_KEY, LineLoad, RawBatch, RawFlag, SampleBlock
from triaxcal_drivers.profile import READING_CHANNELS, Bundle
from triaxcal_drivers.timeline import signed_steps
from triaxcal_drivers.two_senders import Senders, by_arrival, by_counter

if TYPE_CHECKING:
    from triaxcal_drivers.can.device import CanDevice


# Raw CAN records to samples.

Ints = NDArray[np.int64]


class TogetherInTime:
    """Messages that come within half a period of a sample's first one are that
    sample, each once; the next one begins another. ``messages`` is how many a
    whole sample has."""

    def __init__(self, messages: int, period_ns: float) -> None:
        self._messages = messages
        self._half_ns = period_ns / 2
        self._had: set[int] = set()  # messages of the sample that is not whole yet
        self._start_ns = 0  # of its first one

    def samples_of(self, time_ns: Ints, message: Ints) -> Ints:
        """The sample of each record, in the order in which they came: 0 is the
        one that was left open by the records before, where there was one."""
        sample = np.zeros(len(time_ns), dtype=np.int64)
        number = 0
        for i, (at_ns, which) in enumerate(zip(time_ns.tolist(), message.tolist(), strict=True)):
            if self._had and (which in self._had or abs(at_ns - self._start_ns) > self._half_ns):
                self._had.clear()
                number += 1
            elif not self._had and i:
                number += 1
            if not self._had:
                self._start_ns = at_ns
            self._had.add(which)
            sample[i] = number
            if len(self._had) == self._messages:
                self._had.clear()
        return sample

    @property
    def open(self) -> bool:
        """Whether the last sample still lacks messages."""
        return bool(self._had)


class Arrived:
    """Times of samples at which they arrived, never back. Samples that arrived
    together, by one stamp of an adapter or a log for several, are 1 ns apart; one
    that repeats the sample before it has the same time."""

    def __init__(self, columns: int) -> None:
        self._stamp_ns = self._latest_ns = -(1 << 62)  # before any
        self._values = np.full((columns, 1), np.nan)

    def in_order(self, arrival_ns: Ints, values: NDArray[np.float64]) -> Ints:
        """``arrival_ns`` (n,), ``values`` (columns, n)."""
        if not len(arrival_ns):
            return arrival_ns
        stamp = np.concatenate([[self._stamp_ns], arrival_ns])
        held = np.concatenate([self._values, values], axis=1)
        together = np.diff(stamp) == 0
        other = ~((held[:, 1:] == held[:, :-1]) | (np.isnan(held[:, 1:]) & np.isnan(held[:, :-1]))).all(axis=0)
        time_ns = np.maximum.accumulate(np.concatenate([[self._latest_ns], arrival_ns]))
        for at in np.flatnonzero(together).tolist():
            time_ns[at + 1] = max(int(time_ns[at + 1]), int(time_ns[at]) + int(other[at]))
        # What comes next by another stamp is later than those that arrived together.
        time_ns = np.maximum.accumulate(time_ns)
        self._stamp_ns, self._latest_ns, self._values = int(stamp[-1]), int(time_ns[-1]), held[:, -1:]
        return np.asarray(time_ns[1:])


LATEST = 8
"""A message may come this many samples late; an unfinished sample is waited for
so long."""
RETURN = 32
"""A counter that goes back further than this has started anew."""
CONTRADICTS = 0.1
"""Tolerance for the length of a gap by host time and by the device's counter: no
device's rate is off by a tenth."""


@dataclass(frozen=True)
class _Parts:
    """Records that belong to the stream: host time, message number, counter,
    the values they hold (those of the channels, then for each signal that says
    whether the sample is valid, 1 where it is), and whether records were lost
    since the one before."""

    time_ns: Ints
    message: Ints
    counter: Ints
    values: NDArray[np.float64]  # (columns, n), nan where the message does not hold the column
    after_gap: NDArray[np.bool_]

    def __getitem__(self, rows: NDArray[np.intp] | NDArray[np.bool_]) -> _Parts:
        return _Parts(
            self.time_ns[rows], self.message[rows], self.counter[rows], self.values[:, rows], self.after_gap[rows]
        )

    def __len__(self) -> int:
        return len(self.counter)

    def followed_by(self, other: _Parts) -> _Parts:
        return _Parts(
            np.concatenate([self.time_ns, other.time_ns]),
            np.concatenate([self.message, other.message]),
            np.concatenate([self.counter, other.counter]),
            np.concatenate([self.values, other.values], axis=1),
            np.concatenate([self.after_gap, other.after_gap]),
        )


class CanDecoder:
    """Decodes one stream of one unit.

    **Node.** Where identifiers shift with the node, the unit is the one whose
    message comes first; those of other nodes are passed over.

    **Counter.** It is unwrapped against the record before, by the shorter way
    round. Two kinds of jump are taken for a restart of the device: backwards by
    more than `RETURN`, and forwards by more than 1/64 of the counter's range to
    a count in its first 1/256. The sample after a restart continues the
    unwrapped counter by the host time since the record before, in whole periods
    and by one at least; so time never goes backwards, and the pause counts as
    missing samples. (A restart within the last 1/64 of the range, or one whose
    first messages are not seen, cannot be told from lost samples.) After a gap
    that the receiver knows of (`RawFlag.LOST_BEFORE`) the host time since the
    record before says how often the counter wrapped meanwhile; a count that
    contradicts it by more than `CONTRADICTS` is that of a restarted device.

    **Time.** Host time of the first record, plus the periods counted since;
    host time where there is no counter.

    **Together by time.** Without a counter, messages that come within half a
    period of a sample's first one are that sample, each once; its time is that
    of the first. One that lacks messages when the next begins is given up, and
    counted ``incomplete``.

    **Samples.** One is delivered when every message of it has come and the ones
    before it are settled. One that lacks messages is given up, and counted
    ``incomplete``, once the counter is more than `LATEST` past it; one of which
    nothing came counts as ``missing``. Each message that is repeated, or comes
    after its sample was given up, counts as one duplicate. A sample of which a
    message says that it is not valid is left out, and counted ``invalid``.
    """

    def __init__(self, layout: Layout, *, rate_hz: float) -> None:
        self._layout = layout
        self._period_ns = 1e9 / rate_hz
        self._names = tuple(layout.channels)
        self._columns = (*layout.channels.values(), *layout.valid.items())  # message and signal of each
        self._sizes = [layout.size(i) for i in range(len(layout.messages))]
        self._range = 1 << layout.counter_bits
        self._latest = min(LATEST, self._range // 8)
        self._return = min(RETURN, self._range // 4)
        self._node: int | None = None
        self._started = False
        self._origin_ns = self._origin = 0  # time and unwrapped counter of the first record
        self._last_ns = self._last_raw = self._last = 0  # of the record before
        self._top = 0  # highest unwrapped counter so far
        self._restarts = 0  # that the latest records show
        self._settled = 0  # every sample below is delivered or given up
        empty = np.zeros(0, dtype=np.int64)
        self._gaps = self._gaps_at_last = 0  # seen so far, and by the record before
        self._held = _Parts(empty, empty, empty, np.zeros((len(self._columns), 0)), empty.astype(bool))
        self._together = TogetherInTime(len(layout.messages), self._period_ns)
        self._arrived = Arrived(len(self._columns))
        self._senders = self._watched()

    def feed(self, batch: RawBatch) -> SampleBlock:
        parts, errors, malformed = self._extract(batch)
        if not len(parts):
            block = self._block(parts.time_ns, parts.counter, parts.values)
            return replace(block, errors=errors, malformed=malformed)
        if not self._started:
            self._start(parts)
        if self._layout.counters:
            block = self._assemble(parts)
        elif len(self._layout.messages) > 1:
            block = self._by_time(parts)
        else:
            block = self._as_they_come(parts)
        return replace(block, errors=errors, malformed=malformed, two_senders=self._two_senders(parts, block))

    def _two_senders(self, parts: _Parts, block: SampleBlock) -> bool:
        """A counter without a fault is one unit's; only one with faults is
        looked at."""
        faults = block.missing or block.incomplete or block.duplicates or block.restarts
        return self._senders.are_two(
            parts.time_ns,
            parts.message,
            parts.counter,
            parts.values.T,
            suspect=bool(faults) or not self._layout.counters,
        )

    def _watched(self) -> Senders:
        if self._layout.counters:
            return Senders(self._range, by_counter, len(self._layout.messages))
        by_moment = partial(by_arrival, period_ns=self._period_ns)
        return Senders(self._range, by_moment, len(self._layout.messages))

    def _start(self, parts: _Parts) -> None:
        self._started = True
        first, first_ns = int(parts.counter[0]), int(parts.time_ns[0])
        self._origin_ns = self._last_ns = first_ns
        self._origin = self._last_raw = self._last = self._top = self._settled = first

    def _extract(self, batch: RawBatch) -> tuple[_Parts, int, int]:
        """Parts of samples in a batch, and the numbers of records in error and of
        records too short for their message."""
        bad = (batch.flags & (RawFlag.ERROR | RawFlag.INVALID)) != 0
        remote = (batch.flags & (RawFlag.REMOTE | RawFlag.FD)) == RawFlag.REMOTE
        message = self._messages(batch, ~bad & ~remote)
        short = (message >= 0) & (batch.length < np.array(self._sizes)[message])
        rows = np.flatnonzero((message >= 0) & ~short)
        message = message[rows]
        length = batch.length.astype(np.int64)
        starts = (np.cumsum(length) - length)[rows]
        octets = np.frombuffer(batch.payload, dtype=np.uint8)
        counter = np.zeros(len(rows), dtype=np.int64)
        values = np.full((len(self._columns), len(rows)), np.nan)
        for number, size in enumerate(self._sizes):
            mine = np.flatnonzero(message == number)
            data = octets[starts[mine, None] + np.arange(size)]
            for column, (at, signal) in enumerate(self._columns):
                if at != number:
                    continue
                if column < len(self._names):
                    values[column, mine] = signal.values(data)
                else:
                    values[column, mine] = np.isin(signal.raw(data).astype(np.int64), self._layout.valid_values)
            if self._layout.counters:
                counter[mine] = self._layout.counters[number].raw(data).astype(np.int64) % self._range
        after_gap = self._after_gap(batch, rows)
        return _Parts(batch.time_ns[rows], message, counter, values, after_gap), int(bad.sum()), int(short.sum())

    def _after_gap(self, batch: RawBatch, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Whether a gap precedes each of the records ``rows``, also if a record of
        another stream carries the flag."""
        gaps = self._gaps + np.cumsum((batch.flags & RawFlag.LOST_BEFORE) != 0)
        after = np.diff(gaps[rows], prepend=self._gaps_at_last) > 0
        self._gaps = int(gaps[-1]) if len(gaps) else self._gaps
        self._gaps_at_last = int(gaps[rows[-1]]) if len(rows) else self._gaps_at_last
        return np.asarray(after)

    def _messages(self, batch: RawBatch, usable: NDArray[np.bool_]) -> Ints:
        """Which message of the stream each record is; -1 for none."""
        key = batch.identifiers
        found = np.full(len(batch), -1, dtype=np.int64)
        node = np.zeros(len(batch), dtype=np.int64)
        for number, message in enumerate(self._layout.messages):
            above = key - message.identifier - message.extended * EXTENDED_KEY
            match = (above >= 1) & (above <= NODES) if message.per_node else above == 0
            found[match & usable] = number
            node[match] = above[match]
        shifting = found >= 0
        shifting &= np.array([m.per_node for m in self._layout.messages])[found]
        if self._node is None and shifting.any():
            self._node = int(node[np.argmax(shifting)])
        found[shifting & (node != self._node)] = -1
        return found

    def _as_they_come(self, parts: _Parts) -> SampleBlock:
        """Without a counter every message is a sample, at host time."""
        time_ns = self._arrived.in_order(parts.time_ns, parts.values)
        counter = self._settled + np.arange(len(parts))
        self._settled += len(parts)
        self._last_ns = int(time_ns[-1])
        return self._block(time_ns, counter, parts.values)

    def _by_time(self, parts: _Parts) -> SampleBlock:
        """Join parts to samples; parts of an incomplete sample are kept for the next
        batch."""
        sample = np.concatenate(
            [np.zeros(len(self._held), dtype=np.int64), self._together.samples_of(parts.time_ns, parts.message)]
        )
        parts = self._held.followed_by(parts)
        last = int(sample[-1])
        settled = last if self._together.open else last + 1
        self._held = parts[sample >= settled]
        complete = np.bincount(sample)[:settled] == len(self._layout.messages)
        values = self._rows(parts, sample, last + 1)[:, :settled]
        time_ns = self._arrived.in_order(parts.time_ns[np.searchsorted(sample, np.arange(settled))], values)
        counter = self._settled + np.arange(settled)
        self._settled += settled
        self._last_ns = int(time_ns[-1]) if settled else self._last_ns
        block = self._block(time_ns[complete], counter[complete], values[:, complete])
        return replace(block, incomplete=settled - int(complete.sum()))

    def _rows(self, parts: _Parts, row: Ints, rows: int) -> NDArray[np.float64]:
        """The values (columns, rows) of parts that belong to samples ``row``."""
        values = np.full((len(self._columns), rows), np.nan)
        for number in range(len(self._layout.messages)):
            mine = np.flatnonzero(parts.message == number)
            to = row[mine]
            for column, (at, _) in enumerate(self._columns):
                if at == number:
                    values[column, to] = parts.values[column, mine]
        return values

    def _unwrap(self, parts: _Parts) -> Ints:
        before = np.concatenate([[self._last_raw], parts.counter[:-1]])
        step = signed_steps(parts.counter, self._last_raw, self._layout.counter_bits)
        restarted = step < -self._return
        restarted |= (step > self._range // 64) & (parts.counter < self._range // 256)
        pause = np.diff(parts.time_ns, prepend=self._last_ns) / self._period_ns
        for i in np.flatnonzero(parts.after_gap):
            step[i], restarted[i] = self._across(int(parts.counter[i] - before[i]), pause[i])
        # A burst of lost messages looks the same where a counter has few
        # bits: the host's time tells.
        jumps = np.flatnonzero(restarted & ~parts.after_gap)
        self._restarts = sum(self._across(int(parts.counter[i] - before[i]), pause[i])[1] for i in jumps)
        step[restarted] = np.maximum(1, np.rint(pause[restarted]))
        unwrapped = self._last + np.cumsum(step)
        self._last_ns, self._last_raw = int(parts.time_ns[-1]), int(parts.counter[-1])
        self._last = int(unwrapped[-1])
        return unwrapped

    def _across(self, difference: int, pause: float) -> tuple[int, bool]:
        """The step over a gap of ``pause`` periods, and whether the count
        contradicts that: the device restarted in it."""
        step = difference % self._range + self._range * round((pause - difference % self._range) / self._range)
        if step < -self._latest:
            step += self._range
        return step, abs(step - pause) > max(self._return, CONTRADICTS * pause)

    def _assemble(self, raw: _Parts) -> SampleBlock:
        parts = replace(raw, counter=self._unwrap(raw))
        highest = np.maximum.accumulate(np.concatenate([[self._top], parts.counter]))
        in_time = (parts.counter >= highest[:-1] - self._latest) & (parts.counter >= self._origin)
        key, held = self._key(parts), self._key(self._held)
        duplicates = 0
        if not (in_time.all() and np.all(np.diff(key, prepend=held.max(initial=-1)) > 0)):
            fresh = np.flatnonzero(in_time)
            fresh = fresh[~np.isin(key[fresh], held)]
            fresh = fresh[np.unique(key[fresh], return_index=True)[1]]
            duplicates, parts = len(parts) - len(fresh), parts[fresh]
        self._top = int(highest[-1])
        block = self._settle(self._held.followed_by(parts))
        return replace(block, duplicates=duplicates, restarts=self._restarts)

    def _key(self, parts: _Parts) -> Ints:
        return parts.counter * len(self._layout.messages) + parts.message

    def _settle(self, parts: _Parts) -> SampleBlock:
        """Deliver and give up what can be, hold the rest."""
        samples, row, came = _samples_of(parts.counter)
        complete = came == len(self._layout.messages)
        given_up = max(self._settled, self._top - self._latest)
        ahead = np.searchsorted(samples, given_up)
        whole = complete[ahead:] & (samples[ahead:] == given_up + np.arange(len(samples) - ahead))
        settled = given_up + (len(whole) if whole.all() else int(np.argmin(whole)))
        new = (samples >= self._settled) & (samples < settled)
        values = self._rows(parts, row, len(samples))
        counter = samples[new & complete]
        time_ns = self._origin_ns + np.rint((counter - self._origin) * self._period_ns).astype(np.int64)
        block = replace(
            self._block(time_ns, counter, values[:, new & complete]),
            missing=settled - self._settled - int(new.sum()),
            incomplete=int((new & ~complete).sum()),
        )
        self._settled = settled
        self._held = parts[parts.counter >= self._top - self._latest]
        return block

    def _block(self, time_ns: Ints, counter: Ints, values: NDArray[np.float64]) -> SampleBlock:
        valid = (values[len(self._names) :] == 1).all(axis=0)
        if not valid.all():
            time_ns, counter, values = time_ns[valid], counter[valid], values[:, valid]
        columns = [self._names.index(name) for name in READING_CHANNELS]
        auxiliary = {n: values[i] for i, n in enumerate(self._names) if n not in READING_CHANNELS}
        readings = np.ascontiguousarray(values[columns].T)
        return SampleBlock(time_ns, counter, readings, auxiliary, invalid=len(valid) - int(valid.sum()))


def _samples_of(counter: Ints) -> tuple[Ints, Ints, Ints]:
    """The counts that there are, which of them each part has, and how many
    parts have it."""
    step = np.diff(counter)
    if len(counter) and np.all(step >= 0):
        begins = np.concatenate([[True], step > 0])
        first = np.flatnonzero(begins)
        return counter[first], np.cumsum(begins) - 1, np.diff(first, append=len(counter))
    return np.unique(counter, return_inverse=True, return_counts=True)


# The entry point ``can``.

STANDARD_BITS, EXTENDED_BITS = 47, 67
"""Bits of a classic frame without its data, with the three bits to the next frame and
without stuff bits (ISO 11898-1): a lower limit of the load."""


class CanDriver:
    """Devices on CAN: streams laid out by a DBC or an EDS file, registers by
    CANopen SDO."""

    profile_model = CanProfile
    bus_model = CanBus
    packages = ("can", "canopen")

    def device(self, bundle: Bundle, bus: CanBus) -> CanDevice:
        """Raises ProfileError where the profile's files do not hold what it
        names."""
        from triaxcal_drivers.can.device import CanDevice  # python-can and canopen, which no recording needs

        profile = cast(CanProfile, bundle.profile)
        return CanDevice(profile, bus, {name: _layout(bundle, name) for name in profile.streams})

    def loads(self, bundle: Bundle, bus: CanBus) -> Mapping[str, LineLoad]:
        """Load of each stream; a message of several streams counts in the first. None
        without a bit rate, or if the bus may carry CAN FD, whose data is faster."""
        if bus.bitrate is None or not bus.classic:
            return {}
        found: dict[str, LineLoad] = {}
        counted: set[Identifier] = set()
        for name in bundle.profile.streams:
            layout = _layout(bundle, name)
            bits = []
            for number, message in enumerate(layout.messages):
                key = message.identifier_of(bus.node_id), message.extended
                if key not in counted:
                    bits.append(8 * layout.size(number) + (EXTENDED_BITS if message.extended else STANDARD_BITS))
                counted.add(key)
            if bits:
                frames_per_s = len(bits) * bundle.profile.sampling.rate_hz
                frame_s = sum(bits) / len(bits) / bus.bitrate
                found[name] = LineLoad(bus.name, f"{bus.bitrate} bit/s", frames_per_s, frame_s)
        return found

    def decoder(self, bundle: Bundle, stream: str) -> CanDecoder:
        """Raises ProfileError where the profile's files do not hold what it
        names."""
        return CanDecoder(_layout(bundle, stream), rate_hz=bundle.profile.sampling.rate_hz)


def _layout(bundle: Bundle, stream: str) -> Layout:
    profile = cast(CanProfile, bundle.profile)
    if stream not in profile.streams:
        raise ProfileError(f"profile {profile.name}: no stream '{stream}'{nearest(stream, profile.streams)}")
    where = f"profile {profile.name}, streams.{stream}"
    return stream_layout(profile.streams[stream], bundle.files, where=where)
