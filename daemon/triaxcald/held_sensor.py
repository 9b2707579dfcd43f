"""The sensor that a document holds, of whoever wrote it: read with errors that name the file and the field."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.calibration import Calibration, Residual
from triaxcal.effects import Effect, effect_of
from triaxcal.sensor import Sensor
from triaxcald.errors import InputError
from triaxcald.units import reference_unit_of


def calibration_part(document: Mapping[str, Any], *, where: str) -> Mapping[str, Any]:
    """The `triaxcal.calibration/1` in a calibration, loop or certificate document. Raises InputError."""
    inner: Any = document
    for key in ("result", "calibration"):
        if isinstance(inner, Mapping) and isinstance(inner.get(key), Mapping):
            inner = inner[key]
    if not isinstance(inner, Mapping) or inner.get("format") != "triaxcal.calibration/1":
        raise InputError(f"{where}: format: expected a triaxcal.calibration/1, .loop/1 or .certificate/1 document")
    return inner


def reference_unit_in(document: Mapping[str, Any], *, where: str, magnitude: float) -> str:
    """The unit of the reference that a calibration document says, or what it must be by its magnitude."""
    units = calibration_part(document, where=where).get("units")
    said = units.get("reference") if isinstance(units, Mapping) else None
    return said if isinstance(said, str) and said else reference_unit_of(magnitude)


def sensor_of(document: Mapping[str, Any], *, where: str) -> tuple[Sensor, dict[str, float], float]:
    """Sensor, channel references and reference magnitude of a calibration document. Raises InputError."""
    part = calibration_part(document, where=where)
    try:
        k, m, b = (np.array(part[name], dtype=float) for name in ("scale_factor", "misalignment", "bias"))
        effects = []
        for name, held in part.get("effects", {}).items():
            effect, q = effect_of(name, {n: float(v["value"]) for n, v in held.items()})
            lacking = [n for n in (*(c.name for c in effect.coefficients), *effect.shape) if n not in held]
            if lacking:
                raise KeyError(f"effects.{name}.{lacking[0]}")
            effects.append((effect, q))
        reference = {str(n): float(v) for n, v in part.get("channel_reference", {}).items()}
        magnitude = float(part.get("reference", 1.0))
    except KeyError as e:
        raise InputError(f"{where}: {e.args[0]}: missing, or no effect of that name is known") from e
    except (TypeError, ValueError, AttributeError, OverflowError) as e:
        raise InputError(f"{where}: not numbers where numbers belong ({e})") from e
    if any(v.shape != (3,) or not np.isfinite(v).all() for v in (k, m, b)) or not np.all(k):
        raise InputError(
            f"{where}: scale_factor, misalignment, bias: expected three numbers each, none zero in the first"
        )
    _require_finite(effects, reference, magnitude, where)
    return Sensor(k, m, b, tuple(effects)), reference, magnitude


def model_of(sensor: Sensor, channel_reference: Mapping[str, float], magnitude: float) -> Calibration:
    """A held sensor as the model of other poses. What only its fit could tell is not a number."""
    n, unknown = 9 + sum(len(q) for _, q in sensor.effects), math.nan
    return Calibration(
        sensor=sensor,
        covariance=np.full((n, n), unknown),
        reference=magnitude,
        channel_reference=channel_reference,
        residual=Residual(unknown, unknown, None, unknown, None),
        poses=(),
        condition=unknown,
        dilution=unknown,
        inflation=unknown,
        dof=unknown,
    )


def _require_finite(
    effects: Sequence[tuple[Effect, Floats]], reference: Mapping[str, float], magnitude: float, where: str
) -> None:
    """JSON as Python reads it has NaN."""
    for effect, values in effects:
        if not np.isfinite(values).all():
            raise InputError(f"{where}: effects.{effect.name}: expected finite numbers")
        for need in effect.needs:
            if need not in reference:
                raise InputError(f"{where}: channel_reference.{need}: missing; the effect {effect.name} needs it")
    for name, value in reference.items():
        if not math.isfinite(value):
            raise InputError(f"{where}: channel_reference.{name}: expected a finite number")
    if not 0 < magnitude < math.inf:
        raise InputError(f"{where}: reference: expected a positive number")
