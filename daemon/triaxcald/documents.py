"""The JSON documents that others script against (`triaxcal.poses/1`, `.calibration/1`, `.loop/1`, `.verify/1`).

Numbers are rounded far below any noise, and far above the last bits in which processors and linear algebra libraries
differ, so that an audit on another machine gets the same bytes.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.calibration import Calibration, Residual
from triaxcal.effects import Effect, effect_of
from triaxcal.loop import Loop
from triaxcal.poses.pose import Pose
from triaxcal.sensor import Sensor
from triaxcal.uncertainty import Budget, Stated, budget
from triaxcald.errors import InputError

Document = dict[str, Any]
DIGITS, UNCERTAINTY_DIGITS, PROBABILITY_DIGITS = 10, 6, 4
LINEAR = ("scale_factor", "misalignment", "bias")
GRID_G = 1e-11
"""Errors of the magnitude are differences of numbers near 1 g: beyond this they differ from processor to processor."""


def number(value: float | None, digits: int = DIGITS) -> float | None:
    """A float as it stands in a document; None where there is none."""
    if value is None or not math.isfinite(value):
        return None
    return float(f"{value:.{digits}g}") + 0.0


def error(value: float | None) -> float | None:
    """An error of the magnitude, in g."""
    return None if value is None else number(round(value / GRID_G) * GRID_G if math.isfinite(value) else value)


def uncertainty(value: float | None) -> float | None:
    """A standard error, or a figure that is a ratio to one."""
    return number(value, UNCERTAINTY_DIGITS)


def probability(value: float | None) -> float | None:
    return number(value, PROBABILITY_DIGITS)


def numbers(values: Any, digits: int = DIGITS) -> list[Any]:
    """An array of any shape as nested lists."""
    array = np.asarray(values, dtype=float)
    return [number(float(v), digits) for v in array] if array.ndim == 1 else [numbers(row, digits) for row in array]


def correlation(covariance: Floats) -> list[Any]:
    """(p,p) from a covariance, to a millionth: near zero the digits beyond differ from processor to processor."""
    deviation = np.sqrt(np.diag(covariance))
    deviation = np.where(deviation > 0, deviation, 1.0)
    return list((np.round(covariance / np.outer(deviation, deviation), 6) + 0.0).tolist())


def direction(unit_vector: Floats) -> list[float]:
    """To a billionth: its small components are differences of large ones, as errors are."""
    return [round(float(v), 9) + 0.0 for v in unit_vector]


def to_text(document: Mapping[str, Any]) -> str:
    """The document as it is written and compared: UTF-8, two spaces, one key a line, a newline at the end."""
    return json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def poses_document(poses: Sequence[Pose]) -> Document:
    return {
        "format": "triaxcal.poses/1",
        "poses": [
            {
                "start_s": number(p.start_s),
                "end_s": number(p.end_s),
                "samples": p.samples,
                "mean": numbers(p.mean),
                "standard_error": numbers(p.standard_error, UNCERTAINTY_DIGITS),
                "channels": {name: number(v) for name, v in p.channels.items()},
            }
            for p in poses
        ],
    }


def in_units_of(unit: str, reference_unit: str) -> str:
    """A coefficient's unit, which the metrology writes with g for the unit of the reference vector."""
    return unit if reference_unit == "g" else unit.replace("g", grouped(reference_unit))


def grouped(unit: str) -> str:
    """A unit as it stands below a fraction bar."""
    return f"({unit})" if set(unit) & set(" /") else unit


def micro_unit(reference_unit: str) -> str:
    """The unit in which errors of the magnitude are told."""
    return "µg" if reference_unit == "g" else f"1e-6 {reference_unit}"


def in_words_of(text: str, reference_unit: str) -> str:
    """What the metrology says in words, where it writes g likewise."""
    return text.replace("µg", micro_unit(reference_unit))


def residual_document(residual: Residual) -> Document:
    return {
        "rms_g": error(residual.rms_g),
        "max_abs_g": error(residual.max_abs_g),
        "cross_validated_rms_g": error(residual.cross_validated_rms_g),
        "noise_floor_g": error(residual.noise_floor_g),
        "lack_of_fit_p": probability(residual.lack_of_fit_p),
    }


def coefficients_document(coefficients: Mapping[str, tuple[float, float | None, str]], reference_unit: str) -> Document:
    """Of one effect; null for a standard error that the poses do not tell."""
    return {
        name: {
            "value": number(value),
            "standard_error": None if deviation is None else uncertainty(deviation),
            "unit": in_units_of(unit, reference_unit),
        }
        for name, (value, deviation, unit) in coefficients.items()
    }


def reference_unit_of(reference: float) -> str:
    """g where the magnitude can be gravity in units of g, else what the caller did not name."""
    return "g" if 0.9 <= reference <= 1.1 else "reference unit"


