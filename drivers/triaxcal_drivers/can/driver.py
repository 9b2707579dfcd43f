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

from triaxcal_drivers.can.layout import NODES, Layout, stream_layout
from triaxcal_drivers.can.message import Message
from triaxcal_drivers.can.model import CanBus, CanProfile
from triaxcal_drivers.errors import ProfileError
from triaxcal_drivers.hints import nearest
from triaxcal_drivers.interface import EXTENDED_KEY, LineLoad, RawBatch, RawFlag, SampleBlock
from triaxcal_drivers.profile import READING_CHANNELS, Bundle
from triaxcal_drivers.timeline import Arrivals, Clockwork, Placed, Timeline, signed_steps
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


class TogetherFromBegin:
    """A sample begins with message ``begins`` and takes each other one once before
    the next begin. ``messages`` is how many a whole sample has. Messages whose begin
    was lost are a sample of their own, which is never whole; those before the first
    begin belong to none."""

    def __init__(self, messages: int, begins: int) -> None:
        self._messages, self._begins = messages, begins
        self._had: set[int] = set()
        self._begun = False

    def samples_of(self, time_ns: Ints, message: Ints) -> Ints:
        """The sample of each record, as of `TogetherInTime`; -1 for none."""
        sample = np.full(len(time_ns), -1, dtype=np.int64)
        number = 0 if self._had else -1
        for i, which in enumerate(message.tolist()):
            if which == self._begins:
                number, self._begun, self._had = number + 1, True, {which}
            elif not self._begun:
                continue
            elif not self._had or which in self._had:
                number, self._had = number + 1, {which}
            else:
                self._had.add(which)
            sample[i] = number
            if len(self._had) == self._messages:
                self._had = set()
        return sample

    @property
    def open(self) -> bool:
        """Whether the last sample still lacks messages."""
        return bool(self._had)


WAITED = 64
"""Samples that are held until such begins come: where none does, somebody else sends
the other messages."""
BEGINS = 4
"""Begins that are waited for where a message came later than half a period after its
begin: either the next begin was lost, and the message is of the next sample, or the
host was late. With more of them a device that is a tenth too fast looks as if none
were lost."""


def _mixed(time_ns: Ints, is_begin: NDArray[np.bool_], sample: Ints, period_ns: float) -> tuple[NDArray[np.bool_], int]:
    """Which samples (of parts in the order of ``sample``) may have messages of another
    one, and the first of which nobody knows yet; the number of samples without one.

    A message within half a period of its begin is of that sample. A later one is so
    too where the begins that follow come so early that none of them can be missing.
    """
    samples = int(sample[-1]) + 1 if len(sample) else 0
    mixed, unknown = np.zeros(samples, dtype=bool), samples
    begin_ns = np.full(samples, np.iinfo(np.int64).max)
    begin_ns[sample[is_begin]] = time_ns[is_begin]
    begun = np.flatnonzero(begin_ns < np.iinfo(np.int64).max)
    late = np.unique(sample[time_ns - period_ns / 2 > begin_ns[sample]])
    for number in late.tolist():
        after = begun[np.searchsorted(begun, number, side="right") :][:BEGINS]
        periods = (begin_ns[after] - begin_ns[number]) / period_ns
        if (periods < np.arange(1, len(after) + 1) + 0.5).any():
            continue
        waited = int(after[-1]) if len(after) == BEGINS else samples
        if len(after) < BEGINS and waited - number <= WAITED:
            unknown = min(unknown, number)
        else:
            mixed[number] = True
    return mixed, unknown


