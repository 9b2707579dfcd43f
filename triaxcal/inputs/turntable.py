"""Weighted least squares of ``u = P g + c`` over poses of known attitude, whose
errors are nuisances of the fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from triaxcal.arrays import Floats, Ints
from triaxcal.distributions import f_sf
from triaxcal.errors import Refused
from triaxcal.estimate.initial_estimate import problem_of, start
from triaxcal.frames.faces import nearest_rotation
from triaxcal.poses.degrees_of_freedom import lack_of_fit_p
from triaxcal.poses.pose import Pose

PARAMETERS = 12
"""A matrix of nine and three offsets: the attitudes tell the rotation as well."""
ROUNDS_MOST = 60
"""Steps of Gauss–Newton, which ends sooner where it converges."""
CONVERGED = 1e-11
"""Relative change of the matrix from step to step: far below any noise, above
rounding."""
ALARM = 0.005
"""Probability that one of a set of right rows is called wrong."""
ESTIMATE_BELOW = 0.2
"""Residuals of less probability are put down to the attitudes, where nobody
declared their error."""
ERROR_LEAST = 1e-8
"""Attitudes that are off by less, in rad (2 milliarcseconds), count as exact."""
ERROR_MOST = 0.3
"""Attitudes that are off by more, in rad, carry nothing."""
PAIRS_MOST = 400
"""Pairs of rows of which each is tried for the rotation: one of two right rows
is enough. All pairs of 28 rows; of more rows some, always the same, for the
sake of time."""
TIED = 0.02
"""Rows that take out of the sum of squares within this share of each other
cannot be distinguished."""


class AttitudesContradictReadings(Refused):
    """In too many rows to tell which are right."""

    def __init__(self) -> None:
        super().__init__("attitudes and readings contradict each other; are the rows in the order of the poses?")


@dataclass(frozen=True)
class TurntableData:
    """``u`` (n,3) outputs, ``covariance`` (n,3,3) of them with ``dof`` behind,
    ``ups`` (n,3) as stated."""

    u: Floats
    covariance: Floats
    ups: Floats
    reference: float
    dof: float

    def only(self, rows: Ints) -> TurntableData:
        return replace(self, u=self.u[rows], covariance=self.covariance[rows], ups=self.ups[rows])


@dataclass(frozen=True)
class TurntableSolution:
    """``P`` (3,3) and ``c`` (3,) with ``covariance`` (12,12) of P row by row
    and c; ``noise_only`` the same were the attitudes exact. ``rest`` (n,3)
    residuals, ``weight`` (n,3,3) their inverse covariance, ``design`` (n,3,12).
    ``found`` (n,3) the attitudes that the fit settled on, unit vectors;
    ``target`` (n,3) what ``design @ p`` is fitted to.
    """

    data: TurntableData
    P: Floats
    c: Floats
    covariance: Floats
    noise_only: Floats
    rest: Floats
    weight: Floats
    design: Floats
    found: Floats
    target: Floats
    error_rad: float
    estimated: bool

    @property
    def chi2(self) -> float:
        return float(np.einsum("ni,nij,nj->", self.rest, self.weight, self.rest))

    @property
    def left(self) -> int:
        return 3 * len(self.data.u) - PARAMETERS

    @property
    def p(self) -> float | None:
        return lack_of_fit_p(self.chi2, self.left, self.data.dof)

    def without(self, row: int) -> tuple[Floats, Floats]:
        """P and c of all other poses."""
        rest: Ints = np.delete(np.arange(len(self.rest)), row)
        p, _ = _weighted(self.design[rest], self.weight[rest], self.target[rest])
        return p[:9].reshape(3, 3), p[9:]

    @property
    def error_uncertainty_rad(self) -> float:
        """Standard error of ``error_rad`` as it is estimated: where ``chi2`` is
        ``left``.

        The sum has variance 2 ``left``, and the part of it that is the
        attitudes' falls with the square of their error.
        """
        of_noise = np.einsum("nij,njk,nkl,nli->", self.weight, self.free, self.weight, self.data.covariance)
        of_attitudes = float(self.left - of_noise)
        if not of_attitudes > 0:
            return float("inf")
        return self.error_rad * float(np.sqrt(2 * self.left)) / (2 * of_attitudes)

    @property
    def free(self) -> Floats:
        """(n,3,3): covariance of each pose's residual."""
        fitted = np.einsum("nip,pq,njq->nij", self.design, self.covariance, self.design)
        return np.asarray(np.linalg.inv(self.weight) - fitted)


def solved(data: TurntableData, error_rad: float | None) -> TurntableSolution:
    """With the declared error of the attitudes; else the smallest with which
    the residuals are as large as expected."""
    solution = iterated(data, error_rad or 0.0)
    if error_rad is not None or solution.p is None or solution.p > ESTIMATE_BELOW:
        return solution

    def excess(log: float) -> float:
        tried = iterated(data, float(np.exp(log)))
        return tried.chi2 - tried.left

    low = np.log(ERROR_LEAST)
    if excess(low) <= 0:
        return solution
    high = low + 2
    while excess(high) > 0:
        low, high = high, high + 2
        if low > np.log(ERROR_MOST):
            raise AttitudesContradictReadings
    best = float(np.exp(scipy.optimize.brentq(excess, low, high, xtol=1e-2)))
    return replace(iterated(data, best), estimated=True)


