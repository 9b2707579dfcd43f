"""Calibration from poses of known attitude: a turntable, or a cube on a levelled
plate (the paper's traditional way).

``u = P g + c`` with ``g`` the reference vector in the table's frame, from the
attitude, ``P = K R C`` (3,3) and ``c = K b``: twelve parameters, the nine of the
sensor and the rotation C from the table's frame to the sensor's, which magnitudes do
not show. Errors of the attitudes are nuisances, two angles a pose with a variance of
their own. Where they are large against the noise, the magnitude still counts in full,
and the fit tends to that of the ellipsoid.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
import scipy.linalg

from triaxcal.arrays import Floats, Ints
from triaxcal.distributions import f_sf
from triaxcal.errors import InvalidData, Refused
from triaxcal.estimate.calibration import (
    BirgeRatio,
    Calibration,
    Caution,
    Exclusion,
    FewPoses,
    PoseResult,
    ReferenceEpoch,
    Residual,
    pose_results,
    studentized,
)
from triaxcal.estimate.initial_estimate import problem_of, start
from triaxcal.frames.faces import nearest_rotation
from triaxcal.model.directions import most_wanted
from triaxcal.model.sensor import Sensor
from triaxcal.poses.degrees_of_freedom import LACK_OF_FIT, lack_of_fit_p, within_pose_dof
from triaxcal.poses.pose import Pose, PoseStart, the_poses

# Cautions of a fit to poses of known attitude.


@dataclass(frozen=True)
class Row:
    """A given attitude by name, and the beginning of its pose."""

    name: str
    began: PoseStart


@dataclass(frozen=True)
class AttitudesTied(Caution):
    """One of these attitudes is wrong; none is excluded."""

    rows: tuple[Row, ...]


@dataclass(frozen=True)
class AttitudeExcluded(Caution):
    """The attitude is wrong by ``off_rad``; the pose was measured with ``up`` in the
    table's frame."""

    row: Row
    off_rad: float
    up: tuple[float, float, float]


@dataclass(frozen=True)
class AttitudesContradict(Caution):
    """The attitudes contradict each other by more than noise; ``error_rad`` by axis
    is estimated from that."""

    error_rad: float


@dataclass(frozen=True)
class DeclaredErrorContradicted(Caution):
    """The residuals contradict the declared error: they give ``error_rad`` ±
    ``uncertainty_rad``; ``declared_rad`` stays in force.

    With it the standard errors are up to ``raised`` times those with the estimate.
    """

    declared_rad: float
    error_rad: float
    uncertainty_rad: float
    raised: float


@dataclass(frozen=True)
class MagnitudeContradicts(Caution):
    """Under the fit |a| is off by ``ratio`` times its noise, most in the ``worst``
    row."""

    ratio: float
    worst: Row


# Weighted least squares of ``u = P g + c`` over poses of known attitude, with the
# errors of the attitudes as nuisances.

PARAMETERS = 12
"""A matrix of nine and three offsets: attitudes determine the rotation as well."""
ROUNDS_MOST = 60
"""Gauss–Newton steps; fewer where it converges."""
CONVERGED = 1e-11
"""Relative change of the matrix from step to step: far below any noise, above
rounding."""
ALARM = 0.005
"""Probability of a false alarm in a set of right rows."""
ESTIMATE_BELOW = 0.2
"""Residuals of smaller probability are attributed to the attitudes, where their error
was not declared."""
ERROR_LEAST = 1e-8
"""Smaller errors of attitudes, in rad (2 milliarcseconds), count as zero."""
ERROR_MOST = 0.3
"""Largest useful error of attitudes, in rad."""
PAIRS_MOST = 400
"""Pairs of rows that are tried for the rotation: one pair of right rows is enough.
All pairs of 28 rows; of more rows a fixed subset, to limit the time."""
TIED = 0.02
"""Rows whose reductions in chi-square are within this share of each other are
tied."""


class AttitudesContradictReadings(Refused):
    """Too many rows contradict the readings to determine the right ones."""

    def __init__(self) -> None:
        super().__init__("attitudes and readings contradict each other; are the rows in the order of the poses?")


