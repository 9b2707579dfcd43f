"""The standard uncertainty that a calibration gives the readings which it is
applied to."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.model.sensor import Sensor


def uncertainty_of_readings(sensor: Sensor, covariance: Floats, u: Floats, covariates: Mapping[str, Floats]) -> Floats:
    """(n,3) of the specific force at outputs u (n,3), for a ``covariance``
    (p,p) of the sensor's parameters; NaN where that is not known."""
    variance = np.zeros(u.shape)
    for step in _steps(sensor, covariance, u, covariates):
        variance += step**2
    return np.sqrt(variance)


def uncertainty_of_magnitude(sensor: Sensor, covariance: Floats, u: Floats, covariates: Mapping[str, Floats]) -> Floats:
    """(n,) likewise of |a|."""
    up = sensor.up(u, covariates)
    variance = np.zeros(len(u))
    for step in _steps(sensor, covariance, u, covariates):
        variance += np.sum(step * up, axis=1) ** 2
    return np.sqrt(variance)


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
