"""provision, registers, devices."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from triaxcal.effects import CATALOGUE
from triaxcal.effects.plugins import package_of, plugins
from triaxcal.errors import Refused
from triaxcal_drivers.catalogue import listed
from triaxcal_drivers.errors import DriverError, DriverMissing, ProfileError
from triaxcal_drivers.profile import BUILT_IN, load_bundle
from triaxcald.certificate import REFERENCE_TEMPERATURE, roles
from triaxcald.choices import is_passing
from triaxcald.cli.arguments import add_json
from triaxcald.cli.console import emit, say, table
from triaxcald.cli.interrupt import run_interruptible
from triaxcald.documents import number
from triaxcald.errors import InputError
from triaxcald.held_sensor import sensor_of
from triaxcald.inputs import read_document
from triaxcald.provision.explain import explain
from triaxcald.provision.identity import check_identity, same_serial
from triaxcald.provision.image import RegisterImage, build_image
from triaxcald.provision.procedure import ProvisionReport, provision
from triaxcald.provision.snapshot import take_snapshot
from triaxcald.station.config import Place, load_station
from triaxcald.station.today import days_since_1970

REGISTER_DIGITS = 12
"""So many tell any two float32 apart, and any two integers of a register."""


def register(commands: Any) -> None:
    p = commands.add_parser("provision", help="write a calibration to the device's registers and verify it")
    p.add_argument("calibration", metavar="CAL.json")
    p.add_argument("station", metavar="STATION.toml", type=Path)
    p.add_argument("--unit", help="where the station has more than one")
    p.add_argument("--dry-run", action="store_true", help="read and compare, write nothing")
    add_json(p)
    p.set_defaults(run=provision_command)
    p = commands.add_parser("registers", help="read and explain the device's calibration registers")
    p.add_argument("station", metavar="STATION.toml", type=Path)
    p.add_argument("--unit", help="where the station has more than one")
    add_json(p)
    p.set_defaults(run=registers_command)
    p = commands.add_parser("devices", help="drivers, profiles and effects found, broken ones with their reason")
    add_json(p)
    p.set_defaults(run=devices_command)


def provision_command(a: argparse.Namespace) -> int:
    place = load_station(a.station).place(a.unit)
    image, serial = image_from(a.calibration, place)
    report = run_interruptible(_provision(place, image, a.dry_run, serial))
    words = {w.register: w for w in image.words}
    document = {
        "format": "triaxcal.provisioning/1",
        "unit": place.unit.name,
        "serial": report.identity.serial,
        "dry_run": a.dry_run,
        "written": list(report.written),
        "differing": list(report.differing),
        "stored": report.stored,
        "words": [
            {
                "register": name,
                "before": raw.hex(),
                "wanted": words[name].raw.hex() if name in words else None,
                "after": report.after.raw[name].hex(),
                "value": number(words[name].value, REGISTER_DIGITS) if name in words else None,
                "held": number(words[name].held, REGISTER_DIGITS) if name in words else None,
            }
            for name, raw in report.before.raw.items()
        ],
    }
    if a.json:
        emit(document)
        return 0
    table(
        f"unit {place.unit.name}, serial {report.identity.serial}",
        ["register", "before", "wanted", "after", "value"],
        [[w["register"], w["before"], w["wanted"], w["after"], w["value"]] for w in document["words"]],
    )
    if a.dry_run:
        print(f"dry run: {len(report.differing)} registers would be written, nothing was")
    else:
        print(described(report))
    return 0


def described(report: ProvisionReport) -> str:
    """What was done, in words."""
    if not report.written:
        return "the device held these registers already; nothing was written"
    return f"{len(report.written)} registers written, stored, read back after a restart and equal"


def image_from(path: str, place: Place) -> tuple[RegisterImage, str | None]:
    """The registers that a calibration file asks for, and the serial number of the unit that it is meant for.

    The serial is the station's where the file names none. Raises Refused where file, station and device do not go
    together: another unit, another unit of the reference vector, other signs, effects that the device cannot hold.
    """
    document = read_document(path)
    sensor, channel_reference, reference = sensor_of(document, where=path)
    profile = place.bundle.profile
    if not 0.9 <= reference <= 1.1:
        raise Refused(f"{path}: the reference is {reference:g}; registers are in units of g")
    serial = _serial_of(document, path, place)
    wanted = roles(sensor, channel_reference)
    passing = {f"{e.name}.{c.name}" for e, _ in sensor.effects if is_passing(e) for c in e.coefficients}
    homeless = [r for r in wanted if r not in passing and profile.by_role(r) is None and r != REFERENCE_TEMPERATURE]
    if homeless:
        raise Refused(
            f"{path}: {profile.name} has no register for {', '.join(homeless)}; without them the other coefficients "
            "would be wrong"
        )
    for axis, k, sign in zip("xyz", sensor.scale_factor, place.signs, strict=True):
        if k * sign < 0:
            raise Refused(f"{path}: scale_factor.{axis} is {k:.4g}, of another sign than the device's: fit with --sign")
    held = {r: v for r, v in wanted.items() if profile.by_role(r)}
    return build_image(profile, held, date_days=days_since_1970()), serial


def _serial_of(document: Mapping[str, Any], path: str, place: Place) -> str | None:
    unit = document.get("unit")
    meant = unit.get("serial") if isinstance(unit, Mapping) else None
    expected = place.unit.serial
    if not isinstance(meant, str | None):
        raise InputError(f"{path}: unit.serial: expected text, not {meant!r}")
    if meant is not None and expected is not None and not same_serial(meant, expected):
        raise Refused(f"{path}: is for the unit with serial {meant}, the station expects {expected}")
    return meant or expected


async def _provision(place: Place, image: RegisterImage, dry_run: bool, serial: str | None) -> ProvisionReport:
    async with place.opened() as device:
        return await provision(
            device, place.bundle, image, expected_serial=serial, dry_run=dry_run, where=place.address
        )


def registers_command(a: argparse.Namespace) -> int:
    place = load_station(a.station).place(a.unit)
    serial, rows = run_interruptible(_registers(place))
    if a.json:
        emit(
            {
                "format": "triaxcal.registers/1",
                "unit": place.unit.name,
                "serial": serial,
                "registers": [{**dataclasses.asdict(r), "value": number(r.value, REGISTER_DIGITS)} for r in rows],
            }
        )
        return 0
    table(
        f"unit {place.unit.name}, serial {serial}",
        ["register", "raw", "value", "unit", "role", "remarks"],
        [[r.register, r.raw_hex, f"{r.value:.9g}", r.unit, r.role, _remark(r)] for r in rows],
    )
    return 0


def _remark(row: Any) -> str:
    remarks = [] if row.within_limits else ["outside its limits"]
    if row.crc_ok is not None:
        remarks.append("checksum right" if row.crc_ok else "checksum WRONG")
    return ", ".join(remarks)


async def _registers(place: Place) -> tuple[str | None, list[Any]]:
    async with place.opened() as device:
        identity = await check_identity(device, place.bundle, place.unit.serial, where=place.address)
        return identity.serial, explain(place.bundle, await take_snapshot(device, place.bundle))


def devices_command(a: argparse.Namespace) -> int:
    drivers = [dataclasses.asdict(d) for d in listed()]
    profiles = [_profile(path) for path in sorted(BUILT_IN.glob("*.toml"))]
    effects = _effects()
    if a.json:
        emit({"format": "triaxcal.devices/1", "drivers": drivers, "profiles": profiles, "effects": effects})
        return 0
    rows = [[d["name"], d["distribution"], d["target"], d["fault"] or "usable"] for d in drivers]
    table("drivers", ["name", "package", "class", "state"], rows)
    table("profiles", ["name", "title", "state"], [[p["name"], p["title"], p["fault"] or "usable"] for p in profiles])
    table("effects", ["name", "from", "state"], [[e["name"], e["origin"], e["fault"] or "usable"] for e in effects])
    for broken in (x for x in (*drivers, *profiles, *effects) if x["fault"]):
        say(f"warning: {broken['name']}: {broken['fault']}")
    return 0


def _profile(path: Path) -> dict[str, Any]:
    try:
        profile = load_bundle(path).profile
    except (ProfileError, DriverMissing, DriverError) as e:
        return {"name": path.stem, "title": "", "driver": "", "fault": str(e)}
    return {"name": profile.name, "title": profile.title, "driver": profile.driver, "fault": None}


def _effects() -> list[dict[str, Any]]:
    found, broken = plugins()
    own = [{"name": e.name, "origin": "triaxcal", "fault": None} for e in CATALOGUE]
    others = [{"name": e.name, "origin": package_of(e.name), "fault": None} for e in found]
    return [*own, *others, *({"name": name, "origin": package_of(name), "fault": why} for name, why in broken)]
