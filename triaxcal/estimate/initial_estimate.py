"""The start of the fit: the poses as arrays, the closed form, and the refusal of
poses that cannot carry the parameters."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.linalg

from triaxcal.arrays import Floats
from triaxcal.distributions import chi2_ppf
from triaxcal.effects.contract import Effect
from triaxcal.errors import InvalidData, Refused
from triaxcal.estimate.likelihood import Problem, State, linearise
from triaxcal.model.directions import dilution, distinct, linear_design, most_wanted
from triaxcal.model.sensor import LINEAR, Sensor
from triaxcal.poses.covariates import channels_of, lags_for, references, with_scale
from triaxcal.poses.pose import Pose

# The closed form: the ellipsoid on which a resting unit's outputs lie.

# 4 J − I² = 1 for β₁ = (a, b, c, d, e, f) of a x² + b y² + c z² + d xy + e yz +
# f xz.
_CONSTRAINT = np.zeros((6, 6))
_CONSTRAINT[:3, :3] = 1.0 - 2.0 * np.eye(3)
_CONSTRAINT[range(3, 6), range(3, 6)] = -1.0


def closed_form(u: Floats) -> tuple[Floats, Floats]:
    """``A`` (3,3), upper triangular with a positive diagonal, and ``c`` (3,) in
    output units, such that ``|A (u − c)| = 1``.

    Direct fit with the ellipsoid constraint 4 J − I² = 1 (Li and
    Griffiths 2004), after scaling each axis to its range. ``u`` (n,3) outputs, n ≥ 9.
    Raises Refused where the outputs lie on no ellipsoid.
    """
    # Scale each axis to −1 … 1: the constraint fails where one half-axis is shorter
    # than half of the longest.
    middle = (u.max(axis=0) + u.min(axis=0)) / 2
    half = (u.max(axis=0) - u.min(axis=0)) / 2
    if len(u) < 9 or not np.all(half > 0):
        raise Refused(f"{len(u)} poses cannot carry nine parameters: at least nine that differ in every axis")
    x, y, z = ((u - middle) / half).T
    # Design matrix D = [D1 D2]: quadratic columns, then linear ones and the constant.
    D1 = np.stack([x * x, y * y, z * z, x * y, y * z, x * z], axis=1)
    D2 = np.stack([x, y, z, np.ones_like(x)], axis=1)
    S12, S22 = D1.T @ D2, D2.T @ D2
    # Eliminate β₂ = −T β₁ with T = S22⁻¹ S12ᵀ; then C⁻¹ (S11 − S12 T) β₁ = λ β₁.
    try:
        T = np.linalg.solve(S22, S12.T)
        values, vectors = scipy.linalg.eig(np.linalg.solve(_CONSTRAINT, D1.T @ D1 - S12 @ T))
    except np.linalg.LinAlgError:
        raise Refused("the poses lie in one plane or on one point; no ellipsoid goes through them") from None
    # The one positive eigenvalue belongs to the ellipsoid.
    beta1 = vectors[:, int(np.argmax(values.real))].real
    beta2 = -T @ beta1
    a, b, c, d, e, f = beta1
    # Quadratic form uᵀ B u + [h i j] u + β₁₀ = 0.
    B = np.array([[a, d / 2, f / 2], [d / 2, b, e / 2], [f / 2, e / 2, c]])
    try:
        # Centre c = −½ B⁻¹ [h i j]ᵀ; H = B / (cᵀ B c − β₁₀), so that (u − c)ᵀ H (u − c)
        # = 1.
        centre = -0.5 * np.linalg.solve(B, beta2[:3])
        H = B / (centre @ B @ centre - beta2[3])
        # H = Aᵀ A: A is the upper Cholesky factor.
        A = np.linalg.cholesky(H).T
    except np.linalg.LinAlgError:
        raise Refused("the poses lie on no ellipsoid: too few, in one plane or hemisphere, or not still") from None
    # Undo the scaling of the axes.
    return A / half, middle + half * centre


def coefficients(A: Floats, c: Floats) -> tuple[Floats, Floats, Floats]:
    """Scale factor (3,), misalignment (ax, ay, az) in radians and bias (3,) from
    ``A`` and ``c`` (eq. 4, 5)."""
    # A⁻¹ = K R: its diagonal is K, R = K⁻¹ A⁻¹, and b = K⁻¹ c.
    KR = np.linalg.inv(A)
    k = np.diag(KR).copy()
    return k, np.array([KR[1, 2] / k[1], KR[0, 2] / k[0], KR[0, 1] / k[0]]), c / k


DILUTION_LIMIT = 100.0
"""Largest dilution of a set of poses that is fitted: some combination of parameters
is a hundred times as uncertain as one pose."""
NOISE_LIMIT = 0.05
"""Largest noise times dilution, as a share of the reference, with which poses are
fitted."""
ROUGH_LEAST, ROUGH_APART_DEG, ROUGH_LIMIT_RAD, TRIAD_UNLIKE_SPHERE = 6, 10.0, 0.2, 0.03
"""Directions without a fit need so many distinct directions so far apart, with no
more than this uncertainty; scale factors of the axes are assumed to differ by at
least the last number."""


class Underdetermined(Refused):
    """The poses cannot carry nine parameters; ``a`` (n,3) are their directions as far
    as they are known."""

    def __init__(self, why: str, a: Floats, wanted: Sequence[str]) -> None:
        super().__init__(f"{why}; {len(a)} poses in {distinct(a)} distinct directions", wanted=wanted)


def problem_of(
    poses: Sequence[Pose],
    *,
    signs: Sequence[float] = (1, 1, 1),
    reference: float = 1.0,
    effects: Sequence[Effect] = (),
) -> Problem:
    """Poses as arrays, with the lagged channels that the ``effects`` need. Raises
    InvalidData for bad arguments, Refused for fewer than nine poses."""
    if len(poses) < LINEAR:
        raise Refused(
            f"{len(poses)} still pose{'s' * (len(poses) != 1)}; nine parameters need at least {LINEAR}, "
            "14 or 26 are better",
            wanted=wanted_for(poses, signs),
        )
    # Range of each output: its middle and half scale the outputs of the search.
    u = np.array([p.mean for p in poses])
    low, high = u.min(axis=0), u.max(axis=0)
    flat = [axis for axis, same in zip("xyz", high - low <= 0, strict=True) if same]
    if flat:
        raise Refused(f"the output of axis {', '.join(flat)} never changes; it cannot be calibrated")
    if not all(s in (1, -1) for s in signs):
        raise InvalidData(f"signs must be +1 or −1, not {signs}")
    if not (np.isfinite(reference) and reference > 0):
        raise InvalidData(f"the reference must be a positive number, not {reference}")
    channels = channels_of(poses, lags_for(effects))
    return Problem(
        u=u,
        covariance=np.array([p.covariance for p in poses]),
        channels=channels,
        channel_reference=references(channels),
        middle=(low + high) / 2,
        half=(high - low) / 2,
        signs=np.asarray(signs, dtype=float),
        reference=reference,
    )


def start(problem: Problem, poses: Sequence[Pose], signs: Sequence[float]) -> State:
    """The closed form as the starting point. Raises Underdetermined where the poses
    cannot carry nine parameters."""
    # Directions for the refusal, if the closed form fails: outputs scaled to their
    # range.
    x = (problem.u - problem.middle) / problem.half
    rough = x / np.linalg.norm(x, axis=1, keepdims=True)
    try:
        # Closed form, and the dilution of the directions that it gives.
        A, c = closed_form(problem.u)
        a = (problem.u - c) @ A.T
        spread = dilution(a, linear_design(a / np.linalg.norm(a, axis=1, keepdims=True), x))
    except Refused as e:
        raise Underdetermined(str(e), rough, wanted_for(poses, signs)) from None
    # Signs of the scale factors: k and b change sign with their own axis, an angle with
    # the product of the signs of its two axes.
    k, angles, b = coefficients(A * problem.reference, c)
    ax, ay, az = angles
    sx, sy, sz = problem.signs
    D = problem.signs * problem.half / k
    w = problem.signs * b - problem.middle * D / problem.half
    state = State(np.concatenate([D, w, [ax * sy * sz, ay * sx * sz, az * sx * sy]]), ())
    # Refuse sets whose dilution, or dilution times noise, is beyond the limit.
    noise = float(np.sqrt(np.mean(linearise(problem, state)[2] ** 2))) / problem.reference
    known = spread * noise < NOISE_LIMIT
    if not spread < DILUTION_LIMIT:
        raise Underdetermined(
            f"the poses cannot carry nine parameters: some combination of them would be {spread:.3g} times as "
            f"uncertain as one pose (limit {DILUTION_LIMIT:g})",
            a,
            wanted_for(poses, signs),
        )
    if not known:
        raise Underdetermined(
            "the poses cannot carry nine parameters: they differ by little more than their noise",
            a,
            wanted_for(poses, signs),
        )
    return state


def with_history(problem: Problem, poses: Sequence[Pose], sensor: Sensor) -> Problem:
    """The problem with the covariates that need the scale of the outputs: the
    previous pose and the scatter."""
    return problem.with_channels(with_scale(problem.channels, poses, sensor.scale_factor, sensor.bias))


def started_problem(
    poses: Sequence[Pose], *, signs: Sequence[float], reference: float, effects: Sequence[Effect] = ()
) -> tuple[Problem, State]:
    """The problem with all covariates that the ``effects`` need, and the starting
    point of the fit. Raises as `problem_of` and `start` do."""
    problem = problem_of(poses, signs=signs, reference=reference, effects=effects)
    state = start(problem, poses, signs)
    return with_history(problem, poses, state.sensor(problem)), state


def wanted_for(poses: Sequence[Pose], signs: Sequence[float]) -> tuple[str, ...]:
    """Labels of the poses that would complete a set, as far as its directions can be
    determined without a fit.

    Where they cannot, these are the labels of a whole set, which carries nine
    parameters by itself.
    """
    up, unsure_rad = rough_directions(poses, signs)
    return _labels(up, unsure_rad)


def rough_directions(poses: Sequence[Pose], signs: Sequence[float]) -> tuple[Floats, float]:
    """Up (n,3) in the sensor's frame for poses that need not carry a fit, and its
    uncertainty in radians; (0,3) where it cannot be determined.

    The method is a sphere through the outputs. With poses to spare, the residual
    shows how far the triad is from a sphere.
    """
    nothing = np.zeros((0, 3)), 0.0
    if len(poses) < ROUGH_LEAST:
        return nothing
    # The range of the outputs must be far above their noise.
    u = np.array([p.mean for p in poses])
    error = float(np.sqrt(np.mean([np.trace(p.covariance) for p in poses])))
    half = float(np.max(np.ptp(u, axis=0))) / 2
    if half <= error / NOISE_LIMIT:
        return nothing
    # Sphere through the scaled outputs: |v|² = 2 v·c + (r² − |c|²), linear in c.
    v = (u - u.mean(axis=0)) / half
    rows = np.concatenate([2 * v, np.ones((len(v), 1))], axis=1)
    centre = np.linalg.lstsq(rows, (v**2).sum(axis=1), rcond=1e-9)[0][:3]
    radii = np.linalg.norm(v - centre, axis=1)
    a = (v - centre) / np.maximum(radii, 1e-300)[:, None]
    # The smallest singular value bounds how an error of the radii turns the directions.
    smallest = float(np.linalg.svd(np.concatenate([a, np.ones((len(a), 1))], axis=1), compute_uv=False)[-1])
    if (many := distinct(a, ROUGH_APART_DEG)) < ROUGH_LEAST:
        return nothing
    # With few degrees of freedom left a triad that is no sphere may pass for
    # one: the least that 5 % of them show.
    shown = float(np.sqrt(many / chi2_ppf(0.05, many - 4)))
    unlike = max(TRIAD_UNLIKE_SPHERE, shown * float(np.std(radii) / np.mean(radii)))
    unsure_rad = unlike / max(smallest, 1e-9)
    return (a * np.asarray(signs), unsure_rad) if unsure_rad < ROUGH_LIMIT_RAD else nothing


def _labels(a: Floats, unsure_rad: float = 0.0) -> tuple[str, ...]:
    # Directions of a refused set that seem to want nothing are wrong.
    wanted = most_wanted(a, unsure_rad=unsure_rad) or most_wanted(np.zeros((0, 3)))
    return tuple(label for label, _ in wanted)