@dataclass(frozen=True)
class TurntableData:
    """``u`` (n,3) outputs, ``covariance`` (n,3,3) with ``dof`` degrees of freedom,
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
    """``P`` (3,3) and ``c`` (3,) with ``covariance`` (12,12) of P row by row and c;
    ``noise_only`` the same for exact attitudes. ``rest`` (n,3) residuals, ``weight``
    (n,3,3) their inverse covariance, ``design`` (n,3,12). ``found`` (n,3) the fitted
    attitudes, unit vectors; ``target`` (n,3) the data of ``design @ p``."""

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
        """P and c from all other poses."""
        rest: Ints = np.delete(np.arange(len(self.rest)), row)
        p, _ = _weighted(self.design[rest], self.weight[rest], self.target[rest])
        return p[:9].reshape(3, 3), p[9:]

    @property
    def error_uncertainty_rad(self) -> float:
        """Standard error of the estimate ``error_rad``, which makes ``chi2`` equal to
        ``left``.

        Chi-square has variance 2 ``left``, and the part due to the attitudes
        decreases with the square of their error.
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
    """The solution with the declared error of the attitudes; else with the smallest
    error that explains the residuals."""
    # With exact attitudes first; keep them if the residuals agree.
    solution = iterated(data, error_rad or 0.0)
    if error_rad is not None or solution.p is None or solution.p > ESTIMATE_BELOW:
        return solution

    def excess(log: float) -> float:
        tried = iterated(data, float(np.exp(log)))
        return tried.chi2 - tried.left

    # Bracket the error at which chi-square equals its degrees of freedom, then Brent.
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
    """The solution for attitudes with this error: Gauss–Newton over the twelve
    parameters, with each attitude adjusted within its error. Raises Refused where it
    diverges."""
    n = len(data.u)
    g = data.ups
    design = np.zeros((n, 3, PARAMETERS))
    P, c = _plain(data)
    for _ in range(ROUNDS_MOST):
        # Design at the adjusted attitudes, row by row of P, and the offsets.
        for i in range(3):
            design[:, i, 3 * i : 3 * i + 3] = data.reference * g
            design[:, i, 9 + i] = 1.0
        # Two angles of each attitude: their outputs, and the stated attitude in them.
        across = _across(g)
        turned = data.reference * P @ across  # (n,3,2): outputs by the two angles
        stated = np.einsum("nik,ni->nk", across, data.ups - g)  # the stated attitude, seen from the settled one
        # Covariance with the attitudes' errors: V = Σ + σ² T Tᵀ.
        V = data.covariance + error_rad**2 * turned @ turned.transpose(0, 2, 1)
        try:
            weight = np.linalg.inv(V)
        except np.linalg.LinAlgError:
            raise AttitudesContradictReadings from None
        target = data.u - np.einsum("nik,nk->ni", turned, stated)
        # Weighted step for P and c.
        p, covariance = _weighted(design, weight, target)
        P, before, c = p[:9].reshape(3, 3), P, p[9:]
        rest = target - design @ p
        # Posterior mean of the attitudes' angles: σ² Tᵀ V⁻¹ r.
        if error_rad:
            tilt = stated + error_rad**2 * np.einsum("nik,nij,nj->nk", turned, weight, rest)
            g = g + np.einsum("nik,nk->ni", across, tilt)
            g /= np.linalg.norm(g, axis=1, keepdims=True)
        if np.max(np.abs(P - before)) < CONVERGED * np.max(np.abs(P)):
            break
    _, noise_only = _weighted(design, np.linalg.inv(data.covariance), target)
    return TurntableSolution(data, P, c, covariance, noise_only, rest, weight, design, g, target, error_rad, False)


def _plain(data: TurntableData) -> tuple[Floats, Floats]:
    """P and c by unweighted least squares, as a starting point."""
    design = np.concatenate([data.reference * data.ups, np.ones((len(data.u), 1))], axis=1)
    found = np.linalg.lstsq(design, data.u, rcond=None)[0]
    return found[:3].T, found[3]


