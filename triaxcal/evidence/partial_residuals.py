"""Partial residuals of one effect against the variable that drives it (Larsen and
McCleary 1972, Technometrics 14:781).

A partial residual is the residual of the full model plus the contribution of one
effect. The nine linear parameters absorb a part of every effect; the contribution is
the remainder in the poses that the fit uses.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property
from itertools import permutations

import numpy as np
from numpy.polynomial import legendre
from scipy.optimize import nnls

from triaxcal.arrays import Bools, Floats, Ints
from triaxcal.distributions import f_sf, t_ppf
from triaxcal.effects import TEMPERATURE
from triaxcal.effects.catalogue import EffectFault
from triaxcal.effects.contract import (
    BEFORE,
    CHANGE,
    DURATION,
    RUN,
    SCATTER,
    SINCE_START,
    TIME,
    Effect,
    channel_of,
    is_derived,
    lag_in,
    rate_of,
)
from triaxcal.effects.runs import runs_named
from triaxcal.errors import Refused
from triaxcal.estimate.calibration import Calibration
from triaxcal.evidence.linearised_data import LinearisedData
from triaxcal.model.sensor import LINEAR
from triaxcal.poses.covariates import static_covariates

READINGS = ("reading_x", "reading_y", "reading_z")
"""The specific force along each sensitive axis, in units of the reference."""
PREDICTED = "predicted"
"""The contribution to |a| by the fit, in units of the reference: the variable
of an effect that no single one drives."""
POSE = "pose"
"""The number of the pose, from 1, where the times are not known."""
LEVEL = 0.95
"""Confidence level of the band about a curve."""
POINTS = 41
"""Points of a curve: a picture of some 300 pixels needs no more."""
PANELS = 3
"""Number of panels: parts of an effect with the largest contributions (rms in
standard errors), or the three most telling variables of an unexplained residual."""
VISIBLE = 0.45
"""Least derivative of |a| by the reading of an axis for a pose in the picture: below
it the error bar is more than twice that of |a|. It is less than the 0.5 of the edges
of a cube, so rounding decides nothing."""
SAME = 1e-6
"""Relative difference below which two functions are the same: others differ by far
more."""
OF_READING, OF_COVARIATE = (3, 4, 5), (1, 2)
"""Degrees of the polynomials of `telling_variables`."""
AXES = 3
"""The sensitive axes, and the components of a vector."""


class Quantity(StrEnum):
    """The quantity of a partial residual."""

    MAGNITUDE = "magnitude"
    """|a|."""
    READING = "reading"
    """The reading along one axis; of what changes a scale factor, at one
    reference along the axis."""
    STANDARD_ERRORS = "standard_errors"
    """|a|, over the standard error of the pose."""


@dataclass(frozen=True, eq=False)
class Trace:
    """k partial residuals against one variable, and the fitted curve.

    ``effect`` is empty for a residual without one; ``axis`` ("x", "y", "z") is the
    one on which its ``coefficients`` act, empty where there are several. ``variable``
    is a covariate by name (`triaxcal.effects.contract`), one of `READINGS`,
    `PREDICTED` or `POSE`; `unit_of` has its unit. ``pose`` (k,) are indices among all
    given poses; ``x`` (k,) the variable; ``y`` (k,) the partial residuals and
    ``error`` (k,) one standard error of the pose, in units of the reference unless
    the ``quantity`` says otherwise; ``excluded`` (k,) the poses that the fit does not
    use. ``curve`` (m,) is the contribution at the values ``grid`` (m,) of the
    variable, ``half_width`` (m,) half its 95 % band; empty without a curve. ``share``
    measures how telling the variable of an unexplained residual is, ``p_value`` is
    the probability of as telling a variable by chance (`telling_variables`); else
    None.
    """

    effect: str
    axis: str
    coefficients: tuple[str, ...]
    variable: str
    quantity: Quantity
    pose: Ints
    x: Floats
    y: Floats
    error: Floats
    excluded: Bools
    grid: Floats
    curve: Floats
    half_width: Floats
    share: float | None = None
    p_value: float | None = None


def of_effect(rows: LinearisedData, c: Calibration, name: str) -> tuple[Trace, ...]:
    """Traces of an effect of the model ``c``, fitted to these ``rows``: one for each
    axis on which it acts, at most `PANELS`. Raises KeyError where the model has no
    such effect."""
    data = _Data.of(rows, c)
    at = LINEAR
    for effect, q in c.sensor.effects:
        own = slice(at, at + len(q))
        at = own.stop
        if effect.name == name:
            return tuple(data.traces_of(effect, np.asarray(q), c.covariance[own, own], c.coverage_factor(LEVEL)))
    raise KeyError(name)


def telling_variables(rows: LinearisedData, c: Calibration, of_direction: bool = False) -> tuple[Trace, ...]:
    """The residuals of the model ``c`` against the `PANELS` most telling variables;
    ``of_direction``: readings of the axes first.

    The measure is the adjusted share of the weighted sum of squares that a smooth
    curve in the variable explains in addition to the nine parameters: 1 less the
    ratio of the mean squares with and without it. The curve is a polynomial of degree
    5 in the reading of an axis, whose first three terms the nine absorb, and of
    degree 2 on each axis in any other variable. The probability is that of the F
    test, times the number of variables (Bonferroni).
    """
    data = _Data.of(rows, c).of_means()
    found = [fit for drivers in data.candidates() if drivers and (fit := data.fitted(drivers)) is not None]
    best = sorted(found, key=lambda fit: (of_direction and not fit.of_reading, -fit.share))[:PANELS]
    return tuple(data.trace_of_curve(fit, min(1.0, fit.p_value * len(found))) for fit in best)


def residuals(c: Calibration) -> Trace:
    """Residuals of all poses, where known, in standard errors, against the time;
    against the number of the pose for several recordings or unknown times."""
    known = [i for i, p in enumerate(c.poses) if np.isfinite(p.residual_g) and p.standard_error_g > 0]
    poses = [c.poses[i] for i in known]
    t_s = np.array([p.pose.t_s for p in poses])
    timed = len(t_s) > 1 and bool(np.ptp(t_s) > 0) and len({p.pose.run.index for p in poses}) == 1
    nothing = np.empty(0)
    return Trace(
        effect="",
        axis="",
        coefficients=(),
        variable=SINCE_START if timed else POSE,
        quantity=Quantity.STANDARD_ERRORS,
        pose=np.array(known, dtype=int),
        x=t_s if timed else np.array(known, dtype=float) + 1,
        y=np.array([p.residual_g / p.standard_error_g for p in poses]),
        error=np.ones(len(poses)),
        excluded=np.array([not p.used for p in poses], dtype=bool),
        grid=nothing,
        curve=nothing,
        half_width=nothing,
    )


@dataclass(frozen=True, eq=False)
class _Coefficients:
    """``values`` (p,), their ``covariance`` (p,p), and the factor from a standard
    error to half a band."""

    values: Floats
    covariance: Floats
    coverage: float

    def standard_error(self, by_one: Floats) -> Floats:
        """(m,) standard errors of linear combinations with weights (m,p)."""
        return np.asarray(np.sqrt(np.maximum(np.einsum("mp,pq,mq->m", by_one, self.covariance, by_one), 0.0)))

    def only(self, index: Ints, given: Ints | None = None) -> _Coefficients:
        """Some of the coefficients, conditional on the estimates of those
        ``given``."""
        covariance = self.covariance[np.ix_(index, index)]
        if given is not None and len(given):
            crossed, others = self.covariance[np.ix_(index, given)], self.covariance[np.ix_(given, given)]
            covariance = covariance - crossed @ np.linalg.pinv(others, hermitian=True) @ crossed.T
        return replace(self, values=self.values[index], covariance=covariance)


@dataclass(frozen=True, eq=False)
class _Driver:
    """Coefficients that act on |a| by ``loading`` (n,) times functions of one
    variable ``x`` (n,). ``functions`` gives k values of them (k,p), ``absorbed``
    those of the functions (k,h) of the same variable that the nine parameters can
    remove. ``whole``: the nine parameters remove exactly the functions in
    ``absorbed``. Otherwise they may also reduce the effect's own function, because
    the variable was correlated with the directions. ``rows`` (n,) are the poses in
    which it acts."""

    variable: str
    quantity: Quantity
    axis: str
    x: Floats
    loading: Floats
    functions: Callable[[Floats], Floats]
    absorbed: Callable[[Floats], Floats]
    whole: bool
    rows: Bools


@dataclass(frozen=True, eq=False)
class _Curve:
    """A smooth curve in one variable: ``coefficients`` of all ``drivers``, equally
    many each. ``p_value`` is that of its F test."""

    drivers: Sequence[_Driver]
    coefficients: _Coefficients
    share: float
    p_value: float

    @property
    def of_reading(self) -> bool:
        return self.drivers[0].variable in READINGS


@dataclass(frozen=True, eq=False)
class _Data:
    """The poses of ``rows`` under the model ``c``; ``used`` (N,) are the rows that
    the fit uses."""

    rows: LinearisedData
    c: Calibration
    used: Bools

    @classmethod
    def of(cls, rows: LinearisedData, c: Calibration) -> _Data:
        used = np.array([c.poses[place].used for place in rows.places], dtype=bool)
        return cls(rows, c, np.resize(used, len(rows.y)))

    def of_means(self) -> _Data:
        """The same without the slopes inside the poses."""
        return replace(self, used=self.used & (np.arange(len(self.used)) < self.rows.n))

    def left(self, columns: Floats) -> Floats:
        """Residuals (n,…) of columns (N,…) in the means after regression on the nine
        parameters in the used rows."""
        linear, n = self.rows.linear, self.rows.n
        found = np.linalg.lstsq(linear[self.used], columns[self.used], rcond=None)[0]
        return np.asarray(columns[:n] - linear[:n] @ found)

    @cached_property
    def residual(self) -> Floats:
        """(n,) residuals of |a| under all effects of the model."""
        y = self.rows.y.copy()
        for effect, q in self.c.sensor.effects:
            y -= self.rows.by_coefficients(effect) @ q
        return -self.left(y) * self.error

    @property
    def error(self) -> Floats:
        """(n,) standard errors that weighted the means."""
        return self.rows.error[: self.rows.n]

    @property
    def in_fit(self) -> Bools:
        """(n,) whether the fit uses each pose."""
        return self.used[: self.rows.n]

    @cached_property
    def covariates(self) -> Mapping[str, Floats]:
        return self.rows.problem.covariates

    @cached_property
    def s(self) -> Floats:
        """(n,3) readings along the sensitive axes."""
        problem = self.rows.problem
        return self.rows.point.sensor(problem).along_axes(problem.u, problem.covariates)

    @cached_property
    def by_axis(self) -> Floats:
        """(n,3) derivatives of |a| by the reading of each axis."""
        problem = self.rows.problem
        return self.rows.point.sensor(problem).radius(problem.u, problem.covariates).by_v

    def traces_of(self, effect: Effect, q: Floats, covariance: Floats, coverage: float) -> Iterator[Trace]:
        # Contributions by part; the largest PANELS parts in their own order.
        contribution = self.contribution(self.rows.by_coefficients(effect))
        groups = _groups(effect)
        weight = [self.weight(contribution[:, index] @ q[index]) for index in groups]
        whole = _Coefficients(q, covariance, coverage)
        for k in sorted(sorted(range(len(groups)), key=lambda k: -weight[k])[:PANELS]):
            if weight[k] > 0:
                index = groups[k]
                names = tuple(effect.coefficients[i].name for i in index)
                own = whole.only(index, given=_of_other_recordings(effect, index))
                made = self.trace(self.driver(effect, index), contribution[:, index], own, self.residual)
                yield replace(made, effect=effect.name, coefficients=names)

    def contribution(self, columns: Floats) -> Floats:
        """(n,p) contribution to |a| of a unit of each coefficient, after absorption
        by the nine parameters, from ``columns`` (N,p) of the rows."""
        return -self.left(columns) * self.error[:, None]

    def weight(self, contribution: Floats) -> float:
        """Rms of a contribution in standard errors."""
        return float(np.sqrt(np.mean((contribution / self.error)[self.in_fit] ** 2)))

    def trace(self, driver: _Driver | None, contribution: Floats, of: _Coefficients, residual: Floats) -> Trace:
        """The trace of ``contribution`` (n,p); ``residual`` (n,) is that of the full
        model."""
        if driver is None:
            return self._against_predicted(residual, contribution, of)
        # Poses in which |a| follows the axis, and the curve over their range.
        shown = driver.rows & (np.abs(driver.loading) >= VISIBLE)
        grid = _grid(driver, driver.x[shown])
        curves = self._curves(driver, contribution)
        by_one, loading = curves(grid), driver.loading[shown]
        return Trace(
            effect="",
            axis=driver.axis,
            coefficients=(),
            variable=driver.variable,
            quantity=driver.quantity,
            pose=self.rows.places[shown],
            x=driver.x[shown],
            y=curves(driver.x[shown]) @ of.values + residual[shown] / loading,
            error=self.stated_error[shown] / np.abs(loading),
            excluded=~self.in_fit[shown],
            grid=grid,
            curve=by_one @ of.values,
            half_width=of.coverage * of.standard_error(by_one),
        )

    @cached_property
    def stated_error(self) -> Floats:
        """(n,) standard errors of the poses as in documents."""
        return np.array([self.c.poses[place].standard_error_g for place in self.rows.places])

    def _curves(self, driver: _Driver, contribution: Floats) -> Callable[[Floats], Floats]:
        """Contribution of a unit of each coefficient at values of the variable: the
        functions themselves and those that the nine parameters can remove, fitted to
        the ``contribution`` (n,p) in the poses. A part correlated with the directions
        is no function of the variable and is omitted."""
        # Weighted regression of the contribution on own and absorbed functions.
        rows = driver.rows & self.in_fit
        weight = (driver.loading / self.error)[rows, None]
        own, taken = driver.functions(driver.x[rows]) * weight, driver.absorbed(driver.x[rows]) * weight
        target = contribution[rows] / self.error[rows, None]
        if driver.whole:
            found = _least_squares(taken, target - own)
            return lambda x: np.asarray(driver.functions(x) + driver.absorbed(x) @ found)
        found = _least_squares(np.concatenate([own, taken], axis=1), target)
        return lambda x: np.asarray(np.concatenate([driver.functions(x), driver.absorbed(x)], axis=1) @ found)

    def _against_predicted(self, residual: Floats, contribution: Floats, of: _Coefficients) -> Trace:
        """The trace of an effect without a single driving variable, against its
        predicted contribution: the curve is the identity. The variance of the
        contribution, for the band, is fitted by a constant and a multiple of its
        square."""
        predicted = contribution @ of.values
        grid = np.linspace(predicted.min(), predicted.max(), POINTS)
        size = max(float(np.abs(predicted).max()), 1e-300)
        variance = of.standard_error(contribution) ** 2
        constant, by_square = nnls(np.stack([np.ones(len(predicted)), (predicted / size) ** 2], axis=1), variance)[0]
        return Trace(
            effect="",
            axis="",
            coefficients=(),
            variable=PREDICTED,
            quantity=Quantity.MAGNITUDE,
            pose=self.rows.places,
            x=predicted,
            y=predicted + residual,
            error=self.stated_error,
            excluded=~self.in_fit,
            grid=grid,
            curve=grid,
            half_width=of.coverage * np.sqrt(constant + by_square * (grid / size) ** 2),
        )

    # What drives an effect.

    def driver(self, effect: Effect, index: Ints) -> _Driver | None:
        """The driver of these coefficients; None where no single variable drives
        them, or too few poses show it."""
        try:
            basis = effect.basis(self.s, self.covariates)[:, :, index]
            return next((driver for driver in self._drivers(effect, index, basis) if self._shows(driver)), None)
        except (EffectFault, Refused):  # of another package, which does not say what it adds elsewhere
            return None

    def _shows(self, driver: _Driver) -> bool:
        x = driver.x[driver.rows & self.in_fit & (np.abs(driver.loading) >= VISIBLE)]
        return len(x) > 1 and bool(np.ptp(x) > 0)

    def _drivers(self, effect: Effect, index: Ints, basis: Floats) -> Iterator[_Driver]:
        """Drivers with which the ``basis`` (n,3,p) is a function of one variable."""
        axes = [i for i in range(AXES) if basis[:, i].any()]
        if not effect.needs:
            if len(axes) == 1:
                yield from self._by_own_reading(effect, index, axes[0], basis[:, axes[0]])
            yield from self._by_two_readings(effect, index, basis)
        elif len(axes) == 1:
            yield from self._by_covariate(effect, index, axes[0], basis[:, axes[0]])

    def _by_own_reading(self, effect: Effect, index: Ints, axis: int, basis: Floats) -> Iterator[_Driver]:
        """Driver by the reading of the only axis on which the effect acts."""
        reference = self.rows.problem.reference

        def own(x: Floats) -> Floats:
            return effect.basis(_on_sphere(x, axis, reference), {})[:, axis, index]

        if _same(own(self.s[:, axis]), basis):
            yield self.of_reading(axis, lambda x: own(x) * x[:, None] / reference)

    def _by_two_readings(self, effect: Effect, index: Ints, basis: Floats) -> Iterator[_Driver]:
        """Driver by the reading of one axis times the square of another: a change of
        the scale factor of the latter by the reading of the former, on whichever of
        the two it acts."""
        reference = self.rows.problem.reference
        along = np.einsum("ni,nip->np", self.s, basis)
        for axis, other in permutations(range(AXES), 2):

            def functions(x: Floats, axis: int = axis, other: int = other) -> Floats:
                s = np.zeros((len(x), AXES))
                s[:, axis], s[:, other] = reference, x
                return np.asarray(np.einsum("ni,nip->np", s, effect.basis(s, {})[:, :, index]) / reference)

            gain = self.s[:, axis] / reference
            if _same(gain[:, None] ** 2 * reference * functions(self.s[:, other]), along):
                on_axis = self.on_axis(READINGS[other], axis, self.s[:, other], functions)
                yield replace(on_axis, loading=on_axis.loading * gain)

    def _by_covariate(self, effect: Effect, index: Ints, axis: int, basis: Floats) -> Iterator[_Driver]:
        """Driver by a covariate, on the bias of the axis or on its scale factor."""
        name = _driving(effect, axis)
        if name is None:
            return
        problem = self.rows.problem
        runs = runs_named(effect.coefficients[i].name for i in index) if name != RUN else ()
        rows = np.isin(self.rows.run, runs) if runs else np.ones(self.rows.n, dtype=bool)
        median = {n: float(np.median(self.covariates[n][rows])) for n in effect.needs}

        def at(x: Floats, covariates: Mapping[str, Floats]) -> Floats:
            full = np.tile(problem.reference * np.eye(AXES)[axis], (len(x), 1))
            moved = {**covariates, name: x - problem.channel_reference[name]}
            return effect.basis(full, moved)[:, axis, index]

        def functions(x: Floats) -> Floats:
            return at(x, {n: np.full(len(x), v) for n, v in median.items()})

        on_axis = replace(self.on_axis(name, axis, problem.channels[name], functions), rows=rows)
        # The duration of its own pose decides a step inside a pose.
        durations = {n: self.covariates[n] for n in effect.needs if n == DURATION}
        in_poses = at(on_axis.x, {n: np.full(self.rows.n, v) for n, v in median.items()} | durations)
        for gain in (np.ones(self.rows.n), self.s[:, axis] / problem.reference):
            if _same((gain[:, None] * in_poses)[rows], basis[rows]):
                yield replace(on_axis, loading=on_axis.loading * gain)

    def of_reading(self, axis: int, functions: Callable[[Floats], Floats]) -> _Driver:
        """Driver of |a| by the reading of an axis. The nine parameters absorb its
        square, itself and a constant (the sum of all three squares)."""
        return _Driver(
            variable=READINGS[axis],
            quantity=Quantity.MAGNITUDE,
            axis="xyz"[axis],
            x=self.s[:, axis],
            loading=np.ones(self.rows.n),
            functions=functions,
            absorbed=lambda x: (x[:, None] / self.rows.problem.reference) ** np.arange(3),
            whole=True,
            rows=np.ones(self.rows.n, dtype=bool),
        )

    def on_axis(self, variable: str, axis: int, x: Floats, functions: Callable[[Floats], Floats]) -> _Driver:
        """Driver on the bias of an axis, of which the nine parameters absorb a
        constant."""
        return _Driver(
            variable=variable,
            quantity=Quantity.READING,
            axis="xyz"[axis],
            x=x,
            loading=self.by_axis[:, axis],
            functions=functions,
            absorbed=lambda x: np.ones((len(x), 1)),
            whole=False,
            rows=np.ones(self.rows.n, dtype=bool),
        )

    # The most telling variables of an unexplained residual.

    def candidates(self) -> Iterator[Sequence[_Driver]]:
        """Drivers of each variable, one for each axis on which it may act."""
        for axis in range(AXES):
            yield [self.of_reading(axis, _Polynomials.over(self.s[:, axis], OF_READING))]
        still = static_covariates(self.rows.poses)
        for name, x in self.rows.problem.channels.items():
            if name not in still and np.isfinite(x).all() and np.ptp(x) > 0:
                functions = _Polynomials.over(x, OF_COVARIATE)
                yield [self.on_axis(name, axis, x, functions) for axis in _axes_of(name)]

    def fitted(self, drivers: Sequence[_Driver]) -> _Curve | None:
        """Polynomials in one variable, fitted together with the nine parameters; None
        where these absorb them, or no degree of freedom is left."""
        # Project the columns off the nine parameters (Frisch–Waugh–Lovell), then
        # regress.
        columns = self.left(self.columns(drivers))[self.in_fit]
        misfit = (-self.residual / self.error)[self.in_fit]
        size = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
        q, _, rank, _ = np.linalg.lstsq(columns / size, misfit, rcond=SAME)
        q, free = q / size, len(misfit) - LINEAR
        before = float(misfit @ misfit)
        if rank == 0 or free <= rank or not before > 0:
            return None
        # Mean squares with and without the curve, covariance, F test.
        after = float(np.sum((misfit - columns @ q) ** 2)) / (free - rank)
        inverse = np.linalg.pinv((columns / size).T @ (columns / size), rcond=SAME, hermitian=True)
        covariance = max(1.0, after) * inverse / np.outer(size, size)
        coverage = float(t_ppf((1 + LEVEL) / 2, free - rank))
        explained = max(before - after * (free - rank), 0.0) / rank
        p_value = float(f_sf(explained / after, rank, free - rank)) if after > 0 else 0.0
        return _Curve(drivers, _Coefficients(q, covariance, coverage), 1 - after / (before / free), p_value)

    def columns(self, drivers: Sequence[_Driver]) -> Floats:
        """(N,p) as `LinearisedData.by_coefficients`, in the means alone."""
        each = [driver.loading[:, None] * driver.functions(driver.x) / self.error[:, None] for driver in drivers]
        means = -np.concatenate(each, axis=1)
        return np.concatenate([means, np.zeros((len(self.rows.y) - self.rows.n, means.shape[1]))])

    def trace_of_curve(self, fit: _Curve, p_value: float) -> Trace:
        """The trace on the axis with the largest contribution."""
        contribution, of = self.contribution(self.columns(fit.drivers)), fit.coefficients
        parts = np.array_split(np.arange(len(of.values)), len(fit.drivers))
        best = max(range(len(parts)), key=lambda k: self.weight(contribution[:, parts[k]] @ of.values[parts[k]]))
        residual = self.residual - contribution @ of.values
        own = parts[best]
        made = self.trace(fit.drivers[best], contribution[:, own], of.only(own), residual)
        return replace(made, share=fit.share, p_value=p_value)


def unit_of(variable: str) -> str:
    """The unit of a trace's variable; g stands for the unit of the reference, a
    channel's name in brackets for that of the channel."""
    if variable in (POSE, RUN):
        return ""
    if variable in (*READINGS, PREDICTED, *BEFORE, *CHANGE):
        return "g"
    if variable in SCATTER:
        return "g²"
    if variable in (TIME, SINCE_START):
        return "s"
    lag, bare = lag_in(variable), variable.removesuffix(rate_of(""))
    thermal = channel_of(lag[0] if lag else bare) == TEMPERATURE
    if bare != variable:
        return "K/s" if thermal else f"[{channel_of(bare)}]/s"
    return ("K" if lag else "°C") if thermal else f"[{channel_of(lag[0] if lag else variable)}]"


