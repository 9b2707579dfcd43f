"""Control charts of single values: individuals with moving ranges, EWMA and CUSUM, and
the average run length of each.

Run lengths are those of independent normal values whose mean and standard deviation
are known. Charts whose centre and scatter come from the same few values signal more
often.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy import special

from triaxcal.arrays import Floats
from triaxcal.errors import InvalidData

INDIVIDUALS, RANGES = 2.66, 3.267
"""3/d2 and D4 for ranges of two values: limits of individuals and of moving ranges in
mean moving ranges (ASTM E2587)."""
D2 = 1.128
"""Mean range of two values of a normal distribution, in its standard deviations."""
RUN_OF = 8
"""Values in a row on one side of the centre (Western Electric rule 4)."""
EWMA_WEIGHT, EWMA_WIDTH = 0.2, 2.962
"""In-control average run length 500; best for shifts of about one standard deviation
(Lucas and Saccucci, Technometrics 32 (1990) 1, table 3)."""
CUSUM_REFERENCE, CUSUM_DECISION = 0.5, 5.0
"""In-control average run length 465; best for a shift of one standard deviation (Lucas
and Crosier, Technometrics 24 (1982) 199)."""
NODES = 120
"""Of the quadrature of the integral equations: ten digits for weights of 0.03 and
more, and for decision intervals up to 20."""


def mean_of(values: Floats) -> float:
    """Exact for equal values: rounding of their sum would pass for a scatter."""
    return float(values[0] + (values - values[0]).mean())


@dataclass(frozen=True)
class Individuals:
    """Control chart of single values. ``low`` … ``mr_high`` are None below two
    values; ``moving_ranges`` has one less than there are values."""

    values: Floats
    moving_ranges: Floats
    centre: float | None
    low: float | None
    high: float | None
    mr_mean: float | None
    mr_high: float | None
    outside: tuple[str | None, ...]
    """By value: `limits` or `run` for one that breaks a rule."""

    @property
    def sd(self) -> float | None:
        """Standard deviation by the mean moving range."""
        return None if self.mr_mean is None else self.mr_mean / D2


def individuals(values: Sequence[float] | Floats) -> Individuals:
    """Limits from the mean moving range of all values (n,), which drifts and steps
    widen little. NIST/SEMATECH e-Handbook of Statistical Methods, 6.3.2.2."""
    x = np.asarray(values, dtype=float)
    if len(x) < 2:
        centre = float(x[0]) if len(x) else None
        return Individuals(x, np.empty(0), centre, None, None, None, None, (None,) * len(x))
    ranges = np.abs(np.diff(x))
    centre, mean = mean_of(x), float(ranges.mean())
    low, high = centre - INDIVIDUALS * mean, centre + INDIVIDUALS * mean
    beyond = (x < low) | (x > high)
    outside: list[str | None] = []
    side, row = 0, 0
    for value, far in zip(np.sign(x - centre).astype(int).tolist(), beyond.tolist(), strict=True):
        row = row + 1 if value == side else 1
        side = value
        outside.append("limits" if far else "run" if side and row >= RUN_OF else None)
    return Individuals(x, ranges, centre, low, high, mean, RANGES * mean, tuple(outside))


@dataclass(frozen=True)
class Ewma:
    """Exponentially weighted moving averages ``statistic`` (n,) of values, between
    ``low`` (n,) and ``high`` (n,). ``signals`` are indices of those outside;
    ``run_length`` is the in-control average run length."""

    centre: float
    sd: float
    weight: float
    width: float
    statistic: Floats
    low: Floats
    high: Floats
    signals: tuple[int, ...]
    run_length: float


def ewma(
    values: Sequence[float] | Floats,
    centre: float,
    sd: float,
    *,
    weight: float = EWMA_WEIGHT,
    width: float = EWMA_WIDTH,
    exact_limits: bool = False,
) -> Ewma:
    """zᵢ = λ xᵢ + (1 − λ) zᵢ₋₁ from z₀ = ``centre``, with λ = ``weight``, and limits at
    ``width`` standard deviations of z: of a long series, or with ``exact_limits`` of
    each i, which are tighter at first. ``sd`` is that of a value. NIST/SEMATECH
    e-Handbook, 6.3.2.4. Raises InvalidData."""
    x = np.asarray(values, dtype=float)
    if not (sd > 0 and 0 < weight <= 1):
        raise InvalidData("ewma: expected a positive sd, and a weight above 0 and at most 1")
    z = np.empty(len(x))
    at = centre
    for i, value in enumerate(x.tolist()):
        at = weight * value + (1 - weight) * at
        z[i] = at
    share = 1 - (1 - weight) ** (2 * np.arange(1, len(x) + 1)) if exact_limits else np.ones(len(x))
    reach = width * sd * np.sqrt(weight / (2 - weight) * share)
    signals = np.flatnonzero(np.abs(z - centre) > reach)
    return Ewma(
        centre, sd, weight, width, z, centre - reach, centre + reach, tuple(signals.tolist()),
        ewma_run_length(weight, width),
    )  # fmt: skip


@dataclass(frozen=True)
class Cusum:
    """Cumulative sums ``high`` and ``low`` (n,) of what exceeds the ``reference`` above
    and below the centre, both in standard deviations and never negative. ``signals``
    are indices of sums above ``decision``. ``since`` has for each signal the index of
    the first value that its sum counts: an estimate of when the mean moved.
    ``run_length`` is the in-control average run length."""

    centre: float
    sd: float
    reference: float
    decision: float
    high: Floats
    low: Floats
    signals: tuple[int, ...]
    since: tuple[int, ...]
    run_length: float


def cusum(
    values: Sequence[float] | Floats,
    centre: float,
    sd: float,
    *,
    reference: float = CUSUM_REFERENCE,
    decision: float = CUSUM_DECISION,
    restart: bool = False,
) -> Cusum:
    """Two-sided tabular CUSUM; ``reference`` and ``decision`` (k and h of the
    literature) are in standard deviations. ``restart`` sets both sums to zero after a
    signal, so that each signal is one shift. NIST/SEMATECH e-Handbook, 6.3.2.3. Raises
    InvalidData."""
    if not (sd > 0 and reference > 0 and decision > 0):
        raise InvalidData("cusum: expected a positive sd, reference and decision")
    scaled = (np.asarray(values, dtype=float) - centre) / sd
    high, low = np.empty(len(scaled)), np.empty(len(scaled))
    signals, since = [], []
    above = below = 0.0
    above_since = below_since = 0
    for i, value in enumerate(scaled.tolist()):
        above_since = i if above <= 0 else above_since
        below_since = i if below <= 0 else below_since
        above, below = max(0.0, above + value - reference), max(0.0, below - value - reference)
        high[i], low[i] = above, below
        if above > decision or below > decision:
            signals.append(i)
            since.append(above_since if above > decision else below_since)
            if restart:
                above = below = 0.0
    return Cusum(
        centre, sd, reference, decision, high, low, tuple(signals), tuple(since), cusum_run_length(reference, decision)
    )


# Average run lengths.


@cache
def individuals_run_length(shift: float = 0.0, width: float = 3.0, run_of: int | None = RUN_OF) -> float:
    """Average number of values until one is ``width`` standard deviations from the
    centre, or the last of ``run_of`` in a row on one side of it (None: no such rule).
    ``shift`` of the mean is in standard deviations. By the Markov chain of the number
    in a row (Champ and Woodall, Technometrics 29 (1987) 393)."""
    above = float(special.ndtr(width - shift) - special.ndtr(-shift))
    below = float(special.ndtr(-shift) - special.ndtr(-width - shift))
    if run_of is None:
        return 1 / (1 - above - below)
    # States: none yet, then 1 … run_of − 1 in a row above, and as many below.
    most = run_of - 1
    step = np.zeros((2 * most + 1, 2 * most + 1))
    step[:, 1] += above
    step[:, most + 1] += below
    for i in range(1, most + 1):
        step[i, 1] -= above
        step[most + i, most + 1] -= below
        if i < most:
            step[i, i + 1] += above
            step[most + i, most + i + 1] += below
    return float(np.linalg.solve(np.eye(len(step)) - step, np.ones(len(step)))[0])


@cache
def ewma_run_length(weight: float, width: float, shift: float = 0.0) -> float:
    """Average run length from z₀ = centre with the limits of a long series: the
    integral equation of Crowder (Technometrics 29 (1987) 401), by Gauss–Legendre
    quadrature."""
    if weight == 1.0:
        return individuals_run_length(shift, width, None)
    limit = width * math.sqrt(weight / (2 - weight))
    nodes, weights = np.polynomial.legendre.leggauss(_nodes(2 * limit / weight))
    at, weights = limit * nodes, limit * weights

    def kernel(start: Floats) -> Floats:
        moved = (at[None, :] - (1 - weight) * start[:, None]) / weight - shift
        return np.asarray(weights * _density(moved) / weight)

    inside = np.linalg.solve(np.eye(len(at)) - kernel(at), np.ones(len(at)))
    return float(1 + (kernel(np.zeros(1)) @ inside)[0])


@cache
def cusum_run_length(reference: float, decision: float, shift: float = 0.0, head_start: float = 0.0) -> float:
    """Average run length of the two-sided CUSUM from sums of ``head_start``: that of
    the two one-sided ones combined (Lucas and Crosier, Technometrics 24 (1982) 199),
    which is exact where both cannot be near a signal at once."""
    up, up_head = (one_sided_run_length(reference, decision, shift, head) for head in (0.0, head_start))
    down, down_head = (one_sided_run_length(reference, decision, -shift, head) for head in (0.0, head_start))
    return (up_head * down + up * down_head - up * down) / (up + down)


@cache
def one_sided_run_length(reference: float, decision: float, shift: float = 0.0, head_start: float = 0.0) -> float:
    """Average run length of a one-sided CUSUM: the integral equation of Page, by Gauss
    and Legendre (Vance, Journal of Quality Technology 18 (1986) 188)."""
    nodes, weights = np.polynomial.legendre.leggauss(_nodes(decision))
    at, weights = decision * (nodes + 1) / 2, decision * weights / 2
    start = np.concatenate([[0.0, head_start], at])
    # L(u) = 1 + L(0) P(sum ≤ 0) + ∫ L(y) φ(y + k − u − shift) dy, first of u = 0.
    system = np.eye(len(start))
    system[:, 0] -= special.ndtr(reference - start - shift)
    system[:, 2:] -= weights * _density(at[None, :] + reference - start[:, None] - shift)
    return float(np.linalg.solve(system, np.ones(len(start)))[1])


def _nodes(span: float) -> int:
    """For an interval of so many standard deviations of one step."""
    return min(max(NODES, math.ceil(4 * span)), 800)


def _density(x: Floats) -> Floats:
    return np.asarray(np.exp(-0.5 * x * x) / math.sqrt(2 * math.pi))
