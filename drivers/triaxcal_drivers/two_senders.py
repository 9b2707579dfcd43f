"""Whether two units send side by side: by the records of a stream, and by answers
that no request explains. No I/O; all that is said follows from records and
answers alone.

**Records.** Two units with one identifier, or one address, mix two sequences of
counts. Each goes on by one at the unit's own rate, so that there are twice as
many records as either sequence has counts. One unit that loses, repeats, delays
or reorders records, or restarts, does neither: its repeats are equal in content,
its delayed records lack in the sequence that they are not in, and after a
restart the old sequence does not go on.

**Answers.** They are counted against requests: one too many shows that two units
have one address, or that another program asks the same unit.
"""

from __future__ import annotations

from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]

RECORDS = 64
"""Of one message, that are looked at: a third of a second of two units at
100 Hz. Chance does not keep up such a pattern for so long."""
SMALL = 4096
"""With fewer counts than these a sequence that a loss broke off goes on by chance
when the counter comes round: four times as many records are looked at, and one
in eight has to go over."""
BURSTS = 768
"""And so many where each unit sends several at once, as out of a FIFO: a dozen
windows of 60."""
MEMORY = 2048
"""Records of each message that are remembered, to tell a delayed repeat from
another unit's record: ten seconds of two units at 100 Hz."""
PIECE = 1024
"""Records that are taken at once, at most."""
NEAR = 8
"""Records come late by up to so many samples; sequences that are no further
apart are told by what is in them."""
ALIVE = 4
"""Sequences that are waited for: two, and what a loss in each leaves."""
SWITCHES = 8
"""So often the records go over from one sequence to the other and back. After a
loss or a restart they do so once."""
EXACT = 0.7
"""Of the steps of each sequence are by one: three in ten may be lost."""
TWICE = 1.5
"""So many records there are at least for each count: two where none is lost,
one where one unit sends."""
SHARE = 0.3
"""Of the records each sequence has at least so many."""
COVERED = 0.85
"""Of the records the two sequences explain at least so many."""
APART = 4.0
"""Levels are apart by so many times their own width."""
REPEATS = 0.2
"""So many of a sequence are equal to earlier records only where it repeats
them: with noise in them, two units' samples are not."""
COMPARED, LATE = 8, 512
"""Records to compare, and counts by which a record may be late: five seconds at
100 Hz."""
LEAST_APART_S = 1.0
"""And by more than a reply is ever late."""
SAME_SIGN = 0.95
"""Of neighbouring records without a counter differ in one direction."""


@dataclass(frozen=True)
class Records:
    """Of one message in the order in which they came: host time (n,), raw count
    (n,) of ``counts`` different ones, and their numbers (n, channels)."""

    time_ns: Ints
    counter: Ints
    values: Floats
    counts: int

    def last(self, n: int) -> Records:
        return Records(self.time_ns[-n:], self.counter[-n:], self.values[-n:], self.counts)


