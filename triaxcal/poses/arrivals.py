"""Times of samples that came late and together: a host that stamps what it receives
sees bursts, where the unit sampled evenly.

A sample never comes before it is taken, and those behind a delayed one come soon
after it. So a pause that the samples behind it make up for is no gap: they are laid
evenly over it. In a stream of bursts the end of each corrects a line that goes on by
the sample period, as a loop filter of second order does; what stays late by more than
the bursts scatter is a gap. A stream without such pauses keeps its times.

The result depends on the times alone, not on the size of the blocks.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from triaxcal.arrays import Ints

# The sample period.

GAP = 4.0
"""Sample periods of silence after which a window, and a span, ends."""
RATE_SAMPLES = 64  # steps are taken over a quarter of them, so that bursts average out
RATE_S = 1.0
"""Samples, and duration, from which the sample period is estimated."""
RATE_LEAST = 12
"""Least samples of a shorter stream; with fewer the period is unknown and there is no
window."""


def first_period_ns(time_ns: Ints) -> float:
    """Sample period at the beginning of a stream, from lags of a quarter of the
    samples, robust against bursts and gaps."""
    time_ns = time_ns[: _until(time_ns, RATE_S, RATE_SAMPLES)]
    lag = len(time_ns) // 4
    return float(np.median(time_ns[lag:] - time_ns[:-lag])) / lag


def _until(time_ns: Ints, seconds: float, least: int) -> int:
    """Number of samples up to the first one after so many ``seconds``."""
    return max(least, int(np.searchsorted(time_ns, time_ns[0] + seconds * 1e9)) + 1)


# Bursts at the beginning of a stream.

BURSTS_S = 4.0
"""Duration from which bursts are learned: sixteen of the longest, 250 ms, whose ends
then tell the period to a percent though they scatter by a fifth."""
BURSTS_LEAST = 3
"""Pauses that make a beginning in bursts: a second has no more of 250 ms where a burst
is lost. Fewer are gaps."""
APART = 5.0
"""Steps longer than the typical pause over this part bursts; a pause may be as much
shorter than most."""
PAIRS = 1.9
"""Samples in a burst on average, from which there are any: two, less the edges."""
MANY = 3.0
"""Samples in a burst on average, from which their number need not be the same: chance
delays make pairs and singles, but not so many."""
ALIKE, ALIKE_SHARE = 0.25, 0.8
"""Deviation from the usual number that makes a burst like the others, and the share of
such bursts."""


def _typical_pause_ns(step: Ints) -> float:
    """The step in which half of the time passes: a pause where samples come in
    bursts, the period where they come evenly."""
    ordered = np.sort(step)
    passed = np.cumsum(ordered)
    return float(ordered[int(np.searchsorted(passed, passed[-1] / 2))])


def _in_bursts(time_ns: Ints) -> float:
    """The typical pause [ns] of a stream that comes in bursts; zero of another."""
    step = np.diff(time_ns)
    pause_ns = _typical_pause_ns(step)
    pauses = np.flatnonzero(step > pause_ns / APART)
    if len(pauses) < BURSTS_LEAST or len(step) < PAIRS * len(pauses):
        return 0.0
    sizes = np.diff(pauses)
    usual = float(sizes.mean())
    off = np.abs(sizes - usual)
    alike = (off < 1.0) | (off <= ALIKE * usual)
    if len(step) < MANY * len(pauses) and alike.mean() < ALIKE_SHARE:
        return 0.0
    # Most of the time passes in many pauses: in one or two, they are gaps.
    return pause_ns if step[pauses].max() < step[pauses].sum() * 2 / 3 else 0.0


STALL_S = 1.0
"""Longest pause that later samples are expected to make up for, also where the end of
the stream cuts them off."""

# The line that the ends of bursts correct.

ALPHA = 1 / 8
"""Share of its lateness by which a burst corrects the line: a delay that scatters is
averaged over some eight bursts."""
BETA = ALPHA**2 / 4
"""Share by which it corrects the period: a loop without overshoot."""
SHORTEST_S = 0.01
"""Time between two corrections, a tenth of a window: shorter bursts are taken
together."""
AHEAD = 2
"""Bursts after one that show whether it was delayed or samples are lost: a host that is
late catches up with the next, or the one after."""
ENDLESS = 2.0
"""A burst that lasts for so many of the typical pauses is none: the samples come
evenly."""
LOST = 0.75
"""Periods by which bursts without scatter stay late when a sample is lost."""
SCATTER = 6.0
"""Mean deviations of the ends of bursts beyond which a burst is late: more than any
even or normal scatter."""


@dataclass
class _Line:
    """Time [ns] of the last sample laid, and the sample period; ``scatter_ns`` is the
    mean deviation of the bursts' ends from the line, ``usual_ns`` the time of a typical
    burst."""

    last_ns: float
    period_ns: float
    scatter_ns: float
    usual_ns: float

    def late_ns(self, bursts: list[tuple[int, int]]) -> list[float]:
        """By how much each burst ends after the line; a burst is the number of its
        samples and the time at which the last one came."""
        ends = self.last_ns + self.period_ns * np.cumsum([n for n, _ in bursts])
        return [at_ns - float(end) for (_, at_ns), end in zip(bursts, ends, strict=True)]

    def lay(self, bursts: list[tuple[int, int]], *, follow: bool, last: bool) -> Ints:
        """Times of the samples of the first burst, in view of those after it. Of the
        ``last`` of a stream a part may be cut off."""
        n, late = bursts[0][0], self.late_ns(bursts)
        most_ns = GAP * self.period_ns + self.usual_ns / 2
        limit_ns = LOST * self.period_ns + min(SCATTER * self.scatter_ns, most_ns)
        begin_ns, span_ns = self.last_ns, n * self.period_ns
        if min(late) > limit_ns + last * STALL_S * 1e9:  # samples are lost
            begin_ns += min(late)
        elif follow and not last:
            error = min(max(late[0], -limit_ns), limit_ns)
            self.scatter_ns += ALPHA * (min(abs(late[0]), span_ns) - self.scatter_ns)
            self.period_ns += BETA * error / n
            # A line that runs ahead of what has come is wrong at once.
            span_ns = max(span_ns + ALPHA * error + min(late[0] + limit_ns, 0.0) / 2, span_ns / 4)
        self.last_ns = begin_ns + span_ns
        return np.rint(begin_ns + span_ns * np.arange(1, n + 1) / n).astype(np.int64)


def _line_of(bursts: list[tuple[int, int]]) -> _Line:
    """The line of the first bursts, by least squares, with the time of lost samples
    taken out."""
    count = np.cumsum([n for n, _ in bursts]).astype(float)
    end = np.array([at_ns for _, at_ns in bursts], dtype=float)
    begin_ns, end = end[0], end - end[0]
    lag = max(len(end) // 4, 1)
    period = float(np.median((end[lag:] - end[:-lag]) / (count[lag:] - count[:-lag])))
    usual = float(np.median([n for n, _ in bursts]))
    deficit = np.diff(end) - period * np.diff(count)
    lost = np.where(deficit > usual * period / 2 + GAP * period, deficit, 0.0)
    end[1:] -= np.cumsum(lost)
    if len(end) > 2:
        period = float(np.polyfit(count, end, 1)[0])
    phase = end - period * count
    middle = float(np.median(phase))
    return _Line(begin_ns + middle, period, float(np.mean(np.abs(phase - middle))), usual * period)


# Pauses in a stream that comes evenly otherwise.

MADE_UP_LEAST = 3
"""Samples that make up for a pause: a pair may be two delays by chance."""
CAUGHT_UP = 0.5
"""Periods to the even clock within which the samples have made up for a pause."""
SLOW, SLOW_LEAST = 0.9, 8
"""Samples at this many periods or more make up for nothing, once there are so many."""
LONGEST = 10.0
"""They make up for a pause within so many times as many samples as it lacks."""


BURSTS_REPORTED, SHARE_REPORTED = 8, 0.2
"""Bursts, and the share of the stream in them, from which they are reported: a few
stalls of a host are none."""
NONE = np.zeros(0, dtype=np.int64)
"""No samples."""


@dataclass
class SampleTimes:
    """Feed it the times of arrival; it returns the times at which samples were taken.

    The latest ones are held back while it depends on later ones where they belong:
    up to four seconds at the beginning, three bursts later on, and none where the
    samples come evenly.
    """

    samples: int = field(default=0, init=False)
    _held: Ints = field(default_factory=NONE.copy)
    _period_ns: float = 0.0
    _line: _Line | None = None
    _pause_ns: float = 0.0
    """The typical pause between bursts, where there are any."""
    _learned_ns: int = 0
    """Time up to which the line was learned."""
    _came_ns: int | None = None
    """Arrival of the last sample that was laid."""
    _laid_ns: int | None = None
    _together: Counter[int] = field(default_factory=Counter)
    _every_ms: Counter[int] = field(default_factory=Counter)
    _ended: bool = False

    def feed(self, time_ns: Ints) -> Ints:
        """``time_ns`` (n,) strictly increasing across calls; the times of the next
        samples in their order, as many as are settled."""
        self.samples += len(time_ns)
        time_ns = np.asarray(time_ns, dtype=np.int64)
        self._held = np.concatenate([self._held, time_ns]) if len(self._held) else time_ns
        return self._settled()

    def finish(self) -> Ints:
        """End of the stream: the times of all samples that are held."""
        self._ended = True
        return self._settled()

    def bursts(self) -> tuple[int, float] | None:
        """Samples in a burst, and seconds from one to the next, the medians; None where
        there are only a few bursts so far."""
        count = sum(self._together.values())
        if count < BURSTS_REPORTED or sum(n * k for n, k in self._together.items()) < SHARE_REPORTED * self.samples:
            return None
        return _median(self._together), _median(self._every_ms) * 1e-3

    def _settled(self) -> Ints:
        """Times of all samples that can be laid, strictly increasing."""
        laid: list[Ints] = []
        while len(self._held) and (found := self._next()) is not None:
            laid += found
        times = np.concatenate(laid) if laid else NONE
        if not len(times):
            return NONE
        before = times[0] - 1 if self._laid_ns is None else self._laid_ns
        if times[0] <= before or (np.diff(times) <= 0).any():
            index = np.arange(1, len(times) + 1)
            times = np.maximum(np.maximum.accumulate(times - index), before) + index
        self._laid_ns = int(times[-1])
        return times

    def _next(self) -> list[Ints] | None:
        """Times of the next samples; None where they depend on later ones."""
        if not self._period_ns:
            return self._learn()
        return self._evenly() if self._line is None else self._in_line(self._line)

    def _settle(self, count: int) -> None:
        if count:
            self._came_ns, self._held = int(self._held[count - 1]), self._held[count:]

    def _note(self, samples: int, every_ns: float) -> None:
        if samples > 1:
            self._together[samples] += 1
            self._every_ms[round(every_ns * 1e-6)] += 1

    def _learn(self) -> list[Ints] | None:
        """The sample period, and whether there are bursts."""
        time_ns = self._held
        if not self._ended and (len(time_ns) < RATE_SAMPLES or time_ns[-1] - time_ns[0] < RATE_S * 1e9):
            return None
        if len(time_ns) < RATE_LEAST:
            self._settle(len(time_ns))
            return [time_ns]
        if _in_bursts(time_ns[: _until(time_ns, RATE_S, RATE_SAMPLES)]):
            if not self._ended and time_ns[-1] - time_ns[0] < BURSTS_S * 1e9:
                return None
            time_ns = time_ns[: _until(time_ns, BURSTS_S, RATE_SAMPLES)]
            self._pause_ns = _in_bursts(time_ns)
        if self._pause_ns:
            ends = np.flatnonzero(np.diff(time_ns) > self._pause_ns / APART)
            sizes = np.diff(ends, prepend=-1)
            self._line = _line_of(list(zip(sizes.tolist(), time_ns[ends].tolist(), strict=True)))
            self._period_ns, self._learned_ns = self._line.period_ns, int(time_ns[-1])
        else:
            self._period_ns = first_period_ns(time_ns)
        return []

    def _in_line(self, line: _Line) -> list[Ints] | None:
        """Times of the bursts that are followed by enough others."""
        time_ns = self._held
        ends = np.flatnonzero(np.diff(time_ns) > self._pause_ns / APART)
        # The last one ends with the stream, or may go on; one that goes on for too
        # long is no burst.
        ends = np.append(ends, len(time_ns) - 1)
        begins = np.concatenate([[0], ends[:-1] + 1])
        endless = np.flatnonzero(time_ns[ends] - time_ns[begins] > ENDLESS * self._pause_ns)
        whole = int(endless[0]) if len(endless) else len(ends) - (0 if self._ended else 1)
        ends = self._apart(time_ns, ends[:whole])
        settled = len(endless) > 0 or self._ended
        bursts = list(zip(np.diff(ends, prepend=-1).tolist(), time_ns[ends].tolist(), strict=True))
        laid = []
        until = len(ends) if settled else len(ends) - AHEAD
        for i in range(until):
            at_ns = bursts[i][1]
            last = i + 1 == len(ends) and not len(endless)
            laid.append(line.lay(bursts[i : i + 1 + AHEAD], follow=at_ns > self._learned_ns, last=last))
        if until > 0:
            self._note_all(time_ns[: ends[until - 1] + 1])
            self._settle(int(ends[until - 1]) + 1)
        if len(endless):  # the stream comes evenly from now on
            self._line, self._period_ns = None, line.period_ns
            return laid
        return laid or None

    def _apart(self, time_ns: Ints, ends: Ints) -> Ints:
        """Those of the ``ends`` of bursts that are far enough apart to correct the
        line, and the last of the stream."""
        end_ns, kept, at_ns = time_ns[ends], [], self._came_ns
        while (at := 0 if at_ns is None else int(np.searchsorted(end_ns, at_ns + SHORTEST_S * 1e9))) < len(ends):
            kept.append(at)
            at_ns = int(end_ns[at])
        if len(ends) and (self._ended and (not kept or kept[-1] < len(ends) - 1)):
            kept.append(len(ends) - 1)
        return ends[kept] if kept else NONE

    def _note_all(self, time_ns: Ints) -> None:
        """The bursts that end in ``time_ns``."""
        before_ns = time_ns[0] if self._came_ns is None else self._came_ns
        ends = np.append(np.flatnonzero(np.diff(time_ns) > self._pause_ns / APART), len(time_ns) - 1)
        sizes, every = np.diff(ends, prepend=-1), np.diff(time_ns[ends], prepend=before_ns)
        for counts, values in ((self._together, sizes), (self._every_ms, np.rint(every * 1e-6).astype(int))):
            values, times = np.unique(values[(sizes > 1) & (every > 0)], return_counts=True)
            counts.update(dict(zip(values.tolist(), times.tolist(), strict=True)))

    def _evenly(self) -> list[Ints] | None:
        """Times as they are, but for those that make up for a pause."""
        time_ns, period_ns = self._held, self._period_ns
        before_ns = time_ns[0] - 1 if self._came_ns is None else self._came_ns
        step = np.diff(time_ns, prepend=before_ns)
        laid, at = [], 0
        for pause in np.flatnonzero((step > GAP * period_ns) & (step <= STALL_S * 1e9)).tolist():
            if pause < at:
                continue
            laid.append(time_ns[at:pause])
            at = pause
            arrival_ns = time_ns[pause : pause + int(LONGEST * step[pause] / period_ns)]
            before_ns = time_ns[pause] - step[pause]
            if (count := _made_up(arrival_ns - before_ns, period_ns, ended=self._ended)) is None:
                break
            laid.append(self._spread(arrival_ns[:count], int(before_ns)))
            at = pause + count
        else:
            laid.append(time_ns[at:])
            at = len(time_ns)
        self._settle(at)
        return laid if at else None

    def _spread(self, arrival_ns: Ints, before_ns: int) -> Ints:
        """Times of samples behind a pause that begins at ``before_ns``."""
        n, end_ns = len(arrival_ns), int(arrival_ns[-1])
        late_ns = end_ns - before_ns - n * self._period_ns
        slow = arrival_ns[-1] - arrival_ns[0] >= SLOW * (n - 1) * self._period_ns
        if n < MADE_UP_LEAST or slow:
            return arrival_ns
        self._note(n, end_ns - before_ns)
        lost = late_ns > (GAP + n / 2) * self._period_ns
        spacing_ns = self._period_ns if lost else (end_ns - before_ns) / n
        return np.asarray(np.rint(end_ns - spacing_ns * np.arange(n - 1, -1, -1)), dtype=np.int64)


def _made_up(elapsed_ns: Ints, period_ns: float, *, ended: bool) -> int | None:
    """Number of samples behind a pause that belong together: until they have made up
    for it, or another pause, or they come as slowly as all; one where that does not
    happen, and None where later samples decide. ``elapsed_ns`` (n,) since the pause
    began."""
    number = np.arange(1, len(elapsed_ns) + 1)
    step = np.diff(elapsed_ns)
    most = int(LONGEST * elapsed_ns[0] / period_ns)
    caught_up = elapsed_ns <= (number + CAUGHT_UP) * period_ns
    pause = np.append(step > GAP * period_ns, False)
    slow = (number >= SLOW_LEAST) & (elapsed_ns - elapsed_ns[0] >= SLOW * (number - 1) * period_ns)
    if not (decided := caught_up | pause | slow).any():
        return len(elapsed_ns) if ended else 1 if len(elapsed_ns) >= most else None
    first = int(np.argmax(decided))
    if slow[first]:
        return first + 1
    # What comes with the last of them belongs to them.
    apart = np.flatnonzero(step[first:] >= period_ns / 2)
    if len(apart):
        return first + 1 + int(apart[0])
    return len(elapsed_ns) if ended or len(elapsed_ns) >= most else None


def _median(counts: Counter[int]) -> int:
    """The lower median of numbers that are counted."""
    numbers = sorted(counts)
    passed = np.cumsum([counts[n] for n in numbers])
    return numbers[int(np.searchsorted(passed, passed[-1] / 2))]
