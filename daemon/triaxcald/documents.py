"""The JSON document of a closed loop (`triaxcal.loop/1`), and how documents are
written and parsed."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald.caveats import UNIT, correction_options

NO_LONGER_OF_A_FINDING = ("p_value", "spoiled", "coincidence", "held_out_rms_g", "apart", "residual", "pose_residual_g")
NO_LONGER_OF_WHAT_IS_UNEXPLAINED = ("p_value", "or_spoiled", "or_named", "only_inside")
"""Keys of 0.1 that mean nothing since names have probabilities: others read
them, and find null."""


CONTAINERS_MOST = 400_000
"""Lists and objects of a JSON document, with the brackets inside its texts: one
of a thousand poses has some 20,000, and each takes 70 bytes and more."""


class TooManyContainers(ValueError):
    """More lists and objects than `CONTAINERS_MOST`."""

    def __init__(self) -> None:
        super().__init__(f"more than {CONTAINERS_MOST} lists and objects")


def json_value(data: bytes) -> Any:
    """JSON in UTF-8, in which no object has a key twice. Raises ValueError, of
    which TooManyContainers is one, and RecursionError."""
    if data.count(b"[") + data.count(b"{") > CONTAINERS_MOST:
        raise TooManyContainers
    return json.loads(data.decode(), object_pairs_hook=_each_key_once)


def _each_key_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    held = dict(pairs)
    if len(held) < len(pairs):
        twice = next(k for k, count in Counter(k for k, _ in pairs).items() if count > 1)
        raise ValueError(f"the key '{td.hints.clipped(twice)}' is given twice")
    return held


def to_text(document: Mapping[str, Any]) -> str:
    """The document as it is written and compared: UTF-8, two spaces, one key a
    line, a newline at the end."""
    return json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def loop_document(
    loop: tc.diagnosis.Loop,
    *,
    data_quality: Sequence[str] = (),
    output_unit: str = "",
    reference_unit: str = "g",
    stated: tc.Stated | None = None,
    held_by_device: tc.estimate.Calibration | None = None,
    remarks: Sequence[str] = (),
    unit_in_doubt: bool = False,
    odds: tc.interchange.Document | None = None,
) -> tc.interchange.Document:
    """``held_by_device`` is the calibration that a device has registers for,
    None where there is no such device. ``remarks`` are warnings besides those
    of the fit; ``unit_in_doubt``: one of them asks whether it is one unit. ``odds``
    are those that were learned, where the loop was found by them."""
    calibration = tc.interchange.calibration_document(
        loop.after, output_unit=output_unit, reference_unit=reference_unit, stated=stated
    )
    reference = loop.after.reference
    small = tc.units.ErrorUnit.of(reference_unit, reference)
    calibration["warnings"] += remarks
    for finding in loop.findings:
        if finding.verdict is tc.diagnosis.Verdict.ADOPTED:
            calibration["effects"][finding.effect][tc.interchange.WEIGHT] = 1.0
    for pose, before in zip(calibration["poses"], loop.before.poses, strict=True):
        pose["before_residual_g"] = tc.rounding.error(before.residual_g, reference)
    following = tc.uncertainty.next_recording(loop.after, tc.uncertainty.budget(loop.after, stated))
    given: dict[str, Any] = {}  # keys that most loops do without
    if loop.held_out:
        given["held_out"] = _held_out(loop.held_out, following.expanded_uncertainty, reference)
    if odds is not None:
        given["odds"] = tc.schema.OddsUsed.model_validate(odds)
    if unit_in_doubt or loop.found.change_point:
        given["doubts"] = [UNIT]
    return tc.schema.Loop(
        format="triaxcal.loop/1",
        call=loop.call.value,
        summary=list(tc.text.diagnosis.lines(loop, small, following, stated)),
        before=_residual(loop.before.residual, reference),
        after=_residual(loop.after.residual, reference),
        findings=[_finding(f, loop.refusal, reference_unit) for f in loop.findings],
        candidates=[
            tc.schema.Candidate(
                effect=c.effect,
                probability=calibrated(c.probability),
                hangs_on_one_pose=c.hangs_on_one_pose,
                coefficients=tc.interchange.coefficients_document(c.coefficients, reference_unit),
            )
            for c in loop.candidates
        ],
        probabilities={name: calibrated(p) for name, p in loop.stated.items()},
        nothing_probability=tc.rounding.chance(loop.found.nothing),
        another_unit=_another(loop),
        not_corrected=None if loop.refusal is None else loop.refusal.value,
        choices=[
            tc.schema.Choice.model_validate(
                {
                    "corrected_by": list(choice.corrected_by),
                    "terms": list(choice.terms),
                    **tc.interchange.residual_document(choice.residual, reference),
                }
            )
            for choice in correction_options(loop, held_by_device)
        ],
        unexplained=_unexplained(loop.found.unexplained, small, reference),
        data_quality=list(data_quality),
        advice=list(tc.text.diagnosis.advice(loop, small)),
        notes=list(tc.text.diagnosis.notes(loop, small)),
        traces=[_trace(trace, reference, reference_unit) for trace in loop.traces],
        calibration=tc.schema.Calibration.model_validate(calibration),
        **given,
    ).document()


def _residual(residual: tc.estimate.Residual, reference: float) -> tc.schema.Residual:
    return tc.schema.Residual.model_validate(tc.interchange.residual_document(residual, reference))


def _trace(trace: tc.evidence.Trace, reference: float, reference_unit: str) -> tc.schema.Trace:
    in_errors = trace.quantity is tc.evidence.Quantity.STANDARD_ERRORS
    widest = float(trace.half_width.max(initial=0.0))

    def value(v: float, known: float) -> float | None:
        return tc.rounding.in_standard_errors(v) if in_errors else tc.rounding.known_to(v, known, reference)

    return tc.schema.Trace(
        effect=trace.effect or None,
        axis=trace.axis or None,
        coefficients=list(trace.coefficients),
        variable=trace.variable,
        variable_unit=tc.units.in_units_of(tc.evidence.unit_of(trace.variable), reference_unit),
        quantity=trace.quantity.value,
        share=tc.rounding.uncertainty(trace.share),
        p_value=tc.rounding.probability(trace.p_value),
        pose=trace.pose.tolist(),
        x=tc.rounding.numbers(trace.x),
        y=[value(float(y), float(known)) for y, known in zip(trace.y, trace.error, strict=True)],
        error=[tc.rounding.uncertainty(float(v)) for v in trace.error],
        excluded=trace.excluded.tolist(),
        curve=tc.schema.Curve(
            x=tc.rounding.numbers(trace.grid),
            y=[value(float(y), widest) for y in trace.curve],
            half_width=[tc.rounding.known_to(float(v), widest, reference) for v in trace.half_width],
        ),
    )


def rezero_document(
    c: tc.estimate.Calibration,
    *,
    data_quality: Sequence[str] = (),
    output_unit: str = "",
    reference_unit: str = "g",
    stated: tc.Stated | None = None,
) -> tc.interchange.Document:
    """A calibration with biases anew in the place of a closed loop: it was not
    searched for effects."""
    assert c.update is not None
    calibration = tc.interchange.calibration_document(
        c, output_unit=output_unit, reference_unit=reference_unit, stated=stated
    )
    return tc.schema.Rezero(
        format="triaxcal.rezero/1",
        summary=list(tc.text.bias_update.lines(c, c.update, tc.units.ErrorUnit.of(reference_unit, c.reference))),
        before=_residual(c.update.before, c.reference),
        after=_residual(c.residual, c.reference),
        findings=[],
        candidates=[],
        choices=[],
        data_quality=list(data_quality),
        advice=[],
        calibration=tc.schema.Calibration.model_validate(calibration),
    ).document()


def calibrated(probability: float | None) -> float | None:
    """Null where it is not calibrated."""
    return None if probability is None else tc.rounding.chance(probability)


def _finding(f: tc.diagnosis.Finding, refusal: tc.evidence.Refusal | None, reference_unit: str) -> tc.schema.Finding:
    return tc.schema.Finding(
        effect=f.effect,
        verdict=f.verdict.value,
        probability=calibrated(f.probability),
        coefficients=tc.interchange.coefficients_document(f.coefficients, reference_unit),
        alternatives=list(f.alternatives),
        probabilities={name: calibrated(p) for name, p in f.alternatives.items()},
        reason=tc.text.diagnosis.reason(f, refusal),
        remedy=f.remedy,
        **dict.fromkeys(NO_LONGER_OF_A_FINDING),
    )


def _unexplained(part: tc.evidence.Unexplained, small: tc.units.ErrorUnit, reference: float) -> tc.schema.Unexplained:
    return tc.schema.Unexplained(
        significant=part.significant,
        probability=tc.rounding.chance(part.probability),
        kind=None if part.kind is None else part.kind.value,
        rms_g=tc.rounding.error(part.rms_g, reference),
        lead=tc.text.diagnosis.unexplained(part, small) if part.significant else "",
        **dict.fromkeys(NO_LONGER_OF_WHAT_IS_UNEXPLAINED),
    )


def _another(loop: tc.diagnosis.Loop) -> tc.schema.AnotherUnit | None:
    """From which pose on there is another unit, or another mounting; None where
    that is unlikely."""
    found = loop.found.change_point
    if found is None:
        return None
    began = loop.after.poses[found.pose].pose.began
    return tc.schema.AnotherUnit(
        start_s=tc.rounding.number(began.start_s),
        probability=tc.rounding.chance(found.probability),
        **({} if began.recording is None else {"recording": began.recording}),
    )


def _held_out(held: tc.estimate.HoldOut, another_day: float, reference: float) -> tc.schema.HeldOut:
    contradiction = held.contradicts(another_day)
    return tc.schema.HeldOut(
        before_rms_g=tc.rounding.error(held.before_rms_g, reference),
        after_rms_g=tc.rounding.error(held.after_rms_g, reference),
        noise_floor_g=tc.rounding.error(held.noise_floor_g, reference),
        poses=held.poses,
        contradicts=None if contradiction is None else contradiction.value,
    )
