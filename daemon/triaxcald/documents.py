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

from triaxcal import text
from triaxcal.arrays import Floats
from triaxcal.calibration import Calibration, Exclusion, Residual
from triaxcal.figures import moment
from triaxcal.loop import Loop
from triaxcal.poses.pose import Pose
from triaxcal.uncertainty import Budget, Stated, budget
from triaxcald.choices import choices_of
from triaxcald.doubts import UNIT
from triaxcald.remarks import assumed_in
from triaxcald.units import SMALLEST, ErrorUnit, grouped, in_units_of

Document = dict[str, Any]
DIGITS, UNCERTAINTY_DIGITS, PROBABILITY_DIGITS = 10, 6, 4
REGISTER_DIGITS = 12
"""So many tell any two float32 apart, and any two integers of a register."""
LINEAR = ("scale_factor", "misalignment", "bias")
GRID_G = 1e-11
"""Errors of the magnitude are differences of numbers near 1 g: beyond this they differ from processor to processor. Of
numbers near another reference, as much finer or coarser as that is smaller or larger, in powers of ten."""


_LEFT_OUT = {Exclusion.OUTLIER: "spoiled", Exclusion.CALLER: "caller", Exclusion.UNKNOWN_HISTORY: "unknown_history"}
"""As documents of 0.1 have it, beside ``excluded``; else the name of the fault."""


def number(value: float | None, digits: int = DIGITS) -> float | None:
    """A float as it stands in a document; None where there is none."""
    if value is None or not math.isfinite(value):
        return None
    return float(f"{value:.{digits}g}") + 0.0


def error(value: float | None, reference: float = 1.0) -> float | None:
    """An error of the magnitude, in the unit of the ``reference``."""
    if value is None or not math.isfinite(value):
        return None
    grid = GRID_G * 10.0 ** round(math.log10(max(reference, SMALLEST)))
    return number(round(value / grid) * grid)


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


def residual_document(residual: Residual, reference: float = 1.0) -> Document:
    return {
        "rms_g": error(residual.rms_g, reference),
        "max_abs_g": error(residual.max_abs_g, reference),
        "cross_validated_rms_g": error(residual.cross_validated_rms_g, reference),
        "noise_floor_g": error(residual.noise_floor_g, reference),
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


def holds_of(c: Calibration) -> list[str]:
    """In words, under which conditions scale factor, misalignment and bias are all of a reading; none where always."""
    several = any(p.pose.run.of > 1 for p in c.poses)
    return list(text.holds([effect for effect, _ in c.sensor.effects], c.channel_reference, several=several))


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
        "holds": holds_of(c),
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
        "residual": residual_document(c.residual, c.reference),
        "poses": [
            {
                "start_s": number(p.pose.start_s),
                "end_s": number(p.pose.end_s),
                "mean": numbers(p.pose.mean),
                "direction": direction(p.direction),
                "residual_g": error(p.residual_g, c.reference),
                "standard_error_g": uncertainty(p.standard_error_g),
                "studentized": uncertainty(p.studentized),
                "leverage": uncertainty(p.leverage),
                "used": p.used,
                "excluded": p.excluded,
                **({"left_out": _LEFT_OUT.get(p.excluded, p.pose.fault)} if p.excluded else {}),
                "channels": {name: number(v) for name, v in p.pose.channels.items()},
            }
            for p in c.poses
        ],
        "trends": c.trends,
        "condition": uncertainty(c.condition),
        "dilution": uncertainty(c.dilution),
        "blind_to": list(c.blind_to),
        "warnings": [text.caution(caution) for caution in c.cautions],
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

    whole, small = b.magnitude, ErrorUnit.of(reference_unit, c.reference)
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
                "how": text.basis(line.basis),
                **({"assumes": list(effects)} if (effects := assumed_in(line.basis)) else {}),
            }
            for line in b.components
        ],
        "dominant": b.dominant.source,
        "halved_by": text.remedy(b.dominant.halved_by, small.figure),
        "magnitude_if_halved_g": uncertainty(b.magnitude_if_halved),
        "not_evaluated": [text.not_evaluated(source, small.figure) for source in b.not_evaluated],
    }


def loop_document(
    loop: Loop,
    *,
    data_quality: Sequence[str] = (),
    output_unit: str = "",
    reference_unit: str = "g",
    stated: Stated | None = None,
    held_by_device: Calibration | None = None,
    remarks: Sequence[str] = (),
    unit_in_doubt: bool = False,
) -> Document:
    """``held_by_device`` is the calibration that a device has registers for, None where there is no such device.
    ``remarks`` are warnings besides those of the fit; ``unit_in_doubt``: one of them asks whether it is one unit."""
    calibration = calibration_document(
        loop.after, output_unit=output_unit, reference_unit=reference_unit, stated=stated
    )
    reference, held = loop.after.reference, loop.held_out
    small = ErrorUnit.of(reference_unit, reference)
    calibration["warnings"] += remarks
    for pose, before in zip(calibration["poses"], loop.before.poses, strict=True):
        pose["before_residual_g"] = error(before.residual_g, reference)
    return {
        "format": "triaxcal.loop/1",
        "before": residual_document(loop.before.residual, reference),
        "after": residual_document(loop.after.residual, reference),
        **(
            {
                "held_out": {
                    "before_rms_g": error(held.before_rms_g, reference),
                    "after_rms_g": error(held.after_rms_g, reference),
                    "noise_floor_g": error(held.noise_floor_g, reference),
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
                "spoiled": [moment(began) for began in f.spoiled],
                "coincidence": probability(f.coincidence),
                "held_out_rms_g": {n: error(held.instead[n], reference) for n in f.alternatives if n in held.instead}
                if held
                else {},
                "reason": small.in_words(f.reason),
                "remedy": f.remedy,
                "apart": [small.in_words(line) for line in f.apart],
                "residual": residual_document(f.step.residual, reference),
                "pose_residual_g": [error(p.residual_g, reference) for p in f.step.poses],
            }
            for f in loop.findings
        ],
        "choices": [
            {
                "corrected_by": list(choice.corrected_by),
                "terms": list(choice.terms),
                **residual_document(choice.residual, reference),
            }
            for choice in choices_of(loop, held_by_device)
        ],
        "unexplained": {
            "significant": loop.unexplained.significant,
            "p_value": probability(loop.unexplained.p_value),
            "rms_g": error(loop.unexplained.rms_g, reference),
            "lead": small.in_words(loop.unexplained.lead),
            "or_spoiled": loop.unexplained.or_spoiled,
            "or_named": loop.unexplained.or_named,
            "only_inside": loop.unexplained.only_inside,
        },
        **({"doubts": [UNIT]} if unit_in_doubt else {}),
        "data_quality": list(data_quality),
        "advice": [small.in_words(line) for line in loop.advice],
        "calibration": calibration,
    }
