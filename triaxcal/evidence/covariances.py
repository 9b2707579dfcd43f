"""Covariances of all rows, without dense matrices, and those of unmodelled parts:
Gaussian processes of several kinds.

A covariance is diagonal, or of low rank on top of the unit noise. Both give an
inverse with a diagonal and a few axes. No singular matrix is inverted: for each axis
the inverse lacks a share between 0 and 1.

Every function of direction is projected off the nine parameters over the sphere, not
at the poses: these would absorb half of it, and the linear part would come out two or
three times worse.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property, partial
from typing import Protocol

import numpy as np

from triaxcal.arrays import Floats, Ints, evenly_spread
from triaxcal.effects.contract import BEFORE
from triaxcal.estimate.likelihood import radius_by_linear
from triaxcal.evidence.linearised_data import LinearisedData, in_attitude
from triaxcal.model.directions import spiral

# Covariances of all rows and their inverses, without dense matrices.

NOTHING = 1e-9
"""Share of the noise variance that is negligible."""


@dataclass(frozen=True, eq=False)
class RowPrecision:
    """A symmetric matrix (N,N), applied by ``@`` from either side: diag(``weight``) −
    A diag(``taken``) Aᵀ with weight (N,), axes A (N,k) and taken (k,).
    ``half_log_det`` is half the logarithm of its determinant."""

    weight: Floats
    axes: Floats
    taken: Floats
    half_log_det: float

    __array_ufunc__ = None  # an array leaves ``@`` to this class

    def __matmul__(self, columns: Floats) -> Floats:
        """The matrix times columns (N,) or (N,q)."""
        along = (self.axes.T @ columns).T * self.taken
        return np.asarray((columns.T * self.weight - along @ self.axes.T).T)

    def __rmatmul__(self, rows: Floats) -> Floats:
        """Rows (N,) or (q,N) times the matrix."""
        return np.asarray((self @ rows.T).T)


@dataclass(frozen=True, eq=False)
class OwnVariances:
    """Independent ``variances`` (N,) of the rows."""

    variances: Floats

    def times(self, scale: float) -> OwnVariances:
        return OwnVariances(scale * self.variances)

    def beyond(self, basis: Floats) -> Floats:
        """(N,) variances after projection off an orthonormal ``basis`` (N,r)."""
        share = basis**2
        crossed = (basis.T * self.variances) @ basis
        return np.asarray(
            self.variances * (1 - 2 * share.sum(axis=1)) + np.einsum("ni,ij,nj->n", basis, crossed, basis)
        )

    def precision(self, tau: float) -> RowPrecision:
        """Inverse of 1 + τ² diag(variances)."""
        weight = 1 / (1 + tau**2 * self.variances)
        return RowPrecision(weight, np.empty((len(weight), 0)), np.empty(0), 0.5 * float(np.log(weight).sum()))

    def precisions_beyond(self, basis: Floats, taus: Sequence[float]) -> list[RowPrecision]:
        """The same for each τ, after projection off an orthonormal ``basis``
        (N,r)."""
        return [_beyond(self.precision(tau), basis) for tau in taus]


def _beyond(whole: RowPrecision, basis: Floats) -> RowPrecision:
    """P − P B (Bᵀ P B)⁻¹ Bᵀ P for a diagonal P: projection off the ``basis`` B in its
    metric."""
    weighted = basis * whole.weight[:, None]
    value, axes = np.linalg.eigh(basis.T @ weighted)
    value = np.maximum(value, np.finfo(float).tiny)
    half_log_det = whole.half_log_det - 0.5 * float(np.log(value).sum())
    return RowPrecision(whole.weight, weighted @ (axes / np.sqrt(value)), np.ones(len(value)), half_log_det)


@dataclass(frozen=True, eq=False)
class LowRank:
    """Covariance F Fᵀ of functions of few degrees of freedom; ``factor`` F is
    (N,r)."""

    factor: Floats

    def times(self, scale: float) -> LowRank:
        return LowRank(np.sqrt(scale) * self.factor)

    @property
    def variances(self) -> Floats:
        """(N,) variances of the rows."""
        return np.asarray(np.sum(self.factor**2, axis=1))

    def beyond(self, basis: Floats) -> Floats:
        """(N,) variances after projection off an orthonormal ``basis`` (N,r)."""
        return self._left_by(basis).variances

    def precision(self, tau: float) -> RowPrecision:
        """Inverse of 1 + τ² F Fᵀ."""
        return _precision(*self._principal(tau), tau)

    def precisions_beyond(self, basis: Floats, taus: Sequence[float]) -> list[RowPrecision]:
        """The same for each τ, after projection off an orthonormal ``basis``
        (N,r)."""
        axes, variance = self._left_by(basis)._principal(max(taus))
        whole, taken = np.concatenate([basis, axes], axis=1), np.ones(basis.shape[1])
        each = (_precision(axes, variance, tau) for tau in taus)
        return [replace(left, axes=whole, taken=np.concatenate([taken, left.taken])) for left in each]

    def _left_by(self, basis: Floats) -> LowRank:
        return LowRank(self.factor - basis @ (basis.T @ self.factor))

    def _principal(self, tau: float) -> tuple[Floats, Floats]:
        """Principal axes (N,k) and variances (k,) that are not negligible at size
        τ."""
        if not self.factor.size:
            return self.factor, np.empty(0)
        axes, variance = self._all_principal
        shown = tau**2 * variance > NOTHING
        return axes[:, shown], variance[shown]

    @cached_property
    def _all_principal(self) -> tuple[Floats, Floats]:
        axes, size, _ = np.linalg.svd(self.factor, full_matrices=False)
        return axes, size**2


def inverse_of(precision: Floats) -> Floats:
    """(…,d,d) inverses of symmetric matrices (…,d,d). Combinations that are
    determined no better than rounding get the variance that rounding gives them,
    effectively unknown."""
    # Scale to a unit diagonal, then invert with a floor on the eigenvalues.
    size = np.sqrt(np.maximum(np.diagonal(precision, axis1=-2, axis2=-1), np.finfo(float).tiny))
    scaled = precision / size[..., :, None] / size[..., None, :]
    value, axes = np.linalg.eigh(scaled)
    value = np.maximum(value, value.shape[-1] * np.finfo(float).eps)
    axes = axes / size[..., :, None]
    return np.asarray((axes / value[..., None, :]) @ np.swapaxes(axes, -1, -2))


def _precision(axes: Floats, variance: Floats, tau: float) -> RowPrecision:
    # (1 + τ² A v Aᵀ)⁻¹ = 1 − A (1 − 1/(1 + τ² v)) Aᵀ.
    spread = 1 + tau**2 * variance
    return RowPrecision(np.ones(len(axes)), axes, 1 - 1 / spread, -0.5 * float(np.log(spread).sum()))


# Covariances of unmodelled parts: Gaussian processes of several kinds.

SPHERE = 300
"""Number of directions of the projection off the nine parameters."""
SOME = 60
"""Number of these directions over which the mean variance of a function is
computed."""
SMOOTH = (0.4, 0.8)
"""Correlation lengths on the unit sphere: features of the size of a face, and of a
hemisphere."""
BY_AXIS = 0.3
"""Correlation length, in the reference vector, of an odd or even function of the
reading of one axis."""
MEMORY = 0.8
"""Correlation length, in the reference vector, for the previous pose."""
IN_TIME = (0.1, 0.3)
"""Correlation lengths as shares of the recording's duration."""
KNEES = (0.7, 0.8, 0.9)
"""Readings, in the reference vector, at which a deviation near one end of an axis
begins."""
NEAR = 0.3
"""Reach of a local part on the unit sphere."""
ABSORBED = 1e-9
"""A kind is dropped if projection off the nine parameters leaves less than this
share of its covariance. An example is time, where the times of the poses are
unknown."""