def _weighted(design: Floats, weight: Floats, target: Floats) -> tuple[Floats, Floats]:
    """Weighted least squares by pose: parameters (12,) and covariance (12,12)."""
    # Whiten the rows by the Cholesky factors of their weights.
    root = np.linalg.cholesky(weight).transpose(0, 2, 1)
    X, y = (root @ design).reshape(-1, PARAMETERS), (root @ target[..., None]).ravel()
    norms = np.linalg.norm(X, axis=0)
    inverse = np.linalg.inv((X / norms).T @ (X / norms)) / np.outer(norms, norms)
    return inverse @ (X.T @ y), inverse


def _across(g: Floats) -> Floats:
    """(n,3,2): two unit vectors perpendicular to each of ``g`` (n,3)."""
    spare = np.eye(3)[np.argmin(np.abs(g), axis=1)]
    one = np.cross(g, spare)
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    return np.stack([one, np.cross(g, one)], axis=2)


def wrong_by_magnitude(poses: Sequence[Pose], ups: Floats, reference: float) -> Ints:
    """Rows whose attitude disagrees with most others, by the angles between the poses
    that |a| alone determines. None where |a| does not determine them."""
    # Directions in the sensor's frame from the fit to |a|; the handedness is unknown.
    try:
        problem = problem_of(poses, reference=reference)
        sensor = start(problem, poses, (1, 1, 1)).sensor(problem)
    except Refused:
        return np.zeros(0, dtype=int)
    a = sensor.specific_force(np.array([p.mean for p in poses]), {})
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    mirrored = a * [1.0, 1.0, -1.0]  # signs are not known, but only their product is no rotation
    # The handedness with the smaller median deviation.
    off = min((_off_most(v, ups) for v in (a, mirrored)), key=lambda v: float(np.median(v)))
    scale = max(float(np.median(off)), 1e-9)
    return np.flatnonzero(off > np.clip(10 * scale, 0.02, ERROR_MOST))


def _off_most(a: Floats, ups: Floats) -> Floats:
    """(n,) angles between ``ups`` and ``a`` under the rotation that fits most of
    them."""
    # Rotations from pairs of rows that are far enough apart; the least median wins.
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
    """The row with a significant deletion residual, against the noise and all other
    rows.

    Empty where there is none, several rows where these are tied.
    """
    n, left = len(s.data.u), s.left - 3
    if left < 3:
        return np.zeros(0, dtype=int)
    # Reduction in chi-square by deletion of each row: rᵀ C⁺ r.
    taken = np.einsum("ni,nij,nj->n", s.rest, np.linalg.pinv(s.free, rcond=1e-9, hermitian=True), s.rest)
    most = float(np.max(taken))
    after = max(s.chi2 - most, 1e-300)
    # F-tests against the noise and against the rest, with Bonferroni's factor.
    p = float(f_sf(most / 3, 3, max(s.data.dof, 1.0)))
    p = max(p, float(f_sf(most / 3 / (after / left), 3, left))) * n
    return np.flatnonzero(taken > (1 - TIED) * most) if p < ALARM else np.zeros(0, dtype=int)


# From ``u = P g + c`` to a sensor and the rotation of its frame: K, R and C of
# ``P = K R C``.

SECOND_ORDER = 0.2
"""Share of a standard error from which on the squares of the misalignments' errors
are added to it."""


def signs_of(s: TurntableSolution, signs: Sequence[float] | None) -> Floats:
    """(3,) signs as declared, else those with the sensor's frame nearest to the
    table's."""
    product = float(np.sign(np.linalg.det(s.P)))
    if signs is not None:
        flips = np.asarray(signs, dtype=float)
        if float(np.prod(flips)) != product:
            raise InvalidData(
                f"the product of the signs is {np.prod(flips):+.0f}, but the attitudes say {product:+.0f}: a sign is "
                "wrong, or the frame of the attitudes is left-handed"
            )
        return flips
    choices = [np.array(f) for f in itertools.product((1.0, -1.0), repeat=3) if np.prod(f) == product]
    return max(choices, key=lambda f: float(np.trace(sensor_and_rotation(s.P, s.c, f)[1])))