def _groups(effect: Effect) -> list[Ints]:
    """Indices of the coefficients of one part, and of one recording among several."""
    keys = [(c.part, runs_named([c.name]) if RUN not in effect.needs[:1] else ()) for c in effect.coefficients]
    return [np.array([i for i, other in enumerate(keys) if other == key]) for key in dict.fromkeys(keys)]


def _of_other_recordings(effect: Effect, index: Ints) -> Ints:
    """Indices of the coefficients of the same part in other recordings. Their common
    value is also the unit's own bias, which no picture of one recording shows: its
    band is conditional on the others."""
    part = effect.coefficients[index[0]].part
    own = set(index.tolist())
    runs = runs_named(effect.coefficients[i].name for i in index)
    same = [i for i, c in enumerate(effect.coefficients) if runs and c.part == part and i not in own]
    return np.array(same, dtype=int)


def _driving(effect: Effect, axis: int) -> str | None:
    """The one covariate that drives an effect on an axis, or None."""
    names = [n for n in effect.needs if n not in (DURATION, RUN)] or [n for n in effect.needs if n == RUN]
    own = [n for n in names if n in (BEFORE[axis], CHANGE[axis], SCATTER[axis])] or names
    return own[0] if len(own) == 1 else None


def _axes_of(covariate: str) -> Sequence[int]:
    """Axes on which an unexplained variable may act: its own axis for an
    axis-specific variable. The previous pose also represents the change, time since
    the start represents time, and a channel represents its lags."""
    if covariate in (*BEFORE, *SCATTER):
        return ["xyz".index(covariate[-1])]
    rate = covariate.endswith(rate_of("")) and not lag_in(covariate)
    return range(AXES) if covariate == SINCE_START or rate or not is_derived(covariate) else ()


