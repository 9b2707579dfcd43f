"""poses, verify."""

from __future__ import annotations

import argparse
import gzip
import io
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import triaxcal as tc
from triaxcald.applied import Applied, applied
from triaxcald.cli.console import emit, say, show
from triaxcald.cli.showing import counted, judge, read_recording, reading_of, show_poses, telling_data_quality, warn
from triaxcald.cli.syntax import writable
from triaxcald.errors import InputError
from triaxcald.files import new_beside
from triaxcald.inputs import CALIBRATION, Measured, read_document
from triaxcald.tables.arrow import write_parquet
from triaxcald.tables.native_csv import write_csv
from triaxcald.verification import Verification, errors_under, pose_rows, trust, unlike


def found_poses(a: argparse.Namespace) -> tuple[Measured, tc.interchange.Document]:
    """The still poses of a recording, and its `triaxcal.poses/1`."""
    measured = read_recording(a, a.recording)
    document = tc.interchange.poses_document(measured.poses)
    for row, p in zip(document["poses"], measured.poses, strict=True):
        row |= trust(p)
    document["data_quality"] = measured.data_quality
    return measured, document


def poses(a: argparse.Namespace) -> int:
    measured, document = found_poses(a)
    if a.json:
        emit(document)
        return 0
    left_out = sum(bool(p.fault) for p in measured.poses)
    show_poses(
        f"{counted(len(measured.poses), left_out, 'still poses')} in {measured.name}",
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
        measured.poses,
    )
    warn(measured.data_quality)
    return 0


@dataclass(frozen=True)
class Verified:
    """``result`` is the `triaxcal.verify/1`, ``expected_g`` the rms error to expect."""

    measured: Measured
    found: Verification
    calibration: tc.Calibration
    expected_g: float
    result: dict[str, Any]


def verified_by(a: argparse.Namespace, document: Mapping[str, Any]) -> Verified:
    """The poses of a recording under the calibration in a ``document``, whose name is
    ``a.calibration``. Raises InputError, Refused."""
    calibration = tc.Calibration.from_dict(document, where=a.calibration)
    model = calibration.fitted
    sensor, reference = model.sensor, model.reference
    if a.sign and any(k * s < 0 for k, s in zip(sensor.scale_factor, a.sign, strict=True)):
        raise InputError(f"--sign: the scale factors in {a.calibration} have other signs")
    if a.reference and not math.isclose(a.reference, reference, rel_tol=1e-9):
        raise InputError(f"--reference {a.reference:g}: {a.calibration} was made for {reference:g}")
    measured = read_recording(a, a.recording, of=calibration)
    with telling_data_quality(measured):
        _require_trusted(measured)
    found = _verified(measured, model, where=a.calibration)
    assert found.rms_g is not None
    assert found.noise_floor_g is not None
    trusted = [p for p in measured.poses if not p.fault]
    of_calibration = calibration.uncertainty_in(trusted)
    expected = float(np.sqrt(found.noise_floor_g**2 + np.mean(of_calibration**2)))
    warnings = unlike(measured.name, found.rms_g, reference)
    if not warnings:
        held = tc.estimate.shape_in(tc.interchange.calibration_part(document, where=a.calibration))
        warnings = tc.text.pooled_units.other_unit(
            a.calibration, measured.name, held, tc.estimate.shape_without_effects(model, measured.poses)
        )
    warnings += _of_its_recording(model, a.calibration)
    result = {
        "format": "triaxcal.verify/1",
        "rms_g": tc.rounding.error(found.rms_g, reference),
        "max_abs_g": tc.rounding.error(found.max_abs_g, reference),
        "noise_floor_g": tc.rounding.error(found.noise_floor_g, reference),
        "expected_rms_g": tc.rounding.error(expected, reference) if np.isfinite(expected) else None,
        "poses": pose_rows(found, reference),
        "data_quality": measured.data_quality,
        "warnings": warnings,
    }
    return Verified(measured, found, calibration, expected, result)


def verify_command(a: argparse.Namespace) -> int:
    document = read_document(a.calibration)
    of = verified_by(a, document)
    found, reference = of.found, of.calibration.fitted.reference
    assert found.rms_g is not None
    assert found.noise_floor_g is not None
    unit = a.reference_unit or tc.interchange.reference_unit_in(document, where=a.calibration, magnitude=reference)
    if a.json:
        emit(of.result)
    else:
        _show_verified(
            found, f"|a| − {reference:g} {unit} under {a.calibration}", tc.units.ErrorUnit.of(unit, reference)
        )
        poses = counted(len(found.poses), len(found.untrusted))
        show(tc.text.verification(poses, found.rms_g, found.noise_floor_g, of.expected_g, (unit, reference)))
        warn([*of.result["warnings"], *of.measured.data_quality])
    return judge(a.limit, found.rms_g, reference)


