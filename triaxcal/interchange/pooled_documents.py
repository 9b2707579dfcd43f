"""Several recordings in one diagnosis: of one unit, or of several units
(`triaxcal.agreement/1`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from triaxcal.diagnosis import Loop
from triaxcal.estimate.recordings import residuals_by_run
from triaxcal.evidence.posterior import Shape
from triaxcal.interchange.calibration_document import Document
from triaxcal.pooled_units import Answer, PooledAnalysis, PooledEffect, SharedShape
from triaxcal.rounding import chance, error, number, uncertainty
from triaxcal.text.pooled_units import verdict
from triaxcal.units import in_units_of

OBSOLETE_KEYS = ("worse", "gain", "units_gain", "shown_by")
"""Keys of 0.1 without a meaning since effects have probabilities. They stay, with
null, for programs that read them."""


def with_recordings(document: Document, loop: Loop, names: Sequence[str]) -> Document:
    """A `triaxcal.loop/1` of several recordings, with the recording of each pose and
    the residual of each recording."""
    by_recording = [
        {
            "recording": name,
            "poses": r.poses,
            "before_rms_g": error(r.before_rms_g, loop.after.reference),
            "after_rms_g": error(r.after_rms_g, loop.after.reference),
            "noise_floor_g": error(r.noise_floor_g, loop.after.reference),
        }
        for name, r in zip(names, residuals_by_run(loop.before, loop.after), strict=True)
    ]
    for pose, result in zip(document["calibration"]["poses"], loop.after.poses, strict=True):
        pose["recording"] = names[result.pose.run.index]
    return {**document, "recordings": list(names), "by_recording": by_recording}


def agreement_document(
    found: PooledAnalysis, names: Sequence[str], results: Sequence[Document], reference_unit: str = "g"
) -> Document:
    """`triaxcal.agreement/1`. ``results`` are the units' own documents,
    `triaxcal.loop/1`, and ``names`` their recordings."""
    return {
        "format": "triaxcal.agreement/1",
        "verdict": verdict(found),
        "answer": found.answer.value,
        "agreed": [group[0] for group in found.agreed if len(group) == 1] if found.answer is Answer.AGREE else [],
        "agreed_one_of": [list(group) for group in found.agreed if len(group) > 1],
        "probability": chance(found.probability),
        "nothing_probability": chance(found.nothing),
        "effects": [_effect(c, names, reference_unit) for c in found.effects],
        "units": [{"recording": n, "result": dict(r)} for n, r in zip(names, results, strict=True)],
    }


def _effect(c: PooledEffect, names: Sequence[str], reference_unit: str) -> Document:
    def recordings(indices: Sequence[int]) -> list[str]:
        return [names[i] for i in indices]

    without = [i for i in range(len(names)) if i not in (*c.named, *c.listed)]
    return {
        "effect": c.effect,
        "probability": chance(c.probability),
        "common_values_probability": chance(c.common),
        "units_probability": [chance(p) for p in c.units],
        "named_by": recordings(c.named),
        "listed_by": recordings(c.listed),
        "not_found_by": recordings(without),
        "shapes": {name: _shape(shape, names, reference_unit) for name, shape in c.shapes.items()},
        **dict.fromkeys(OBSOLETE_KEYS),
    }


def _shape(s: SharedShape, names: Sequence[str], reference_unit: str) -> Mapping[str, Any]:
    return {
        **_value(s.shared),
        "unit": in_units_of(s.shared.unit, reference_unit),
        "p_value": None,
        "own": [{"recording": names[i], **_value(own)} for i, own in s.own.items()],
    }


def _value(s: Shape) -> Mapping[str, Any]:
    return {"value": number(s.value, 6), "standard_error": uncertainty(s.standard_error)}
