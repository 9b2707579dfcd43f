"""The errors of a calibration as its document holds them: standard errors, and
how they go together."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.errors import InvalidData
from triaxcal.interchange.calibration_document import LINEAR
from triaxcal.model.sensor import Sensor

ROUNDED = 1e-4
"""Documents round correlations to a millionth, so that the smallest eigenvalue
may come out below zero."""


def linear_errors_of(part: Mapping[str, Any], *, where: str) -> Floats:
    """(9,) standard errors of scale factors, misalignments and biases. Raises
    InvalidData."""
    held = part.get("standard_error")
    out = []
    for name in LINEAR:
        values = _numbers(held.get(name) if isinstance(held, Mapping) else None)
        if values.shape != (3,) or not np.all(values >= 0):
            raise InvalidData(f"{where}: standard_error.{name}: expected three numbers of at least 0")
        out.append(values)
    return np.concatenate(out)


def effect_errors_of(part: Mapping[str, Any], sensor: Sensor, *, where: str) -> Floats:
    """(p,) standard errors of the effects' coefficients. Raises InvalidData."""
    out = []
    for effect, _ in sensor.effects:
        for k in effect.coefficients:
            value = _numbers(part["effects"][effect.name][k.name].get("standard_error"))
            if value.shape or not value >= 0:
                name = f"effects.{effect.name}.{k.name}.standard_error"
                raise InvalidData(f"{where}: {name}: expected a number of at least 0")
            out.append(float(value))
    return np.array(out)


def correlation_of(part: Mapping[str, Any], sensor: Sensor, *, where: str) -> Floats | None:
    """(9+p,9+p) in the order of `Calibration.parameters`; None where the
    document has none. Raises InvalidData.

    Values without a standard error go with nothing: zeros.
    """
    if "correlation" not in part:
        return None
    expected = [f"{name}.{axis}" for name in LINEAR for axis in "xyz"]
    expected += [f"{effect.name}.{k.name}" for effect, _ in sensor.effects for k in effect.coefficients]
    names = part.get("parameters", expected)
    if not isinstance(names, list) or sorted(map(str, names)) != sorted(expected):
        raise InvalidData(f"{where}: parameters: expected the names of all {len(expected)} coefficients")
    held = _numbers(part["correlation"])
    n = len(expected)
    sound = held.shape == (n, n) and np.all(np.abs(held) <= 1 + ROUNDED) and np.all(np.abs(held - held.T) <= ROUNDED)
    if not sound or np.linalg.eigvalsh(held)[0] < -ROUNDED * n:
        raise InvalidData(f"{where}: correlation: expected a correlation matrix of {n} rows")
    order = [names.index(name) for name in expected]
    return np.asarray(held[np.ix_(order, order)])


def _numbers(value: object) -> Floats:
    """Finite numbers, an empty array where they are none."""
    try:
        out = np.array(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        return np.zeros(0)
    return out if np.isfinite(out).all() else np.zeros(0)