def sensor_and_rotation(P: Floats, c: Floats, flips: Floats) -> tuple[Sensor, Floats]:
    """The sensor, with R upper triangular and the signs ``flips`` of K, and the
    rotation C."""
    # RQ decomposition P = (K R) C, with signs moved between both factors.
    KR, C = scipy.linalg.rq(P)
    turn = flips * np.sign(np.diag(KR))
    KR, C = KR * turn, turn[:, None] * C
    k = np.diag(KR).copy()
    R = KR / k[:, None]
    return Sensor(k, np.array([R[1, 2], R[0, 2], R[0, 1]]), c / k), np.asarray(C)


def parameters_by_entries(s: TurntableSolution, flips: Floats, C: Floats) -> Floats:
    """(12,12) derivative of scale factor, misalignment, bias and rotation of the
    sensor's frame by P row by row and c, by central differences."""

    def of(p: Floats) -> Floats:
        sensor, turned = sensor_and_rotation(p[:9].reshape(3, 3), p[9:], flips)
        W = turned @ C.T
        turns = np.array([W[2, 1] - W[1, 2], W[0, 2] - W[2, 0], W[1, 0] - W[0, 1]]) / 2
        return np.concatenate([sensor.scale_factor, sensor.misalignment, sensor.bias, turns])

    start = np.concatenate([s.P.ravel(), s.c])
    sizes = np.concatenate([np.repeat(np.linalg.norm(s.P, axis=1), 3), np.linalg.norm(s.P, axis=1)])
    steps = 1e-6 * sizes
    return np.stack([(of(start + h) - of(start - h)) / (2 * h.sum()) for h in np.diag(steps)], axis=1)


def second_order(covariance: Floats, sensor: Sensor, reference: float) -> Floats:
    """(12,) effect of the squares of poorly known angles on scale factors and biases,
    where it counts.

    On six faces only attitudes determine the misalignments; an axis that is off by an
    angle reads its cosine.
    """
    square = float(np.max(np.diag(covariance)[3:6]))
    scale = np.abs(sensor.scale_factor) * square
    if np.all(scale < SECOND_ORDER * np.sqrt(np.diag(covariance)[:3])):
        return np.zeros(12)
    return np.concatenate([scale, np.zeros(3), np.full(3, reference * square), np.zeros(3)])


DILUTION_MOST = 100.0
"""Largest standard error of a combination of the twelve parameters, in errors of one
pose, as in a fit to still poses."""
RAISED = 1.5
"""Factor by which the error of the attitudes has to raise a standard error to be
reported."""
FREE_LEAST = 1e-3
"""Poses that show a smaller share of their error as a residual are not tested by
it."""
LEFT_LEAST = 6
"""Degrees of freedom below which the residual proves little: half a degree for each
of the parameters."""
WRONG_MOST = 0.25
"""Largest share of wrong rows; with more, the right ones are not known."""


@dataclass(frozen=True)
class Attitude:
    """The attitude of one pose. ``up`` (3,) is the direction of the specific force in
    the table's frame, a unit vector; ``off_rad`` the angle between it and the fit,
    ``off`` the same in standard errors."""

    name: str
    up: Floats
    off_rad: float
    off: float


@dataclass(frozen=True)
class AttitudeFit:
    """``rotation`` C (3,3): ``a_sensor = C a_table``; ``rotation_error_rad`` (3,)
    standard errors of rotations of the sensor's frame about its axes.
    ``attitude_error_rad`` by axis and pose, declared or ``estimated`` from the
    residuals, then with its standard error, ``attitude_error_uncertainty_rad``.
    ``noise_error`` (9,) are the standard errors for exact attitudes; ``attitudes``
    are those of all poses.

    ``if_estimated`` is the fit with an estimate, where the residuals contradict the
    declared error and a larger one explains them.
    """

    calibration: Calibration
    rotation: Floats
    rotation_error_rad: Floats
    attitude_error_rad: float
    estimated: bool
    noise_error: Floats
    attitudes: tuple[Attitude, ...]
    attitude_error_uncertainty_rad: float | None = None
    if_estimated: AttitudeFit | None = None


