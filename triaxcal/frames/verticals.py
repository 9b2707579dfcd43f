"""Which way is up in a unit's still poses, in the sensor's frame, and how
uncertain that is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Bools, Floats
from triaxcal.errors import InvalidData
from triaxcal.estimate.calibration import Calibration
from triaxcal.model.sensor import Sensor
from triaxcal.poses.covariates import covariates_elsewhere
from triaxcal.poses.degrees_of_freedom import SIGNIFICANT
from triaxcal.poses.pose import Pose


@dataclass(frozen=True)
class Verticals:
    """``direction`` (n,3) of up in each pose, unit vectors, sensor frame;
    ``covariance`` (3n,3n) of all, rad².

    The covariance holds the noise of the poses and what the uncertainty of the
    calibration adds, which is common to all poses. ``used`` (n,): poses that
    are no outliers. ``dof`` behind the covariance.
    """

    poses: tuple[Pose, ...]
    direction: Floats
    covariance: Floats
    used: Bools
    dof: float


def verticals(calibration: Calibration) -> Verticals:
    """Of the poses that the calibration was fitted to."""
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
    """Of poses of another recording than the calibration's; ``covariance``
    (p,p) of `Calibration.parameters`.

    Effects of time count as at one ``moment``
    (`triaxcal.poses.covariates.of_moment`), since its clock is its own. Raises
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
    """Up (n,3), and the covariance (3n,3n) of all, where that of the parameters
    is P (p,p).

    |a| is known, so the residual r = |a| − reference is noise along the
    measured vector, and with it goes that part of the noise across which is
    correlated with it (noise that differs by axis): the estimate is a − N v r /
    (vᵀ N v), N the noise of a. What noise is left is independent of the
    residuals, hence of the errors of a calibration that was fitted to the same
    poses.
    """
    u = np.array([p.mean for p in poses])
    a, by_u, by_parameter = sensor.specific_force_and_derivatives(u, covariates)
    length = np.linalg.norm(a, axis=1)
    if not np.all(length > 0):
        raise InvalidData("a pose reads no specific force at all under the calibration")
    noise = by_u @ np.array([p.covariance for p in poses]) @ by_u.transpose(0, 2, 1) + excess_g**2 * np.eye(3)
    v = a / length[:, None]
    along = np.einsum("nij,nj->ni", noise, v)
    gain = along * (used / np.maximum(np.einsum("ni,ni->n", v, along), 1e-300))[:, None]
    direction = a - gain * (length - reference)[:, None]
    size = np.linalg.norm(direction, axis=1, keepdims=True)
    direction = direction / size
    J = np.einsum("ni,nip->np", v, by_parameter)
    n = len(u)
    D = (by_parameter - gain[:, :, None] * J[:, None, :]).reshape(3 * n, -1)
    V = D @ P @ D.T
    across = np.zeros((3 * n, 3 * n))
    for i in range(n):
        block = slice(3 * i, 3 * i + 3)
        V[block, block] += noise[i] - np.outer(gain[i], along[i])
        across[block, block] = (np.eye(3) - np.outer(direction[i], direction[i])) / size[i]
    return direction, across @ V @ across