BLOCK = 32
"""Number of poses whose covariance is decomposed at a time."""


class UnmodelledKind(StrEnum):
    """The variable of an unmodelled part."""

    EACH_POSE = "each_pose"
    DIRECTION = "direction"
    ODD = "odd_by_axis"
    EVEN = "even_by_axis"
    POSE_BEFORE = "pose_before"
    TIME = "time"
    LOCAL = "local"
    """Near one end of an axis, or in one direction: only the few poses there show
    it."""
    WITHIN_POSE = "inside_poses"
    """In the slopes alone, for instance from noise of a logged channel."""


OWN = (UnmodelledKind.EACH_POSE, UnmodelledKind.WITHIN_POSE)
"""Independent from row to row."""


@dataclass(frozen=True, eq=False)
class ReadingGeometry:
    """k readings: ``up`` (k,3) unit vectors, ``by_bias`` (k,3) derivatives of |a| by
    the bias of each axis, ``along`` (k,3) readings along the sensitive axes in g,
    ``linear`` (k,9) derivatives by the nine parameters, in the scale of
    `LinearisedData.linear`."""

    up: Floats
    by_bias: Floats
    along: Floats
    linear: Floats

    def only(self, readings: Ints) -> ReadingGeometry:
        """Those of some of the readings."""
        return ReadingGeometry(*(each[readings] for each in (self.up, self.by_bias, self.along, self.linear)))


