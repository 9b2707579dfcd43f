"""How a figure is distributed over units, and whether groups of units differ: moments,
quantiles, normality, outliers, and tests that outliers do not decide."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import special

from triaxcal.arrays import Bools, Floats, Ints
from triaxcal.distributions import chi2_sf, f_sf, normal_isf
from triaxcal.population.control_charts import mean_of

QUANTILES = (0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99)
"""Of a box, its whiskers, and the tails that limits are about."""
NORMALITY_LEAST = 8
"""Values below which the distribution of the Anderson–Darling statistic is not known
(D'Agostino and Stephens, Goodness-of-Fit Techniques, 1986, table 4.9)."""
OUTLIERS_EXPECTED = 0.05
"""Values of a normal distribution of all units that pass for outliers by chance."""
MAD_TO_SD = 1.4826
"""Of a normal distribution."""
GROUP_LEAST = 3
"""Units of the smallest group whose location and scatter are compared with others."""


@dataclass(frozen=True)
class Distribution:
    """Of ``n`` values, each with an equal share. ``sd`` and ``robust_sd`` are None for
    one value; the latter is the median distance from the median, scaled to a normal
    distribution. ``quantiles`` are those of `QUANTILES`. ``normality_p`` is the
    probability of such a departure from a normal distribution by chance, None below
    `NORMALITY_LEAST` values and for equal ones; ``outliers`` are indices of values that
    a normal distribution of the others does not hold."""

    n: int
    mean: float
    sd: float | None
    median: float
    robust_sd: float | None
    quantiles: tuple[float, ...]
    normality_p: float | None
    outliers: tuple[int, ...]


def distribution(values: Floats) -> Distribution:
    """Of at least one value (n,)."""
    x = np.asarray(values, dtype=float)
    n, median = len(x), float(np.median(x))
    sd = float((x - x[0]).std(ddof=1)) if n > 1 else None
    robust = float(MAD_TO_SD * np.median(np.abs(x - median))) if n > 1 else None
    return Distribution(
        n, mean_of(x), sd, median, robust, tuple(np.quantile(x, QUANTILES).tolist()), normality_p(x),
        tuple(np.flatnonzero(outliers(x, median, robust)).tolist()),
    )  # fmt: skip


def normality_p(values: Floats) -> float | None:
    """P-value of the Anderson–Darling test with mean and standard deviation of the
    values (D'Agostino and Stephens 1986, table 4.9). None where it has none."""
    x = np.sort(np.asarray(values, dtype=float))
    n = len(x)
    sd = float((x - x[0]).std(ddof=1)) if n >= NORMALITY_LEAST else 0.0
    if not sd:
        return None
    z = (x - mean_of(x)) / sd
    rank = np.arange(1, n + 1)
    square = -n - float(np.sum((2 * rank - 1) * (special.log_ndtr(z) + special.log_ndtr(-z[::-1])))) / n
    return anderson_darling_p(square * (1 + 0.75 / n + 2.25 / n**2))


def anderson_darling_p(a: float) -> float:
    """Of the statistic A², adjusted for the number of values."""
    if a < 0.2:
        return 1 - math.exp(-13.436 + 101.14 * a - 223.73 * a**2)
    if a < 0.34:
        return 1 - math.exp(-8.318 + 42.796 * a - 59.938 * a**2)
    if a < 0.6:
        return math.exp(0.9177 - 4.279 * a - 1.38 * a**2)
    if a < 13:
        return math.exp(1.2937 - 5.709 * a + 0.0186 * a**2)
    return 0.0


def outliers(values: Floats, median: float, robust_sd: float | None) -> Bools:
    """Which values (n,) are so far from the median, in robust standard deviations, that
    `OUTLIERS_EXPECTED` of n normal values would be. None is with ``robust_sd`` zero or
    unknown."""
    n = len(values)
    if not robust_sd or n < NORMALITY_LEAST:
        return np.zeros(n, dtype=bool)
    far = float(normal_isf(OUTLIERS_EXPECTED / n / 2))
    return np.asarray(np.abs(values - median) > far * robust_sd)


@dataclass(frozen=True)
class Heterogeneity:
    """Whether ``groups`` groups of ``n`` values together differ. ``location_p`` is by
    ranks (Kruskal and Wallis, JASA 47 (1952) 583), ``scatter_p`` by distances from the
    group's median (Brown and Forsythe, JASA 69 (1974) 364); ``between_sd`` is the
    standard deviation of the groups' true means, ``share`` its share of the variance of
    a unit, 0…1; both by the medians and robust standard deviations of the groups."""

    groups: int
    n: int
    location_p: float
    scatter_p: float
    between_sd: float
    share: float


def heterogeneity(values: Floats, group: Ints) -> Heterogeneity | None:
    """Between groups of ``values`` (n,), numbered by ``group`` (n,). Groups below
    `GROUP_LEAST` values do not count; None where fewer than two are left, or all values
    are equal."""
    x, labels = np.asarray(values, dtype=float), np.asarray(group)
    _, labels, counts = np.unique(labels, return_inverse=True, return_counts=True)
    kept = counts[labels] >= GROUP_LEAST
    x = x[kept]
    if not len(x) or np.ptp(x) == 0.0:
        return None
    _, labels, counts = np.unique(labels[kept], return_inverse=True, return_counts=True)
    if len(counts) < 2:
        return None
    median, robust = _medians(x, labels, len(counts))
    scatter = _f_test_p(np.abs(x - median[labels]), labels, counts)
    between, within = _variances(median, robust, counts)
    share = between / (between + within) if between + within > 0 else 0.0
    return Heterogeneity(len(counts), len(x), _kruskal_wallis_p(x, labels, counts), scatter, math.sqrt(between), share)


def _medians(x: Floats, labels: Ints, groups: int) -> tuple[Floats, Floats]:
    """Median and robust standard deviation of each group."""

    def of(values: Floats) -> Floats:
        order = np.lexsort((values, labels))
        bounds = np.searchsorted(labels[order], np.arange(groups + 1))
        parts = [values[order[a:b]] for a, b in pairwise(bounds.tolist())]
        return np.array([(p[(len(p) - 1) // 2] + p[len(p) // 2]) / 2 for p in parts])

    median = of(x)
    return median, MAD_TO_SD * of(np.abs(x - median[labels]))


def _variances(median: Floats, robust: Floats, counts: Ints) -> tuple[float, float]:
    """Between groups and within them: the variance of the medians less what the
    scatter of π/2 variances over n explains."""
    within = float(np.average(robust**2, weights=counts))
    noise = float(np.mean(math.pi / 2 * within / counts))
    return max(0.0, float(median.var(ddof=1)) - noise), within


def _kruskal_wallis_p(x: Floats, labels: Ints, counts: Ints) -> float:
    """With the correction for ties."""
    n = len(x)
    _, place, number = np.unique(x, return_inverse=True, return_counts=True)
    last = np.cumsum(number)
    rank = (last - (number - 1) / 2)[place]
    sums = np.bincount(labels, rank)
    statistic = 12 / (n * (n + 1)) * float(np.sum(sums**2 / counts)) - 3 * (n + 1)
    ties = 1 - float(np.sum(number.astype(float) ** 3 - number)) / (float(n) ** 3 - n)
    return float(chi2_sf(statistic / ties, len(counts) - 1))


def _f_test_p(y: Floats, labels: Ints, counts: Ints) -> float:
    """Of a one-way analysis of variance."""
    means = np.bincount(labels, y) / counts
    between = float(np.sum(counts * (means - y.mean()) ** 2)) / (len(counts) - 1)
    within = float(np.sum((y - means[labels]) ** 2)) / max(len(y) - len(counts), 1)
    if within == 0.0:
        return 1.0 if between == 0.0 else 0.0
    return float(f_sf(between / within, len(counts) - 1, len(y) - len(counts)))


def holm(p_values: Sequence[float]) -> list[float]:
    """P-values adjusted for their number (Holm, Scandinavian Journal of Statistics 6
    (1979) 65): with a limit of 0.05 on these, at most 5 % of families without any
    difference show one."""
    p = np.asarray(p_values, dtype=float)
    order = np.argsort(p, kind="stable")
    steps = np.minimum(1.0, p[order] * np.arange(len(p), 0, -1))
    adjusted = np.empty(len(p))
    adjusted[order] = np.maximum.accumulate(steps)
    return list(adjusted.tolist())
