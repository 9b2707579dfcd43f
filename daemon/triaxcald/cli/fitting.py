"""fit, diagnose."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from triaxcal.fit import fit
from triaxcal.loop import diagnose
from triaxcald import documents
from triaxcald.cli.arguments import add_recording, add_uncertainty, positive, writable
from triaxcald.cli.console import emit
from triaxcald.cli.showing import chosen, judge, show_calibration, show_loop, warn
from triaxcald.cli.ways import Way, add_ways, chosen_way, telling_default_signs
from triaxcald.files import write_text
from triaxcald.inputs import Measured, measure
from triaxcald.report.page import render_report
from triaxcald.report.stream import overview_of


def register(commands: Any) -> None:
    p = commands.add_parser("fit", help="fit the linear model to a recording's still poses")
    add_recording(p)
    add_ways(p)
    _add_results(p)
    p.set_defaults(run=fit_command)
    p = commands.add_parser("diagnose", help="find, add and judge effects that the linear model lacks")
    add_recording(p)
    _add_results(p)
    p.add_argument("--check", metavar="REC2", help="another recording, whose poses no fit sees")
    p.set_defaults(run=diagnose_command)


def _add_results(p: argparse.ArgumentParser) -> None:
    add_uncertainty(p)
    p.add_argument("-o", "--output", type=Path, metavar="CAL.json")
    p.add_argument("--report", type=Path, metavar="R.html")
    p.add_argument("--limit", type=positive, metavar="G", help="exit 1 where the rms residual is above this")


def fit_command(a: argparse.Namespace) -> int:
    writable(a.output)
    writable(a.report)
    way = chosen_way(a)
    if way is not None:
        return _fit_by(way, a)
    measured = measure(a.recording)
    choice = chosen(a, measured)
    with telling_default_signs(a, measured):
        calibration = fit(measured.poses, signs=choice.signs, reference=choice.reference)
    document = documents.calibration_document(
        calibration, output_unit=choice.output_unit, reference_unit=choice.reference_unit, stated=choice.stated
    )
    document["data_quality"] = measured.data_quality
    _write(a, measured, document)
    if a.json:
        emit(document)
    else:
        show_calibration(calibration, choice)
        warn([*calibration.warnings, *measured.data_quality])
    return judge(a.limit, calibration.residual.rms_g)


def _fit_by(way: Callable[[argparse.Namespace], Way], a: argparse.Namespace) -> int:
    measured, document, calibration, show = way(a)
    document["data_quality"] = measured.data_quality
    _write(a, measured, document)
    if a.json:
        emit(document)
    else:
        show()
        warn([*calibration.warnings, *measured.data_quality])
    return judge(a.limit, calibration.residual.rms_g)


def diagnose_command(a: argparse.Namespace) -> int:
    writable(a.output)
    writable(a.report)
    measured = measure(a.recording)
    check = measure(a.check).poses if a.check else None
    choice = chosen(a, measured)
    with telling_default_signs(a, measured):
        loop = diagnose(measured.poses, signs=choice.signs, reference=choice.reference, check=check)
    document = documents.loop_document(
        loop,
        data_quality=measured.data_quality,
        output_unit=choice.output_unit,
        reference_unit=choice.reference_unit,
        stated=choice.stated,
    )
    _write(a, measured, document)
    if a.json:
        emit(document)
    else:
        show_loop(loop, choice)
        show_calibration(loop.after, choice)
        warn([*loop.after.warnings, *measured.data_quality])
    return judge(a.limit, loop.after.residual.rms_g)


def _write(a: argparse.Namespace, measured: Measured, document: documents.Document) -> None:
    if measured.unit:
        document["unit"] = dict(measured.unit)  # so that it cannot be written to another
    if a.output:
        write_text(a.output, documents.to_text(document))
    if a.report:
        limits = {"limits": {"rms_g": a.limit}} if a.limit else None
        overview = overview_of(measured.windows, measured.poses, chosen(a, measured).output_unit)
        page = render_report(document, title=measured.name, stream=overview, certificate=limits)
        write_text(a.report, page)
