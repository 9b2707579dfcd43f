"""poses, fit, diagnose, verify."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from triaxcal.calibration import Calibration
from triaxcal.errors import Refused
from triaxcal.fit import fit
from triaxcal.loop import Loop, diagnose, magnitude_errors
from triaxcald import documents
from triaxcald.cli.arguments import add_recording, positive, writable
from triaxcald.cli.console import emit, micro, say, table
from triaxcald.documents import number
from triaxcald.errors import InputError
from triaxcald.files import write_text
from triaxcald.inputs import Measured, measure, read_document
from triaxcald.report.page import render_report
from triaxcald.report.stream import overview_of


def register(commands: Any) -> None:
    p = commands.add_parser("poses", help="find the still spans of a recording")
    add_recording(p)
    p.set_defaults(run=poses)
    p = commands.add_parser("fit", help="fit the linear model to a recording's still poses")
    add_recording(p)
    _add_results(p)
    p.set_defaults(run=fit_command)
    p = commands.add_parser("diagnose", help="find, add and judge effects that the linear model lacks")
    add_recording(p)
    _add_results(p)
    p.add_argument("--check", metavar="REC2", help="another recording, whose poses no fit sees")
    p.set_defaults(run=diagnose_command)
    p = commands.add_parser("verify", help="error of the magnitude in every pose under a calibration")
    p.add_argument("calibration", metavar="CAL.json")
    add_recording(p)
    p.add_argument("--limit", type=positive, metavar="G", help="exit 1 where the rms error is above this")
    p.set_defaults(run=verify_command)


def _add_results(p: argparse.ArgumentParser) -> None:
    p.add_argument("-o", "--output", type=Path, metavar="CAL.json")
    p.add_argument("--report", type=Path, metavar="R.html")
    p.add_argument("--limit", type=positive, metavar="G", help="exit 1 where the rms residual is above this")


def poses(a: argparse.Namespace) -> int:
    measured = measure(a.recording)
    document = documents.poses_document(measured.poses)
    document["data_quality"] = measured.data_quality
    if a.json:
        emit(document)
        return 0
    table(
        f"{len(measured.poses)} still poses in {measured.name}",
        ["start s", "end s", "samples", "mean x", "mean y", "mean z", "standard error"],
        [
            [
                f"{p.start_s:.2f}",
                f"{p.end_s:.2f}",
                p.samples,
                *(f"{v:.7g}" for v in p.mean),
                " ".join(f"{v:.2g}" for v in p.standard_error),
            ]
            for p in measured.poses
        ],
    )
    _warn(measured.data_quality)
    return 0


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
        _warn([*calibration.warnings, *measured.data_quality])
    return _judge(a.limit, calibration.residual.rms_g)


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
        _warn([*loop.after.warnings, *measured.data_quality])
    return _judge(a.limit, loop.after.residual.rms_g)


def verify_command(a: argparse.Namespace) -> int:
    document = read_document(a.calibration)
    sensor, channel_reference, reference = documents.sensor_of(document, where=a.calibration)
    if a.sign and any(k * s < 0 for k, s in zip(sensor.scale_factor, a.sign, strict=True)):
        raise InputError(f"--sign: the scale factors in {a.calibration} have other signs")
    if a.reference and not math.isclose(a.reference, reference, rel_tol=1e-9):
        raise InputError(f"--reference {a.reference:g}: {a.calibration} was made for {reference:g}")
    measured = measure(a.recording)
    if not measured.poses:
        raise Refused(f"{a.recording}: no still pose")
    with np.errstate(all="ignore"):  # numbers out of a file may be any; what comes of them is judged
        errors, noise = magnitude_errors(
            sensor, measured.poses, channel_reference=channel_reference, reference=reference
        )
        rms = float(np.sqrt(np.mean(errors**2)))
    if not np.isfinite([*errors, *noise, rms]).all():
        raise InputError(f"{a.calibration}: its numbers and the readings of {a.recording} give no finite magnitude")
    result = {
        "format": "triaxcal.verify/1",
        "rms_g": documents.error(rms),
        "max_abs_g": documents.error(float(np.max(np.abs(errors)))),
        "noise_floor_g": documents.error(float(np.sqrt(np.mean(noise**2)))),
        "poses": [
            {
                "start_s": number(p.start_s),
                "end_s": number(p.end_s),
                "error_g": documents.error(float(e)),
                "standard_error_g": documents.uncertainty(float(s)),
            }
            for p, e, s in zip(measured.poses, errors, noise, strict=True)
        ],
    }
    unit = a.reference_unit or documents.reference_unit_of(reference)
    small = documents.micro_unit(unit)
    if a.json:
        emit(result)
    else:
        table(
            f"|a| − {reference:g} {unit} under {a.calibration}",
            ["start s", f"error {small}", f"standard error {small}"],
            [
                [f"{p.start_s:.2f}", f"{e * 1e6:+.1f}", micro(s)]
                for p, e, s in zip(measured.poses, errors, noise, strict=True)
            ],
        )
        print(f"rms {micro(rms)} {small}, noise floor {micro(float(np.sqrt(np.mean(noise**2))))} {small}")
    return _judge(a.limit, rms)


@dataclass(frozen=True)
class Choice:
    """How a recording is to be read: the user's word, else the recording's own, else the default."""

    signs: tuple[int, int, int]
    reference: float
    output_unit: str
    reference_unit: str

    @property
    def micro_unit(self) -> str:
        return documents.micro_unit(self.reference_unit)


def chosen(a: argparse.Namespace, measured: Measured) -> Choice:
    reference = a.reference or measured.reference or 1.0
    return Choice(
        a.sign or measured.signs or (1, 1, 1),
        reference,
        a.output_unit or (measured.profile.output.unit if measured.profile else ""),
        a.reference_unit or documents.reference_unit_of(reference),
    )


@contextmanager
def _telling_default_signs(a: argparse.Namespace, measured: Measured) -> Iterator[None]:
    """A refusal names poses, and which way is up depends on signs that nobody may have given."""
    try:
        yield
    except Refused as e:
        if e.wanted and a.sign is None and measured.signs is None:
            raise Refused(f"{e}; no --sign was given, so +,+,+ is taken", wanted=e.wanted) from e
        raise


def _judge(limit: float | None, rms: float) -> int:
    if limit is not None and not rms <= limit:
        say(f"outside the limit: rms {rms:.3g}, limit {limit:.3g}")
        return 1
    return 0


def _warn(lines: list[str]) -> None:
    for line in lines:
        say(f"warning: {line}")


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


def show_calibration(c: Calibration, choice: Choice) -> None:
    rows = []
    unit = choice.reference_unit
    units = {"scale_factor": f"{choice.output_unit or 'output'}/{unit}", "misalignment": "rad", "bias": unit}
    of_effects = {
        f"{e.name}.{k.name}": documents.in_units_of(k.unit, unit) for e, _ in c.sensor.effects for k in e.coefficients
    }
    for name, value, error in zip(c.parameters, c.values, c.standard_errors, strict=True):
        rows.append([name, f"{value:.9g}", f"{error:.2g}", of_effects.get(name, units.get(name.split(".")[0], ""))])
    table("coefficients", ["", "value", "standard error", "unit"], rows)
    r, micro_unit = c.residual, choice.micro_unit
    p = "—" if r.lack_of_fit_p is None else f"{r.lack_of_fit_p:.2g}"
    print(
        f"{len(c.poses)} poses: residual rms {micro(r.rms_g)} {micro_unit}, cross-validated "
        f"{micro(r.cross_validated_rms_g)} {micro_unit}, noise floor {micro(r.noise_floor_g)} {micro_unit}, "
        f"lack of fit p {p}"
    )


def show_loop(loop: Loop, choice: Choice) -> None:
    b, f = loop.before.residual, loop.after.residual
    rows = [
        ["residual rms", micro(b.rms_g), micro(f.rms_g)],
        ["cross-validated rms", micro(b.cross_validated_rms_g), micro(f.cross_validated_rms_g)],
    ]
    if loop.held_out:
        rows.append(["held-out rms", micro(loop.held_out.before_rms_g), micro(loop.held_out.after_rms_g)])
    rows.append(["noise floor", micro(b.noise_floor_g), micro(f.noise_floor_g)])
    table(f"error of the magnitude, {choice.micro_unit}", ["", "before", "after"], rows)
    for finding in loop.findings:
        print(f"{finding.verdict}: {finding.effect} ({documents.in_words_of(finding.reason, choice.reference_unit)})")
    if not loop.findings:
        print("no effect of the catalogue shows")
    if loop.unexplained.significant:
        lead = documents.in_words_of(loop.unexplained.lead, choice.reference_unit)
        print(f"unexplained: {micro(loop.unexplained.rms_g)} {choice.micro_unit} rms; {lead}")
    for line in loop.advice:
        print(f"advice: {line}")