def iterated(data: TurntableData, error_rad: float) -> TurntableSolution:
    """With attitudes that err by so much: Gauss–Newton over the twelve
    parameters, each attitude following within its error. Raises Refused where
    it runs away."""
    n = len(data.u)
    g = data.ups
    design = np.zeros((n, 3, PARAMETERS))
    P, c = _plain(data)
    for _ in range(ROUNDS_MOST):
        for i in range(3):
            design[:, i, 3 * i : 3 * i + 3] = data.reference * g
            design[:, i, 9 + i] = 1.0
        across = _across(g)
        turned = data.reference * P @ across  # (n,3,2): outputs by the two angles
        stated = np.einsum("nik,ni->nk", across, data.ups - g)  # the stated attitude, seen from the settled one
        V = data.covariance + error_rad**2 * turned @ turned.transpose(0, 2, 1)
        try:
            weight = np.linalg.inv(V)
        except np.linalg.LinAlgError:
            raise AttitudesContradictReadings from None
        target = data.u - np.einsum("nik,nk->ni", turned, stated)
        p, covariance = _weighted(design, weight, target)
        P, before, c = p[:9].reshape(3, 3), P, p[9:]
        rest = target - design @ p
        if error_rad:
            tilt = stated + error_rad**2 * np.einsum("nik,nij,nj->nk", turned, weight, rest)
            g = g + np.einsum("nik,nk->ni", across, tilt)
            g /= np.linalg.norm(g, axis=1, keepdims=True)
        if np.max(np.abs(P - before)) < CONVERGED * np.max(np.abs(P)):
            break
    _, noise_only = _weighted(design, np.linalg.inv(data.covariance), target)
    return TurntableSolution(data, P, c, covariance, noise_only, rest, weight, design, g, target, error_rad, False)


def _plain(data: TurntableData) -> tuple[Floats, Floats]:
    """P and c without weights, to begin with."""
    design = np.concatenate([data.reference * data.ups, np.ones((len(data.u), 1))], axis=1)
    found = np.linalg.lstsq(design, data.u, rcond=None)[0]
    return found[:3].T, found[3]


def _weighted(design: Floats, weight: Floats, target: Floats) -> tuple[Floats, Floats]:
    """Least squares with weights by pose: parameters (12,) and covariance
    (12,12)."""
    root = np.linalg.cholesky(weight).transpose(0, 2, 1)
    X, y = (root @ design).reshape(-1, PARAMETERS), (root @ target[..., None]).ravel()
    norms = np.linalg.norm(X, axis=0)
    inverse = np.linalg.inv((X / norms).T @ (X / norms)) / np.outer(norms, norms)
    return inverse @ (X.T @ y), inverse


def _across(g: Floats) -> Floats:
    """(n,3,2): two unit vectors at right angles to each of ``g`` (n,3)."""
    spare = np.eye(3)[np.argmin(np.abs(g), axis=1)]
    one = np.cross(g, spare)
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    return np.stack([one, np.cross(g, one)], axis=2)


def wrong_by_magnitude(poses: Sequence[Pose], ups: Floats, reference: float) -> Ints:
    """Rows whose attitude does not go with those of most others, judged by the
    angles that |a| alone says are between the poses. None where |a| cannot
    say."""
    try:
        problem = problem_of(poses, reference=reference)
        sensor = start(problem, poses, (1, 1, 1)).sensor(problem)
    except Refused:
        return np.zeros(0, dtype=int)
    a = sensor.specific_force(np.array([p.mean for p in poses]), {})
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    mirrored = a * [1.0, 1.0, -1.0]  # signs are not known, but only their product is no rotation
    off = min((_off_most(v, ups) for v in (a, mirrored)), key=lambda v: float(np.median(v)))
    scale = max(float(np.median(off)), 1e-9)
    return np.flatnonzero(off > np.clip(10 * scale, 0.02, ERROR_MOST))


def _off_most(a: Floats, ups: Floats) -> Floats:
    """(n,) angles between ``ups`` and ``a`` under the rotation that suits most
    of them best."""
    i, j = np.tril_indices(len(a), -1)
    apart = np.minimum(*(np.linalg.norm(np.cross(v[i], v[j]), axis=1) for v in (a, ups))) > 0.3
    i, j = i[apart], j[apart]
    if len(i) > PAIRS_MOST:
        some = np.random.default_rng(0).permutation(len(i))[:PAIRS_MOST]
        i, j = i[some], j[some]
    C = nearest_rotation(np.stack([ups[i], ups[j]], axis=1), np.stack([a[i], a[j]], axis=1))
    off: Floats = np.linalg.norm(a - np.einsum("mij,nj->mni", C, ups), axis=2)
    return off[int(np.argmin(np.median(off, axis=1)))] if len(off) else np.full(len(a), np.inf)


def wrong_by_residual(s: TurntableSolution) -> Ints:
    """The row whose residual stands out from the noise and from all others, as
    if it had not been in the fit.

    None where no row does, several where these cannot be distinguished.
    """
    n, left = len(s.data.u), s.left - 3
    if left < 3:
        return np.zeros(0, dtype=int)
    taken = np.einsum("ni,nij,nj->n", s.rest, np.linalg.pinv(s.free, rcond=1e-9, hermitian=True), s.rest)
    most = float(np.max(taken))
    after = max(s.chi2 - most, 1e-300)
    p = float(f_sf(most / 3, 3, max(s.data.dof, 1.0)))
    p = max(p, float(f_sf(most / 3 / (after / left), 3, left))) * n
    return np.flatnonzero(taken > (1 - TIED) * most) if p < ALARM else np.zeros(0, dtype=int)
