"""provision, restore."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald import text
from triaxcald.caveats import is_passing
from triaxcald.certificate import held_by_device, image_of, of_correction, rounding_of, why_not_written
from triaxcald.cli.console import emit, say, show, showing, table
from triaxcald.cli.interrupt import run_interruptible
from triaxcald.errors import InputError
from triaxcald.inputs import read_document
from triaxcald.provision.correction import IN_DOCUMENT, from_document
from triaxcald.provision.identity import same_serial
from triaxcald.provision.procedure import Provisioning
from triaxcald.provision.registers import RegisterImage
from triaxcald.run.attempts import settle_killed
from triaxcald.run.provision_by_hand import Provisioned, ProvisionRun, RestoreRun, snapshot_in, unit_in
from triaxcald.schema.codes import Stage
from triaxcald.station.config import Place, Station, days_since_1970, load_station


def provision_command(a: argparse.Namespace) -> int:
    if a.resume == (a.calibration is not None):
        raise InputError("provision: give CAL.json, or --resume without one")
    station = load_station(a.station)
    _settle_killed(station)
    place = station.place(a.unit)
    wanted = None if a.resume else wanted_by(a.calibration, place)
    ask = _ask if a.power_cycle or station.file.provisioning.power_cycle else None
    run = ProvisionRun(station, place, dry_run=a.dry_run, force=a.force, ask=ask)
    if wanted is not None:
        run = ProvisionRun(
            station, place, wanted.image, wanted.serial,
            dry_run=a.dry_run, force=a.force, ask=ask, at_start=wanted.at_start,
        )  # fmt: skip
    done = run_interruptible(run.run())
    if done.error is not None:
        say(f"triaxcal: {done.error}")
    with showing(done.exit_code, _told(done, station.path)):
        if a.json:
            emit(_document(done, place, wanted, dry_run=a.dry_run))
        elif done.error is None:
            _show(done, place, station.path, dry_run=a.dry_run)
            if wanted is not None and wanted.correction is not None:
                for line in text.of_correction(wanted.correction, wanted.rounding_rms_g):
                    show(line)
    return done.exit_code


def _settle_killed(station: Station) -> None:
    """Write the outcomes of runs that were killed in the station's folder."""
    for killed in settle_killed(station):
        say(killed.line)


def _told(done: Provisioned, station: Path) -> str:
    """Result and recovery command; empty if the error has them already."""
    p = done.provisioning
    if p is None or done.error is not None:
        return ""
    return "; ".join(filter(None, [done.document["reason"], text.recovery_command(p, station)]))


def _ask(stage: Stage, what: str) -> None:
    say(what)


def _document(done: Provisioned, place: Place, wanted: Wanted | None, *, dry_run: bool) -> dict[str, Any]:
    p = done.provisioning
    of_correction = {}
    if wanted is not None and wanted.correction is not None:
        of_correction = {"correction": {**wanted.correction, "rounding_rms_g": wanted.rounding_rms_g}}
    return {
        "format": "triaxcal.provisioning/1",
        "unit": place.unit.name,
        "serial": p.identity.serial if p else None,
        "dry_run": dry_run,
        "written": list(p.written) if p else [],
        "differing": list(p.differing) if p else [],
        "stored": bool(p and p.stored),
        "error": done.error,
        "words": _words(p) if p else [],
        **of_correction,
        "outcome": done.document,
        "outcome_file": str(done.path) if done.path else None,
    }


def _words(p: Provisioning) -> list[dict[str, Any]]:
    words = {w.register: w for w in p.image.words}
    return [
        {
            "register": name,
            "before": raw.hex(),
            "wanted": words[name].raw.hex() if name in words else None,
            "after": p.after.raw[name].hex(),
            "value": tc.rounding.number(words[name].value, tc.rounding.REGISTER_DIGITS) if name in words else None,
            "held": tc.rounding.number(words[name].held, tc.rounding.REGISTER_DIGITS) if name in words else None,
        }
        for name, raw in p.found.raw.items()
    ]


def _show(done: Provisioned, place: Place, station: Path, *, dry_run: bool) -> None:
    p = done.provisioning
    assert p is not None
    columns = ["register", "before", "wanted", "after", "value"]
    if dry_run:
        columns.remove("after")
    rows = [[word[column] for column in columns] for word in _words(p)]
    table(f"unit {place.unit.name}, serial {p.identity.serial}", columns, rows)
    for warning in p.warnings:
        say(f"warning: {text.sanity_warning(warning)}")
    show(done.document["reason"])
    if recovery_command := text.recovery_command(p, station):
        show(recovery_command)
    if done.path is not None:
        show(f"outcome {done.path}")


@dataclass(frozen=True)
class Wanted:
    """What a calibration file asks for: ``image`` in the unit ``serial``, which still
    holds ``at_start``, by which it corrected the readings. ``correction`` are the
    figures of a certificate for a device with a form of correction."""

    image: RegisterImage
    serial: str | None
    at_start: Mapping[str, bytes] | None = None
    correction: Mapping[str, Any] | None = None
    rounding_rms_g: float | None = None