def fit_attitudes(
    poses: Sequence[Pose],
    ups: Floats,
    *,
    names: Sequence[str] | None = None,
    signs: Sequence[float] | None = None,
    reference: float = 1.0,
    attitude_error_rad: float | None = None,
) -> AttitudeFit:
    """Fit the linear model to still poses of known attitude.

    ``ups`` (n,3): the direction of the specific force at rest (up) in the table's
    frame, of any length. ``names`` of the rows. ``signs`` (3,) of the scale factors;
    attitudes determine them up to a half turn of the sensor's frame about one of its
    axes, and without them the frame nearest to the table's is used.
    ``attitude_error_rad``, the standard error of either angle, is estimated from the
    residuals where it is None. Raises Refused where the poses cannot carry twelve
    parameters, or rows and poses contradict each other; InvalidData for bad
    arguments.
    """
    ups = _checked(poses, ups, signs, reference, attitude_error_rad)
    called = list(names) if names is not None else [f"row {i + 1}" for i in range(len(poses))]
    data = TurntableData(
        np.array([p.mean for p in poses]),
        np.array([p.covariance for p in poses]),
        ups,
        reference,
        within_pose_dof(poses),
    )
    # Exclude rows that contradict the angles between the poses.
    rows = np.arange(len(poses))
    wrong = wrong_by_magnitude(poses, ups, reference)
    if len(wrong) > WRONG_MOST * len(poses):
        given = ", ".join(f"{called[i]} ({the_poses([poses[i].began])})" for i in wrong[:4])
        raise Refused(
            f"{len(wrong)} of {len(poses)} attitudes contradict the angles between the poses, beginning with {given}; "
            "are the rows in the order of the poses?"
        )
    # Exclude further rows one by one by their deletion residuals.
    while True:
        kept = np.setdiff1d(rows, wrong)
        _require_spread(data.ups[kept], signs)
        # Without an estimated error of the attitudes, which would absorb a single
        # wrong row.
        worst = wrong_by_residual(iterated(data.only(kept), attitude_error_rad or 0.0))
        if len(worst) != 1 or len(wrong) + 1 > WRONG_MOST * len(poses):
            break
        wrong = np.sort(np.append(wrong, kept[worst]))
    # Final solution; then the competing fit with an estimated error of the attitudes.
    found = _concluded(poses, data, solved(data.only(kept), attitude_error_rad), kept, called, signs)
    more: list[Caution] = []
    if len(worst) > 1:
        more.append(AttitudesTied(tuple(Row(called[i], poses[i].began) for i in kept[worst])))
    if attitude_error_rad is not None and found.calibration.birge_ratio > 1:
        instead = _if_estimated(poses, ups, called, signs, reference)
        if instead is not None and instead.attitude_error_rad > attitude_error_rad:
            found = replace(found, if_estimated=instead)
            more.append(_contradicted(found, instead))
    return replace(found, calibration=replace(found.calibration, cautions=(*more, *found.calibration.cautions)))


def _if_estimated(
    poses: Sequence[Pose], ups: Floats, names: Sequence[str], signs: Sequence[float] | None, reference: float
) -> AttitudeFit | None:
    """The fit with an error of the attitudes estimated from the residuals; None where
    they show none.

    Also None where |a| contradicts it: then more than the attitudes is wrong, and the
    estimate would absorb all of it.
    """
    try:
        found = fit_attitudes(poses, ups, names=names, signs=signs, reference=reference)
    except Refused:
        return None
    doubtful = any(isinstance(c, MagnitudeContradicts) for c in found.calibration.cautions)
    return found if found.estimated and not doubtful else None


def _contradicted(found: AttitudeFit, instead: AttitudeFit) -> DeclaredErrorContradicted:
    assert instead.attitude_error_uncertainty_rad is not None
    return DeclaredErrorContradicted(
        found.attitude_error_rad,
        instead.attitude_error_rad,
        instead.attitude_error_uncertainty_rad,
        float(np.max(found.calibration.standard_errors / instead.calibration.standard_errors)),
    )


