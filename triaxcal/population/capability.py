"""How surely a process stays within its limits: Ppk with its interval, and intervals of
shares."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import special
from scipy.optimize import brentq

from triaxcal.arrays import Floats
from triaxcal.distributions import normal_isf
from triaxcal.errors import InvalidData
from triaxcal.population.control_charts import mean_of

LEVEL = 0.95
"""Of confidence, of intervals that say none."""
PPK_LEAST = 30
"""Units below which Ppk is not stated."""


@dataclass(frozen=True)
class Capability:
    """``ppk`` of ``n`` values with its ``interval``; both None below 30 values, for
    equal values, and without a limit. ``outside`` is the number of values beyond a
    limit, ``outside_interval`` the interval of its share."""

    n: int
    ppk: float | None
    interval: tuple[float, float] | None
    outside: int
    outside_interval: tuple[float, float] | None


def capability_of(
    values: Floats, low: float | None = None, high: float | None = None, level: float = LEVEL
) -> Capability:
    """Of ``values`` (n,) against a lower or an upper limit, or both. The interval is
    exact for a normal distribution with one limit (noncentral t); with two it is that
    of Bissell (Applied Statistics 39 (1990) 331). Raises InvalidData for limits in the
    wrong order."""
    if low is not None and high is not None and low >= high:
        raise InvalidData("low: expected a limit below the upper one")
    x = np.asarray(values, dtype=float)
    outside = int(np.sum((x < (-np.inf if low is None else low)) | (x > (np.inf if high is None else high))))
    share = share_interval(outside, len(x), level) if low is not None or high is not None else None
    ppk = ppk_of(x, low, high)
    if ppk is None:
        return Capability(len(x), None, None, outside, share)
    one_sided = low is None or high is None
    interval = one_sided_interval(ppk, len(x), level) if one_sided else two_sided_interval(ppk, len(x), level)
    return Capability(len(x), ppk, interval, outside, share)


def ppk_of(values: Floats, low: float | None, high: float | None) -> float | None:
    """Distance of the mean from the nearer limit in three standard deviations of all
    values. None below 30 values, for equal values, and without a limit."""
    n = len(values)
    if n < PPK_LEAST or (low is None and high is None):
        return None
    mean, sd = mean_of(values), float((values - values[0]).std(ddof=1))
    if not sd:
        return None
    room = [high - mean] if high is not None else []
    room += [mean - low] if low is not None else []
    return min(room) / (3 * sd)


def share_interval(count: int, of: int, level: float = LEVEL) -> tuple[float, float] | None:
    """Of a probability, after ``count`` of ``of`` trials: Clopper and Pearson,
    Biometrika 26 (1934) 404. None without a trial."""
    if not of:
        return None
    tail = (1 - level) / 2
    low = float(special.betaincinv(count, of - count + 1, tail)) if count else 0.0
    high = float(special.betaincinv(count + 1, of - count, 1 - tail)) if count < of else 1.0
    return low, high


def one_sided_interval(ppk: float, n: int, level: float = LEVEL) -> tuple[float, float]:
    """Of the Ppk of a normal distribution with one limit, estimated as ``ppk`` from
    ``n`` values: 3 √n ``ppk`` has a noncentral t distribution with n − 1 degrees of
    freedom and the noncentrality 3 √n Ppk (Owen, Technometrics 10 (1968) 445)."""
    scale, tail = 3 * math.sqrt(n), (1 - level) / 2
    spread, probability = _chi_over_root_dof(n - 1)
    t = scale * ppk

    def reached(noncentrality: float) -> float:
        """Probability of an estimate up to this one."""
        return float(probability @ special.ndtr(t * spread - noncentrality))

    # By the variance of the estimate, ten times over.
    reach = 10 * math.sqrt(1 + t * t / (2 * (n - 1)))

    def end(wanted: float) -> float:
        return float(brentq(lambda d: reached(d) - wanted, t - reach, t + reach)) / scale

    return end(1 - tail), end(tail)


def two_sided_interval(ppk: float, n: int, level: float = LEVEL) -> tuple[float, float]:
    """Of the Ppk of a normal distribution with two limits, by the normal approximation
    of Bissell."""
    reach = float(normal_isf((1 - level) / 2)) * math.sqrt(1 / (9 * n) + ppk**2 / (2 * (n - 1)))
    return ppk - reach, ppk + reach


def _chi_over_root_dof(dof: int) -> tuple[Floats, Floats]:
    """Values of √(χ²/dof) and their probabilities, which add up to one: sums over them
    are integrals to ten digits from 10 degrees of freedom on."""
    width = 9 / math.sqrt(2 * dof)
    spread = np.linspace(max(1e-9, 1 - width), 1 + width, 1001)
    log = (dof - 1) * np.log(spread) - dof * (spread**2 - 1) / 2
    density = np.exp(log - log.max())
    return spread, density / density.sum()