def calibration_document(
    c: Calibration,
    *,
    output_unit: str = "",
    reference_unit: str = "g",
    stated: Stated | None = None,
    budgeted: bool = True,
) -> Document:
    """``reference_unit`` names the unit of the reference vector; keys keep their ``_g`` whatever it is. ``stated`` are
    uncertainties that no recording can tell. ``budgeted``: with the budget, which is that of a fit to still poses."""
    whole = c.whole
    errors = dict(zip(whole.parameters, whole.standard_errors, strict=True))
    unit = output_unit or "output"

    def group(name: str) -> list[Any]:
        return numbers([errors[f"{name}.{axis}"] for axis in "xyz"], UNCERTAINTY_DIGITS)

    return {
        "format": "triaxcal.calibration/1",
        "terms": list(c.terms),
        "units": {
            "output": output_unit,
            "reference": reference_unit,
            "scale_factor": f"{unit}/{grouped(reference_unit)}",
            "misalignment": "rad",
            "bias": reference_unit,
        },
        "reference": number(c.reference),
        "channel_reference": {name: number(v) for name, v in c.channel_reference.items()},
        "scale_factor": numbers(c.sensor.scale_factor),
        "misalignment": numbers(c.sensor.misalignment),
        "bias": numbers(c.sensor.bias),
        "matrix": numbers(c.sensor.matrix),
        "centre": numbers(c.sensor.centre),
        "effects": {
            effect.name: coefficients_document(whole.coefficients_of(effect.name), reference_unit)
            for effect, _ in c.sensor.effects
        },
        "standard_error": {name: group(name) for name in LINEAR},
        "parameters": list(whole.parameters),
        "correlation": correlation(whole.covariance),
        **({"uncertainty": budget_document(c, budget(c, stated), reference_unit)} if budgeted else {}),
        "residual": residual_document(c.residual),
        "poses": [
            {
                "start_s": number(p.pose.start_s),
                "end_s": number(p.pose.end_s),
                "mean": numbers(p.pose.mean),
                "direction": direction(p.direction),
                "residual_g": error(p.residual_g),
                "standard_error_g": uncertainty(p.standard_error_g),
                "studentized": uncertainty(p.studentized),
                "leverage": uncertainty(p.leverage),
                "used": p.used,
                "channels": {name: number(v) for name, v in p.pose.channels.items()},
            }
            for p in c.poses
        ],
        "condition": uncertainty(c.condition),
        "dilution": uncertainty(c.dilution),
        "blind_to": list(c.blind_to),
        "warnings": list(c.warnings),
    }


def by_parameter(c: Calibration, values: Sequence[Any]) -> Document:
    """Values in the order of `Calibration.parameters`, in groups as the coefficients stand in a document."""
    held = dict(zip(c.parameters, values, strict=True))
    groups: Document = {name: [held[f"{name}.{axis}"] for axis in "xyz"] for name in LINEAR}
    effects = {e.name: {k.name: held[f"{e.name}.{k.name}"] for k in e.coefficients} for e, _ in c.sensor.effects}
    return groups | ({"effects": effects} if effects else {})


def budget_document(c: Calibration, b: Budget, reference_unit: str = "g") -> Document:
    """Expanded uncertainties and where they come from. Standard uncertainties in the budget's lines."""

    def by_name(values: Floats) -> Document:
        return by_parameter(c, [uncertainty(float(v)) for v in values])

    whole = b.magnitude
    return {
        "level": b.parameters.level,
        "expanded": by_name(b.parameters.expanded),
        "coverage_factor": by_name(b.parameters.coverage),
        "magnitude": {
            "standard_g": uncertainty(float(whole.standard)),
            "coverage_factor": uncertainty(float(whole.coverage)),
            "expanded_g": uncertainty(float(whole.expanded)),
        },
        "budget": [
            {
                "source": line.source,
                "evaluation": line.evaluation,
                "degrees_of_freedom": uncertainty(line.dof),
                **by_name(line.parameters),
                "magnitude_g": uncertainty(line.magnitude),
                "share": uncertainty(b.share(line)),
                "how": line.how,
            }
            for line in b.components
        ],
        "dominant": b.dominant.source,
        "halved_by": in_words_of(b.dominant.halved_by, reference_unit),
        "magnitude_if_halved_g": uncertainty(b.magnitude_if_halved),
        "not_evaluated": list(b.not_evaluated),
    }


def loop_document(
    loop: Loop,
    *,
    data_quality: Sequence[str] = (),
    output_unit: str = "",
    reference_unit: str = "g",
    stated: Stated | None = None,
) -> Document:
    calibration = calibration_document(
        loop.after, output_unit=output_unit, reference_unit=reference_unit, stated=stated
    )
    for pose, before in zip(calibration["poses"], loop.before.poses, strict=True):
        pose["before_residual_g"] = error(before.residual_g)
    held = loop.held_out
    return {
        "format": "triaxcal.loop/1",
        "before": residual_document(loop.before.residual),
        "after": residual_document(loop.after.residual),
        **(
            {
                "held_out": {
                    "before_rms_g": error(held.before_rms_g),
                    "after_rms_g": error(held.after_rms_g),
                    "noise_floor_g": error(held.noise_floor_g),
                    "poses": held.poses,
                }
            }
            if held
            else {}
        ),
        "findings": [
            {
                "effect": f.effect,
                "verdict": f.verdict,
                "p_value": probability(f.p_value),
                "coefficients": coefficients_document(f.coefficients, reference_unit),
                "alternatives": list(f.alternatives),
                "reason": in_words_of(f.reason, reference_unit),
                "remedy": f.remedy,
                "apart": [in_words_of(line, reference_unit) for line in f.apart],
                "residual": residual_document(f.step.residual),
                "pose_residual_g": [error(p.residual_g) for p in f.step.poses],
            }
            for f in loop.findings
        ],
        "unexplained": {
            "significant": loop.unexplained.significant,
            "p_value": probability(loop.unexplained.p_value),
            "rms_g": error(loop.unexplained.rms_g),
            "lead": in_words_of(loop.unexplained.lead, reference_unit),
        },
        "data_quality": list(data_quality),
        "advice": [in_words_of(line, reference_unit) for line in loop.advice],
        "calibration": calibration,
    }


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
