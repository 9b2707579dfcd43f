"""The noise of a stream at each time scale, and spans without their disturbed ends."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Bools, Floats, Ints
from triaxcal.poses.stillness.windows import Rounding, Windows

# Standard deviations of differences of neighbouring averages, learned from the
# static parts at every scale.

SCALES = (1, 2, 4, 8)
"""Numbers of windows in an average."""
ENOUGH = 12
"""Number of differences from which a standard deviation is estimated."""


@dataclass(frozen=True)
class NoiseScales:
    """Standard deviations (3,) of differences of averages: ``step`` of two over
    equally many windows, ``edge`` of one over a number of windows and its neighbour
    over four times as many. ``scatter`` is that inside a window."""

    step: dict[int, Floats]
    edge: dict[int, Floats]
    scatter: Floats

    @classmethod
    def learned(cls, w: Windows, still: Bools, rounding: Rounding, *, first: bool = False) -> NoiseScales:
        """Noise at every scale. ``rounding`` is the contribution of the output's
        steps. ``first``: most windows may still be moving.

        With wide steps most differences are zero, and a median does not show the
        variance half-way between two steps.
        """
        base = w.variance[still] if still.any() else w.variance
        scatter = np.sqrt(np.median(base, axis=0))
        quantile = 0.25 if first else 0.5
        step: dict[int, Floats] = {}
        edge: dict[int, Floats] = {}
        # Per scale: quantile of the absolute differences, at least the rounding
        # variance.
        for s in SCALES:
            share = 2 / (w.size * s)
            found = contrasts(w.mean, still, w.joined, s, s)[1]
            least = np.maximum(2 * rounding.residue, rounding.widest * share)
            step[s] = _scale(found, quantile, least, scatter**2 * share, step.get(s // 2))
            share = 1.25 / (w.size * s)
            found = contrasts(w.mean, still, w.joined, 4 * s, s)[1]
            least = np.maximum(2 * rounding.residue, rounding.widest * share)
            edge[s] = _scale(found, quantile, least, scatter**2 * share, edge.get(s // 2))
        return cls(step, edge, scatter)

    def of_edge(self, scale: int, before: int) -> Floats:
        """(3,) ``edge`` for an average over ``before`` windows, fewer than four times
        ``scale``, next to one over ``scale``."""
        return np.asarray(self.edge[scale] * np.sqrt((1 / scale + 1 / before) / (1.25 / scale)))


def _scale(differences: Floats, quantile: float, least: Floats, white: Floats, half: Floats | None) -> Floats:
    """(3,) standard deviation from a quantile of the absolute differences; with too
    few of them, from half the scale as for white noise. At least the variance
    ``least`` (3,)."""
    if len(differences) >= ENOUGH:
        # A normal variable is within 0.3186 and 0.6745 standard deviations in a
        # quarter and in half of all cases.
        sigma = np.quantile(np.abs(differences), quantile, axis=0) / {0.25: 0.31864, 0.5: 0.67449}[quantile]
    elif half is not None:
        sigma = half / np.sqrt(2)
    else:
        sigma = np.sqrt(white)
    sigma = np.maximum(sigma, np.sqrt(least))
    # An axis that hardly ever changes from window to window may still scatter
    # inside them.
    return np.asarray(np.where(sigma > 0, sigma, np.sqrt(white)))


def contrasts(values: Floats, still: Bools, joined: Bools, before: int, after: int) -> tuple[Ints, Floats]:
    """`unbroken` and the `contrast` there."""
    at = unbroken(still, joined, before, after)
    return at, contrast(values, at, before, after)


def unbroken(still: Bools, joined: Bools, before: int, after: int) -> Ints:
    """(k,) indices at which ``before`` windows before and ``after`` windows from
    there on are still and without a gap."""
    n = len(still)
    broken = np.ones(n + 1, dtype=bool)
    broken[1:n] = ~(still[:-1] & still[1:] & joined[1:])
    breaks = np.cumsum(broken)
    i = np.arange(before, n - after + 1)
    # Between the first and the last of them no boundary is broken; a single
    # window must be still itself.
    at = i[breaks[i + after - 1] == breaks[i - before]]
    return np.asarray(at[still[at - before]] if len(at) else at, dtype=np.int64)


def contrast(values: Floats, at: Ints, before: int, after: int) -> Floats:
    """(k,c) mean of ``values`` (n,c) over ``after`` windows from ``at`` (k,) on, less
    that of the ``before`` windows before."""
    offset = values[0] * ((after > 0) - int(before > 0))
    out = np.empty((len(at), values.shape[1]))
    for axis in range(values.shape[1]):  # one by one: a recording may last for days
        # Differences of cumulative sums.
        sums = np.concatenate([[0.0], np.cumsum(values[:, axis] - values[0, axis])])
        here = (sums[at] - sums[at - before]) / max(before, 1)
        there = (sums[at + after] - sums[at]) / max(after, 1)
        out[:, axis] = there - here + offset[axis]
    return out


# The ends of a still run: what of it belongs to the moves on either side.

SPAN_LEAST_WINDOWS = 3
"""Windows in a span: fewer have no middle that ends could differ from."""
GUARD = 1
"""Windows at either end of a run that are never used: a move may begin or end
inside one."""
EDGE_SIGMA = 3.5
"""At the ends of a run, where a false alarm costs a few windows and nothing
else."""
EVENLY = 0.1
"""The scatter of a steady tone repeats itself to less than that: a little more
of it at an end is no sign of a move."""
ONSET_SIGMA = 6.0  # standard deviations of the mean of a window, which no noise reaches
ONSET_WINDOWS = 30
"""Where the onset of a move is judged by what follows: well above the noise,
and within this reach."""


def trimmed(w: Windows, run: Ints, noise: NoiseScales) -> Ints:
    """The run without a guard window at either end, and without windows in which a
    move begins or settles."""
    # Cut the guards, or the onset of a move, at both ends.
    late, early = _onset(w, run, noise), _onset(w, run[::-1], noise)
    run = run[max(early, GUARD) : len(run) - max(late, GUARD)]
    # Then cut as long as an end differs from the middle, keeping at least half.
    for direction in (1, -1):
        least = max(len(run) // 2, 2 * SPAN_LEAST_WINDOWS)
        while len(run) > least:
            cut = _unsettled(w, run[::direction], noise)
            if not cut:
                break
            # As many again: what comes before the part that shows is smaller,
            # but the same.
            run = run[: -2 * cut] if direction == 1 else run[2 * cut :]
    return run


def _onset(w: Windows, run: Ints, noise: NoiseScales) -> int:
    """Number of windows at the end of a run that belong to the move after it, though
    noise hides it there.

    A move begins smoothly: its displacement grows as the cube of time or slower (a
    minimum-jerk path: as the cube). Two moments at which it is well above the noise
    determine when it began.
    """
    # Windows after the run, up to the next gap.
    n, way = len(run), int(run[-1] - run[-2]) if len(run) > 1 else 1
    behind = run[-1] + way * np.arange(1, ONSET_WINDOWS)
    behind = behind[(behind >= 0) & (behind < len(w))]
    broken = np.flatnonzero(~w.joined[np.maximum(behind, behind - way)])
    behind = behind[: broken[0]] if len(broken) else behind
    if n < 2 * SPAN_LEAST_WINDOWS or not len(behind):
        return 0
    # Displacement from the middle of the run, in standard deviations of a step.
    away = (w.mean[behind] - w.mean[run[n // 4 : n - n // 4]].mean(axis=0)) / noise.step[1]
    z = np.maximum.accumulate(np.abs(away).max(axis=1))
    if z[-1] < ONSET_SIGMA:
        return 0
    # The first window well above the noise, and one at four times that displacement.
    first = int(np.argmax(z >= ONSET_SIGMA))
    # A move that is there at once has no onset; what noise adds to its end is
    # none of it.
    second = int(np.argmax(z >= min(4 * z[first], 0.9 * z[-1])))
    if second <= first:
        return 0
    # The sum of displacements up to the end of a window grows as the fourth
    # power of the time since the onset.
    area = np.abs(np.cumsum(away, axis=0))[:, int(np.argmax(np.abs(away[second])))]
    ratio = min(float(area[first] / area[second]), 1.0) ** 0.25
    # Extrapolate the fourth root of the area to zero.
    began = first + 1 - (second - first) * ratio / max(1 - ratio, 1e-3)
    return int(min(max(np.ceil(-1.25 * began), 0), n // 4, SCALES[-1]))


def _unsettled(w: Windows, run: Ints, noise: NoiseScales) -> int:
    """Number of windows at the end of a run that differ from those before, in mean or
    in scatter."""
    # Slope of the middle, and the log variance relative to it.
    n = len(run)
    inner = run[n // 4 : n - n // 4]
    climb = np.zeros(3)
    if len(inner) >= 8:
        x = inner - inner.mean()
        climb = x @ w.mean[inner] / (x @ x) * np.sign(run[1] - run[0])
    # Of the logarithm, which is nearly normal also where coloured noise leaves
    # few degrees of freedom to a window.
    share = np.log((w.variance[run] / np.median(w.variance[inner], axis=0)).mean(axis=1))
    middle = share[n // 4 : n - n // 4]
    spread = max(1.4826 * float(np.median(np.abs(middle - np.median(middle)))), EVENLY)
    # A part without the usual vibration does not make the rest exceptional.
    usual = np.maximum(share[: n // 2], np.median(middle) - 5 * spread).mean()
    # Compare the last windows with four times as many before, at every scale.
    for scale in SCALES:
        before = min(4 * scale, n - scale)
        if before < 2 * scale or n < 5 * scale:
            break
        change = w.mean[run[-scale:]].mean(axis=0) - w.mean[run[-scale - before : -scale]].mean(axis=0)
        # What the middle climbs explains any part of it: whether that is a
        # creep, or the noise, one need not know.
        crept = climb * (scale + before) / 2
        change -= np.clip(change, np.minimum(crept, 0), np.maximum(crept, 0))
        if (np.abs(change) > EDGE_SIGMA * noise.of_edge(scale, before)).any():
            return scale
        excess = float(share[-scale:].mean() - usual)
        if n >= 12 and excess > EDGE_SIGMA * spread * np.sqrt(1 / scale + 2 / n):
            return scale
    return 0
