"""fit, diagnose."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from triaxcal.errors import Refused
from triaxcal.fit import fit
from triaxcal.loop import diagnose
from triaxcald import documents
from triaxcald.cli.arguments import add_recording, positive, writable
from triaxcald.cli.console import emit
from triaxcald.cli.showing import chosen, judge, show_calibration, show_loop, warn
from triaxcald.files import write_text
from triaxcald.inputs import Measured, measure
from triaxcald.report.page import render_report
from triaxcald.report.stream import overview_of


def register(commands: Any) -> None:
    p = commands.add_parser("fit", help="fit the linear model to a recording's still poses")
    add_recording(p)
    _add_results(p)
    p.set_defaults(run=fit_command)
    p = commands.add_parser("diagnose", help="find, add and judge effects that the linear model lacks")
    add_recording(p)
    _add_results(p)
    p.add_argument("--check", metavar="REC2", help="another recording, whose poses no fit sees")
    p.set_defaults(run=diagnose_command)


def _add_results(p: argparse.ArgumentParser) -> None:
    p.add_argument("-o", "--output", type=Path, metavar="CAL.json")
    p.add_argument("--report", type=Path, metavar="R.html")
    p.add_argument("--limit", type=positive, metavar="G", help="exit 1 where the rms residual is above this")


def fit_command(a: argparse.Namespace) -> int:
    writable(a.output)
    writable(a.report)
    measured = measure(a.recording)
    choice = chosen(a, measured)
    with _telling_default_signs(a, measured):
        calibration = fit(measured.poses, signs=choice.signs, reference=choice.reference)
    document = documents.calibration_document(
        calibration, output_unit=choice.output_unit, reference_unit=choice.reference_unit
    )
    document["data_quality"] = measured.data_quality
    _write(a, measured, document)
    if a.json:
        emit(document)
    else:
        show_calibration(calibration, choice)
        warn([*calibration.warnings, *measured.data_quality])
    return judge(a.limit, calibration.residual.rms_g)


def diagnose_command(a: argparse.Namespace) -> int:
    writable(a.output)
    writable(a.report)
    measured = measure(a.recording)
    check = measure(a.check).poses if a.check else None
    choice = chosen(a, measured)
    with _telling_default_signs(a, measured):
        loop = diagnose(measured.poses, signs=choice.signs, reference=choice.reference, check=check)
    document = documents.loop_document(
        loop,
        data_quality=measured.data_quality,
        output_unit=choice.output_unit,
        reference_unit=choice.reference_unit,
    )
    _write(a, measured, document)
    if a.json:
        emit(document)
    else:
        show_loop(loop, choice)
        show_calibration(loop.after, choice)
        warn([*loop.after.warnings, *measured.data_quality])
    return judge(a.limit, loop.after.residual.rms_g)


@contextmanager
def _telling_default_signs(a: argparse.Namespace, measured: Measured) -> Iterator[None]:
    """A refusal names poses, and which way is up depends on signs that nobody may have given."""
    try:
        yield
    except Refused as e:
        if e.wanted and a.sign is None and measured.signs is None:
            raise Refused(f"{e}; no --sign was given, so +,+,+ is taken", wanted=e.wanted) from e
        raise


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