_EXACT = (1 << 52) - 1
"""What a float holds of a whole number, of which a longer time stamp keeps so many
bits: it wraps earlier."""


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
    whether the sample is valid, 1 where it is, then the counter and time stamp that
    one message bears), how many gaps there were up to it, and their place among all
    records of the stream. A gap before a record that is in no sample, or in one that
    is given up, is so that of the next sample."""

    time_ns: Ints
    message: Ints
    counter: Ints
    values: NDArray[np.float64]  # (columns, n), nan where the message does not hold the column
    gaps: Ints
    order: Ints

    def __getitem__(self, rows: NDArray[np.intp] | NDArray[np.bool_]) -> _Parts:
        return _Parts(
            self.time_ns[rows],
            self.message[rows],
            self.counter[rows],
            self.values[:, rows],
            self.gaps[rows],
            self.order[rows],
        )

    def __len__(self) -> int:
        return len(self.counter)

    def followed_by(self, other: _Parts) -> _Parts:
        return _Parts(
            np.concatenate([self.time_ns, other.time_ns]),
            np.concatenate([self.message, other.message]),
            np.concatenate([self.counter, other.counter]),
            np.concatenate([self.values, other.values], axis=1),
            np.concatenate([self.gaps, other.gaps]),
            np.concatenate([self.order, other.order]),
        )


@dataclass(frozen=True)
class _Firsts:
    """Of each sample the part that came first: its host time, and its place among
    all records; and how many gaps there were, and how many samples were given up, up
    to it."""

    time_ns: Ints
    order: Ints
    gaps: Ints
    given_up: Ints

    @classmethod
    def of(cls, parts: _Parts, row: Ints, rows: int) -> _Firsts:
        """``row`` is the sample of each part, of ``rows``."""
        time_ns = np.full(rows, np.iinfo(np.int64).max)
        order, gaps = time_ns.copy(), np.zeros(rows, np.int64)
        np.minimum.at(time_ns, row, parts.time_ns)
        np.minimum.at(order, row, parts.order)
        np.maximum.at(gaps, row, parts.gaps)
        return cls(time_ns, order, gaps, np.zeros(rows, np.int64))

    def __getitem__(self, rows: NDArray[np.bool_]) -> _Firsts:
        return _Firsts(self.time_ns[rows], self.order[rows], self.gaps[rows], self.given_up[rows])


class _Beside:
    """The values of messages outside the samples, as far as samples still need
    them."""

    def __init__(self, layout: Layout) -> None:
        self._first = layout.sample  # number of the first such message
        self._of: dict[int, _Parts] = {}

    def add(self, parts: _Parts) -> None:
        for number in np.unique(parts.message).tolist():
            mine = parts[parts.message == number]
            self._of[number] = self._of[number].followed_by(mine) if number in self._of else mine

    def newest(self, number: int, column: int, firsts: _Firsts, latest_s: float) -> NDArray[np.float64]:
        """The newest value of a message before each sample; nan where there is none, or
        it is older than ``latest_s``."""
        values = np.full(len(firsts.order), np.nan)
        if (held := self._of.get(number)) is None:
            return values
        at = np.searchsorted(held.order, firsts.order) - 1
        fresh = (at >= 0) & (firsts.time_ns - held.time_ns[at] <= latest_s * 1e9)
        values[fresh] = held.values[column, at[fresh]]
        return values

    def forget(self, order: int) -> None:
        """What no sample needs that begins with record ``order`` or later."""
        for number, held in self._of.items():
            at = int(np.searchsorted(held.order, order)) - 1
            if at > 0:
                self._of[number] = held[np.arange(at, len(held))]


class CanDecoder:
    """Decodes one stream of one unit.

    **Node.** Where identifiers shift with the node, or hold a source address
    (J1939), the unit is the one whose message comes first; those of others are
    passed over.

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

    **Together.** Without a counter in every message they are joined by
    `TogetherInTime` or `TogetherFromBegin`. A sample's time is that of its first
    message, or that of a counter or time stamp that one of its messages bears
    (`Timeline`). A sample that lacks messages when the next begins is given up,
    and counted ``incomplete``.

    **Multiplexed.** Of a message whose signals are multiplexed, the frames with
    another selector are passed over.

    **Beside.** Some channels come in messages outside the sample. The newest value
    before the sample's first message counts; a sample with none, or an old one,
    is left out, and counted ``incomplete``.

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
        single = [entry[:2] for entry in (layout.count, layout.stamp) if entry is not None]
        valid = [entry[:2] for entry in layout.valid]
        self._columns = (*layout.channels.values(), *valid, *single)  # message and signal of each
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
        self._held = _Parts(empty, empty, empty, np.zeros((len(self._columns), 0)), empty.astype(bool), empty)
        self._held_sample = empty  # of each part that is held, where no counter says so
        self._together: TogetherInTime | TogetherFromBegin = (
            TogetherInTime(layout.sample, self._period_ns)
            if layout.begins is None
            else TogetherFromBegin(layout.sample, layout.begins)
        )
        self._beside = _Beside(layout) if layout.latest_s else None
        self._timeline = _timeline(layout, self._period_ns)
        stamp = layout.stamp
        self._bridged_ns = 0.5e9 * stamp[2] * 2 ** min(stamp[1].length, _EXACT.bit_length()) if stamp else 0.0
        self._given_up = self._given_up_at_last = 0  # samples so far, and at the last one that was placed
        self._gaps_at_last_sample = 0  # at the last one that was placed
        self._count: int | None = None  # of the last sample that was placed
        self._placed_ns = 0  # host time of the last sample that it placed
        self._order = 0  # records of the stream so far
        self._arrived = Arrived(len(self._columns))
        self._senders = self._watched()

    def feed(self, batch: RawBatch) -> SampleBlock:
        parts, errors, malformed = self._extract(batch)
        if self._beside is not None:
            outside = parts.message >= self._layout.sample
            self._beside.add(parts[outside])
            parts = parts[~outside]
        if not len(parts):
            block = self._block(parts.time_ns, parts.counter, parts.values, _Firsts.of(parts, parts.message, 0))
            return replace(block, errors=errors, malformed=malformed)
        if not self._started:
            self._start(parts)
        if self._layout.counters:
            block = self._assemble(parts)
        elif self._layout.sample > 1:
            block = self._joined(parts)
        else:
            block = self._as_they_come(parts)
        if self._beside is not None:
            self._beside.forget(int(self._held.order.min(initial=self._order)))
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
            return Senders(self._range, by_counter, self._layout.sample)
        by_moment = partial(by_arrival, period_ns=self._period_ns)
        return Senders(self._range, by_moment, self._layout.sample)

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
                elif column < len(self._names) + len(self._layout.valid):
                    allowed = self._layout.valid[column - len(self._names)][2]
                    values[column, mine] = np.isin(signal.raw(data).astype(np.int64), allowed)
                else:
                    values[column, mine] = signal.raw(data).astype(np.int64) & _EXACT
            if self._layout.counters and number < self._layout.sample:
                counter[mine] = self._layout.counters[number].raw(data).astype(np.int64) % self._range
        gaps = self._gaps + np.cumsum((batch.flags & RawFlag.LOST_BEFORE) != 0)
        self._gaps = int(gaps[-1]) if len(gaps) else self._gaps
        order = self._order + np.arange(len(rows))
        self._order += len(rows)
        parts = _Parts(batch.time_ns[rows], message, counter, values, gaps[rows], order)
        return parts, int(bad.sum()), int(short.sum())

    def _messages(self, batch: RawBatch, usable: NDArray[np.bool_]) -> Ints:
        """Which message of the stream each record is; -1 for none."""
        key = batch.identifiers
        found = np.full(len(batch), -1, dtype=np.int64)
        node = np.zeros(len(batch), dtype=np.int64)
        for number, message in enumerate(self._layout.messages):
            above = key - message.identifier - message.extended * EXTENDED_KEY
            if message.j1939:
                bits, group = message.group
                match = (key >= EXTENDED_KEY) & (key & bits == group)
                above = key & 0xFF
            else:
                match = (above >= 1) & (above <= NODES) if message.per_node else above == 0
            if message.selected:
                match &= _selected(message, batch, match & usable)
            found[match & usable] = number
            node[match] = above[match]
        shifting = found >= 0
        shifting &= np.array([m.per_node or m.j1939 for m in self._layout.messages])[found]
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
        return self._block(
            time_ns,
            counter,
            parts.values,
            _Firsts(parts.time_ns, parts.order, parts.gaps, np.zeros(len(parts), np.int64)),
        )

    def _joined(self, parts: _Parts) -> SampleBlock:
        """Join parts to samples; parts of an incomplete sample are kept for the next
        batch."""
        # Those held back are whole, but for the last where it was open.
        before = int(self._held_sample[-1]) + 1 - self._together.open if len(self._held_sample) else 0
        joined = self._together.samples_of(parts.time_ns, parts.message)
        sample = np.concatenate([self._held_sample, before + joined[joined >= 0]])
        parts = self._held.followed_by(parts[joined >= 0])
        last = int(sample[-1]) if len(sample) else -1
        settled = last if self._together.open else last + 1
        complete = np.bincount(sample, minlength=settled)[:settled] == self._layout.sample
        if self._layout.begins is not None:
            mixed, unknown = _mixed(parts.time_ns, parts.message == self._layout.begins, sample, self._period_ns)
            settled = min(settled, unknown)
            complete = complete[:settled] & ~mixed[:settled]
        self._held, self._held_sample = parts[sample >= settled], sample[sample >= settled] - settled
        values = self._rows(parts, sample, last + 1)[:, :settled]
        time_ns = self._arrived.in_order(parts.time_ns[np.searchsorted(sample, np.arange(settled))], values)
        counter = self._settled + np.arange(settled)
        self._settled += settled
        self._last_ns = int(time_ns[-1]) if settled else self._last_ns
        firsts = _Firsts.of(parts[sample < settled], sample[sample < settled], settled)
        given_up = self._given_up + np.cumsum(~complete)
        self._given_up = int(given_up[-1]) if settled else self._given_up
        firsts = replace(firsts, given_up=given_up)[complete]
        block = self._block(time_ns[complete], counter[complete], values[:, complete], firsts)
        return replace(block, incomplete=block.incomplete + settled - int(complete.sum()))

    def _rows(self, parts: _Parts, row: Ints, rows: int) -> NDArray[np.float64]:
        """The values (columns, rows) of parts that belong to samples ``row``."""
        values = np.full((len(self._columns), rows), np.nan)
        for number in range(self._layout.sample):
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
        after_gap = np.diff(parts.gaps, prepend=self._gaps_at_last) > 0
        self._gaps_at_last = int(parts.gaps[-1])
        for i in np.flatnonzero(after_gap):
            step[i], restarted[i] = self._across(int(parts.counter[i] - before[i]), pause[i])
        # A burst of lost messages looks the same where a counter has few
        # bits: the host's time tells.
        jumps = np.flatnonzero(restarted & ~after_gap)
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
        return parts.counter * self._layout.sample + parts.message

    def _settle(self, parts: _Parts) -> SampleBlock:
        """Deliver and give up what can be, hold the rest."""
        samples, row, came = _samples_of(parts.counter)
        complete = came == self._layout.sample
        given_up = max(self._settled, self._top - self._latest)
        ahead = np.searchsorted(samples, given_up)
        whole = complete[ahead:] & (samples[ahead:] == given_up + np.arange(len(samples) - ahead))
        settled = given_up + (len(whole) if whole.all() else int(np.argmin(whole)))
        new = (samples >= self._settled) & (samples < settled)
        values = self._rows(parts, row, len(samples))
        counter = samples[new & complete]
        time_ns = self._origin_ns + np.rint((counter - self._origin) * self._period_ns).astype(np.int64)
        firsts = _Firsts.of(parts, row, len(samples))[new & complete]
        block = self._block(time_ns, counter, values[:, new & complete], firsts)
        block = replace(
            block,
            missing=settled - self._settled - int(new.sum()),
            incomplete=block.incomplete + int((new & ~complete).sum()),
        )
        self._settled = settled
        self._held = parts[parts.counter >= self._top - self._latest]
        return block

    def _block(self, time_ns: Ints, counter: Ints, values: NDArray[np.float64], firsts: _Firsts) -> SampleBlock:
        """Whole samples, with the counts of those that are left out."""
        placed, missing = None, 0
        if self._timeline is not None:
            placed = self._timeline.place(self._arrivals(values, firsts))
            time_ns, values, firsts = placed.time_ns, values[:, placed.new], firsts[placed.new]
            missing = self._missing(placed, firsts)
            counter = placed.counter if self._layout.count or not self._layout.counters else counter[placed.new]
        fresh = np.ones(len(time_ns), dtype=bool)
        for name, latest_s in self._layout.latest_s.items():
            assert self._beside is not None
            column, number = self._names.index(name), self._layout.channels[name][0]
            values[column] = self._beside.newest(number, column, firsts, latest_s)
            fresh &= ~np.isnan(values[column])
        valid = (values[len(self._names) : len(self._names) + len(self._layout.valid)] == 1).all(axis=0)
        stale, invalid = int((~fresh).sum()), int((fresh & ~valid).sum())
        if stale or invalid:
            kept = fresh & valid
            time_ns, counter, values = time_ns[kept], counter[kept], values[:, kept]
        columns = [self._names.index(name) for name in READING_CHANNELS]
        auxiliary = {n: values[i] for i, n in enumerate(self._names) if n not in READING_CHANNELS}
        readings = np.ascontiguousarray(values[columns].T)
        block = SampleBlock(time_ns, counter, readings, auxiliary, invalid=invalid, incomplete=stale)
        if placed is not None:
            repeated = len(placed.new) - int(placed.new.sum())
            block = replace(block, missing=missing, restarts=placed.restarts, duplicates=repeated)
        return block

    def _arrivals(self, values: NDArray[np.float64], firsts: _Firsts) -> Arrivals:
        """What `Timeline` places samples by."""
        count, stamp = self._layout.count, self._layout.stamp
        at = len(self._names) + len(self._layout.valid)
        counts = values[at].astype(np.int64) if count else None
        stamps = values[at + (count is not None)].astype(np.int64) if stamp else None
        elapsed = np.diff(firsts.time_ns, prepend=self._placed_ns or firsts.time_ns[:1].sum())
        after_gap = np.diff(firsts.gaps, prepend=self._gaps_at_last_sample) > 0
        if len(firsts.time_ns):
            self._placed_ns, self._gaps_at_last_sample = int(firsts.time_ns[-1]), int(firsts.gaps[-1])
        return Arrivals(
            counts,
            stamps,
            np.zeros(len(firsts.time_ns), np.int64),
            firsts.time_ns,
            after_gap | (elapsed > LATEST * self._period_ns),
            # A time stamp bridges a gap by itself, unless it may wrap within.
            after_gap & (elapsed > self._bridged_ns),
        )

    def _missing(self, placed: Placed, firsts: _Firsts) -> int:
        """Samples between those that were placed, without those that were given up."""
        if not len(placed.counter):
            return 0
        before = placed.counter[0] - 1 if self._count is None else self._count
        lost = np.diff(placed.counter, prepend=before) - 1
        known = np.diff(firsts.given_up, prepend=self._given_up_at_last)
        self._count, self._given_up_at_last = int(placed.counter[-1]), int(firsts.given_up[-1])
        return int(np.maximum(lost - known, 0).sum()) if self._layout.count else 0


