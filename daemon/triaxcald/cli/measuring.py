"""poses, verify."""

from __future__ import annotations

import argparse
import math
from typing import Any

import numpy as np

from triaxcal.errors import Refused
from triaxcal.loop import magnitude_errors
from triaxcald import documents
from triaxcald.cli.arguments import add_recording, positive
from triaxcald.cli.console import emit, table
from triaxcald.cli.showing import judge, warn
from triaxcald.documents import number
from triaxcald.errors import InputError
from triaxcald.held_sensor import reference_unit_in, sensor_of
from triaxcald.inputs import measure, read_document
from triaxcald.units import ErrorUnit


def register(commands: Any) -> None:
    p = commands.add_parser("poses", help="find the still spans of a recording")
    add_recording(p)
    p.set_defaults(run=poses)
    p = commands.add_parser("verify", help="error of the magnitude in every pose under a calibration")
    p.add_argument("calibration", metavar="CAL.json")
    add_recording(p)
    p.add_argument("--limit", type=positive, metavar="G", help="exit 1 where the rms error is above this")
    p.set_defaults(run=verify_command)


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
    warn(measured.data_quality)
    return 0


def verify_command(a: argparse.Namespace) -> int:
    document = read_document(a.calibration)
    sensor, channel_reference, reference = sensor_of(document, where=a.calibration)
    if a.sign and any(k * s < 0 for k, s in zip(sensor.scale_factor, a.sign, strict=True)):
        raise InputError(f"--sign: the scale factors in {a.calibration} have other signs")
    if a.reference and not math.isclose(a.reference, reference, rel_tol=1e-9):
        raise InputError(f"--reference {a.reference:g}: {a.calibration} was made for {reference:g}")
    measured = measure(a.recording)
    if not measured.poses:
        warn(measured.data_quality)
        raise Refused(f"{a.recording}: no still pose")
    with np.errstate(all="ignore"):  # numbers out of a file may be any; what comes of them is judged
        errors, noise = magnitude_errors(
            sensor, measured.poses, channel_reference=channel_reference, reference=reference
        )
        rms, floor = float(np.sqrt(np.mean(errors**2))), float(np.sqrt(np.mean(noise**2)))
    if not np.isfinite([*errors, *noise, rms]).all():
        raise InputError(f"{a.calibration}: its numbers and the readings of {a.recording} give no finite magnitude")
    result = {
        "format": "triaxcal.verify/1",
        "rms_g": documents.error(rms, reference),
        "max_abs_g": documents.error(float(np.max(np.abs(errors))), reference),
        "noise_floor_g": documents.error(floor, reference),
        "poses": [
            {
                "start_s": number(p.start_s),
                "end_s": number(p.end_s),
                "error_g": documents.error(float(e), reference),
                "standard_error_g": documents.uncertainty(float(s)),
            }
            for p, e, s in zip(measured.poses, errors, noise, strict=True)
        ],
    }
    unit = a.reference_unit or reference_unit_in(document, where=a.calibration, magnitude=reference)
    small = ErrorUnit.of(unit, reference)
    if a.json:
        emit(result)
    else:
        table(
            f"|a| − {reference:g} {unit} under {a.calibration}",
            ["start s", f"error {small}", f"standard error {small}"],
            [
                [f"{p.start_s:.2f}", f"{small.count(e):+.1f}", small.told(s)]
                for p, e, s in zip(measured.poses, errors, noise, strict=True)
            ],
        )
        print(f"rms {small.in_full(rms)}, noise floor {small.in_full(floor)}")
    return judge(a.limit, rms)
