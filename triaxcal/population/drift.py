"""How figures of a unit move between calibrations, and how long a calibration lasts.

A figure of a unit at time t is a constant, a trend that all units share, the unit's own
movement, and an error of each measurement:

    y(t) = a + c t + w(t) + ε,   var ε = u² + r²

u is the stated standard error, r what differs from start to start. The movement w is a
random walk with the variance q t, or a slope of each unit with the variance q t²;
the likelier one is taken. q, r and c are found by restricted maximum likelihood of the
differences between successive measurements of each unit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from scipy import special
from scipy.optimize import brentq, minimize, minimize_scalar

from triaxcal.arrays import Floats, Ints
from triaxcal.distributions import chi2_isf, normal_isf
from triaxcal.errors import InvalidData

LEVEL = 0.95
"""Of confidence."""
CHANGES_LEAST = 5
"""Differences below which no drift is stated: q has a fifth as many degrees of freedom
at worst."""
SEPARABLE = 2.0
"""Ratio of the longest to the shortest time between measurements below which start-to-
start differences cannot be told from drift; all counts as drift then."""
FLOOR = 1e-8
"""Of the mean square of the differences: a variance as small as this is none."""
DIRECTIONS = 400
"""On the sphere, over which the error of |a| is averaged."""
LONGEST = 1e6
"""In spans of the data: an interval beyond is not stated."""


class Movement(StrEnum):
    RANDOM_WALK = "random_walk"
    SLOPE = "slope"


@dataclass(frozen=True)
class Drift:
    """``movement`` with the ``rate`` √q per √time (random walk) or per time (slope) and
    its interval; ``trend`` c per time, of all units, with its standard error;
    ``start_to_start`` r, 0 where it cannot be told from drift (``separable``). Of
    ``changes`` differences of ``units`` units over times of up to ``span``.
    ``preference`` is the log of the likelihood of the other movement over that of this
    one, at most 0."""

    movement: Movement
    rate: float
    rate_interval: tuple[float, float]
    trend: float
    trend_standard_error: float
    start_to_start: float
    separable: bool
    units: int
    changes: int
    span: float
    preference: float

    def variance(self, time: float, rate: float | None = None) -> float:
        """Of the movement in such a ``time``."""
        q = (self.rate if rate is None else rate) ** 2
        return q * (time if self.movement is Movement.RANDOM_WALK else time**2)


def drift_of(unit: Ints, time: Floats, values: Floats, standard_errors: Floats, level: float = LEVEL) -> Drift | None:
    """From measurements (n,) of units numbered by ``unit``, at ``time``, with standard
    errors; NaN counts as 0. None below `CHANGES_LEAST` differences, or where none took
    time. Raises InvalidData for shapes that differ."""
    if not len(unit) == len(time) == len(values) == len(standard_errors):
        raise InvalidData("drift: expected a unit, a time, a value and a standard error for each measurement")
    changes = _Changes.of(unit, time, values, standard_errors)
    if changes.count < CHANGES_LEAST or changes.span <= 0:
        return None
    fits = {movement: _fitted(changes, movement) for movement in Movement}
    best = min(fits, key=lambda movement: fits[movement][0])
    other = next(movement for movement in Movement if movement is not best)
    deviance, q, r = fits[best]
    trend, trend_error = changes.trend(q, r, best)
    low, high = _interval(changes, best, q, deviance, level)
    return Drift(
        best, math.sqrt(q), (math.sqrt(low), math.sqrt(high)), trend, trend_error, math.sqrt(r), changes.separable,
        changes.units, changes.count, changes.span, min(0.0, (deviance - fits[other][0]) / 2),
    )  # fmt: skip


@dataclass(frozen=True)
class _Group:
    """Units with the same number m of differences: ``step`` (g,m,1) in time,
    ``change`` (g,m,1), and the stated ``noise`` (g,m,m) of the changes."""

    step: Floats
    change: Floats
    noise: Floats


@dataclass(frozen=True)
class _Changes:
    groups: tuple[_Group, ...]
    units: int
    count: int
    span: float
    separable: bool
    mean_square: float

    @staticmethod
    def of(unit: Ints, time: Floats, values: Floats, standard_errors: Floats) -> _Changes:
        y, u = np.asarray(values, dtype=float), np.nan_to_num(np.asarray(standard_errors, dtype=float))
        t, number = np.asarray(time, dtype=float), np.asarray(unit)
        known = np.isfinite(y) & np.isfinite(t)
        order = np.lexsort((t[known], number[known]))
        y, u, t, number = (a[known][order] for a in (y, u, t, number))
        _, first, counts = np.unique(number, return_index=True, return_counts=True)
        groups, steps, spans = [], [], []
        for m in np.unique(counts[counts > 1]):
            rows = first[counts == m][:, None] + np.arange(m)
            step, change, noise = np.diff(t[rows]), np.diff(y[rows]), _noise(u[rows] ** 2)
            groups.append(_Group(step[:, :, None], change[:, :, None], noise))
            steps.append(step.ravel())
            spans.append(t[rows][:, -1] - t[rows][:, 0])
        all_steps = np.concatenate([*steps, *spans]) if steps else np.zeros(1)
        positive = all_steps[all_steps > 0]
        longest = float(positive.max()) if len(positive) else 0.0
        separable = bool(len(positive) and longest >= SEPARABLE * float(all_steps.min()))
        squares = np.concatenate([g.change.ravel() for g in groups]) ** 2 if groups else np.zeros(1)
        count = sum(g.change.size for g in groups)
        return _Changes(tuple(groups), int(np.sum(counts > 1)), count, longest, separable, float(squares.mean()))

    def deviance(self, q: float, r: float, movement: Movement) -> float:
        """Minus twice the restricted log-likelihood."""
        log, gram = 0.0, np.zeros((2, 2))
        for g in self.groups:
            covariance = self._covariance(g, q, r, movement)
            log += float(np.linalg.slogdet(covariance)[1].sum())
            columns = np.concatenate([g.change, g.step], axis=2)
            gram += np.einsum("gmi,gmj->ij", columns, np.linalg.solve(covariance, columns))
        if gram[1, 1] <= 0:
            return math.inf
        return log + math.log(gram[1, 1]) + float(gram[0, 0] - gram[0, 1] ** 2 / gram[1, 1])

    def trend(self, q: float, r: float, movement: Movement) -> tuple[float, float]:
        """With its standard error."""
        above = below = 0.0
        for g in self.groups:
            solved = np.linalg.solve(self._covariance(g, q, r, movement), g.step)
            above += float(np.sum(solved * g.change))
            below += float(np.sum(solved * g.step))
        return above / below, 1 / math.sqrt(below)

    def _covariance(self, g: _Group, q: float, r: float, movement: Movement) -> Floats:
        m = g.step.shape[1]
        apart = np.eye(m) if movement is Movement.RANDOM_WALK else g.step.transpose(0, 2, 1)
        moved = q * g.step * apart
        own = r * (2 * np.eye(m) - np.eye(m, k=1) - np.eye(m, k=-1))
        # Values that are equal, with no stated error, still have some.
        return np.asarray(moved + own + g.noise + FLOOR * (self.mean_square or 1.0) * np.eye(m))


def _noise(square: Floats) -> Floats:
    """Covariance (g,m,m) of differences of values with these variances (g,m+1)."""
    m = square.shape[1] - 1
    found = np.zeros((len(square), m, m))
    i = np.arange(m)
    found[:, i, i] = square[:, :-1] + square[:, 1:]
    found[:, i[:-1], i[1:]] = found[:, i[1:], i[:-1]] = -square[:, 1:-1]
    return found


def _scales(changes: _Changes, movement: Movement) -> tuple[float, float]:
    """Of q and of r, by the mean square of the differences."""
    scale = changes.mean_square or 1.0
    return scale / (changes.span if movement is Movement.RANDOM_WALK else changes.span**2), scale


def _fitted(changes: _Changes, movement: Movement) -> tuple[float, float, float]:
    """Deviance, q and r."""
    of_q, of_r = _scales(changes, movement)
    low = math.log(FLOOR)

    def deviance(log: Floats) -> float:
        held = np.clip(log, low, 12.0)
        r = of_r * math.exp(held[1]) if changes.separable else 0.0
        return changes.deviance(of_q * math.exp(held[0]), r, movement)

    found = [
        minimize(deviance, start, method="Nelder-Mead", options={"xatol": 1e-4, "fatol": 1e-7, "maxiter": 400})
        for start in ([0.0, -1.0], [-4.0, -0.5], [0.0, -8.0])[: 3 if changes.separable else 1]
    ]
    best = min(found, key=lambda f: f.fun)
    log_q, log_r = np.clip(best.x, low, 12.0).tolist()
    q = of_q * math.exp(log_q) if log_q > low + 1.0 else 0.0
    r = of_r * math.exp(log_r) if changes.separable and log_r > low + 1.0 else 0.0
    return changes.deviance(q, r, movement), q, r


def _interval(changes: _Changes, movement: Movement, q: float, deviance: float, level: float) -> tuple[float, float]:
    """Of q, by the profile of the likelihood."""
    of_q, of_r = _scales(changes, movement)
    allowed = float(chi2_isf(1 - level, 1))

    def excess(of: float) -> float:
        if not changes.separable:
            return changes.deviance(of, 0.0, movement) - deviance - allowed
        best = minimize_scalar(
            lambda log: changes.deviance(of, of_r * math.exp(log), movement),
            bounds=(math.log(FLOOR), 6.0), method="bounded", options={"xatol": 1e-3},
        )  # fmt: skip
        return min(float(best.fun), changes.deviance(of, 0.0, movement)) - deviance - allowed

    low = _end(excess, q, 0.5, FLOOR * of_q) if q > 0 else 0.0
    return low, _end(excess, max(q, FLOOR * of_q), 2.0, 1e9 * of_q)


def _end(excess: Callable[[float], float], start: float, factor: float, last: float) -> float:
    """Where the excess becomes positive on the way to ``last``; 0 or infinity where it
    does not."""
    at = start
    while (at > last) if factor < 1 else (at < last):
        following = at * factor**2
        if excess(following) > 0:
            return float(brentq(excess, at, following, rtol=1e-3)) if excess(at) < 0 else at
        at = following
    return 0.0 if factor < 1 else math.inf


# How long a calibration lasts.


class Part(StrEnum):
    """What a figure is to the magnitude |a| of a unit vector n."""

    BIAS = "bias"
    """n_i per unit of the reference."""
    SCALE_FACTOR = "scale_factor"
    """n_i² per relative change."""
    MISALIGNMENT = "misalignment"
    """n_i n_j per radian."""


@dataclass(frozen=True)
class Moving:
    """A figure of a calibration: its part in |a|, the axes it acts on (one, or two of a
    misalignment), its drift, and the standard ``uncertainty`` of its value when it is
    new."""

    part: Part
    axes: tuple[int, ...]
    drift: Drift
    uncertainty: float = 0.0


@dataclass(frozen=True)
class RecalibrationInterval:
    """``time`` after which the error of |a|, in a direction drawn at random, is beyond
    ``limit`` with ``probability``; 0 where it is so from the start, None where it is
    not within `LONGEST` spans of the data. ``interval`` comes from that of the rates;
    ``at_start`` is the probability right after a calibration."""

    limit: float
    probability: float
    time: float | None
    interval: tuple[float, float | None]
    at_start: float


def recalibration_interval(figures: Sequence[Moving], limit: float, probability: float = 0.05) -> RecalibrationInterval:
    """Of figures that move independently. A calibration and its use are two starts, so
    start-to-start differences count twice. Bounds of the variances add by the method
    of variance estimates recovery (Zou and Donner, Statistics in Medicine 27 (2008)
    1693). Raises InvalidData without a figure, a limit or a probability."""
    if not figures or limit <= 0 or not 0 < probability < 1:
        raise InvalidData("recalibration interval: expected figures, a limit above 0, a probability between 0 and 1")
    reach = np.array([_sensitivity(f) for f in figures])
    span = max(f.drift.span for f in figures)

    def chance(time: float, side: int) -> float:
        """With the variances as estimated (0), or at their lower or upper bound."""
        variance = reach**2 * np.array([[f.drift.variance(time)] for f in figures])
        still = [2 * f.drift.start_to_start**2 + f.uncertainty**2 for f in figures]
        trend = np.array([f.drift.trend * time for f in figures]) @ reach
        trend_variance = np.array([(f.drift.trend_standard_error * time) ** 2 for f in figures]) @ reach**2
        total = variance.sum(axis=0)
        if side:
            ends = np.array([[f.drift.variance(time, f.drift.rate_interval[side > 0])] for f in figures])
            total = np.maximum(0.0, total + side * np.sqrt(np.sum((reach**2 * ends - variance) ** 2, axis=0)))
        sd = np.sqrt(total + np.array(still) @ reach**2 + trend_variance)
        sd = np.maximum(sd, 1e-300)
        return float(np.mean(special.ndtr((-limit - trend) / sd) + special.ndtr((trend - limit) / sd)))

    def lasts(side: int) -> float | None:
        if chance(0.0, 0) >= probability:
            return 0.0
        last = LONGEST * span
        if not math.isfinite(chance(last, side)) or chance(last, side) < probability:
            return None
        return float(brentq(lambda time: chance(time, side) - probability, 0.0, last, rtol=1e-4, xtol=1e-9 * span))

    low = _lower(lasts, figures)
    return RecalibrationInterval(limit, probability, lasts(0), (low, lasts(-1)), chance(0.0, 0))


def _lower(lasts: Callable[[int], float | None], figures: Sequence[Moving]) -> float:
    """Zero where some rate has no upper bound."""
    if any(math.isinf(f.drift.rate_interval[1]) for f in figures):
        return 0.0
    found = lasts(1)
    return LONGEST * max(f.drift.span for f in figures) if found is None else found


def _sensitivity(figure: Moving) -> Floats:
    """Of |a| to the figure, in each of `DIRECTIONS`."""
    n = sphere()
    if figure.part is Part.BIAS:
        return np.asarray(n[:, figure.axes[0]])
    if figure.part is Part.SCALE_FACTOR:
        return np.asarray(n[:, figure.axes[0]] ** 2)
    return np.asarray(n[:, figure.axes[0]] * n[:, figure.axes[1]])


def sphere() -> Floats:
    """Directions (`DIRECTIONS`,3), evenly spread on a spiral."""
    i = np.arange(DIRECTIONS) + 0.5
    z, turn = 1 - 2 * i / DIRECTIONS, math.pi * (1 + math.sqrt(5)) * i
    across = np.sqrt(1 - z**2)
    return np.column_stack([across * np.cos(turn), across * np.sin(turn), z])


def change_after(of: Drift, time: float, probability: float = 0.95) -> float:
    """What a unit's change in such a time stays within with this probability, without
    the trend."""
    return float(normal_isf((1 - probability) / 2)) * math.sqrt(of.variance(time))