@dataclass(frozen=True, eq=False)
class PoseInputs:
    """k poses, taken or planned, as arguments of a covariance: ``reading_geometry``,
    specific force in the previous pose ``before`` (k,3) over the reference, ``t_s``,
    ``duration_s`` and ``run`` (k,); the standard ``error`` of their rows (K,), K = 2
    k where these have ``slopes``."""

    reading_geometry: ReadingGeometry
    before: Floats
    t_s: Floats
    duration_s: Floats
    run: Ints
    error: Floats
    slopes: bool

    @classmethod
    def of(cls, rows: LinearisedData) -> PoseInputs:
        covariates = rows.problem.covariates
        before = np.stack([covariates[name] for name in BEFORE], axis=1) / rows.problem.reference
        u = in_attitude(rows.problem, rows.state).u
        return cls(reading_geometry(rows, u), before, rows.t_s, rows.duration_s, rows.run, rows.error, rows.slopes)

    @property
    def k(self) -> int:
        return len(self.t_s)

    def only(self, poses: Ints) -> PoseInputs:
        """Those of some of the poses."""
        return PoseInputs(
            self.reading_geometry.only(poses),
            self.before[poses],
            self.t_s[poses],
            self.duration_s[poses],
            self.run[poses],
            self.error[self.rows_of(poses)],
            self.slopes,
        )

    def rows_of(self, poses: Ints) -> Ints:
        """Indices of the rows of some poses."""
        return np.concatenate([poses, poses + self.k]) if self.slopes else poses


class _Between(Protocol):
    """(K,L) covariance of the rows of k and l poses, in units of the reference
    squared, up to a factor."""

    def __call__(self, p: PoseInputs, q: PoseInputs) -> Floats: ...


@dataclass(frozen=True, eq=False)
class UnmodelledCovariance:
    """A covariance of the rows, scaled to a mean variance of 1, in units of the
    noise, after projection off the nine parameters. ``of_rows`` is the covariance of
    the rows over their errors, ``between`` the function behind it; every covariance
    of this kind is multiplied by ``scale``. ``length`` is the correlation length.
    ``whole`` is the rms of |a| over the sphere at size one, in the unit of the
    reference."""

    what: UnmodelledKind
    length: float
    scale: float
    whole: float
    of_rows: OwnVariances | LowRank
    between: _Between

    def covariance_of(self, p: PoseInputs, q: PoseInputs) -> Floats:
        """(K,L) covariance of the rows of two sets of poses, over their errors."""
        return np.asarray(self.scale * self.between(p, q) / p.error[:, None] / q.error)

    def bias_at(self, rows: LinearisedData, t_s: float) -> Floats:
        """(3,N) covariance of the bias at a moment of the last recording with the
        rows over their errors, for a process in time; its length is a share of the
        recording's duration. The bias itself has the variance ``scale``."""
        length = self.length * duration_of(rows)
        apart = t_s - rows.t_s
        # Squared-exponential covariance with the means; its derivative with the slopes.
        near = np.exp(-(apart**2) / 2 / length**2) * (rows.run == rows.run.max())
        both = [near] if not rows.slopes else [near, near * apart / length**2 * rows.duration_s]
        by_bias = reading_geometry(rows, rows.problem.u).by_bias
        return np.asarray(self.scale * np.concatenate([each[:, None] * by_bias for each in both]).T / rows.error)