def _on_sphere(x: Floats, axis: int, reference: float) -> Floats:
    """(k,3) readings with the length of the reference: x along the axis, the rest in
    equal parts along the others."""
    rest = np.sqrt(np.maximum(reference**2 - x**2, 0.0) / 2)
    return np.stack([x if i == axis else rest for i in range(AXES)], axis=1)


@dataclass(frozen=True)
class _Polynomials:
    """Legendre's, of these degrees, over a range from ``low`` to ``high``."""

    low: float
    high: float
    degrees: tuple[int, ...]

    @classmethod
    def over(cls, x: Floats, degrees: tuple[int, ...]) -> _Polynomials:
        return cls(float(x.min()), float(x.max()), degrees)

    def __call__(self, x: Floats) -> Floats:
        t = (2 * x - self.low - self.high) / max(self.high - self.low, 1e-300)
        return np.asarray(legendre.legvander(t, max(self.degrees))[:, list(self.degrees)])


def _grid(driver: _Driver, x: Floats) -> Floats:
    return np.unique(x) if driver.variable == RUN else np.linspace(x.min(), x.max(), POINTS)


def _same(one: Floats, other: Floats) -> bool:
    return bool(np.allclose(one, other, rtol=0, atol=SAME * max(float(np.abs(other).max(initial=0.0)), 1e-300)))


def _least_squares(columns: Floats, target: Floats) -> Floats:
    """However different the columns are in size."""
    size = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    return np.asarray(np.linalg.lstsq(columns / size, target, rcond=SAME)[0] / size[:, None])