def _checked(
    poses: Sequence[Pose], ups: Floats, signs: Sequence[float] | None, reference: float, error: float | None
) -> Floats:
    ups = np.asarray(ups, dtype=float)
    if ups.shape != (len(poses), 3):
        raise InvalidData(f"{len(poses)} poses, but attitudes of shape {ups.shape}; expected ({len(poses)}, 3)")
    if not np.isfinite(ups).all():
        raise InvalidData("an attitude is not a finite number")
    length = np.linalg.norm(ups, axis=1)
    if not np.all(length > 0):
        raise InvalidData(f"attitude {int(np.argmin(length)) + 1} is a vector of no length")
    if not (np.isfinite(reference) and reference > 0):
        raise InvalidData(f"the reference must be a positive number, not {reference}")
    if signs is not None and not all(s in (1, -1) for s in signs):
        raise InvalidData(f"signs must be +1 or −1, not {signs}")
    if error is not None and not 0 <= error <= ERROR_MOST:
        raise InvalidData(f"the error of an attitude must lie between 0 and {ERROR_MOST} rad, not at {error}")
    return np.asarray(ups / length[:, None])


def _require_spread(ups: Floats, signs: Sequence[float] | None) -> None:
    """Twelve parameters need poses (n,3) with (up, 1) spanning four dimensions;
    raises Refused otherwise."""
    if not _dilution(ups) < DILUTION_MOST:
        flips = np.ones(3) if signs is None else np.asarray(signs, dtype=float)
        labels = tuple(dict.fromkeys(label for label, _ in most_wanted(ups * flips)))
        raise Refused(
            f"{len(ups)} poses of known attitude cannot carry twelve parameters: at least four are needed, not all in "
            "one plane or circle",
            wanted=labels,
        )


def _concluded(
    poses: Sequence[Pose],
    data: TurntableData,
    s: TurntableSolution,
    kept: Ints,
    names: Sequence[str],
    signs: Sequence[float] | None,
) -> AttitudeFit:
    flips = signs_of(s, signs)
    sensor, C = sensor_and_rotation(s.P, s.c, flips)
    raised = max(1.0, float(np.sqrt(s.chi2 / s.left))) if s.p is not None and s.p < LACK_OF_FIT else 1.0
    G = parameters_by_entries(s, flips, C)
    covariance = G @ s.covariance @ G.T * raised**2
    covariance += np.diag(second_order(covariance, sensor, data.reference) ** 2)
    results = _results(poses, data, s, sensor, kept)
    misses, noise = (np.array(v) for v in zip(*((p.residual_g, p.standard_error_g) for p in results), strict=True))
    information = np.linalg.inv(s.covariance)
    norms = np.sqrt(np.diag(information))
    attitudes = _judged(data, s, np.array([p.direction for p in results]), C, names)
    residual = Residual.of(misses[kept], noise[kept], cross_validated_rms_g=_left_out(s), lack_of_fit_p=s.p)
    calibration = Calibration(
        sensor=sensor,
        covariance=covariance[:9, :9],
        reference=data.reference,
        channel_reference={},
        residual=residual,
        poses=results,
        condition=float(np.sqrt(np.linalg.cond(information / np.outer(norms, norms)))),
        dilution=_dilution(s.data.ups),
        birge_ratio=raised,
        dof=float(s.left if raised > 1 or s.estimated else max(s.data.dof, 1.0)),
        holds_at=ReferenceEpoch.of(poses),
    )
    found = AttitudeFit(
        calibration,
        C,
        np.sqrt(np.diag(covariance)[9:]),
        s.error_rad,
        s.estimated,
        np.sqrt(np.diag(G @ s.noise_only @ G.T)[:9]),
        attitudes,
        s.error_uncertainty_rad if s.estimated else None,
    )
    return replace(found, calibration=replace(calibration, cautions=tuple(_cautions(found, s))))