def duration_of(rows: LinearisedData) -> float:
    """Duration of the longest recording in s."""
    return max(1e-9, *(float(np.ptp(rows.t_s[rows.run == run])) for run in np.unique(rows.run)))


def kinds_of(rows: LinearisedData) -> list[UnmodelledCovariance]:
    sphere = _Sphere.of(rows)
    return _whitened(rows, sphere, _covariances(rows, sphere))


def local_kinds_of(rows: LinearisedData, suspects: Sequence[int]) -> list[UnmodelledCovariance]:
    """Local parts near an end of an axis, or about the direction of one of the
    ``suspects``, possible outliers."""
    sphere = _Sphere.of(rows)
    return _whitened(rows, sphere, _local(rows, sphere, suspects))


def _whitened(
    rows: LinearisedData, sphere: _Sphere, covariances: Iterable[tuple[UnmodelledKind, float, _Between]]
) -> list[UnmodelledCovariance]:
    found = []
    here = PoseInputs.of(rows)
    everywhere = _everywhere(sphere.everywhere, rows.slopes)
    for what, length, between in covariances:
        # Low-rank factor of the covariance, and what the nine parameters leave of it.
        variances = _variances(between, here)
        of_rows = OwnVariances(variances) if what in OWN else LowRank(_factor(between, here, variances))
        shown = float(of_rows.beyond(rows.basis).sum())
        if shown <= ABSORBED * variances.sum():
            continue
        scale = rows.residual_dof / shown
        whole = float(np.sqrt(scale * np.mean(np.diag(between(everywhere, everywhere))[: everywhere.k])))
        found.append(UnmodelledCovariance(what, length, scale, whole, of_rows.times(scale), between))
    return found


def _everywhere(geometry: ReadingGeometry, slopes: bool) -> PoseInputs:
    """Poses over the sphere, equal in all other respects."""
    geometry = geometry.only(evenly_spread(np.arange(len(geometry.up)), SOME))
    k = len(geometry.up)
    nothing, error = np.zeros(k), np.ones(2 * k if slopes else k)
    return PoseInputs(geometry, geometry.up, nothing, nothing, np.zeros(k, dtype=np.int64), error, slopes)


def _variances(between: _Between, here: PoseInputs) -> Floats:
    """(N,) variances of the rows over their errors."""
    out = np.empty(len(here.error))
    for first in range(0, here.k, BLOCK):
        some = np.arange(first, min(first + BLOCK, here.k))
        own = here.only(some)
        out[here.rows_of(some)] = np.diag(between(own, own)) / own.error**2
    return out


def _factor(between: _Between, here: PoseInputs, variances: Floats) -> Floats:
    """(N,r) factor F with F Fᵀ equal to the covariance of the rows over their errors,
    within rounding: Cholesky decomposition with pivoting by blocks of poses
    (Harbrecht, Peters and Schneider 2012, Appl. Numer. Math. 62:428). Smooth
    functions have few degrees of freedom, whatever the number of poses."""
    factor, left = np.empty((len(variances), 0)), variances
    least = len(variances) * np.finfo(float).eps * float(variances.max(initial=0.0))
    while True:
        # Pivots: the poses with the largest remaining variance.
        of_poses = left.reshape(-1, here.k).max(axis=0)
        block = np.argsort(-of_poses, kind="stable")[:BLOCK]
        block = block[of_poses[block] > least]
        if not len(block):
            return factor
        own, rows = here.only(block), here.rows_of(block)
        # Remaining covariance of the block, its principal axes, and new columns of F.
        rest = between(own, here) / own.error[:, None] / here.error - factor[rows] @ factor.T
        value, axes = np.linalg.eigh((rest[:, rows] + rest[:, rows].T) / 2)
        kept = value > least
        if not kept.any():
            return factor
        factor = np.concatenate([factor, rest.T @ (axes[:, kept] / np.sqrt(value[kept]))], axis=1)
        left = variances - np.sum(factor**2, axis=1)


