"""Several recordings in one diagnosis: of one unit, or of several units side by side (`triaxcal.agreement/1`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from triaxcal.agreement import Agreement, Common, SharedShape
from triaxcal.calibration_document import Document
from triaxcal.loop import Loop
from triaxcal.rounding import error, number, probability, uncertainty
from triaxcal.runs import residuals_by_run
from triaxcal.units import in_units_of


def with_recordings(document: Document, loop: Loop, names: Sequence[str]) -> Document:
    """A `triaxcal.loop/1` of several recordings: which pose is of which, and the residual of each."""
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
    found: Agreement, names: Sequence[str], results: Sequence[Document], reference_unit: str = "g"
) -> Document:
    """``results`` are the units' own, `triaxcal.loop/1`, and ``names`` their recordings."""
    return {
        "format": "triaxcal.agreement/1",
        "verdict": found.verdict,
        "agreed": list(found.agreed),
        "effects": [_effect(c, names, reference_unit) for c in found.effects],
        "units": [{"recording": n, "result": dict(r)} for n, r in zip(names, results, strict=True)],
    }


def _effect(c: Common, names: Sequence[str], reference_unit: str) -> Document:
    def recordings(indices: Sequence[int]) -> list[str]:
        return [names[i] for i in indices]

    silent = [i for i in range(len(names)) if i not in (*c.named, *c.listed)]
    return {
        "effect": c.effect,
        "worse": uncertainty(c.worse),
        "gain": uncertainty(c.gain),
        "units_gain": [uncertainty(gain) for gain in c.units_gain],
        "shown_by": recordings(c.shown),
        "named_by": recordings(c.named),
        "listed_by": recordings(c.listed),
        "not_found_by": recordings(silent),
        "shapes": {name: _shape(shape, names, reference_unit) for name, shape in c.shapes.items()},
    }


def _shape(s: SharedShape, names: Sequence[str], reference_unit: str) -> Mapping[str, Any]:
    return {
        "value": number(s.value, 6),
        "standard_error": uncertainty(s.standard_error),
        "unit": in_units_of(s.unit, reference_unit),
        "p_value": probability(s.p_value),
        "own": [
            {"recording": names[i], "value": number(value, 6), "standard_error": uncertainty(deviation)}
            for i, (value, deviation) in zip(s.units, s.own, strict=True)
        ],
    }
