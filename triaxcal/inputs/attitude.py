"""Calibration from poses of known attitude: a turntable, or a cube on a
levelled plate (the paper's traditional way).

``u = P g + c`` with ``g`` the reference vector in the table's frame, which the
attitude gives, ``P = K R C`` (3,3) and ``c = K b``: twelve parameters, the nine
of the sensor and the rotation C from the table's frame to the sensor's, which
magnitudes cannot show. Attitudes err too. Their error is a nuisance of two
angles a pose with a variance of its own: where it is large against the noise
the magnitude still counts in full, and the fit tends to that of the ellipsoid.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from triaxcal.arrays import Floats, Ints
from triaxcal.distributions import f_sf
from triaxcal.errors import InvalidData, Refused
from triaxcal.estimate.calibration import (
    Calibration,
    Exclusion,
    HoldsAt,
    PoseResult,
    Residual,
    pose_results,
    studentized,
)
from triaxcal.estimate.caution import BirgeRatio, Caution, FewPoses
from triaxcal.inputs.attitude_cautions import (
    AttitudeExcluded,
    AttitudesContradict,
    AttitudesTied,
    DeclaredErrorContradicted,
    MagnitudeContradicts,
    Row,
)
from triaxcal.inputs.turntable import (
    ERROR_MOST,
    TurntableData,
    TurntableSolution,
    iterated,
    solved,
    wrong_by_magnitude,
    wrong_by_residual,
)
from triaxcal.inputs.turntable_parameters import parameters_by_entries, second_order, sensor_and_rotation, signs_of
from triaxcal.model.directions import most_wanted
from triaxcal.model.sensor import Sensor
from triaxcal.poses.degrees_of_freedom import LACK_OF_FIT, within_pose_dof
from triaxcal.poses.pose import Pose
from triaxcal.poses.pose_in_words import the_poses

DILUTION_MOST = 100.0
"""Largest standard error of a combination of the twelve parameters, in errors
of one pose: the limit that a fit to still poses has."""
RAISED = 1.5
"""By how much the error of the attitudes has to raise a standard error to be
worth a word."""
FREE_LEAST = 1e-3
"""Poses of which less of the error shows as a residual are not judged by it."""
PARAMETERS, LEFT_LEAST = 12, 6
"""Degrees of freedom below which the residual proves little: half a degree for
each of the parameters."""
WRONG_MOST = 0.25
"""Share of the rows that may be wrong; with more it is not known which ones are
right."""


@dataclass(frozen=True)
class Attitude:
    """What one pose says of its attitude. ``up`` (3,) is the direction of the
    specific force in the table's frame, a unit vector; ``off_rad`` the angle
    between it and what the fit finds, ``off`` in that angle's standard
    errors."""

    name: str
    up: Floats
    off_rad: float
    off: float


@dataclass(frozen=True)
class AttitudeFit:
    """``rotation`` C (3,3): ``a_sensor = C a_table``; ``rotation_error_rad``
    (3,) standard errors of turns of the sensor's frame about its axes.
    ``attitude_error_rad`` by axis and pose, declared or ``estimated`` from the
    residuals, then with its standard error, ``attitude_error_uncertainty_rad``.
    ``noise_error`` (9,) are the standard errors that the same poses would give,
    were the attitudes exact; ``attitudes`` are those of all poses.

    ``if_estimated`` is the fit with an estimate, where the residuals contradict
    the error that was declared and a larger one explains them.
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
    """Fit the linear model to still poses whose attitudes are known.

    ``ups`` (n,3): the direction of the specific force at rest (up) in the
    table's frame, of any length. ``names`` tell the rows in words. ``signs``
    (3,) of the scale factors; attitudes show them but for a half turn of the
    sensor's frame about one of its axes, and without them the frame nearest to
    the table's is taken. ``attitude_error_rad``, standard error of either
    angle, is estimated from the residuals where it is None. Raises Refused
    where the poses cannot carry twelve parameters, or rows and poses contradict
    each other; InvalidData.
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
    rows = np.arange(len(poses))
    wrong = wrong_by_magnitude(poses, ups, reference)
    if len(wrong) > WRONG_MOST * len(poses):
        given = ", ".join(f"{called[i]} ({the_poses([poses[i].began])})" for i in wrong[:4])
        raise Refused(
            f"{len(wrong)} of {len(poses)} attitudes contradict the angles between the poses, beginning with {given}; "
            "are the rows in the order of the poses?"
        )
    while True:
        kept = np.setdiff1d(rows, wrong)
        _require_spread(data.ups[kept], signs)
        # As if nobody knew of an error of all: it would be made to explain a
        # single wrong row.
        worst = wrong_by_residual(iterated(data.only(kept), attitude_error_rad or 0.0))
        if len(worst) != 1 or len(wrong) + 1 > WRONG_MOST * len(poses):
            break
        wrong = np.sort(np.append(wrong, kept[worst]))
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
    """The fit with an error of the attitudes that the residuals say; None where
    they say none.

    Nor where |a| disagrees with it: then more than the attitudes is wrong, and
    the estimate would stand for all of it.
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
    """Twelve parameters by poses (n,3): (up, 1) has to span four dimensions."""
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
        holds_at=HoldsAt.of(poses),
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
    """Stated attitudes against those that the readings show under the fit."""
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