def _covariances(rows: LinearisedData, sphere: _Sphere) -> Iterator[tuple[UnmodelledKind, float, _Between]]:
    yield UnmodelledKind.EACH_POSE, 0.0, _own_of_means
    for length in SMOOTH:
        yield UnmodelledKind.DIRECTION, length, sphere.covariance(partial(_smooth, length=length))
    for what, sign in ((UnmodelledKind.ODD, -1), (UnmodelledKind.EVEN, 1)):
        length = BY_AXIS * rows.problem.reference
        yield what, length, sphere.covariance(partial(_by_axis, sign=sign, length=length))
    yield UnmodelledKind.POSE_BEFORE, MEMORY, _by_the_pose_before
    for share in IN_TIME:
        yield UnmodelledKind.TIME, share, partial(_in_time, length=share * duration_of(rows))
    if rows.slopes:
        yield UnmodelledKind.WITHIN_POSE, 0.0, _own_of_slopes


def _local(
    rows: LinearisedData, sphere: _Sphere, suspects: Sequence[int]
) -> Iterator[tuple[UnmodelledKind, float, _Between]]:
    reference = rows.problem.reference
    for axis in range(3):
        for end in (1.0, -1.0):
            of = partial(_beyond_knees, axis=axis, end=end, reference=reference)
            yield UnmodelledKind.LOCAL, reference, sphere.covariance(of)
    up = reading_geometry(rows, rows.problem.u).up
    for pose in suspects:
        yield UnmodelledKind.LOCAL, NEAR, sphere.covariance(partial(_about, centre=up[pose]))


def _same(p: PoseInputs, q: PoseInputs) -> Floats:
    """(k,l) identity: independent from pose to pose."""
    return np.eye(p.k) if p is q else np.zeros((p.k, q.k))


def _of_means(p: PoseInputs, q: PoseInputs, covariance: Floats) -> Floats:
    whole = np.zeros((len(p.error), len(q.error)))
    whole[: p.k, : q.k] = covariance
    return whole


def _of_slopes(p: PoseInputs, q: PoseInputs, covariance: Floats) -> Floats:
    whole = np.zeros((len(p.error), len(q.error)))
    whole[p.k :, q.k :] = covariance
    return whole


def _own_of_means(p: PoseInputs, q: PoseInputs) -> Floats:
    return _of_means(p, q, _same(p, q))


def _own_of_slopes(p: PoseInputs, q: PoseInputs) -> Floats:
    return _of_slopes(p, q, _same(p, q))


def _by_the_pose_before(p: PoseInputs, q: PoseInputs) -> Floats:
    near = np.exp(-np.sum((p.before[:, None] - q.before[None]) ** 2, axis=2) / 2 / MEMORY**2)
    return _of_means(p, q, near * (p.reading_geometry.by_bias @ q.reading_geometry.by_bias.T))


def _in_time(p: PoseInputs, q: PoseInputs, length: float) -> Floats:
    """A bias of each axis with a smooth random drift, independent between recordings.
    Means and slopes follow one process, or slow drift would count twice."""
    apart = p.t_s[:, None] - q.t_s[None]
    together = (p.reading_geometry.by_bias @ q.reading_geometry.by_bias.T) * (p.run[:, None] == q.run)
    near = np.exp(-(apart**2) / 2 / length**2) * together
    if not p.slopes:
        return np.asarray(near)
    # Covariances with slopes: first and second derivatives of the kernel in time.
    mean_slope = near * apart / length**2 * q.duration_s[None]
    slope_mean = -near * apart / length**2 * p.duration_s[:, None]
    inside = near * (1 / length**2 - apart**2 / length**4) * p.duration_s[:, None] * q.duration_s[None]
    return np.block([[near, mean_slope], [slope_mean, inside]])


