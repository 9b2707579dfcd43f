"""The JSON document of a closed loop (`triaxcal.loop/1`), and how documents are
written."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from triaxcal.diagnosis import Finding, Loop, Verdict
from triaxcal.estimate.calibration import Calibration
from triaxcal.estimate.hold_out import HoldOut
from triaxcal.evidence.findings import Unexplained
from triaxcal.evidence.model_average import Refusal
from triaxcal.evidence.partial_residuals import Quantity, Trace, unit_of
from triaxcal.interchange.calibration_document import (
    WEIGHT,
    Document,
    calibration_document,
    coefficients_document,
    residual_document,
)
from triaxcal.rounding import chance, error, in_standard_errors, known_to, number, numbers, probability, uncertainty
from triaxcal.text import bias_update, diagnosis
from triaxcal.uncertainty import Stated, budget
from triaxcal.uncertainty.another_day import next_recording
from triaxcal.units import ErrorUnit, in_units_of
from triaxcald.doubts import UNIT, choices_of

NO_LONGER_OF_A_FINDING = ("p_value", "spoiled", "coincidence", "held_out_rms_g", "apart", "residual", "pose_residual_g")
NO_LONGER_OF_WHAT_IS_UNEXPLAINED = ("p_value", "or_spoiled", "or_named", "only_inside")
"""Keys of 0.1 that mean nothing since names have probabilities: others read
them, and find null."""


def to_text(document: Mapping[str, Any]) -> str:
    """The document as it is written and compared: UTF-8, two spaces, one key a
    line, a newline at the end."""
    return json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


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
    """``held_by_device`` is the calibration that a device has registers for,
    None where there is no such device. ``remarks`` are warnings besides those
    of the fit; ``unit_in_doubt``: one of them asks whether it is one unit."""
    calibration = calibration_document(
        loop.after, output_unit=output_unit, reference_unit=reference_unit, stated=stated
    )
    reference = loop.after.reference
    small = ErrorUnit.of(reference_unit, reference)
    calibration["warnings"] += remarks
    for finding in loop.findings:
        if finding.verdict is Verdict.ADOPTED:
            calibration["effects"][finding.effect][WEIGHT] = 1.0
    for pose, before in zip(calibration["poses"], loop.before.poses, strict=True):
        pose["before_residual_g"] = error(before.residual_g, reference)
    following = next_recording(loop.after, budget(loop.after, stated))
    return {
        "format": "triaxcal.loop/1",
        "call": loop.call.value,
        "summary": list(diagnosis.lines(loop, small, following, stated)),
        "before": residual_document(loop.before.residual, reference),
        "after": residual_document(loop.after.residual, reference),
        **({"held_out": _held_out(loop.held_out, following.expanded_uncertainty, reference)} if loop.held_out else {}),
        "findings": [_finding(f, loop.refusal, reference_unit) for f in loop.findings],
        "candidates": [
            {
                "effect": c.effect,
                "probability": calibrated(c.probability),
                "hangs_on_one_pose": c.hangs_on_one_pose,
                "coefficients": coefficients_document(c.coefficients, reference_unit),
            }
            for c in loop.candidates
        ],
        "probabilities": {name: calibrated(p) for name, p in loop.stated.items()},
        "nothing_probability": chance(loop.found.nothing),
        "another_unit": _another(loop),
        "not_corrected": None if loop.refusal is None else loop.refusal.value,
        "choices": [
            {
                "corrected_by": list(choice.corrected_by),
                "terms": list(choice.terms),
                **residual_document(choice.residual, reference),
            }
            for choice in choices_of(loop, held_by_device)
        ],
        "unexplained": _unexplained(loop.found.unexplained, small, reference),
        **({"doubts": [UNIT]} if unit_in_doubt or loop.found.change_point else {}),
        "data_quality": list(data_quality),
        "advice": list(diagnosis.advice(loop, small)),
        "notes": list(diagnosis.notes(loop, small)),
        "traces": [_trace(trace, reference, reference_unit) for trace in loop.traces],
        "calibration": calibration,
    }


def _trace(trace: Trace, reference: float, reference_unit: str) -> Document:
    in_errors = trace.quantity is Quantity.STANDARD_ERRORS
    widest = float(trace.half_width.max(initial=0.0))

    def value(v: float, known: float) -> float | None:
        return in_standard_errors(v) if in_errors else known_to(v, known, reference)

    return {
        "effect": trace.effect or None,
        "axis": trace.axis or None,
        "coefficients": list(trace.coefficients),
        "variable": trace.variable,
        "variable_unit": in_units_of(unit_of(trace.variable), reference_unit),
        "quantity": trace.quantity.value,
        "share": uncertainty(trace.share),
        "p_value": probability(trace.p_value),
        "pose": trace.pose.tolist(),
        "x": numbers(trace.x),
        "y": [value(float(y), float(known)) for y, known in zip(trace.y, trace.error, strict=True)],
        "error": [uncertainty(float(v)) for v in trace.error],
        "excluded": trace.excluded.tolist(),
        "curve": {
            "x": numbers(trace.grid),
            "y": [value(float(y), widest) for y in trace.curve],
            "half_width": [known_to(float(v), widest, reference) for v in trace.half_width],
        },
    }


def rezero_document(
    c: Calibration,
    *,
    data_quality: Sequence[str] = (),
    output_unit: str = "",
    reference_unit: str = "g",
    stated: Stated | None = None,
) -> Document:
    """A calibration with biases anew in the place of a closed loop: it was not
    searched for effects."""
    assert c.update is not None
    return {
        "format": "triaxcal.rezero/1",
        "summary": list(bias_update.lines(c, c.update, ErrorUnit.of(reference_unit, c.reference))),
        "before": residual_document(c.update.before, c.reference),
        "after": residual_document(c.residual, c.reference),
        "findings": [],
        "candidates": [],
        "choices": [],
        "data_quality": list(data_quality),
        "advice": [],
        "calibration": calibration_document(c, output_unit=output_unit, reference_unit=reference_unit, stated=stated),
    }


def calibrated(probability: float | None) -> float | None:
    """Null where it is not calibrated."""
    return None if probability is None else chance(probability)


def _finding(f: Finding, refusal: Refusal | None, reference_unit: str) -> Document:
    return {
        "effect": f.effect,
        "verdict": f.verdict.value,
        "probability": calibrated(f.probability),
        "coefficients": coefficients_document(f.coefficients, reference_unit),
        "alternatives": list(f.alternatives),
        "probabilities": {name: calibrated(p) for name, p in f.alternatives.items()},
        "reason": diagnosis.reason(f, refusal),
        "remedy": f.remedy,
        **dict.fromkeys(NO_LONGER_OF_A_FINDING),
    }


def _unexplained(part: Unexplained, small: ErrorUnit, reference: float) -> Document:
    return {
        "significant": part.significant,
        "probability": chance(part.probability),
        "kind": None if part.kind is None else part.kind.value,
        "rms_g": error(part.rms_g, reference),
        "lead": diagnosis.unexplained(part, small) if part.significant else "",
        **dict.fromkeys(NO_LONGER_OF_WHAT_IS_UNEXPLAINED),
    }


def _another(loop: Loop) -> Document | None:
    """From which pose on there is another unit, or another mounting; None where
    that is unlikely."""
    found = loop.found.change_point
    if found is None:
        return None
    began = loop.after.poses[found.pose].pose.began
    return {
        "start_s": number(began.start_s),
        **({} if began.recording is None else {"recording": began.recording}),
        "probability": chance(found.probability),
    }


def _held_out(held: HoldOut, another_day: float, reference: float) -> Document:
    return {
        "before_rms_g": error(held.before_rms_g, reference),
        "after_rms_g": error(held.after_rms_g, reference),
        "noise_floor_g": error(held.noise_floor_g, reference),
        "poses": held.poses,
        "contradicts": held.contradicts(another_day),
    }
