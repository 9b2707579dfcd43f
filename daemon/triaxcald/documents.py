"""The JSON document of a closed loop (`triaxcal.loop/1`), and how documents are written."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from triaxcal.calibration import Calibration
from triaxcal.calibration_document import Document, calibration_document, coefficients_document, residual_document
from triaxcal.figures import moment
from triaxcal.loop import Loop
from triaxcal.rounding import error, probability
from triaxcal.uncertainty import Stated
from triaxcal.units import ErrorUnit
from triaxcald.choices import choices_of
from triaxcald.doubts import UNIT


def to_text(document: Mapping[str, Any]) -> str:
    """The document as it is written and compared: UTF-8, two spaces, one key a line, a newline at the end."""
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
