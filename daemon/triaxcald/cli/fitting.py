"""fit, diagnose."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

import triaxcal as tc
from triaxcald import documents
from triaxcald.attitudes import match, read_attitudes
from triaxcald.cli.console import emit, micro, progress, show, table
from triaxcald.cli.show_fit import (
    WORTH_A_LINE,
    chance_of,
    cross_validated,
    held_at,
    show_budget,
    show_calibration,
    show_coefficients,
    show_loop,
    show_summary,
    temperature_of,
    text_of_held_out,
)
from triaxcald.cli.showing import FitSettings, fit_settings, judge, read_recording, telling_data_quality, warn
from triaxcald.cli.syntax import writable
from triaxcald.documents import rezero_document
from triaxcald.earlier_calibration import EarlierFile
from triaxcald.errors import InputError
from triaxcald.files import write_text
from triaxcald.inputs import Measured, read_document, require_unit
from triaxcald.learned_odds import OddsFile
from triaxcald.provision.correction import IN_DOCUMENT, to_hex
from triaxcald.recording.schema import ODDS_FILE
from triaxcald.verification import unlike

# fit by other ways: a turning unit, poses of known attitude, refinement of
# datasheet values.

POSES_ENOUGH = 9
DEFAULT_SIGNS = (
    "no --sign was given, so +,+,+ is taken: an output that falls where its axis points up needs a minus, "
    "and nothing in the data tells"
)
Way = tuple[Measured, tc.interchange.Document, tc.estimate.Calibration, Callable[[], None]]
"""Measurement, document, calibration, and the function that shows it at the console."""


def chosen_way(a: argparse.Namespace) -> Callable[[argparse.Namespace], Way] | None:
    """The way that the options ask for; None for still poses alone. Raises
    InputError for options without their way."""
    if a.attitude_error is not None and not a.attitudes:
        raise InputError("--attitude-error: there are no --attitudes")
    if a.datasheet_error is not None and not a.datasheet:
        raise InputError("--datasheet-error: there is no --datasheet")
    way = "--turning" if a.turning else "--attitudes" if a.attitudes else "--datasheet" if a.datasheet else None
    for option in ("reference_uncertainty", "thermometer_uncertainty", "thermal_sensitivity"):
        if way and getattr(a, option) is not None:
            raise InputError(f"--{option.replace('_', '-')}: with {way} there is no budget that it would count in")
    return _turning if a.turning else _attitudes if a.attitudes else _datasheet if a.datasheet else None


def signs_given(a: argparse.Namespace, measured: Measured) -> bool:
    """No residual shows that signs are wrong; where nobody gave them this is
    said."""
    return a.sign is not None or measured.signs is not None


def default_signs(a: argparse.Namespace, measured: Measured) -> list[str]:
    """The warning of signs that nobody gave."""
    return [] if signs_given(a, measured) else [DEFAULT_SIGNS]


@contextmanager
def telling_default_signs(a: argparse.Namespace, measured: Measured) -> Iterator[None]:
    """A refusal names poses, and which way is up depends on signs that nobody
    may have given."""
    try:
        yield
    except tc.Refused as e:
        if e.wanted and not signs_given(a, measured):
            assumed = "these directions assume signs of +,+,+, since no --sign was given"
            raise tc.Refused(f"{e}; {assumed}", wanted=e.wanted) from e
        raise


def _turning(a: argparse.Namespace) -> Way:
    moments = tc.inputs.Moments()
    measured = read_recording(a, a.recording, moments)
    settings = fit_settings(a, measured)
    with telling_data_quality(measured), telling_default_signs(a, measured):
        found = tc.inputs.fit_rotation(moments, signs=settings.signs, reference=settings.reference)
    document = tc.interchange.turning_document(
        found, output_unit=settings.output_unit, reference_unit=settings.reference_unit
    )
    calibration = found.calibration
    still = [p for p in measured.poses if not p.creep.any()]
    if len(still) >= POSES_ENOUGH:
        advice = f"there are {len(still)} still poses in it: without --turning the fit would use their quiet"
        document["warnings"] = [*document["warnings"], advice]
    return measured, document, calibration, lambda: _show_turning(found, settings)


def _show_turning(found: tc.inputs.RotationFit, settings: FitSettings) -> None:
    show_coefficients(found.calibration, settings)
    if t := found.temperature:
        show(held_at(t.mean, t.lowest, t.highest, "samples"))
    r, small = found.calibration.residual, settings.small
    noise = ", ".join(f"{v:.3g}" for v in found.noise_g)
    show(
        f"{tc.number_format.number_of(found.samples, 'sample')}, whose noise is {noise} "
        f"{settings.reference_unit} in x, y, z"
    )
    show(
        f"{found.stretches} stretches: |a| off by {small.in_full(r.rms_g)} rms, of which noise is "
        f"{small.in_full(r.noise_floor_g)}, lack of fit p {tc.number_format.probability(r.lack_of_fit_p)}"
    )


def _attitudes(a: argparse.Namespace) -> Way:
    rows = read_attitudes(a.attitudes)
    measured = read_recording(a, a.recording)
    settings = fit_settings(a, measured)
    poses, rows = match(rows, measured.poses, path=a.attitudes, recording=measured.name)
    with telling_data_quality(measured):
        found = tc.inputs.fit_attitudes(
            poses,
            np.array([row.up for row in rows]),
            names=[row.name for row in rows],
            signs=a.sign or measured.signs,
            reference=settings.reference,
            attitude_error_rad=a.attitude_error,
        )
    document = tc.interchange.attitudes_document(
        found, output_unit=settings.output_unit, reference_unit=settings.reference_unit
    )
    return measured, document, found.calibration, lambda: _show_attitudes(found, settings)


def _show_attitudes(found: tc.inputs.AttitudeFit, settings: FitSettings) -> None:
    c = found.calibration
    show_coefficients(c, settings)
    if said := temperature_of(c):
        show(said)
    table(
        "attitudes",
        ["", "start s", "off µrad", "off, standard errors", f"|a| off {settings.small}", "used"],
        [
            [
                row.name,
                f"{pose.pose.start_s:.1f}",
                micro(row.off_rad),
                f"{row.off:.1f}",
                settings.small.written(pose.residual_g),
                "yes" if pose.used else "no",
            ]
            for row, pose in zip(found.attitudes, c.poses, strict=True)
        ],
    )
    table(
        "rotation from the table's frame to the sensor's",
        ["", "x", "y", "z", "standard error µrad"],
        [
            [axis, *(f"{v:+.7f}" for v in line), micro(float(error))]
            for axis, line, error in zip("xyz", found.rotation, found.rotation_error_rad, strict=True)
        ],
    )
    how = "estimated from the residuals" if found.estimated else "as declared" if found.attitude_error_rad else "none"
    cost = float(np.max(c.standard_errors[:9] / found.noise_error))
    show(
        f"error of the attitudes by axis: {micro(found.attitude_error_rad)} µrad ({how}); with what residuals say it "
        f"raises the standard errors by a factor of up to {cost:.2f}"
    )
    small = settings.small
    r = c.residual
    show(
        f"{len(c.poses)} poses: |a| off by {small.in_full(r.rms_g)} rms, {cross_validated(r, small)}, noise floor "
        f"{small.in_full(r.noise_floor_g)}, lack of fit p {tc.number_format.probability(r.lack_of_fit_p)}"
    )


def _datasheet(a: argparse.Namespace) -> Way:
    held = read_document(a.datasheet)
    measured = read_recording(a, a.recording)
    require_unit(held, measured, where=a.datasheet)
    settings = fit_settings(a, measured)
    said = a.reference or measured.reference or getattr(a, "latitude", None)
    datasheet, units = read_datasheet(
        held, where=a.datasheet, errors=a.datasheet_error, reference=settings.reference if said is not None else None
    )
    if a.sign and any(k * s < 0 for k, s in zip(datasheet.sensor.scale_factor, a.sign, strict=True)):
        raise InputError(f"--sign: the scale factors in {a.datasheet} have other signs")
    settings = replace(
        settings,
        reference=datasheet.reference,
        output_unit=settings.output_unit or units.get("output", ""),
        reference_unit=a.reference_unit or units.get("reference") or settings.reference_unit,
    )
    with telling_data_quality(measured), np.errstate(all="ignore"):  # numbers out of a file may be any
        found = tc.inputs.refine(measured.poses, datasheet)
    document = tc.interchange.datasheet_document(
        found, output_unit=settings.output_unit, reference_unit=settings.reference_unit
    )
    return measured, document, found.calibration, lambda: _show_datasheet(found, settings)


def read_datasheet(
    document: Mapping[str, Any], *, where: str, errors: tuple[float, float, float] | None, reference: float | None
) -> tuple[tc.inputs.Datasheet, Mapping[str, str]]:
    """The datasheet values in a calibration, loop or certificate document, and
    its units.

    ``errors`` stand for the document's, and for its correlation: of the scale
    factors relative to them, of the misalignments in rad, of the biases in the
    unit of the reference. ``reference`` is the magnitude in the poses, where it
    is not the document's. Raises InputError.
    """
    sensor, channel_reference, own = tc.interchange.sensor_of(document, where=where)
    part = tc.interchange.calibration_part(document, where=where)
    if reference is not None and not 0.9 < reference / own < 1.1:
        raise InputError(f"--reference {reference:g}: {where} was made for {own:g}, in another unit it seems")
    if errors is not None:
        relative, angle, bias = errors
        linear = np.concatenate([np.abs(sensor.scale_factor) * relative, np.full(3, angle), np.full(3, bias)])
        correlation = None
    elif "standard_error" not in part:
        raise InputError(f"{where}: standard_error: missing; expected them, or --datasheet-error")
    else:
        linear = tc.interchange.linear_errors_of(part, where=where)
        correlation = tc.interchange.correlation_of(part, sensor, where=where)
    standard_error = np.concatenate([linear, tc.interchange.effect_errors_of(part, sensor, where=where)])
    if not np.any(standard_error > 0):
        whose = f"{where}: standard_error" if errors is None else "--datasheet-error"
        raise InputError(f"{whose}: all are 0, so that nothing is left to refine")
    units = part.get("units")
    held = {str(k): str(v) for k, v in units.items()} if isinstance(units, Mapping) else {}
    magnitude = own if reference is None else reference
    return tc.inputs.Datasheet(
        sensor, standard_error, channel_reference, magnitude, correlation, tc.interchange.holds_at_of(part, where=where)
    ), held


def _show_datasheet(found: tc.inputs.Refinement, settings: FitSettings) -> None:
    c = found.calibration
    table(
        f"datasheet values, refined by {len(c.poses)} poses",
        ["", "datasheet", "standard error", "refined", "standard error", "shift, by chance 1", "poses' share", "from"],
        [
            [name, f"{old:.9g}", f"{error:.2g}", f"{new:.9g}", f"{now:.2g}", f"{shift:+.1f}", f"{share:.0%}", source]
            for name, old, error, new, now, shift, share, source in zip(
                c.parameters,
                found.datasheet.values,
                found.datasheet.standard_error,
                c.values,
                c.standard_errors,
                found.shift,
                found.share,
                found.sources,
                strict=True,
            )
        ],
    )
    r, small = c.residual, settings.small
    show(
        f"|a| off by {small.in_full(r.rms_g)} rms, noise floor {small.in_full(r.noise_floor_g)}; datasheet and poses "
        f"agree with p {tc.number_format.probability(found.conflict_p)}"
    )


# Several recordings for one command: whether they go together, and what came of
# each at the console.

COLUMNS = {
    "in all": "probability that the effect acts in every unit",
    "one value": "probability that its coefficients are the same in all, if it does",
    "in each unit by itself": "probability that it acts there, by that unit alone, in the order of the recordings",
}
"""Columns of the table of all units."""


def measured_each(a: argparse.Namespace) -> list[Measured]:
    """The recordings that the arguments name. Raises InputError where one is
    named twice, Refused for one without a pose among several."""
    names: list[str] = a.recording
    places = [_place(name) for name in names]
    twice = next((n for i, n in enumerate(names) if places[i] in places[:i]), None)
    if twice is not None:
        raise InputError(f"{twice}: given twice; a recording counts once")
    if a.check and _place(a.check) in places:
        raise InputError(f"--check {a.check}: is what is diagnosed; held-out poses are of another recording")
    out = [read_recording(a, name) for name in names]
    empty = next((m for m in out if not m.poses), None)
    if empty is not None and len(out) > 1:
        warn(named_quality(empty))
        raise tc.Refused(f"{empty.name}: no still pose")
    return out


def measured_check(measured: Measured, a: argparse.Namespace) -> Measured | None:
    """The recording of the held-out poses, where the arguments name one. Raises
    InputError where it is not alike."""
    if not a.check:
        return None
    check = read_recording(a, a.check)
    _require_alike(measured, check, a)
    return check


def _place(name: str) -> Path | None:
    """Resolved path of a recording; None for standard input."""
    return None if name == "-" else Path(name).resolve()


def as_one_unit(recordings: Sequence[Measured], a: argparse.Namespace) -> Measured:
    """All poses together, the rest as in the first. Raises InputError where
    they are not alike."""
    first = recordings[0]
    if len(recordings) == 1:
        return first
    for one, other in combinations(recordings, 2):  # the first may not say of which unit it is
        _require_alike(one, other, a, hint="; --units judges units side by side")
    return replace(
        first,
        name=f"{first.name} and {len(recordings) - 1} more",
        poses=tc.estimate.gather([m.poses for m in recordings]),
        windows=None,
        unconfirmed=first.unconfirmed if all(m.unconfirmed for m in recordings) else "",
        data_quality=[line for m in recordings for line in named_quality(m)],
        unit=next((m.unit for m in recordings if m.unit), None),
    )


def named_quality(m: Measured) -> list[str]:
    """Data quality with the name of the recording, for several recordings."""
    return [f"{m.name}: {line}" for line in m.data_quality]


def _require_alike(first: Measured, other: Measured, a: argparse.Namespace, *, hint: str = "") -> None:
    """``hint`` is for recordings of two units."""
    ours, theirs = ({"unit": _serial(m), **_document_settings(fit_settings(a, m))} for m in (first, other))
    for what, said in theirs.items():
        if said != ours[what] and not (what == "unit" and None in (said, ours[what])):
            more = hint if what == "unit" else f"; {_SAID_BY[what]} says it for all"
            raise InputError(f"{other.name}: {what}: {said}; {first.name} has {ours[what]}{more}")


def channels_of_some(recordings: Sequence[Measured]) -> list[str]:
    """A line for each channel that not all of several recordings have: no
    effect of it can be put to all poses."""
    logged = {m.name: set.intersection(*(set(p.channels) for p in m.poses)) for m in recordings if m.poses}
    out = []
    for channel in sorted(set().union(*logged.values())):
        lacking = [name for name, channels in logged.items() if channel not in channels]
        if lacking:
            having = ", ".join(name for name in logged if name not in lacking)
            out.append(f"channel {channel}: in {having}, but not in {', '.join(lacking)}; no effect of it was tried")
    return out


def unit_identity_warnings(recordings: Sequence[Measured], loop: tc.diagnosis.Loop, settings: FitSettings) -> list[str]:
    """Lines where several recordings can hardly be of one unit; ``loop`` is
    that of all of them."""
    if len(recordings) == 1:
        return []
    names = " and ".join(m.name for m in recordings)
    if said := unlike(names, loop.before.residual.rms_g, settings.reference, "do not look like one unit"):
        return said
    shapes = [(m.name, tc.estimate.shape_by_poses(m.poses, settings.signs, settings.reference)) for m in recordings]
    known = [(name, shape) for name, shape in shapes if shape is not None]
    return [
        line
        for name, shape in known[1:]
        for line in tc.text.pooled_units.other_unit(known[0][0], name, known[0][1], shape)
    ]


def check_identity_warnings(
    measured: Measured, check: Measured, loop: tc.diagnosis.Loop, settings: FitSettings
) -> list[str]:
    """A line where the held-out poses can hardly be of the unit of those
    diagnosed in ``loop``."""
    assert loop.held_out is not None
    if said := unlike(check.name, loop.held_out.before_rms_g, settings.reference):
        return said
    own = tc.estimate.shape_by_poses(check.poses, settings.signs, settings.reference)
    return tc.text.pooled_units.other_unit(measured.name, check.name, tc.estimate.shape_of(loop.before), own)


def _serial(m: Measured) -> str | None:
    return m.unit.get("serial") if m.unit else None


_SAID_BY = {
    "signs of the scale factors": "--sign",
    "reference": "--reference, --reference-unit",
    "output unit": "--output-unit",
}
"""The options by which a setting is the same for all recordings."""


def _document_settings(settings: FitSettings) -> dict[str, str | None]:
    return {
        "signs of the scale factors": ",".join("+" if s > 0 else "-" for s in settings.signs),
        "reference": f"{settings.reference:g} {settings.reference_unit}",
        "output unit": settings.output_unit or "not stated",
    }


def show_by_recording(loop: tc.diagnosis.Loop, names: Sequence[str], settings: FitSettings) -> None:
    small = settings.small
    table(
        f"by recording, {small} rms",
        ["", "poses", "before", "after", "noise floor"],
        [
            [name, r.poses, *(small.written(v) for v in (r.before_rms_g, r.after_rms_g, r.noise_floor_g))]
            for name, r in zip(names, tc.estimate.residuals_by_run(loop.before, loop.after), strict=True)
        ],
    )


def show_agreement(
    found: tc.pooled_units.PooledAnalysis,
    names: Sequence[str],
    loops: Sequence[tc.diagnosis.Loop],
    settings_of_each: Sequence[FitSettings],
) -> None:
    small = settings_of_each[0].small
    table(
        f"each unit by itself, {small}",
        ["", "finding", "probability", "or instead", "residual before", "after", "noise floor"],
        [
            [
                name,
                tuple(f.effect for f in loop.findings) or "none",
                tuple(chance_of(f.probability) for f in loop.findings),
                tuple(", ".join(f.alternatives) for f in loop.findings),
                small.written(loop.before.residual.rms_g),
                small.written(loop.after.residual.rms_g),
                small.written(loop.after.residual.noise_floor_g),
            ]
            for name, loop in zip(names, loops, strict=True)
        ],
    )
    table(
        "all units together",
        ["", "in all", "one value", "in each unit by itself"],
        [
            [
                c.effect,
                tc.text.diagnosis.chance(c.probability),
                tc.text.diagnosis.chance(c.common),
                " ".join(f"{p:.2f}" for p in c.units),
            ]
            for c in found.effects
            if c.probability >= WORTH_A_LINE or max(c.units) >= WORTH_A_LINE
        ],
    )
    for column, meaning in COLUMNS.items():
        show(f"{column}: {meaning}")
    said = tc.text.pooled_units.verdict(found)
    show(said if found.answer is tc.pooled_units.Answer.NOTHING else f"the units {said}")
    for c in found.effects:
        if any(c.effect in group for group in found.agreed):
            for name, s in c.shapes.items():
                known = (
                    ""
                    if s.shared.standard_error is None
                    else f" ± {tc.number_format.plain(s.shared.standard_error, 2)}"
                )
                show(f"{c.effect}: {name} {tc.number_format.plain(s.shared.value, 4)}{known} {s.shared.unit}")


def fit_command(a: argparse.Namespace) -> int:
    writable(a.output)
    writable(a.report)
    way = chosen_way(a)
    if way is not None:
        return _fit_by(way, a)
    measured, document, calibration, show_it = still_poses(a)
    write_results(a, measured, document)
    if a.json:
        emit(document)
    else:
        show_it()
        warn([*map(tc.text.caution, calibration.cautions), *measured.data_quality, *default_signs(a, measured)])
    return judge(a.limit, calibration.residual.rms_g, calibration.reference)


def still_poses(a: argparse.Namespace) -> Way:
    """The linear model of the still poses. Raises Refused."""
    measured = read_recording(a, a.recording)
    settings = fit_settings(a, measured)
    with telling_data_quality(measured), telling_default_signs(a, measured):
        progress(tc.Stage.FIT)
        calibration = tc.estimate.fit(measured.poses, signs=settings.signs, reference=settings.reference)
    document = tc.interchange.calibration_document(
        calibration, output_unit=settings.output_unit, reference_unit=settings.reference_unit, stated=settings.stated
    )
    document["data_quality"] = measured.data_quality
    return measured, document, calibration, lambda: show_calibration(calibration, settings)


def _fit_by(way: Callable[[argparse.Namespace], Way], a: argparse.Namespace) -> int:
    measured, document, calibration, show = way(a)
    warnings = document["warnings"]
    document["data_quality"] = measured.data_quality
    write_results(a, measured, document)
    if a.json:
        emit(document)
    else:
        show()
        warn([*warnings, *measured.data_quality])
    return judge(a.limit, calibration.residual.rms_g, calibration.reference)


def diagnose_command(a: argparse.Namespace) -> int:
    writable(a.output)
    writable(a.report)
    if a.units:
        _require_alone(a)
    recordings = measured_each(a)
    if a.units:
        return _diagnose_units(a, recordings)
    names = [m.name for m in recordings]
    measured = as_one_unit(recordings, a)
    check = measured_check(measured, a)
    settings = fit_settings(a, measured)
    odds = odds_file(a, measured)
    loop = _loop(a, measured, settings, check.poses if check else None)
    remarks, doubts = channels_of_some(recordings), unit_identity_warnings(recordings, loop, settings)
    if check and loop.held_out:
        measured = replace(measured, data_quality=[*measured.data_quality, *named_quality(check)])
        doubts += check_identity_warnings(measured, check, loop, settings)
    progress(tc.Stage.ADVICE)
    document = _loop_document(loop, measured, settings, [*remarks, *doubts], unit_in_doubt=bool(doubts), odds=odds)
    if len(names) > 1:
        document = tc.interchange.with_recordings(document, loop, names)
    write_results(a, measured, document)
    if a.json:
        emit(document)
    else:
        show_summary(document["summary"])
        if len(names) > 1:
            show_by_recording(loop, names, settings)
        if a.verbose:
            show_loop(loop, settings)
            show_calibration(loop.after, settings)
        elif loop.held_out:
            show(text_of_held_out(loop.held_out, settings.small))
        warn([*document["calibration"]["warnings"], *measured.data_quality, *default_signs(a, measured)])
    return judge(a.limit, loop.after.residual.rms_g, loop.after.reference)


def diagnosed(a: argparse.Namespace) -> tuple[Measured, tc.diagnosis.Loop, tc.interchange.Document]:
    """One recording by itself, and its `triaxcal.loop/1`. Raises Refused."""
    measured = read_recording(a, a.recording)
    settings = fit_settings(a, measured)
    loop = _loop(a, measured, settings)
    return measured, loop, _loop_document(loop, measured, settings)


def _loop(
    a: argparse.Namespace, measured: Measured, settings: FitSettings, check: Sequence[tc.Pose] | None = None
) -> tc.diagnosis.Loop:
    with telling_data_quality(measured), telling_default_signs(a, measured):
        return tc.diagnosis.diagnose(
            measured.poses,
            signs=settings.signs,
            reference=settings.reference,
            check=check,
            at=a.at if a.at is not None else measured.holds_at or tc.Moment.END,
            odds=None if (file := odds_file(a, measured)) is None else file.prior,
            progress=progress,
        )


def _loop_document(
    loop: tc.diagnosis.Loop,
    measured: Measured,
    settings: FitSettings,
    remarks: Sequence[str] = (),
    *,
    unit_in_doubt: bool = False,
    odds: OddsFile | None = None,
) -> tc.interchange.Document:
    return documents.loop_document(
        loop,
        data_quality=measured.data_quality,
        output_unit=settings.output_unit,
        reference_unit=settings.reference_unit,
        stated=settings.stated,
        remarks=remarks,
        unit_in_doubt=unit_in_doubt,
        odds=None if odds is None else odds.document,
    )


def odds_file(a: argparse.Namespace, measured: Measured) -> OddsFile | None:
    """The learned odds: those of ``--odds``, else those that a `run` had. Raises
    InputError, InvalidData."""
    if a.odds:
        return OddsFile.read(a.odds, measured.part_number)
    return None if measured.odds is None else OddsFile.parsed(measured.odds, f"{measured.name}: {ODDS_FILE}")


def _require_alone(a: argparse.Namespace) -> None:
    if len(a.recording) < 2:
        raise InputError("--units: whether units agree takes two recordings or more")
    for option, given in (("--check", a.check), ("--report", a.report)):
        if given:
            raise InputError(f"{option}: not with --units; diagnose the recording of one unit with it")


def _diagnose_units(a: argparse.Namespace, recordings: Sequence[Measured]) -> int:
    names, settings_of_each = [m.name for m in recordings], [fit_settings(a, m) for m in recordings]
    loops = []
    for measured, settings in zip(recordings, settings_of_each, strict=True):
        try:
            loops.append(_loop(a, replace(measured, data_quality=named_quality(measured)), settings))
        except tc.Refused as e:
            raise tc.Refused(f"{measured.name}: {e}", wanted=e.wanted) from e
    found = tc.pooled_units.pooled_analysis(loops)
    results = []
    for loop, measured, settings in zip(loops, recordings, settings_of_each, strict=True):
        results.append(
            _loop_document(loop, measured, settings, odds=odds_file(a, measured))
            | ({"unit": dict(measured.unit)} if measured.unit else {})
        )
    document = tc.interchange.agreement_document(found, names, results, settings_of_each[0].reference_unit)
    if a.output:
        write_text(a.output, documents.to_text(document))
    if a.json:
        emit(document)
    else:
        show_agreement(found, names, loops, settings_of_each)
        for measured, loop in zip(recordings, loops, strict=True):
            warnings = map(tc.text.caution, loop.after.cautions)
            warn([*(f"{measured.name}: {line}" for line in warnings), *named_quality(measured)])
    return max(judge(a.limit, loop.after.residual.rms_g, loop.after.reference) for loop in loops)


def write_results(
    a: argparse.Namespace,
    measured: Measured,
    document: tc.interchange.Document,
    shown: tc.interchange.Document | None = None,
) -> None:
    """``document`` as a file, and a page of it, or of what is ``shown`` in its
    place."""
    if measured.unit:
        document["unit"] = dict(measured.unit)  # so that it cannot be written to another
    if measured.at_start:
        document[IN_DOCUMENT] = to_hex(measured.at_start)  # what the device must still hold when it is written
    if a.report:  # before anything is written
        from triaxcald.report.charts import overview_of
        from triaxcald.report.page import render_report  # matplotlib, which nothing else needs
    if a.output:
        write_text(a.output, documents.to_text(document))
    if a.report:
        limits = {"limits": {"rms_g": a.limit}} if a.limit else None
        unit = fit_settings(a, measured).output_unit
        overview = overview_of(measured.windows, measured.poses, unit) if measured.windows is not None else None
        page = render_report(shown or document, title=title_of(measured.name), stream=overview, certificate=limits)
        write_text(a.report, page)


def title_of(name: str) -> str:
    """Title of a report: the name of the file without its folder."""
    return "standard input" if name == "-" else Path(name).name


# rezero.


def rezero_command(a: argparse.Namespace) -> int:
    writable(a.output)
    writable(a.report)
    file = EarlierFile.read(a.calibration)
    earlier = file.calibration
    measured = read_recording(a, a.recording, wanted_by=earlier)
    said = fit_settings(a, measured)
    file.require_of(
        measured.name,
        serial=(measured.unit or {}).get("serial"),
        signs=a.sign or measured.signs,
        reference=a.reference or measured.reference,
        reference_unit=a.reference_unit,
        output_unit=said.output_unit,
    )
    settings = replace(
        said,
        reference=earlier.fitted.reference,
        output_unit=said.output_unit or earlier.output_unit,
        reference_unit=earlier.reference_unit,
    )
    with telling_data_quality(measured):
        found = tc.inputs.updated_biases(measured.poses, file.known(title_of(measured.name)), first=a.poses)
    loop = rezero_document(
        found,
        data_quality=measured.data_quality,
        output_unit=settings.output_unit,
        reference_unit=settings.reference_unit,
        stated=settings.stated,
    )
    document = loop["calibration"] | {"data_quality": measured.data_quality}
    if file.serial:
        document["unit"] = dict(file.document["unit"])
    write_results(a, measured, document, loop)
    if a.json:
        emit(document)
    else:
        _show(found, settings)
        warn([*map(tc.text.caution, found.cautions), *measured.data_quality])
    if a.poses is not None and len(found.poses) < a.poses:
        warn([f"--poses {a.poses}: {measured.name} has {len(found.poses)} distinct poses"])
    return judge(a.limit, found.residual.rms_g, found.reference)


def _show(found: tc.estimate.Calibration, settings: FitSettings) -> None:
    b = tc.uncertainty.budget(found, settings.stated)
    show_coefficients(found, settings, b.parameters)
    assert found.update is not None
    for line in tc.text.bias_update.lines(found, found.update, settings.small):
        show(line)
    show_budget(b, settings)