def by_counter(records: Records) -> bool:
    """Of a stream whose every sample is sent once: whether the last records are
    two sequences. Those before them serve to tell repeats."""
    if records.counts < SMALL:
        n = 4 * RECORDS
        windows = [(n, n // 8)]
    else:
        n = RECORDS
        windows = [(n, SWITCHES), (BURSTS, SWITCHES)]
    jumps = np.diff(records.counter[-BURSTS:]) % records.counts != 1
    if len(records.counter) < n or np.count_nonzero(jumps) < SWITCHES:
        return False
    return any(_far(records, most, switches) for most, switches in windows) or _near(records, n)


@dataclass
class _Sequence:
    """Counts that go on, at most by `NEAR` at once. ``at`` are the records of
    it, ``steps`` from each to the next."""

    last: int
    at: list[int]
    steps: list[int]


def _sequences(counter: Ints, counts: int) -> list[_Sequence]:
    """Each record goes to the sequence that it continues by the shortest step;
    one that is late or repeated goes to none, one that continues none begins
    another."""
    near = min(NEAR, counts // 8)
    found: list[_Sequence] = []
    alive: list[_Sequence] = []  # the latest continued last
    for i, count in enumerate(counter.tolist()):
        steps = [(count - s.last) % counts for s in alive]
        on = [(step, -k) for k, step in enumerate(steps) if 1 <= step <= near]
        if on:
            step, k = min(on)
            s = alive.pop(-k)
            s.last = count
            s.at.append(i)
            s.steps.append(step)
            alive.append(s)
        elif not any((-step) % counts <= near for step in steps):
            found.append(_Sequence(count, [i], []))
            alive = [*alive[1 - ALIVE :], found[-1]]
    return sorted(found, key=lambda s: -len(s.at))


def _far(records: Records, n: int, least: int) -> bool:
    """Whether the last ``n`` are sequences further apart than records are ever
    late, between which they go over ``least`` times."""
    window = records.last(n)
    n = len(window.counter)
    found = _sequences(window.counter, window.counts)[:2]
    if len(found) < 2 or len(found[0].at) + len(found[1].at) < COVERED * n:
        return False
    for s in found:
        exact = sum(step == 1 for step in s.steps)
        if len(s.at) < SHARE * n or exact < EXACT * len(s.steps):
            return False
    if n < TWICE * max(sum(s.steps) + 1 for s in found):
        return False
    whose = np.full(n, -1)
    for number, s in enumerate(found):
        whose[s.at] = number
    switches = np.count_nonzero(np.diff(whose[whose >= 0]))
    # Two that send side by side do so all the time.
    sides = [np.count_nonzero(part == number) / len(part) for part in np.array_split(whose, 4) for number in (0, 1)]
    return bool(switches >= least and min(sides) >= SHARE / 2) and not _may_repeat(records, n, found)


def _may_repeat(records: Records, n: int, sequences: list[_Sequence]) -> bool:
    """Whether one of the sequences, of the last ``n`` records, may be the other
    one's records once more, late. So it is where a fifth of them are equal in
    content to earlier ones of the same count, and until there are some to
    compare with, where the sequences are no further apart than a record is ever
    late."""
    begin = len(records.counter) - n
    content = [row.tobytes() for row in records.values]
    own = np.full(len(content), -1)
    for number, s in enumerate(sequences):
        own[begin + np.array(s.at)] = number
    same, compared = [0, 0], [0, 0]
    # What shows one number for long is equal to itself: then only the other
    # sequence is looked at.
    unlike = [{number, -1} if _is_constant([content[begin + i] for i in s.at]) else {number}
              for number, s in enumerate(sequences)]  # fmt: skip
    with_count: dict[int, set[int]] = {}
    with_content: dict[tuple[int, bytes], set[int]] = {}
    for count, row, number in zip(records.counter.tolist(), content, own.tolist(), strict=True):
        counted, held = with_count.setdefault(count, set()), with_content.setdefault((count, row), set())
        if number >= 0:
            compared[number] += bool(counted - unlike[number])
            same[number] += bool(held - unlike[number])
        counted.add(number)
        held.add(number)
    if any(s > REPEATS * c for s, c in zip(same, compared, strict=True)):
        return True
    apart = (sequences[0].last - sequences[1].last) % records.counts
    return min(apart, records.counts - apart) <= LATE and max(compared) < COMPARED


def _is_constant(content: list[bytes]) -> bool:
    return len(set(content)) < len(content) / 2


def _are_repeats(records: Records, n: int) -> bool:
    """Whether a fifth of the last ``n`` are equal to earlier ones, in content and
    count."""
    content = [row.tobytes() for row in records.values]
    if _is_constant(content[-n:]):
        return False
    seen, same = set[tuple[int, bytes]](), 0
    for i, key in enumerate(zip(records.counter.tolist(), content, strict=True)):
        same += i >= len(content) - n and key in seen
        seen.add(key)
    return same > REPEATS * n


def _near(records: Records, n: int) -> bool:
    """Two sequences so near that their records could be one sequence's, late
    and repeated: each count comes twice, soon after one another, with another
    content."""
    window = records.last(n)
    counts, near = window.counts, min(NEAR, window.counts // 8)
    reach = 2 * near + 2
    half = counts // 2
    step = (np.diff(window.counter) + half) % counts - half
    # How far the counts have come; from a restart on, by what came since.
    top = at = progress = 0
    for one in step.tolist():
        at += one
        if one < -reach:
            top = at
        elif at > top:
            progress, top = progress + at - top, at
    if n < TWICE * (progress + 1):
        return False
    contested = np.zeros(n, dtype=bool)
    for apart in range(1, min(reach, n - 1) + 1):
        twin = window.counter[apart:] == window.counter[:-apart]
        other = twin & ~_rows_equal(window.values[apart:], window.values[:-apart])
        if np.count_nonzero(twin & ~other) > SHARE * n:
            return False  # repeats
        contested[apart:] |= other
        contested[:-apart] |= other
    return bool(np.count_nonzero(contested) >= EXACT * n) and not _are_repeats(records, n)


def _rows_equal(one: Floats, other: Floats) -> NDArray[np.bool_]:
    return np.asarray(((one == other) | (np.isnan(one) & np.isnan(other))).all(axis=1))


def by_levels(records: Records, period_ns: float) -> bool:
    """Of a stream that is asked for its newest sample, where counts, or stamps,
    go on by what has passed since: whether the last `RECORDS` lie on two lines
    and go to and fro between them. ``period_ns`` is what one count is meant to
    last; a device may run faster."""
    window = records.last(RECORDS)
    n = len(window.counter)
    if n < RECORDS:
        return False
    half = window.counts // 2
    time = (window.time_ns - window.time_ns[0]) / period_ns
    ahead = (window.counter - window.counter[0] + half) % window.counts - half
    # The common rate is where the rates from record to record crowd.
    rates = []
    for lag in range(1, 5):
        passed = time[lag:] - time[:-lag]
        step = (window.counter[lag:] - window.counter[:-lag]) % window.counts
        rates.append(step[passed > 0] / passed[passed > 0])
    rate = _mode(np.concatenate(rates))
    off = (ahead - rate * time + half) % window.counts - half
    order = np.sort(off)
    gaps = np.diff(order)
    cut = int(np.argmax(gaps))
    low, high = order[: cut + 1], order[cut + 1 :]
    if min(len(low), len(high)) < SHARE * n:
        return False
    width = max(float(np.ptp(low)), float(np.ptp(high)))
    if gaps[cut] < max(APART * width, 2 * NEAR, LEAST_APART_S * 1e9 / period_ns):
        return False
    return bool(np.count_nonzero(np.diff(off > order[cut])) >= SWITCHES)


def _mode(values: Floats) -> float:
    """The middle of the shortest interval that holds a third."""
    order = np.sort(values)
    k = max(len(order) // 3, 1)
    width = order[k:] - order[:-k]
    i = int(np.argmin(width))
    return float((order[i] + order[i + k]) / 2)


def by_arrival(records: Records, period_ns: float) -> bool:
    """Of a stream without a counter: whether twice as many records come as are
    declared, every other one at its own moment of the period and with numbers
    of its own. Two units of equal outputs, or that send at one moment, cannot
    be told from one that is twice as fast."""
    window = records.last(2 * RECORDS)
    n = len(window.time_ns)
    if n < 2 * RECORDS:
        return False
    elapsed = float(window.time_ns[-1] - window.time_ns[0])
    if not 1.8 <= (n - 1) * period_ns / max(elapsed, 1.0) <= 2.2:
        return False
    # No device's period is exactly the declared one: from the first record to
    # the last of the same half.
    own_ns = float(window.time_ns[-2] - window.time_ns[0]) / (n / 2 - 1)
    # The one half of the records, and the other, each on its own moment.
    turn = np.exp(2j * np.pi * (window.time_ns - window.time_ns[0]) / own_ns)
    odd = np.arange(n) % 2 == 1
    means = [turn[~odd].mean(), turn[odd].mean()]
    apart = abs(np.angle(means[1] / means[0]))
    if min(abs(m) for m in means) < 0.9 or apart < 0.3:
        return False
    differ = window.values[1::2] - window.values[0::2][: n // 2]
    within = np.concatenate([np.diff(window.values[odd], axis=0), np.diff(window.values[~odd], axis=0)])
    for column, steps in zip(differ.T, within.T, strict=True):
        middle = float(np.median(column))
        sided = np.count_nonzero(np.sign(column) == np.sign(middle)) >= SAME_SIGN * len(column)
        if sided and abs(middle) > APART * float(np.sqrt(np.mean(steps**2))) and middle:
            return True
    return False


class Senders:
    """Remembers the last records of a stream, of so many ``messages`` a sample;
    ``judge`` is one of the functions above."""

    def __init__(self, counts: int, judge: Callable[[Records], bool], messages: int = 1) -> None:
        self._counts, self._judge, self._most = counts, judge, MEMORY * messages
        self._held: deque[tuple[Ints, Ints, Ints, Floats]] = deque()
        self._records = self._since = 0

    def are_two(self, time_ns: Ints, message: Ints, counter: Ints, values: Floats, *, suspect: bool) -> bool:
        """Takes records that came, of which number (n,) of message; ``values``
        (n, channels). Whether two units send, which is looked at only where
        something makes it ``suspect``."""
        begin = 0 if suspect else max(0, len(counter) - self._most)
        for start in range(begin, len(counter), PIECE):
            piece = slice(start, start + PIECE)
            self._take(time_ns[piece], message[piece], counter[piece], values[piece])
            if suspect and self._due and any(map(self._judge, self._messages())):
                return True
        return False

    def _take(self, time_ns: Ints, message: Ints, counter: Ints, values: Floats) -> None:
        self._held.append((time_ns, message, counter, values))
        self._records += len(counter)
        self._since += len(counter)
        while self._records - len(self._held[0][2]) >= self._most:
            self._records -= len(self._held.popleft()[2])

    @property
    def _due(self) -> bool:
        """Whether enough is new to look once more: a stream that loses records
        for hours is not looked at without end."""
        return self._since >= max(RECORDS, self._records // 4)

    def _messages(self) -> list[Records]:
        """What is remembered, of each message."""
        self._since = 0
        time_ns, message, counter, values = (np.concatenate(column) for column in zip(*self._held, strict=True))
        found = []
        for number in np.unique(message):
            mine = np.flatnonzero(message == number)[-MEMORY:]
            found.append(Records(time_ns[mine], counter[mine], values[mine], self._counts))
        return found


KeyT = TypeVar("KeyT", bound=Hashable)

OPEN_MOST = 2
"""Requests without an answer that are remembered for each key: as many late
answers explain themselves. A lost request explains one answer too many."""
KEYS_MOST = 512
"""Keys that are remembered, and answers too many that wait to be taken. A
device has fewer registers."""


@dataclass(frozen=True)
class ExtraAnswer:
    """An answer that no request explains. ``register`` is the profile's name of
    what was asked for, empty if that is unknown; ``answer`` came too many, and
    ``first`` is what had answered the request, None if nobody had asked. Raw
    register bytes of a read, else what came on the wire."""

    register: str
    answer: bytes
    first: bytes | None

    @property
    def same(self) -> bool:
        """Whether an answer came twice, byte for byte, as a line may double it.
        Else one unit alone cannot have sent both."""
        return self.first == self.answer


@dataclass(frozen=True)
class Extra(Generic[KeyT]):
    """As `ExtraAnswer`, as it came on the wire."""

    key: KeyT
    answer: bytes
    first: bytes | None


class Answers(Generic[KeyT]):
    """Requests and answers that belong together have one key."""

    def __init__(self) -> None:
        self._open: Counter[KeyT] = Counter()
        self._last: OrderedDict[KeyT, bytes] = OrderedDict()
        self._extra: list[Extra[KeyT]] = []

    def asked(self, key: KeyT) -> None:
        self._open[key] = min(self._open[key] + 1, OPEN_MOST)

        while len(self._open) > 2 * KEYS_MOST:  # requests that nothing ever answered
            del self._open[next(iter(self._open))]

    def answered(self, key: KeyT, answer: bytes, *, final: bool = True) -> None:
        """``final``: no other answer to the same request is to come, as one may
        after "busy"."""
        if self._open[key] > 0:
            self._open[key] -= final
            self._last[key] = answer
            self._last.move_to_end(key)
            while len(self._last) > KEYS_MOST:
                old, _ = self._last.popitem(last=False)
                del self._open[old]
        elif len(self._extra) < KEYS_MOST:
            self._extra.append(Extra(key, answer, self._last.get(key)))

    def was_asked(self, key: KeyT) -> bool:
        return key in self._last or self._open[key] > 0

    def take(self) -> list[Extra[KeyT]]:
        """The answers too many since the last call."""
        taken, self._extra = self._extra, []
        return taken
