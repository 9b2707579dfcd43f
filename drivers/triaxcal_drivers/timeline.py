"""Wrapping counters and time stamps of a device laid on one line that never
goes back.

Host time is not used to tell how often a counter wrapped: it says when a reply
came, not when a sample was taken, and a simulated device may run many times
faster than the host's clock. It is used where the device gives nothing else:
for the first sample, and to bridge a restart.

A restart is seen where the time stamp goes back or contradicts the counter;
without a time stamp, where the counter is near zero again after failed
requests, or has gone on much further than the host's time allows
(`FASTEST`). A gap that the host knows of, in which it lost the device, is treated
alike. The first sample after it follows the last one before by the time
between their arrivals, at least one period. The counter goes on by one: what
was lost is not known.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

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
            ticks = signed_steps(a.stamp, last_stamp, self._clock.stamp_bits or 64)
            at_start = a.broken & (a.stamp * self._clock.tick_ns < near)
            passed_ns = ticks * self._clock.tick_ns
            too_far = passed_ns < -self._clock.repeat_window * self._clock.period_ns
            # A stamp near its wrap that begins anew looks as if it had gone on.
            too_fast = passed_ns > FASTEST * np.maximum(elapsed_ns, 0) + near
            return ticks, ticks.copy(), (ticks < 0) & (at_start | too_far) | too_fast
        assert a.counter is not None
        modulus = 1 << (self._clock.counter_bits or 16)
        steps = np.diff(a.counter, prepend=last_counter) % modulus
        if a.stamp is None:
            near_steps = min(round(near / self._clock.period_ns), modulus // 8)
            restart = a.broken & (a.counter < near_steps) & (steps >= near_steps)
            steps = np.where(steps >= modulus - self._clock.repeat_window, steps - modulus, steps)
            restart |= steps * self._clock.period_ns > FASTEST * np.maximum(elapsed_ns, 0) + near
            return steps, no_ticks, restart
        ticks = signed_steps(a.stamp, last_stamp, self._clock.stamp_bits or 64)
        by_stamp = ticks * (self._clock.tick_ns / self._clock.period_ns)
        steps = steps + (np.rint((by_stamp - steps) / modulus) * modulus).astype(np.int64)
        contradicts = np.abs(by_stamp - steps) > 2 + 0.05 * np.abs(by_stamp)
        at_start = (steps < 0) & a.broken & (a.stamp * self._clock.tick_ns < near)
        too_fast = ticks * self._clock.tick_ns > FASTEST * np.maximum(elapsed_ns, 0) + near
        return steps, ticks, contradicts | at_start | too_fast | (steps < -self._clock.repeat_window)

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


def signed_steps(raw: Int64, last: int, bits: int) -> Int64:
    """Of each number (n,), which wraps at 2^``bits``, to the one before it, the
    shorter way round."""
    with np.errstate(over="ignore"):
        steps = np.diff(raw, prepend=np.int64(last))
    if bits >= 64:
        return steps
    half = 1 << (bits - 1)
    return ((steps + half) & ((1 << bits) - 1)) - half
