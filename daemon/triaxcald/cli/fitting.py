"""fit, diagnose."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from triaxcal import text
from triaxcal.diagnosis import Loop, diagnose
from triaxcal.errors import Refused
from triaxcal.estimate.pose_fit import fit
from triaxcal.interchange.calibration_document import Document, calibration_document
from triaxcal.interchange.pooled_documents import agreement_document, with_recordings
from triaxcal.model.samples import Moment
from triaxcal.pooled_units import pooled_analysis
from triaxcal.poses.pose import Pose
from triaxcal.progress import Stage
from triaxcald import documents
from triaxcald.cli.arguments import writable
from triaxcald.cli.console import emit, show
from triaxcald.cli.methods import Way, chosen_way, default_signs, telling_default_signs
from triaxcald.cli.progress import progress
from triaxcald.cli.results import show_calibration, show_loop, show_summary, text_of_held_out
from triaxcald.cli.several import (
    as_one_unit,
    channels_of_some,
    doubts_of_check,
    doubts_of_one_unit,
    measured_check,
    measured_each,
    named_quality,
    show_agreement,
    show_by_recording,
)
from triaxcald.cli.showing import Choice, chosen, judge, read_recording, telling_data_quality, warn
from triaxcald.errors import InputError
from triaxcald.files import write_text
from triaxcald.inputs import Measured


def fit_command(a: argparse.Namespace) -> int:
    writable(a.output)
    writable(a.report)
    way = chosen_way(a)
    if way is not None:
        return _fit_by(way, a)
    measured = read_recording(a, a.recording)
    choice = chosen(a, measured)
    with telling_data_quality(measured), telling_default_signs(a, measured):
        progress(Stage.FIT)
        calibration = fit(measured.poses, signs=choice.signs, reference=choice.reference)
    document = calibration_document(
        calibration, output_unit=choice.output_unit, reference_unit=choice.reference_unit, stated=choice.stated
    )
    document["data_quality"] = measured.data_quality
    write_results(a, measured, document)
    if a.json:
        emit(document)
    else:
        show_calibration(calibration, choice)
        warn([*map(text.caution, calibration.cautions), *measured.data_quality, *default_signs(a, measured)])
    return judge(a.limit, calibration.residual.rms_g, calibration.reference)


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
    choice = chosen(a, measured)
    loop = _loop(a, measured, choice, check.poses if check else None)
    remarks, doubts = channels_of_some(recordings), doubts_of_one_unit(recordings, loop, choice)
    if check and loop.held_out:
        measured = replace(measured, data_quality=[*measured.data_quality, *named_quality(check)])
        doubts += doubts_of_check(measured, check, loop, choice)
    progress(Stage.ADVICE)
    document = _loop_document(loop, measured, choice, [*remarks, *doubts], unit_in_doubt=bool(doubts))
    if len(names) > 1:
        document = with_recordings(document, loop, names)
    write_results(a, measured, document)
    if a.json:
        emit(document)
    else:
        show_summary(document["summary"])
        if len(names) > 1:
            show_by_recording(loop, names, choice)
        if a.verbose:
            show_loop(loop, choice)
            show_calibration(loop.after, choice)
        elif loop.held_out:
            show(text_of_held_out(loop.held_out, choice.small))
        warn([*document["calibration"]["warnings"], *measured.data_quality, *default_signs(a, measured)])
    return judge(a.limit, loop.after.residual.rms_g, loop.after.reference)


def _loop(a: argparse.Namespace, measured: Measured, choice: Choice, check: Sequence[Pose] | None = None) -> Loop:
    with telling_data_quality(measured), telling_default_signs(a, measured):
        return diagnose(
            measured.poses,
            signs=choice.signs,
            reference=choice.reference,
            check=check,
            at=a.at if a.at is not None else measured.holds_at or Moment.END,
            progress=progress,
        )


def _loop_document(
    loop: Loop, measured: Measured, choice: Choice, remarks: Sequence[str] = (), *, unit_in_doubt: bool = False
) -> Document:
    return documents.loop_document(
        loop,
        data_quality=measured.data_quality,
        output_unit=choice.output_unit,
        reference_unit=choice.reference_unit,
        stated=choice.stated,
        remarks=remarks,
        unit_in_doubt=unit_in_doubt,
    )


def _require_alone(a: argparse.Namespace) -> None:
    if len(a.recording) < 2:
        raise InputError("--units: whether units agree takes two recordings or more")
    for option, given in (("--check", a.check), ("--report", a.report)):
        if given:
            raise InputError(f"{option}: not with --units; diagnose the recording of one unit with it")


def _diagnose_units(a: argparse.Namespace, recordings: Sequence[Measured]) -> int:
    names, choices = [m.name for m in recordings], [chosen(a, m) for m in recordings]
    loops = []
    for measured, choice in zip(recordings, choices, strict=True):
        try:
            loops.append(_loop(a, replace(measured, data_quality=named_quality(measured)), choice))
        except Refused as e:
            raise Refused(f"{measured.name}: {e}", wanted=e.wanted) from e
    found = pooled_analysis(loops)
    results = []
    for loop, measured, choice in zip(loops, recordings, choices, strict=True):
        results.append(
            _loop_document(loop, measured, choice) | ({"unit": dict(measured.unit)} if measured.unit else {})
        )
    document = agreement_document(found, names, results, choices[0].reference_unit)
    if a.output:
        write_text(a.output, documents.to_text(document))
    if a.json:
        emit(document)
    else:
        show_agreement(found, names, loops, choices)
        for measured, loop in zip(recordings, loops, strict=True):
            warnings = map(text.caution, loop.after.cautions)
            warn([*(f"{measured.name}: {line}" for line in warnings), *named_quality(measured)])
    return max(judge(a.limit, loop.after.residual.rms_g, loop.after.reference) for loop in loops)


def write_results(a: argparse.Namespace, measured: Measured, document: Document, shown: Document | None = None) -> None:
    """``document`` as a file, and a page of it, or of what is ``shown`` in its
    place."""
    if measured.unit:
        document["unit"] = dict(measured.unit)  # so that it cannot be written to another
    if a.report:  # before anything is written
        from triaxcald.report.page import render_report  # matplotlib, which nothing else needs
        from triaxcald.report.stream import overview_of
    if a.output:
        write_text(a.output, documents.to_text(document))
    if a.report:
        limits = {"limits": {"rms_g": a.limit}} if a.limit else None
        unit = chosen(a, measured).output_unit
        overview = overview_of(measured.windows, measured.poses, unit) if measured.windows is not None else None
        page = render_report(shown or document, title=title_of(measured.name), stream=overview, certificate=limits)
        write_text(a.report, page)


def title_of(name: str) -> str:
    """Of a report: the file's name, wherever it lies."""
    return "standard input" if name == "-" else Path(name).name
