"""Whether recordings are of one unit: by the shape of its triad, which age and
temperature hardly change.

A bias comes back anew at every start, and temperature scales all axes alike
first of all. What stays with a unit is how its axes stand to each other and
which of them is the more sensitive.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.distributions import f_sf
from triaxcal.errors import InvalidData, Refused
from triaxcal.estimate.calibration import Calibration
from triaxcal.estimate.pose_fit import fit
from triaxcal.number_format import plain
from triaxcal.poses.covariates import covariates_elsewhere
from triaxcal.poses.pose import Pose

MISALIGNMENT_RAD, SCALE_FACTOR = 1e-3, 6e-3
"""Standard deviations, of each, by which one mass-market unit differs from
itself in another recording: scale factors by what 20 K make of them where
nothing corrects that (`triaxcal.uncertainty`, 3e-4/K)."""
POSES_LEAST = 12
"""Fewer tell hardly more than nine parameters: what the model lacks goes into
these."""
BY_CHANCE = 1e-4
"""The probability that one unit is asked about."""
_RATIOS = np.array([[1.0, -1.0, 0.0], [0.0, 1.0, -1.0]])
_RATIOS.flags.writeable = False


@dataclass(frozen=True)
class Shape:
    """Logarithms of two ratios of scale factors, and the misalignments [rad]:
    (5,), with their covariance (5,5) and the degrees of freedom behind it."""

    values: Floats
    covariance: Floats
    dof: float

    @classmethod
    def of(cls, scale_factor: Floats, misalignment: Floats, covariance: Floats, dof: float) -> Shape:
        """``covariance`` (6,6) of both, in that order."""
        to_shape = np.zeros((5, 6))
        to_shape[:2, :3] = _RATIOS / scale_factor
        to_shape[2:, 3:] = np.eye(3)
        values = np.concatenate([_RATIOS @ np.log(np.abs(scale_factor)), misalignment])
        return cls(values, to_shape @ covariance @ to_shape.T, dof)


def shape_of(c: Calibration) -> Shape:
    return Shape.of(c.sensor.scale_factor, c.sensor.misalignment, c.covariance[:6, :6], c.dof)


def shape_by_poses(poses: Sequence[Pose], signs: Sequence[float], reference: float) -> Shape | None:
    """By a fit of the linear model to these poses alone; None where they do not
    carry one, or are few."""
    try:
        found = fit(poses, signs=signs, reference=reference)
    except (Refused, InvalidData):
        return None
    return shape_of(found) if sum(p.used for p in found.poses) >= POSES_LEAST else None


def shape_beside(held: Calibration, poses: Sequence[Pose]) -> Shape | None:
    """The same by what the outputs would be without the effects that ``held``
    has."""
    sensor = held.sensor
    if sensor.effects:
        try:
            at = covariates_elsewhere(poses, held.channel_reference, sensor.scale_factor, sensor.bias, held.moment)
            s = sensor.along_axes(np.array([p.mean for p in poses]), at)
        except Refused:
            return None
        poses = [replace(p, mean=mean) for p, mean in zip(poses, sensor.scale_factor * (s + sensor.bias), strict=True)]
    return shape_by_poses(poses, np.sign(sensor.scale_factor).tolist(), held.reference)


def shape_in(calibration: Mapping[str, Any]) -> Shape | None:
    """Of a `triaxcal.calibration/1` document; None where it does not say how
    well its shape is known."""
    try:
        k, m = (np.array(calibration[name], dtype=float) for name in ("scale_factor", "misalignment"))
        errors = [calibration["standard_error"][name] for name in ("scale_factor", "misalignment")]
        error = np.concatenate([np.array(e, dtype=float).reshape(3) for e in errors])
    except (KeyError, TypeError, ValueError, OverflowError):
        return None
    with np.errstate(all="ignore"):  # numbers out of a file may be any
        shape = Shape.of(k, m, np.diag(error**2), np.inf)
    return shape if np.isfinite([*shape.values, *shape.covariance.flat]).all() else None


def unlike_shapes(name: str, other: str, one: Shape | None, another: Shape | None) -> list[str]:
    """A line where two recordings, or a calibration and a recording, can hardly
    be of one unit; none where one of the shapes is not known."""
    if one is None or another is None:
        return []
    apart = one.values - another.values
    of_one_unit = np.zeros((5, 5))
    of_one_unit[:2, :2] = SCALE_FACTOR**2 * _RATIOS @ _RATIOS.T
    of_one_unit[2:, 2:] = MISALIGNMENT_RAD**2 * np.eye(3)
    weight = one.covariance + another.covariance + of_one_unit
    squares = float(apart @ np.linalg.solve(weight, apart))
    # Welch–Satterthwaite: what a unit may differ from itself is known, what the
    # fits are off by is estimated.
    shares = [(np.trace(np.linalg.solve(weight, s.covariance)) / len(apart), s.dof) for s in (one, another)]
    dof = 1 / max(sum(share**2 / dof for share, dof in shares), 1e-9)
    if not f_sf(squares / len(apart), len(apart), dof) < BY_CHANCE:
        return []
    ratio, angle = (float(np.max(np.abs(v))) for v in ([*apart[:2], apart[:2].sum()], apart[2:]))
    return [
        f"{name} and {other}: misalignment differs by up to {plain(1e3 * angle, 2)} mrad and the ratio of scale "
        f"factors by up to {plain(100 * ratio, 2)} %, more than age and 20 K make of one unit: the same unit?"
    ]
