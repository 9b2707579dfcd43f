"""rezero."""

from __future__ import annotations

import argparse
from dataclasses import replace

import triaxcal as tc
from triaxcald.cli.console import emit, show
from triaxcald.cli.fitting import title_of, write_results
from triaxcald.cli.results import show_budget, show_coefficients
from triaxcald.cli.showing import Choice, chosen, judge, read_recording, telling_data_quality, warn
from triaxcald.cli.syntax import writable
from triaxcald.documents import rezero_document
from triaxcald.earlier import EarlierFile


def rezero_command(a: argparse.Namespace) -> int:
    writable(a.output)
    writable(a.report)
    file = EarlierFile.read(a.calibration)
    earlier = file.calibration
    measured = read_recording(a, a.recording, wanted_by=earlier)
    said = chosen(a, measured)
    file.require_of(
        measured.name,
        serial=(measured.unit or {}).get("serial"),
        signs=a.sign or measured.signs,
        reference=a.reference or measured.reference,
        reference_unit=a.reference_unit,
        output_unit=said.output_unit,
    )
    choice = replace(
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
        output_unit=choice.output_unit,
        reference_unit=choice.reference_unit,
        stated=choice.stated,
    )
    document = loop["calibration"] | {"data_quality": measured.data_quality}
    if file.serial:
        document["unit"] = dict(file.document["unit"])
    write_results(a, measured, document, loop)
    if a.json:
        emit(document)
    else:
        _show(found, choice)
        warn([*map(tc.text.caution, found.cautions), *measured.data_quality])
    if a.poses is not None and len(found.poses) < a.poses:
        warn([f"--poses {a.poses}: {measured.name} has {len(found.poses)} distinct poses"])
    return judge(a.limit, found.residual.rms_g, found.reference)


def _show(found: tc.estimate.Calibration, choice: Choice) -> None:
    b = tc.uncertainty.budget(found, choice.stated)
    show_coefficients(found, choice, b.parameters)
    assert found.update is not None
    for line in tc.text.bias_update.lines(found, found.update, choice.small):
        show(line)
    show_budget(b, choice)
