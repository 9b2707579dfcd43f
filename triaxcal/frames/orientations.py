"""Orientations of a fixture on each of its faces, and the tilt of the table.

Unknown headings are found as far as they matter: the poses on a face are split in two
groups half a turn apart.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from triaxcal.arrays import Bools, Floats
from triaxcal.distributions import chi2_isf, chi2_sf, t_isf
from triaxcal.errors import InvalidData, Refused
from triaxcal.estimate.calibration import Calibration, Caution
from triaxcal.frames.faces import Labelling
from triaxcal.model.sensor import Sensor
from triaxcal.poses.covariates import covariates_elsewhere
from triaxcal.poses.degrees_of_freedom import SIGNIFICANT
from triaxcal.poses.pose import Pose, PoseStart

# The direction of up in a unit's still poses, in the sensor's frame, with its
# covariance.


@dataclass(frozen=True)
class Verticals:
    """``direction`` (n,3) of up in each pose, unit vectors, sensor frame;
    ``covariance`` (3n,3n) of all, rad².

    The covariance contains the noise of the poses and the uncertainty of the
    calibration, which all poses share. ``used`` (n,): poses that are no outliers.
    ``dof`` of the covariance.
    """

    poses: tuple[Pose, ...]
    direction: Floats
    covariance: Floats
    used: Bools
    dof: float


def verticals(calibration: Calibration) -> Verticals:
    """Verticals in the poses to which the calibration was fitted."""
    results = calibration.poses
    poses = tuple(r.pose for r in results)
    used = np.array([r.used for r in results])
    p = calibration.residual.lack_of_fit_p
    # Without a misfit the noise inside the poses is known better than the
    # residuals tell it.
    scale = calibration.birge_ratio if p is None or p < SIGNIFICANT else 1.0
    direction, covariance = _directions(
        calibration.sensor,
        poses,
        calibration.covariates_of(poses),
        calibration.reference,
        calibration.covariance / calibration.birge_ratio**2,
        used,
        calibration.excess_g,
    )
    return Verticals(poses, direction, scale**2 * covariance, used, max(float(calibration.dof), 1.0))


def verticals_under(
    sensor: Sensor,
    poses: Sequence[Pose],
    covariance: Floats,
    *,
    channel_reference: Mapping[str, float],
    reference: float = 1.0,
    moment: tuple[float, float] | None = None,
) -> Verticals:
    """Verticals in poses of another recording than the calibration's; ``covariance``
    (p,p) of `Calibration.parameters`.

    Effects of time are evaluated at one ``moment``
    (`triaxcal.poses.covariates.of_moment`), since the clock is another. Raises
    InvalidData where a channel that the calibration needs is missing.
    """
    used = np.ones(len(poses), dtype=bool)
    covariates = covariates_elsewhere(poses, channel_reference, sensor.scale_factor, sensor.bias, moment)
    direction, V = _directions(sensor, poses, covariates, reference, covariance, used)
    return Verticals(tuple(poses), direction, V, used, 1e6)


def _directions(
    sensor: Sensor,
    poses: Sequence[Pose],
    covariates: Mapping[str, Floats],
    reference: float,
    P: Floats,
    used: Bools,
    excess_g: float = 0.0,
) -> tuple[Floats, Floats]:
    """Up (n,3), and its covariance (3n,3n), for the covariance P (p,p) of the
    parameters.

    |a| is known, so the residual r = |a| − reference is noise along the measured
    vector v. With noise that differs by axis, the noise across is correlated with it,
    and the estimate is a − N v r / (vᵀ N v), N the covariance of a. The remaining
    noise is independent of the residuals, hence of the errors of a calibration that
    was fitted to the same poses.
    """
    u = np.array([p.mean for p in poses])
    a, by_u, by_parameter = sensor.specific_force_and_derivatives(u, covariates)
    length = np.linalg.norm(a, axis=1)
    if not np.all(length > 0):
        raise InvalidData("a pose reads no specific force at all under the calibration")
    # Covariance N of the specific force, from outputs and excess variance.
    noise = by_u @ np.array([p.covariance for p in poses]) @ by_u.transpose(0, 2, 1) + excess_g**2 * np.eye(3)
    v = a / length[:, None]
    # Subtract the noise along v that the residual shows, and normalise.
    along = np.einsum("nij,nj->ni", noise, v)
    gain = along * (used / np.maximum(np.einsum("ni,ni->n", v, along), 1e-300))[:, None]
    direction = a - gain * (length - reference)[:, None]
    size = np.linalg.norm(direction, axis=1, keepdims=True)
    direction = direction / size
    # Derivatives by the parameters: direct, and through the residual.
    J = np.einsum("ni,nip->np", v, by_parameter)
    n = len(u)
    D = (by_parameter - gain[:, :, None] * J[:, None, :]).reshape(3 * n, -1)
    V = D @ P @ D.T
    # Noise of every pose, and the projection across the direction.
    across = np.zeros((3 * n, 3 * n))
    for i in range(n):
        block = slice(3 * i, 3 * i + 3)
        V[block, block] += noise[i] - np.outer(gain[i], along[i])
        across[block, block] = (np.eye(3) - np.outer(direction[i], direction[i])) / size[i]
    return direction, across @ V @ across


FLOOR_RAD = 1e-12
"""Standard error of a direction without noise, as in a simulation: it keeps the
weights finite, and is far below the noise of any pose."""
SHOWS = 1e-4
"""Probability below which a tilt, or a face that was not turned, is significant."""
PAIRS_LEAST = 3
"""Number of faces with equal tilt from which the tilt of a face with one orientation
is inferred."""
SHORT = 0.95
"""Share of the tilt that a turn by 143° shows."""
SPLIT_MOST = 12
"""Largest number of poses on a face for which all splits in two are tried (2048 of
twelve)."""
APART_RAD = 0.2
"""Orientations that differ by less, 11°, count as one: they show a fifth of a
tilt."""
LARGE_RAD = 0.01
"""Tilts and errors of faces beyond this cause a warning: those of a fixture are far
smaller, and poses of a hand-held unit lie on a cube only by chance."""


@dataclass(frozen=True)
class NotTurned(Caution):
    """The poses with a face up differ by less than half a turn causes on the others;
    they count as not turned."""

    face: str
    began: PoseStart


@dataclass(frozen=True)
class NotFlush(Caution):
    """The poses with a face up differ by ``angle_rad``, far more than on the other
    faces."""

    face: str
    began: PoseStart
    angle_rad: float


@dataclass(frozen=True)
class Assumed:
    """Values stated by the user [rad]: standard errors of one seating of the fixture
    and of a turn, and the table's tilt.

    None where the poses determine the value. ``turn`` is that of a half turn, or of a
    given heading.
    """

    seating: float | None = None
    tilt: float | None = None
    turn: float = 0.0

    def __post_init__(self) -> None:
        for name, value in (("seating error", self.seating), ("tilt", self.tilt), ("turn error", self.turn)):
            if value is not None and not 0 <= value < 1:
                raise InvalidData(f"the {name} must be between 0 and 1 rad, not {value}")


@dataclass(frozen=True)
class Face:
    """``rows`` of the poses on it, ``turn`` (n,) rad: headings where ``headed``, else
    relative to the first pose."""

    label: str
    rows: tuple[int, ...]
    turn: Floats
    headed: bool

    @classmethod
    def of(cls, found: Verticals, labelling: Labelling, label: str) -> Face:
        rows = tuple(i for i, here in enumerate(labelling.labels) if here == label)
        headings = [labelling.headings[i] for i in rows]
        known = [h for h in headings if h is not None]
        if len(known) == len(rows):
            return cls(label, rows, np.array(known), True)
        return cls(label, rows, _turns(found, rows), False)

    @property
    def resolved(self) -> bool:
        """Whether the face has several orientations."""
        return bool(np.any(1 - np.cos(self.turn[:, None] - self.turn[None, :]) > 1 - np.cos(APART_RAD)))


def felt(turn: float) -> Floats:
    """(2,2): the table's tilt in the axes of a face (`standing.basis_of`) after a
    rotation by ``turn``."""
    c, s = np.cos(turn), np.sin(turn)
    return np.array([[c, s], [-s, c]])


def _turns(found: Verticals, rows: Sequence[int]) -> Floats:
    """(n,): half turns from the first pose, by the split in two groups with the most
    distant means; or quarter turns.

    Quarter turns where half turns leave far more than noise, and quarter turns less
    than a quarter of that.
    """
    up = found.direction[list(rows)]
    second = _farthest_halves(up)
    turn = np.where(second, np.pi, 0.0)
    # Compare the residuals of half and quarter turns, with the face's normal and the
    # tilt fitted.
    y, noise = _flat(found, rows)
    left = 2 * len(rows) - 4
    if left <= 0:
        return turn
    xy = y.reshape(-1, 2) - (y.reshape(-1, 2)[second].mean(axis=0) + y.reshape(-1, 2)[~second].mean(axis=0)) / 2
    angle = -np.arctan2(xy[:, 1], xy[:, 0])  # the tilt turns the other way
    quarter = np.round((angle - angle[0]) / (np.pi / 2)) % 4 * (np.pi / 2)
    designs = [_felt_by(turn), _felt_by(quarter)]
    half_left, quarter_left = (float(np.sum((y - H @ (np.linalg.pinv(H) @ y)) ** 2)) for H in designs)
    beyond = chi2_sf(half_left * len(noise) / float(np.trace(noise)), left) < SHOWS
    return quarter if beyond and quarter_left < half_left / 4 else turn


def _farthest_halves(up: Floats) -> Bools:
    """(n,): whether each pose is in the other group than the first."""
    n = len(up)
    if n > SPLIT_MOST:  # the direction of most scatter divides them
        centred = up - up.mean(axis=0)
        along = centred @ np.linalg.svd(centred)[2][0]
        return np.asarray((along > 0) != (along[0] > 0))
    best, farthest = np.zeros(n, dtype=bool), -1.0
    # The split with the largest sum of squares between the groups.
    for code in range(1, 2 ** (n - 1)):
        second = np.array([False, *(bool(code >> i & 1) for i in range(n - 1))])
        gap = up[second].mean(axis=0) - up[~second].mean(axis=0)
        spread = float(gap @ gap) * float(second.sum() * (~second).sum())
        if spread > farthest:
            best, farthest = second, spread
    return np.asarray(best)


def _felt_by(turn: Floats) -> Floats:
    """(2n,4): derivatives of the poses by the face's normal and the table's tilt."""
    return np.concatenate([np.hstack([np.eye(2), felt(t)]) for t in turn])


def _flat(found: Verticals, rows: Sequence[int]) -> tuple[Floats, Floats]:
    """(2n,) up in the poses of one face, in axes perpendicular to its mean, x × y
    along it; and its covariance."""
    up = found.direction[list(rows)]
    m = up.mean(axis=0) / np.linalg.norm(up.mean(axis=0))
    x = np.linalg.svd(m[None])[2][1]
    across = np.kron(np.eye(len(rows)), np.stack([x, np.cross(m, x)]))
    index = np.concatenate([3 * r + np.arange(3) for r in rows])
    return across @ up.ravel(), across @ found.covariance[np.ix_(index, index)] @ across.T


def _tilt_on(face: Face, found: Verticals) -> tuple[float, float]:
    """Magnitude of the table's tilt from one face alone, and its standard error."""
    y, covariance = _flat(found, face.rows)
    gain = np.linalg.pinv(_felt_by(face.turn))[2:]
    d = gain @ y
    size = float(np.linalg.norm(d))
    along = d @ gain / max(size, 1e-300)
    return size, float(np.sqrt(max(float(along @ covariance @ along), FLOOR_RAD**2)))


