"""Samples that are missing by the time stamps alone."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from triaxcal.arrays import Floats, Ints

OFF_LATTICE = 0.2
"""Time stamps of an even clock: steps within this many periods of a whole
number of them."""
EVEN_SHARE = 0.95
"""Of steps that are whole periods, from which on the clock is even: a few may
be late."""
EVEN_LEAST = 0.4
"""Median step over the average period below which samples come in bursts: half
of the steps lie within one then, and say nothing of the period."""
BESIDE = 64
"""Samples on each side of a gap whose earliest stamps are compared: more find a
prompter one, but two gaps within them count as one."""
SHIFT_LEAST = 0.75
"""Of uneven time stamps, a gap is what shifts all that follow by so many
periods."""
LONG = 3.5
"""Periods: of uneven stamps only steps above three are looked at, since late
ones make others."""


@dataclass
class Gaps:
    """Counts what is missing between samples. Fed chunks of the stream; judges
    a step when what follows it is known."""

    missing: int = 0
    gaps: int = 0
    longest: int = 0
    first_ns: int = 0
    _held: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    _judged: int = 0

    def feed(self, time_ns: Ints, *, last: bool = False) -> None:
        """``time_ns`` (n,) of the samples that follow; ``last``: no more come."""
        held = np.concatenate([self._held, time_ns])
        until = len(held) if last else len(held) - BESIDE
        if len(held) >= 3 and until > self._judged:
            self._judge(held, until)
        keep = max(0, len(held) - 2 * BESIDE)
        self._held, self._judged = held[keep:].copy(), max(until, self._judged) - keep

    def _judge(self, time_ns: Ints, until: int) -> None:
        step = np.diff(time_ns).astype(float)
        lag = max(len(step) // 2, 1)  # over many bursts, if there are any
        average, period = float(np.median(time_ns[lag:] - time_ns[:-lag])) / lag, float(np.median(step))
        if period < EVEN_LEAST * average:  # they come in bursts
            period = average
        ratio = step / period
        even = np.mean((np.abs(ratio - np.rint(ratio)) < OFF_LATTICE) & (ratio > 0.5)) >= EVEN_SHARE
        lost = np.rint(ratio) - 1 if even else _shifts((time_ns - time_ns[0]) / average, ratio)
        for i in range(self._judged, min(until, len(step))) if (lost >= 1).any() else ():
            if lost[i] >= 1:
                self._add(int(lost[i]), int(time_ns[i]))

    def _add(self, lost: int, at_ns: int) -> None:
        if not self.gaps:
            self.first_ns = at_ns
        self.gaps += 1
        self.missing += lost
        self.longest = max(self.longest, lost)


def _shifts(periods: Floats, ratio: Floats) -> Floats:
    """(n-1,) whole periods by which each long step shifts the clock for good:
    samples that are only late catch up. ``periods`` (n,) are the times in
    average periods.
    """
    late = periods - np.arange(len(periods))
    lost = np.zeros(len(ratio))
    # The average period is off by a burst in half of all samples.
    least = SHIFT_LEAST + BESIDE * float(np.quantile(ratio, 0.99)) / max(len(ratio) // 2, 1)
    clear = np.ones(len(ratio), dtype=bool)
    long = np.flatnonzero(ratio > LONG)
    for i in long[np.argsort(-ratio[long], kind="stable")]:
        if not clear[i]:
            continue
        before, after = late[max(0, i - BESIDE) : i + 1], late[i + 1 : i + 1 + BESIDE]
        if min(len(before), len(after)) >= BESIDE // 4:
            # Delays only add: the earliest of each side is nearest to the
            # truth.
            shift = float(after.min() - before.min())
            lost[i] = np.rint(shift) if shift > least else 0.0
        if lost[i]:  # seen from the steps beside it too
            clear[max(0, i - 2 * BESIDE) : i + 2 * BESIDE] = False
    return lost