def _timeline(layout: Layout, period_ns: float) -> Timeline | None:
    """What places samples by the counter or time stamp that one message bears."""
    if layout.count is None and layout.stamp is None:
        return None
    return Timeline(
        Clockwork(
            period_ns,
            layout.count[1].length if layout.count else None,
            min(layout.stamp[1].length, _EXACT.bit_length()) if layout.stamp else None,
            layout.stamp[2] * 1e9 if layout.stamp else 1.0,
        )
    )


def _selected(message: Message, batch: RawBatch, candidates: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which of the candidates are the message's frames by their selectors. One too
    short for its selector counts too: it is malformed."""
    size = max(selection.selector.size for selection in message.selected)
    rows = np.flatnonzero(candidates & (batch.length >= size))
    length = batch.length.astype(np.int64)
    starts = (np.cumsum(length) - length)[rows]
    data = np.frombuffer(batch.payload, dtype=np.uint8)[starts[:, None] + np.arange(size)]
    found = candidates & (batch.length < size)
    found[rows] = np.logical_and.reduce([selection.holds(data) for selection in message.selected])
    return found


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
        profile.require_address(bus)
        return CanDevice(profile, bus, {name: _layout(bundle, name) for name in profile.streams})

    def loads(self, bundle: Bundle, bus: CanBus) -> Mapping[str, LineLoad]:
        """Load of each stream; a message of several streams counts in the first. None
        without a bit rate, or if the bus may carry CAN FD, whose data is faster."""
        if bus.bitrate is None or not bus.classic:
            return {}
        found: dict[str, LineLoad] = {}
        counted: set[object] = set()
        for name in bundle.profile.streams:
            layout = _layout(bundle, name)
            bits = []
            for number, message in enumerate(layout.messages[: layout.sample]):
                key = message.identifier_of(bus.node_id or 0), message.extended, message.selected
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