def wanted_by(path: str, place: Place) -> Wanted:
    """The registers that a calibration file asks for, and the serial number of
    the unit that it is meant for.

    The serial is the station's where the file names none. Raises Refused where
    file, station and device do not go together: another unit, another unit of
    the reference vector, other signs, effects that the device cannot hold.
    """
    document = read_document(path)
    full = tc.interchange.calibration_of(document, where=path)
    profile = place.bundle.profile
    if not 0.9 <= full.reference <= 1.1:
        raise tc.Refused(f"{path}: the reference is {full.reference:g}; registers are in units of g")
    serial = _serial_of(document, path, place)
    if missing := why_not_written(profile):
        raise tc.Refused(f"{path}: {profile.name}: {missing}")
    logged = tc.interchange.logged_in(document, where=path)
    at_start = from_document(document, path)
    if profile.reads_corrected and at_start is None:
        raise tc.Refused(
            f"{path}: {profile.name} corrects its readings by its registers, and the file has no {IN_DOCUMENT}: fit a "
            "recording of triaxcal, or let triaxcal run calibrate and write the unit"
        )
    held = held_by_device(profile, full, logged, at_start)
    assert held is not None
    registers = held.registers.calibration
    _require_little_lost(document, full, held.registers, path, profile, logged)
    for axis, k, sign in zip("xyz", registers.sensor.scale_factor, place.signs, strict=True):
        if k * sign < 0:
            raise tc.Refused(
                f"{path}: scale_factor.{axis} is {k:.4g}, of another sign than the device's: fit with --sign"
            )
    image = image_of(profile, held, days_since_1970())
    if held.correction is None:
        return Wanted(image, serial)
    figures, rounding = of_correction(image, held.correction), rounding_of(image, held.correction)
    return Wanted(image, serial, at_start, figures.document(), tc.rounding.error(rounding))


def _require_little_lost(
    document: Mapping[str, Any],
    full: tc.estimate.Calibration,
    registers: tc.estimate.Reduced,
    path: str,
    profile: td.Profile,
    logged: Mapping[str, tc.Floats],
) -> None:
    """Raises Refused where the registers would be off by more than the
    calibration itself may be, or where nobody knows by how much: ``logged`` are
    the channels that are known as they were in the poses."""
    lost = [effect.name for effect, _ in full.sensor.effects if effect.name not in registers.calibration.terms]
    known = tc.interchange.expanded_uncertainty_in(document, where=path)
    passing = {effect.name for effect, _ in full.sensor.effects if is_passing(effect)}
    if not set(lost) <= passing and not registers.cost <= (known or 0.0):
        stated = "" if known is None else f", and its expanded uncertainty is {tc.number_format.micro_g(known)}"
        raise tc.Refused(
            f"{path}: {profile.name} has no registers for {', '.join(lost)}; the best that it can hold is off by "
            f"{tc.number_format.micro_g(registers.cost)} rms{stated}"
        )
    for effect, _ in full.sensor.effects:
        unknown = [name for name in effect.needs if name not in logged and not tc.effects.is_derived(name)]
        if effect.name in lost and unknown:
            raise tc.Refused(
                f"{path}: {profile.name} has no registers for {effect.name}, and the poses do not say how "
                f"{', '.join(unknown)} moved: what that costs is not known"
            )
    if passing & set(lost):
        say(f"{', '.join(name for name in lost if name in passing)}: left to the host, and in no register")
    if others := [name for name in lost if name not in passing]:
        say(
            f"{profile.name} has no registers for {', '.join(others)}: the other coefficients take their place, "
            f"{tc.number_format.micro_g(registers.cost)} rms off"
        )


def _serial_of(document: Mapping[str, Any], path: str, place: Place) -> str | None:
    unit = document.get("unit")
    meant = unit.get("serial") if isinstance(unit, Mapping) else None
    expected = place.unit.serial
    if not isinstance(meant, str | None):
        raise InputError(f"{path}: unit.serial: expected text, not {meant!r}")
    if meant is not None and expected is not None and not same_serial(meant, expected):
        raise tc.Refused(f"{path}: is for the unit with serial {meant}, the station expects {expected}")
    return meant or expected


def restore_command(a: argparse.Namespace) -> int:
    station = load_station(a.station)
    _settle_killed(station)
    names = [place.unit.name for place in station.places]
    theirs = unit_in(a.source)
    place = station.place(a.unit or (theirs if theirs in names else None))
    snapshot, _ = snapshot_in(a.source, place.bundle.profile)
    expected = place.unit.serial
    if snapshot.serial is not None and expected is not None and not same_serial(snapshot.serial, expected):
        raise tc.Refused(f"{a.source}: is of the unit with serial {snapshot.serial}, the station expects {expected}")
    ask = _ask if a.power_cycle or station.file.provisioning.power_cycle else None
    run = RestoreRun(station, place, ask=ask, snapshot=snapshot, source=a.source)
    done = run_interruptible(run.run())
    p = done.provisioning
    if done.error is not None:
        say(f"triaxcal: {done.error}")
    with showing(done.exit_code, _told(done, station.path)):
        if a.json:
            emit(
                {
                    "format": "triaxcal.restoration/1",
                    "unit": place.unit.name,
                    "serial": p.identity.serial if p else None,
                    "device_state": done.document["device_state"],
                    "evidence": done.document["evidence"],
                    "registers": {name: raw.hex() for name, raw in snapshot.raw.items()},
                    "error": done.error,
                    "outcome": done.document,
                    "outcome_file": str(done.path) if done.path else None,
                }
            )
        elif p is not None and done.error is None:
            show(f"unit {place.unit.name}, serial {p.identity.serial}: {_told(done, station.path)}")
            show(f"outcome {done.path}")
    return done.exit_code