class _Covariance(Protocol):
    def __call__(self, p: ReadingGeometry, q: ReadingGeometry) -> Floats: ...


@dataclass(frozen=True, eq=False)
class _Sphere:
    """Directions over the sphere, and the projection of a function there onto the
    nine parameters."""

    everywhere: ReadingGeometry
    fit: Floats

    @classmethod
    def of(cls, rows: LinearisedData) -> _Sphere:
        sensor = rows.state.sensor(rows.problem)
        up = spiral(SPHERE) * rows.problem.reference
        everywhere = reading_geometry(rows, sensor.output(up, {}))
        return cls(everywhere, np.linalg.pinv(everywhere.linear))

    def covariance(self, of: _Covariance) -> _Between:
        """Covariance of a function of direction after projection off its linear part
        over the sphere."""
        return _LessLinear(self, of, of(self.everywhere, self.everywhere))


@dataclass(frozen=True, eq=False)
class _LessLinear:
    """A `_Between`, as a class so that a diagnosis can be pickled. ``inner`` is the
    covariance over the sphere."""

    sphere: _Sphere
    of: _Covariance
    inner: Floats

    def __call__(self, p: PoseInputs, q: PoseInputs) -> Floats:
        # (1 − H) K (1 − H)ᵀ, with H the regression on the nine parameters over the
        # sphere.
        of, everywhere, fit = self.of, self.sphere.everywhere, self.sphere.fit
        here, there = p.reading_geometry.linear @ fit, q.reading_geometry.linear @ fit
        crossed = of(p.reading_geometry, everywhere) @ there.T
        mirrored = here @ of(everywhere, q.reading_geometry)
        return _of_means(
            p, q, of(p.reading_geometry, q.reading_geometry) - crossed - mirrored + here @ self.inner @ there.T
        )


def reading_geometry(rows: LinearisedData, u: Floats) -> ReadingGeometry:
    sensor, problem = rows.state.sensor(rows.problem), rows.problem
    radius = sensor.radius(u, {})
    linear = radius_by_linear(problem, radius, u) / rows.lengths
    return ReadingGeometry(radius.a / radius.length[:, None], -radius.by_v, radius.s, linear)


def _smooth(p: ReadingGeometry, q: ReadingGeometry, length: float) -> Floats:
    return np.asarray(np.exp(-np.sum((p.up[:, None] - q.up[None]) ** 2, axis=2) / 2 / length**2))


def _by_axis(p: ReadingGeometry, q: ReadingGeometry, sign: int, length: float) -> Floats:
    total = np.zeros((len(p.up), len(q.up)))
    for i in range(3):
        same = np.exp(-((p.along[:, None, i] - q.along[None, :, i]) ** 2) / 2 / length**2)
        mirrored = np.exp(-((p.along[:, None, i] + q.along[None, :, i]) ** 2) / 2 / length**2)
        total += np.outer(p.by_bias[:, i], q.by_bias[:, i]) * (same + sign * mirrored)
    return total


def _beyond_knees(p: ReadingGeometry, q: ReadingGeometry, axis: int, end: float, reference: float) -> Floats:
    """A deviation of one axis beyond a knee of unknown position near one end."""
    here, there = (end * g.along[:, axis, None] / reference - KNEES for g in (p, q))
    bent = np.maximum(here, 0.0) @ (np.maximum(there, 0.0) / (1 - np.array(KNEES)) ** 2).T
    return np.asarray(np.outer(p.by_bias[:, axis], q.by_bias[:, axis]) * bent)


def _about(p: ReadingGeometry, q: ReadingGeometry, centre: Floats) -> Floats:
    here, there = (np.exp(-np.sum((g.up - centre) ** 2, axis=1) / 2 / NEAR**2) for g in (p, q))
    return np.asarray(np.outer(here, there) * _smooth(p, q, NEAR))