def _of_its_recording(model: tc.estimate.Calibration, name: str) -> list[str]:
    """A line each for effects of time, and of the recording, which say little
    of another recording."""
    out = _of_its_times(model, name)
    of_run = [e.name for e, _ in model.sensor.effects if tc.effects.RUN in e.needs and not _is_of_time(e)]
    if of_run:
        out.append(f"{', '.join(of_run)} in {name} belongs to its own recordings, and counts as in their mean")
    return out


def _of_its_times(model: tc.estimate.Calibration, name: str) -> list[str]:
    """A line for effects of time: the moment at which the calibration holds."""
    of_time = [e.name for e, _ in model.sensor.effects if _is_of_time(e)]
    if not of_time:
        return []
    held = model.holds_at
    moment = f"as {held.t_s:.0f} s after its start" if held else "as long after its start"
    return [f"{', '.join(of_time)} in {name} goes with the time of its own recording, and counts {moment}"]


def _is_of_time(effect: tc.effects.Effect) -> bool:
    return bool({tc.effects.TIME, tc.effects.SINCE_START} & set(effect.needs))


def _require_trusted(measured: Measured) -> None:
    if not measured.poses:
        raise tc.Refused(f"{measured.name}: no still pose")
    if all(p.fault for p in measured.poses):
        faults = ", ".join(dict.fromkeys(p.fault for p in measured.poses))
        raise tc.Refused(f"{measured.name}: no still pose can be trusted: {len(measured.poses)} left out ({faults})")


def _verified(measured: Measured, model: tc.estimate.Calibration, *, where: str) -> Verification:
    """Under a calibration of another recording. Raises InputError where what
    ``where`` holds gives no finite errors."""
    found = replace(errors_under(measured.poses, model, model.reference), data_quality=tuple(measured.data_quality))
    if not found.is_finite:
        raise InputError(f"{where}: its numbers and the readings of {measured.name} give no finite magnitude")
    return found


def _show_verified(found: Verification, title: str, small: tc.units.ErrorUnit) -> None:
    show_poses(
        title,
        ["start s", f"error {small}", f"standard error {small}"],
        [
            [f"{p.start_s:.2f}", f"{small.count(e):+.1f}", small.written(s)]
            for p, e, s in zip(found.poses, found.error_g, found.standard_error_g, strict=True)
        ],
        found.poses,
    )


# apply.

FRAME = "in the sensor's own frame (triaxcal frame turns it into a housing's)"
KINDS = (".csv", ".csv.gz", ".parquet")


def apply_command(a: argparse.Namespace) -> int:
    if not a.output.name.endswith(KINDS):
        raise InputError(f"{a.output}: expected a name that ends in {', '.join(KINDS)}")
    writable(a.output)
    require_own_times(a)
    calibration = tc.Calibration.from_dict(read_document(a.calibration), where=a.calibration)
    found = applied_as(a, calibration)
    for remark in found.remarks:
        say(f"{a.recording}: {remark}")
    with new_beside(a.output) as path:
        samples = written(found, path, a.output.name)
    if not a.own_recording:
        own = f"if {a.recording} is that recording, --own-recording takes the time of each reading"
        found.cautions += [f"{line}; {own}" for line in _of_its_times(calibration.fitted, a.calibration)]
    warn(found.cautions)
    how = f"{', '.join(calibration.terms)}, in {calibration.reference_unit}, {FRAME}"
    say(f"{a.output}: {tc.number_format.number_of(samples, 'sample')}, {how}")
    return 0


def require_own_times(a: argparse.Namespace) -> None:
    """Raises InputError."""
    if a.own_recording and a.phase != CALIBRATION:
        raise InputError(f"--own-recording: the {a.phase} phase has no times of the recording that was fitted")


def applied_as(a: argparse.Namespace, calibration: tc.Calibration) -> Applied:
    """The recording under the calibration, as the options say."""
    return applied(
        calibration,
        a.recording,
        uncertainty=a.uncertainty,
        own_recording=a.own_recording,
        phase=a.phase,
        reading=reading_of(a, a.recording, calibration),
        output_unit=a.output_unit or "",
    )


def written(found: Applied, path: Path, name: str) -> int:
    if name.endswith(".parquet"):
        return write_parquet(path, found.blocks, found.start_ns)
    with path.open("wb") as file:
        packed = gzip.GzipFile(filename="", fileobj=file, mode="wb", mtime=0) if name.endswith(".gz") else file
        with io.TextIOWrapper(packed, "utf-8", newline="\n") as out:
            return write_csv(out, found.blocks, found.start_ns)
