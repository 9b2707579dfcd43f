"""Gauge repeatability and reproducibility: which part of the scatter is of the units,
and which of the measurement.

Every unit is measured under several conditions (appraisers: operators, stations,
fixtures, runs), more than once under each where possible:

    y = μ + unit + appraiser + unit × appraiser + repetition

Balanced data take the analysis of variance (AIAG, Measurement Systems Analysis, 4th
edition, 2010, chapter III B; expected mean squares of the random model), all other data
restricted maximum likelihood (Patterson and Thompson, Biometrika 58 (1971) 545).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy import special
from scipy.optimize import brentq, minimize

from triaxcal.arrays import Floats, Ints
from triaxcal.distributions import chi2_ppf, f_sf
from triaxcal.errors import InvalidData

LEVEL = 0.95
"""Of confidence."""
POOLED_ABOVE = 0.25
"""P-value of the interaction above which it is pooled with the repeatability (AIAG)."""
CATEGORIES = 1.41
"""√2, as AIAG prints it: distinct categories are 1.41 standard deviations of the units
over that of the measurement."""
DRAWS = 2**14
"""Of the chi-squares of the generalised intervals: their ends are known to one in a
thousand."""
APPROXIMATE_DRAWS = 2**12
"""Of intervals that are approximate."""
BOUND = 1.96
"""Standard errors from a variance that may be zero to the end of its interval."""
DOF_LEAST = 1.0
"""Of a variance that is surely above zero: below 1 its standard error is larger than
√2 of it."""
APPRAISERS_MOST = 200
"""A matrix of so many is solved a thousand times within a minute."""
LEAST_SHARE = 1e-8
"""Of the variance: a component as small as this is none."""
_ROOT = 1.1673039782614187
"""The real root of x⁵ = x + 1, of the additive recurrence in four dimensions."""


class Method(StrEnum):
    ANOVA = "anova"
    REML = "reml"


@dataclass(frozen=True)
class Source:
    """A row of the analysis of variance; ``f`` and ``p`` are None for the error."""

    name: str
    dof: int
    sum_of_squares: float
    mean_square: float
    f: float | None
    p: float | None


@dataclass(frozen=True)
class Component:
    """A variance with its ``interval``; ``share`` of the total variance, and
    ``study_share`` of the total standard deviation (%GRR where it is that of the
    measurement), both 0…1."""

    variance: float
    interval: tuple[float, float]
    share: float
    study_share: float

    @property
    def sd(self) -> float:
        return math.sqrt(self.variance)


@dataclass(frozen=True)
class GaugeStudy:
    """``components`` by name: `repeatability`, `reproducibility` (with the
    interaction), `appraiser`, `interaction` (absent where pooled or not separable),
    `gauge` (repeatability and reproducibility), `part`, `total`. ``grr`` is the
    standard deviation of the gauge over the total, with its interval; ``categories``
    the number of distinct categories, None without a scatter of the gauge. ``anova``
    has the rows of the full model, empty for REML."""

    method: Method
    parts: int
    appraisers: int
    measurements: int
    interaction: bool
    anova: tuple[Source, ...]
    components: dict[str, Component]
    grr: float
    grr_interval: tuple[float, float]
    categories: int | None


def gauge_study(
    values: Floats,
    part: Ints,
    appraiser: Ints,
    *,
    interaction: bool | None = None,
    pooled_above: float = POOLED_ABOVE,
    level: float = LEVEL,
) -> GaugeStudy:
    """Of ``values`` (n,) of units numbered by ``part`` (n,) under conditions numbered
    by ``appraiser`` (n,). ``interaction`` None pools it where its p-value is above
    ``pooled_above``. With one appraiser there is no reproducibility. Intervals are
    generalised ones (Hamada and Weerahandi, Journal of Quality Technology 32 (2000)
    241) for balanced data, and by Satterthwaite's approximation else. Raises
    InvalidData without two parts, or without anything that repeats."""
    cells = _Cells.of(values, part, appraiser)
    if cells.balanced and cells.appraisers > 1 and cells.repetitions > 1:
        return _by_anova(cells, interaction, pooled_above, level)
    return _by_reml(cells, interaction, pooled_above, level)


@dataclass(frozen=True)
class _Cells:
    """Measurements by part and appraiser: number, mean, and the sum of squares about
    the means, in the order of parts."""

    part: Ints
    appraiser: Ints
    count: Ints
    mean: Floats
    within: float
    parts: int
    appraisers: int

    @staticmethod
    def of(values: Floats, part: Ints, appraiser: Ints) -> _Cells:
        y = np.asarray(values, dtype=float)
        if not (len(y) == len(part) == len(appraiser)) or not np.isfinite(y).all():
            raise InvalidData("gauge study: expected a finite value, a part and an appraiser for each measurement")
        _, p = np.unique(part, return_inverse=True)
        _, o = np.unique(appraiser, return_inverse=True)
        parts, appraisers = int(p.max(initial=-1)) + 1, int(o.max(initial=-1)) + 1
        if parts < 2:
            raise InvalidData("gauge study: expected two parts or more")
        if appraisers > APPRAISERS_MOST:
            raise InvalidData(f"gauge study: expected at most {APPRAISERS_MOST} appraisers, not {appraisers}")
        _, cell, count = np.unique(p * appraisers + o, return_inverse=True, return_counts=True)
        if np.bincount(p).max() < 2:
            raise InvalidData("gauge study: no part is measured twice")
        y = y - y.mean()
        mean = np.bincount(cell, y) / count
        within = float(np.sum((y - mean[cell]) ** 2))
        first = np.zeros(len(count), dtype=np.int64)
        first[cell[::-1]] = np.arange(len(y))[::-1]
        return _Cells(p[first], o[first], count, mean, within, parts, appraisers)

    @property
    def measurements(self) -> int:
        return int(self.count.sum())

    @property
    def balanced(self) -> bool:
        return len(self.count) == self.parts * self.appraisers and self.count.min() == self.count.max()

    @property
    def repetitions(self) -> int:
        return int(self.count[0])


# Balanced data.


def _by_anova(cells: _Cells, interaction: bool | None, pooled_above: float, level: float) -> GaugeStudy:
    rows = _anova(cells)
    part, appraiser, crossed, error = rows
    p, o, r = cells.parts, cells.appraisers, cells.repetitions
    crossed_p = 1.0 if crossed.p is None else crossed.p
    keep = crossed_p <= pooled_above if interaction is None else interaction
    if keep:
        squares = [part, appraiser, crossed, error]
    else:
        dof, total = crossed.dof + error.dof, crossed.sum_of_squares + error.sum_of_squares
        pooled = Source("repeatability", dof, total, total / dof, None, None)
        squares = [part, appraiser, pooled, pooled]

    def variances(mean: list[Floats]) -> dict[str, Floats]:
        """Of mean squares of part, appraiser, interaction and error."""
        below = mean[2] if keep else mean[3]
        found = {
            "repeatability": mean[3],
            "appraiser": (mean[1] - below) / (p * r),
            "part": (mean[0] - below) / (o * r),
        }
        if keep:
            found["interaction"] = (mean[2] - mean[3]) / r
        return {name: np.maximum(value, 0.0) for name, value in found.items()}

    one = variances([np.array(s.mean_square) for s in squares])
    draws = _chi_squares(tuple(s.dof for s in squares[: 4 if keep else 3]))
    draws = draws if keep else [*draws, draws[2]]
    spread = variances([s.sum_of_squares / d for s, d in zip(squares, draws, strict=True)])
    tails = [(1 - level) / 2, (1 + level) / 2]

    def interval(of: Callable[[dict[str, Floats]], Floats]) -> tuple[float, float]:
        low, high = np.quantile(of(spread), tails)
        return float(low), float(high)

    return _study(Method.ANOVA, cells, keep, rows, {k: float(v) for k, v in one.items()}, interval)


def _anova(cells: _Cells) -> tuple[Source, ...]:
    """Of the full model; part and appraiser are tested against the interaction."""
    p, o, r = cells.parts, cells.appraisers, cells.repetitions
    table = np.empty((p, o))
    table[cells.part, cells.appraiser] = cells.mean
    of_part, of_appraiser, grand = table.mean(axis=1), table.mean(axis=0), table.mean()
    crossed = table - of_part[:, None] - of_appraiser[None, :] + grand
    squares = {
        "part": (p - 1, o * r * float(np.sum((of_part - grand) ** 2))),
        "appraiser": (o - 1, p * r * float(np.sum((of_appraiser - grand) ** 2))),
        "interaction": ((p - 1) * (o - 1), r * float(np.sum(crossed**2))),
        "repeatability": (p * o * (r - 1), cells.within),
    }
    against = {"part": "interaction", "appraiser": "interaction", "interaction": "repeatability"}
    rows = []
    for name, (dof, total) in squares.items():
        f = chance = None
        if name in against:
            below_dof, below = squares[against[name]]
            f = total / dof / (below / below_dof) if below > 0 else math.inf
            chance = float(f_sf(f, dof, below_dof)) if math.isfinite(f) else 0.0
        rows.append(Source(name, dof, total, total / dof, f, chance))
    return tuple(rows)


@cache
def _chi_squares(dofs: tuple[int, ...]) -> list[Floats]:
    """Draws of independent chi-squares."""
    place = _places(len(dofs), DRAWS)
    return [np.asarray(chi2_ppf(place[:, i], dof)) for i, dof in enumerate(dofs)]


# The result, of variances however they were found.


def _study(
    method: Method,
    cells: _Cells,
    interaction: bool,
    anova: tuple[Source, ...],
    variances: dict[str, float],
    interval: Callable[[Callable[[dict[str, Floats]], Floats]], tuple[float, float]],
) -> GaugeStudy:
    names = {
        "repeatability": ("repeatability",),
        "reproducibility": ("appraiser", "interaction"),
        "appraiser": ("appraiser",),
        "interaction": ("interaction",),
        "gauge": ("repeatability", "appraiser", "interaction"),
        "part": ("part",),
        "total": ("repeatability", "appraiser", "interaction", "part"),
    }

    def sum_of(found: dict[str, Floats] | dict[str, float], keys: tuple[str, ...]) -> Floats:
        return np.asarray(sum(found[key] for key in keys if key in found))

    total = float(sum_of(variances, names["total"]))
    components = {}
    for name, keys in names.items():
        if not any(key in variances for key in keys):
            continue
        variance = float(sum_of(variances, keys))
        share = variance / total if total else 0.0
        ends = interval(lambda found, keys=keys: sum_of(found, keys))  # type: ignore[misc]
        components[name] = Component(variance, ends, share, math.sqrt(share))
    gauge = components["gauge"]

    def ratio(found: dict[str, Floats]) -> Floats:
        whole = sum_of(found, names["total"])
        return np.sqrt(np.divide(sum_of(found, names["gauge"]), whole, out=np.zeros_like(whole), where=whole > 0))

    categories = None
    if gauge.variance > 0:
        categories = max(1, math.floor(CATEGORIES * components["part"].sd / gauge.sd))
    return GaugeStudy(
        method, cells.parts, cells.appraisers, cells.measurements, interaction, anova, components,
        gauge.study_share, interval(ratio), categories,
    )  # fmt: skip


# Data that are not balanced.


def _by_reml(cells: _Cells, interaction: bool | None, pooled_above: float, level: float) -> GaugeStudy:
    separable = cells.appraisers > 1 and cells.measurements > len(cells.count) and len(cells.count) > cells.parts
    names = ["repeatability", "part"] + (["appraiser"] if cells.appraisers > 1 else [])
    likelihood = _Likelihood(cells)
    found = likelihood.maximum(tuple(names))
    keep = False
    if separable and interaction is not False:
        full = likelihood.maximum((*names, "interaction"))
        # A variance on its boundary: half of a chi-square with one degree of freedom.
        ratio = max(0.0, 2 * (likelihood.log(found) - likelihood.log(full)))
        chance = 0.5 * float(special.chdtrc(1, ratio)) if ratio > 0 else 1.0
        keep = interaction is True or chance <= pooled_above
        found = full if keep else found
    spread = likelihood.draws(found)
    tails = [(1 - level) / 2, (1 + level) / 2]

    def interval(of: Callable[[dict[str, Floats]], Floats]) -> tuple[float, float]:
        low, high = np.quantile(of(spread), tails)
        return float(low), float(high)

    return _study(Method.REML, cells, keep, (), found, interval)


class _Likelihood:
    """Minus twice the restricted log-likelihood of the variances. The covariance of
    the cells of a part is a diagonal and a matrix of rank one; appraisers, of which
    there are few, come on top (Woodbury)."""

    def __init__(self, cells: _Cells) -> None:
        self._cells = cells
        self._scale = float(np.var(cells.mean)) + cells.within / max(cells.measurements, 1)
        self._scale = self._scale or 1.0
        self._first = np.flatnonzero(np.diff(cells.part, prepend=-1))
        self._design = np.zeros((len(cells.count), cells.appraisers))
        self._design[np.arange(len(cells.count)), cells.appraiser] = 1.0

    def log(self, variances: dict[str, float]) -> float:
        c = self._cells
        error, part = variances["repeatability"], variances["part"]
        weight = 1 / (error / c.count + variances.get("interaction", 0.0))
        sums = np.bincount(c.part, weight)
        shrink = part / (1 + part * sums)
        columns = np.column_stack([c.mean, np.ones(len(weight)), self._design])
        weighted = columns * weight[:, None]
        of_part = np.add.reduceat(weighted, self._first, axis=0)
        gram = columns.T @ weighted - of_part.T @ (of_part * shrink[:, None])
        log = float(np.sum(np.log(1 / weight)) + np.sum(np.log1p(part * sums)))
        if variances.get("appraiser", 0.0) > 0:
            own = gram[2:, 2:] * variances["appraiser"] + np.eye(c.appraisers)
            log += float(np.linalg.slogdet(own)[1])
            gram = gram[:2, :2] - variances["appraiser"] * gram[:2, 2:] @ np.linalg.solve(own, gram[2:, :2])
        log += math.log(gram[1, 1]) + float(gram[0, 0] - gram[0, 1] ** 2 / gram[1, 1])
        repeated = c.measurements - len(c.count)
        return log + (repeated * math.log(error) + c.within / error if repeated else 0.0)

    def maximum(self, names: tuple[str, ...]) -> dict[str, float]:
        """The variances that the data make likeliest; none below `LEAST_SHARE`."""

        floor, most = math.log(LEAST_SHARE), 8.0

        def variances(log: Floats) -> dict[str, float]:
            held = self._scale * np.exp(np.clip(log, floor, most))
            return dict(zip(names, held.tolist(), strict=True))

        def deviance(log: NDArray[np.float64]) -> float:
            return self.log(variances(log))

        start = [min(max(math.log(of / self._scale), floor), most) for of in self._start(names)]
        best = minimize(deviance, start, method="L-BFGS-B", bounds=[(floor, most)] * len(names))
        # L-BFGS-B stops where its numerical slopes end; the simplex goes on from there.
        log = minimize(
            deviance, [float(x) for x in best.x], method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-9}
        ).x
        found = variances(log)
        least = self._scale * math.e * LEAST_SHARE
        return {name: 0.0 if of <= least and name != "repeatability" else of for name, of in found.items()}

    def _start(self, names: tuple[str, ...]) -> list[float]:
        """By the scatter of the cells of a part, in equal shares, and of the parts."""
        c = self._cells
        own = np.bincount(c.part, c.mean) / np.bincount(c.part)
        inside = float(np.sum((c.mean - own[c.part]) ** 2)) + c.within
        inside = max(inside / (c.measurements - c.parts), LEAST_SHARE * self._scale)
        between = max(float(own.var(ddof=1)), LEAST_SHARE * self._scale)
        return [between if name == "part" else inside / (len(names) - 1) for name in names]

    def draws(self, found: dict[str, float]) -> dict[str, Floats]:
        """Values that the variances may have: scaled inverse chi-squares with the
        degrees of freedom of Satterthwaite, 2 v² / var(v), at most those of the data.
        Of a variance that may be zero, a normal distribution that ends at zero, with
        the upper bound of the likelihood."""
        c = self._cells
        error = self._errors(found)
        most = {"part": c.parts - 1, "appraiser": max(c.appraisers - 1, 1)}
        spread: dict[str, Floats] = {}
        places = _places(len(found), APPROXIMATE_DRAWS)
        for i, (name, variance) in enumerate(found.items()):
            dof = 2 * (variance / error[name]) ** 2 if variance > 0 else 0.0
            if dof < DOF_LEAST:
                reach = (self._upper(found, name) - variance) / BOUND
                spread[name] = np.maximum(variance + reach * np.asarray(special.ndtri(places[:, i])), 0.0)
                continue
            dof = min(dof, most.get(name, c.measurements - 1))
            spread[name] = variance * dof / np.asarray(chi2_ppf(places[:, i], dof))
        return spread

    def _errors(self, found: dict[str, float]) -> dict[str, float]:
        """Standard errors of the variances that are not zero, by the curvature of the
        likelihood."""
        names = [name for name, of in found.items() if of > 0]
        at = np.array([found[name] for name in names])
        step, n = 0.02 * at, len(names)

        def log(moved: Floats) -> float:
            return self.log(found | dict(zip(names, moved.tolist(), strict=True)))

        curvature = np.zeros((n, n))
        for i in range(n):
            for j in range(i, n):
                ei, ej = step * (np.arange(n) == i), step * (np.arange(n) == j)
                second = log(at + ei + ej) - log(at + ei - ej) - log(at - ei + ej) + log(at - ei - ej)
                curvature[i, j] = curvature[j, i] = second / (8 * step[i] * step[j])
        variance = np.diag(np.linalg.pinv(curvature, hermitian=True))
        own = 1 / np.sqrt(np.maximum(np.diag(curvature), 1e-300))
        errors = np.where(variance > 0, np.sqrt(np.maximum(variance, 0.0)), own)
        return dict(zip(names, errors.tolist(), strict=True))

    def _upper(self, found: dict[str, float], name: str) -> float:
        """Where the likelihood has fallen by that of `BOUND` standard errors."""
        best = self.log(found)

        def excess(log: float) -> float:
            return self.log(found | {name: self._scale * math.exp(log)}) - best - BOUND**2

        low, high = math.log(max(found[name] / self._scale, LEAST_SHARE)), 12.0
        if excess(low) > 0:
            return self._scale * math.exp(low)
        return self._scale * math.exp(high if excess(high) < 0 else float(brentq(excess, low, high, xtol=1e-3)))


def _places(dimensions: int, draws: int) -> Floats:
    """Evenly spread in a unit cube by an additive recurrence, the same each time."""
    steps = (1 / _ROOT) ** np.arange(1, dimensions + 1)
    return np.asarray((0.5 + np.arange(1, draws + 1)[:, None] * steps) % 1.0)
