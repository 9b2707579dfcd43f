"""The standard uncertainty that a calibration gives the readings which it is
applied to."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.estimate.calibration import Unmodelled
from triaxcal.model.sensor import Sensor

NOTHING = Unmodelled(0.0, 0.0)
"""Where nothing acts beside the covariance."""


def uncertainty_of_readings(
    sensor: Sensor,
    covariance: Floats,
    u: Floats,
    covariates: Mapping[str, Floats],
    unmodelled: Unmodelled | None = None,
) -> Floats:
    """(n,3) of the specific force at outputs u (n,3), for a ``covariance``
    (p,p) of the sensor's parameters, and what acts beside them; NaN where the
    covariance is not known."""
    beside = unmodelled or NOTHING
    variance = np.zeros(u.shape)
    if beside != NOTHING:
        square = sensor.up(u, covariates) ** 2
        variance += beside.along**2 * square + beside.across**2 * (1 - square)
    for step in _steps(sensor, covariance, u, covariates):
        variance += step**2
    return np.asarray(np.sqrt(variance))


def uncertainty_of_magnitude(
    sensor: Sensor,
    covariance: Floats,
    u: Floats,
    covariates: Mapping[str, Floats],
    unmodelled: Unmodelled | None = None,
) -> Floats:
    """(n,) likewise of |a|."""
    up = sensor.up(u, covariates)
    variance = np.full(len(u), (unmodelled or NOTHING).along ** 2)
    for step in _steps(sensor, covariance, u, covariates):
        variance += np.sum(step * up, axis=1) ** 2
    return np.asarray(np.sqrt(variance))


def _steps(sensor: Sensor, covariance: Floats, u: Floats, covariates: Mapping[str, Floats]) -> Iterator[Floats]:
    """(n,3) each: one standard error along each principal axis of the
    covariance, and what it does."""
    if not np.isfinite(covariance).all():
        yield np.full(u.shape, np.nan)
        return
    size, axes = np.linalg.eigh(covariance)
    a = sensor.specific_force(u, covariates)
    for step in (axes * np.sqrt(np.maximum(size, 0.0))).T:
        yield sensor.moved(step).specific_force(u, covariates) - a
