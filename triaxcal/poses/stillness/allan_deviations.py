"""How averages over neighbouring windows differ where nothing moves, learned
from the stream at every scale.

The standard deviation of the difference of two neighbouring averages is √2
times the Allan deviation (IEEE Std 952, annex C). It is learned by medians, so
that the moves among the windows do not matter, and nothing is assumed of the
noise's colour.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Bools, Floats, Ints
from triaxcal.poses.stillness.quantization import Rounding
from triaxcal.poses.stillness.windows import Windows

SCALES = (1, 2, 4, 8)
"""Windows in an average."""
ENOUGH = 12
"""Differences from which a standard deviation is learned."""


@dataclass(frozen=True)
class NoiseScales:
    """Standard deviations (3,) of differences of averages: ``step`` of two over
    as many windows, ``edge`` of one over a number of windows and the one over
    four times as many beside it. ``scatter`` is that inside a window.
    """

    step: dict[int, Floats]
    edge: dict[int, Floats]
    scatter: Floats

    @classmethod
    def learned(cls, w: Windows, still: Bools, rounding: Rounding, *, first: bool = False) -> NoiseScales:
        """``rounding`` is what the step of the output adds. ``first``: most
        windows may move as yet.

        Where steps are wide, most differences are zero, and a median says
        nothing of places half-way between two steps.
        """
        base = w.variance[still] if still.any() else w.variance
        scatter = np.sqrt(np.median(base, axis=0))
        quantile = 0.25 if first else 0.5
        step: dict[int, Floats] = {}
        edge: dict[int, Floats] = {}
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
        """(3,) ``edge`` for an average over ``before`` windows beside that over
        ``scale``, fewer than four times."""
        return np.asarray(self.edge[scale] * np.sqrt((1 / scale + 1 / before) / (1.25 / scale)))


def _scale(differences: Floats, quantile: float, least: Floats, white: Floats, half: Floats | None) -> Floats:
    """From a quantile of the absolute differences; without enough of them, as
    white noise falls from half the scale. At least the variance ``least``
    (3,)."""
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
    """(k,) where ``before`` windows and the ``after`` windows behind them are
    unbroken and still: the index of the first of the latter."""
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
    """(k,c) how much the average of ``values`` (n,c) over ``after`` windows
    from ``at`` (k,) on exceeds that of the ``before`` windows before it."""
    offset = values[0] * ((after > 0) - int(before > 0))
    out = np.empty((len(at), values.shape[1]))
    for axis in range(values.shape[1]):  # one by one: a recording may last for days
        sums = np.concatenate([[0.0], np.cumsum(values[:, axis] - values[0, axis])])
        here = (sums[at] - sums[at - before]) / max(before, 1)
        there = (sums[at + after] - sums[at]) / max(after, 1)
        out[:, axis] = there - here + offset[axis]
    return out
