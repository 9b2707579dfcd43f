"""Results as a person reads them at the console, and in which units."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import triaxcal as tc
from triaxcald.cli.console import at, say, table
from triaxcald.errors import InputError
from triaxcald.inputs import Measured, measure, require_same_outputs
from triaxcald.recording.reader import is_recording
from triaxcald.tables.samples import Reading


@dataclass(frozen=True)
class FitSettings:
    """Signs, reference and units of a fit: from the options, else from the recording,
    else the defaults."""

    signs: tuple[int, int, int]
    reference: float
    output_unit: str
    reference_unit: str
    stated: tc.Stated

    @property
    def small(self) -> tc.units.ErrorUnit:
        return tc.units.ErrorUnit.of(self.reference_unit, self.reference)


def read_recording(
    a: argparse.Namespace,
    name: str,
    moments: tc.inputs.Moments | None = None,
    of: tc.Calibration | None = None,
    turn_s: float | None = None,
    wanted_by: tc.Calibration | None = None,
) -> Measured:
    """The still poses of the recording ``name``, read as the arguments say; how
    a table was read is told. ``of`` is the calibration that is to be applied to
    them; ``turn_s`` as for `measure`. Raises InputError where that is of other
    units. ``wanted_by`` is a calibration that needs its channels, of whatever
    units."""
    at(f"reading {name}")
    found = measure(name, moments=moments, reading=reading_of(a, name, of or wanted_by), turn_s=turn_s)
    if of is not None:
        require_same_outputs(of, name, a.output_unit or found.output_unit)
    for remark in found.remarks:
        say(f"{found.name}: {remark}")
    if found.unconfirmed:
        say(f"{found.name}: {found.unconfirmed}")
    elif not found.poses and moments is None:
        turns = "the unit never rests; `triaxcal fit --turning` is for a unit that turns all the time"
        say(f"{found.name}: {found.too_short or turns}")
    return found


def reading_of(a: argparse.Namespace, name: str, of: tc.Calibration | None = None) -> Reading:
    """Settings for reading a table; ``of`` is the calibration that needs its channels.
    Raises InputError for settings with a recording."""
    said = Reading(a.columns or {}, a.time_unit, a.rate, a.skip_bad, dict(a.where or ()), a.pose_means)
    if is_recording(name) and said != Reading():
        raise InputError(f"{name}: --columns, --time-unit, --rate, --skip-bad, --where and --pose-means are for tables")
    return (
        said if of is None else replace(said, wanted=frozenset(map(tc.effects.channel_of, of.fitted.channel_reference)))
    )


def fit_settings(a: argparse.Namespace, measured: Measured) -> FitSettings:
    """The settings of a fit. Raises InputError if options about the reference
    contradict each other."""
    latitude, height = getattr(a, "latitude", None), getattr(a, "height", None)
    if (latitude is None) != (height is None):
        raise InputError("--latitude, --height: give both, or neither")
    if latitude is not None and a.reference:
        raise InputError("--reference: --latitude and --height say it already; give one or the other")
    if latitude is not None and a.reference_unit not in (None, "g"):
        raise InputError(f"--reference-unit {a.reference_unit}: --latitude and --height give the reference in g")
    local = None if latitude is None or height is None else tc.local_gravity_g(latitude, height)[0]
    reference = a.reference or local or measured.reference or 1.0
    return FitSettings(
        a.sign or measured.signs or (1, 1, 1),
        reference,
        a.output_unit or (measured.profile.output.unit if measured.profile else measured.output_unit),
        a.reference_unit or tc.units.reference_unit_of(reference),
        _stated(a, measured),
    )


def _stated(a: argparse.Namespace, measured: Measured) -> tc.Stated:
    """Statements by the options, else by the recording's station unless the reference
    differs."""
    latitude, height = getattr(a, "latitude", None), getattr(a, "height", None)
    own = measured.stated or tc.Stated()
    thermometer = getattr(a, "thermometer_uncertainty", None)
    sensitivity = getattr(a, "thermal_sensitivity", None)
    said = tc.Stated.at(
        latitude,
        height,
        getattr(a, "reference_uncertainty", None),
        thermometer_k=own.thermometer_k if thermometer is None else thermometer,
        thermal_sensitivity=own.thermal_sensitivity if sensitivity is None else sensitivity,
    )
    if said.reference is None and a.reference is None:
        return replace(said, reference=own.reference, reference_basis=own.reference_basis)
    return said


def counted(poses: int, left_out: int, what: str = "poses") -> str:
    """Number of poses, with the number of excluded ones."""
    what = what.removesuffix("s") if poses == 1 else what
    return f"{poses} {what}" + (f", {left_out} of them left out" if left_out else "")


def show_poses(title: str, columns: Sequence[str], rows: Sequence[Sequence[Any]], poses: Sequence[tc.Pose]) -> None:
    """A table with a row for each pose, and, where some are at fault, with a
    column that says which and why."""
    if any(p.fault for p in poses):
        columns = [*columns, "left out"]
        rows = [[*row, p.fault] for row, p in zip(rows, poses, strict=True)]
    table(title, columns, rows)


def judge(limit: float | None, rms: float, reference: float) -> int:
    """Compare the printed figure with the limit; the exit code."""
    printed = tc.rounding.error(rms, reference)
    if limit is not None and not (printed is not None and printed <= limit):
        say(f"outside the limit: rms {rms:.3g}, limit {limit:.3g}")
        return 1
    return 0


def warn(lines: Iterable[str]) -> None:
    for line in lines:
        say(f"warning: {line}")


@contextmanager
def telling_data_quality(measured: Measured) -> Iterator[None]:
    """Adds the data quality, a possible cause, to a refusal. Drops the wanted poses if
    most of the recording is unused."""
    try:
        yield
    except tc.Refused as e:
        warn(measured.data_quality)
        if measured.unconfirmed and e.wanted:
            raise tc.Refused(str(e)) from e
        raise