def pairs_of(faces: Sequence[Face], found: Verticals) -> list[tuple[Face, float, float]]:
    """Faces with several orientations at unknown headings: magnitude of the tilt, and
    its standard error."""
    return [(f, *_tilt_on(f, found)) for f in faces if not f.headed and f.resolved]


def turned(faces: list[Face], found: Verticals) -> tuple[list[Face], list[Caution]]:
    """The faces, with those that were apparently not turned reduced to one
    orientation; and cautions."""
    cautions: list[Caution] = []
    pairs = pairs_of(faces, found)
    size = np.array([m for _, m, _ in pairs])
    still = set()
    # Compare the tilt of each face with the median of the others.
    for k, (face, m, error) in enumerate(pairs):
        rest = np.delete(size, k)
        if len(rest) < PAIRS_LEAST - 1:
            continue
        middle = float(np.median(rest))
        scatter = float(np.hypot(error, np.std(rest, ddof=1) * np.sqrt(1 + 1 / len(rest))))
        far = abs(m - middle) > float(t_isf(SHOWS, len(rest) - 1)) * scatter
        began = found.poses[face.rows[0]].began
        if far and m < SHORT * middle:
            still.add(face.label)
            cautions.append(NotTurned(face.label, began))
        elif far and m > max(3 * middle, LARGE_RAD / 10):
            cautions.append(NotFlush(face.label, began, 2 * m))
    single = [f for f in faces if not f.headed and (not f.resolved or f.label in still)]
    if single and len(pairs) - len(still) < PAIRS_LEAST:
        # One or two pairs among faces that stood one way may be poses repeated,
        # without a turn.
        still |= {f.label for f, m, error in pairs if m**2 < chi2_isf(SHOWS, 2) * error**2}
    return [replace(f, turn=np.zeros(len(f.rows))) if f.label in still else f for f in faces], cautions


def tilt_of_others(faces: Sequence[Face], found: Verticals) -> float:
    """Rms tilt of the faces that resolve it. Raises Refused where too few faces
    do."""
    pairs = pairs_of(faces, found)
    chi2 = sum((m / error) ** 2 for _, m, error in pairs)
    if len(pairs) < PAIRS_LEAST or chi2_sf(chi2, 2 * len(pairs)) > SHOWS:
        have = f"{len(pairs)} faces" if len(pairs) > 1 else "one face" if pairs else "no face"
        raise Refused(
            f"{have} of {len(faces)} stood in two orientations half a turn apart"
            f"{', which show no tilt' if len(pairs) >= PAIRS_LEAST else ''}: on the others the table's tilt enters the "
            "rotation and cannot be distinguished from it: record the second orientations, or say by --table-tilt "
            "how large it may be",
            wanted=[f.label for f in faces if not f.resolved],
        )
    return float(np.sqrt(np.mean([m**2 for _, m, _ in pairs])))