def _results(
    poses: Sequence[Pose], data: TurntableData, s: TurntableSolution, sensor: Sensor, kept: Ints
) -> tuple[PoseResult, ...]:
    """|a| in all poses under the fit to those ``kept``."""
    a = sensor.specific_force(data.u, {})
    length, by_u = sensor.magnitude(data.u, {})
    noise = np.sqrt(np.maximum(np.einsum("ni,nij,nj->n", by_u, data.covariance, by_u), (1e-12 * data.reference) ** 2))
    fitted = np.einsum("nip,pq,njq->nij", s.design, s.covariance, s.design)
    taken = np.zeros(len(poses))
    taken[kept] = np.einsum("ni,nij,nj->n", by_u[kept], fitted, by_u[kept])
    leverage = np.clip(taken / noise**2, 0.0, 1.0)
    misses = length - data.reference
    off = studentized(misses, noise, leverage, least=FREE_LEAST)
    gone = {i: Exclusion.FAULT if p.fault else Exclusion.OUTLIER for i, p in enumerate(poses) if i not in kept}
    return pose_results(poses, a / length[:, None], misses, noise, off, leverage, excluded=gone)


def _judged(
    data: TurntableData, s: TurntableSolution, direction: Floats, C: Floats, names: Sequence[str]
) -> tuple[Attitude, ...]:
    """Stated attitudes against those from the readings under the fit."""
    inverse = np.linalg.inv(s.P) / data.reference
    V = inverse @ data.covariance @ inverse.T
    out = []
    for i, name in enumerate(names):
        seen = C.T @ direction[i]
        off = float(np.arctan2(np.linalg.norm(np.cross(seen, data.ups[i])), seen @ data.ups[i]))
        error = float(np.sqrt((np.trace(V[i]) - seen @ V[i] @ seen) / 2 + s.error_rad**2))
        out.append(Attitude(name, data.ups[i], off, off / max(error, 1e-12)))
    return tuple(out)


def _left_out(s: TurntableSolution) -> float | None:
    """rms of each pose's |a| − reference under a fit to all the others; None
    where others cannot carry one."""
    n = len(s.rest)
    squares = 0.0
    for i in range(n):
        if not _dilution(np.delete(s.data.ups, i, axis=0)) < DILUTION_MOST:
            return None
        P, c = s.without(i)
        squares += float(np.linalg.norm(np.linalg.solve(P, s.data.u[i] - c)) - s.data.reference) ** 2
    return float(np.sqrt(squares / n))


def _dilution(ups: Floats) -> float:
    """The worst standard error of a combination of an axis's parameters, in
    standard errors of one pose."""
    if len(ups) < 4:
        return float("inf")
    smallest = float(np.linalg.svd(np.concatenate([ups, np.ones((len(ups), 1))], axis=1), compute_uv=False)[-1])
    return float(1 / smallest) if smallest > 1e-12 else float("inf")


def _cautions(found: AttitudeFit, s: TurntableSolution) -> Iterator[Caution]:
    c = found.calibration
    rows = [Row(a.name, p.pose.began) for a, p in zip(found.attitudes, c.poses, strict=True)]
    for row, attitude, result in zip(rows, found.attitudes, c.poses, strict=True):
        if not result.used:
            x, y, z = map(float, found.rotation.T @ result.direction)
            yield AttitudeExcluded(row, attitude.off_rad, (x, y, z))
    if found.estimated and np.any(c.standard_errors > RAISED * found.noise_error):
        yield AttitudesContradict(found.attitude_error_rad)
    if c.birge_ratio > 1:
        yield BirgeRatio(c.birge_ratio, attitudes=True)
    used = [p for p in c.poses if p.used]
    left = sum(1 - p.leverage for p in used)
    chi2 = sum((p.residual_g / p.standard_error_g) ** 2 for p in used)
    if left > 0.5 and f_sf(chi2 / left, left, max(s.data.dof, 1.0)) < LACK_OF_FIT:
        worst = max(range(len(rows)), key=lambda i: abs(c.poses[i].studentized) if c.poses[i].used else -1.0)
        yield MagnitudeContradicts(float(np.sqrt(chi2 / left)), rows[worst])
    if s.left < LEFT_LEAST:
        yield FewPoses(len(used), PARAMETERS)
