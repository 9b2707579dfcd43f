"""provision, registers, devices."""

from __future__ import annotations

import argparse
import asyncio
import dataclasses
from pathlib import Path
from typing import Any

from triaxcal.errors import Refused
from triaxcal_drivers.catalogue import listed
from triaxcal_drivers.errors import DriverError, DriverMissing, ProfileError
from triaxcal_drivers.profile import BUILT_IN, load_bundle
from triaxcald.certificate import is_passing, roles
from triaxcald.cli.arguments import add_json
from triaxcald.cli.console import emit, say, table
from triaxcald.documents import number, sensor_of
from triaxcald.inputs import read_document
from triaxcald.provision.explain import explain
from triaxcald.provision.identity import check_identity
from triaxcald.provision.image import RegisterImage, build_image
from triaxcald.provision.procedure import ProvisionReport, provision
from triaxcald.provision.snapshot import take_snapshot
from triaxcald.station.config import Place, load_station
from triaxcald.station.today import days_since_1970


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
    p = commands.add_parser("devices", help="drivers and profiles found, broken ones with their reason")
    add_json(p)
    p.set_defaults(run=devices_command)


def provision_command(a: argparse.Namespace) -> int:
    place = load_station(a.station).place(a.unit)
    image = image_from(a.calibration, place)
    report = asyncio.run(_provision(place, image, a.dry_run))
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
                "value": number(words[name].value) if name in words else None,
                "held": number(words[name].held) if name in words else None,
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
        print(f"{len(report.written)} registers written, stored, read back after a restart and equal")
    return 0


def image_from(path: str, place: Place) -> RegisterImage:
    """The registers that a calibration file asks for. Raises Refused where the device cannot hold its effects."""
    sensor, channel_reference, _ = sensor_of(read_document(path), where=path)
    profile = place.bundle.profile
    homeless = [
        f"{effect.name}.{c.name}"
        for effect, _ in sensor.effects
        for c in effect.coefficients
        if not is_passing(effect) and profile.by_role(f"{effect.name}.{c.name}") is None
    ]
    if homeless:
        raise Refused(
            f"{path}: {profile.name} has no register for {', '.join(homeless)}; without them the other coefficients "
            "would be wrong: fit without that effect"
        )
    wanted = {r: v for r, v in roles(sensor, channel_reference).items() if profile.by_role(r)}
    return build_image(profile, wanted, date_days=days_since_1970())


async def _provision(place: Place, image: RegisterImage, dry_run: bool) -> ProvisionReport:
    async with place.opened() as device:
        return await provision(
            device, place.bundle, image, expected_serial=place.unit.serial, dry_run=dry_run, where=place.where
        )


def registers_command(a: argparse.Namespace) -> int:
    place = load_station(a.station).place(a.unit)
    serial, rows = asyncio.run(_registers(place))
    if a.json:
        emit(
            {
                "format": "triaxcal.registers/1",
                "unit": place.unit.name,
                "serial": serial,
                "registers": [{**dataclasses.asdict(r), "value": number(r.value)} for r in rows],
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
        identity = await check_identity(device, place.bundle, place.unit.serial, where=place.where)
        return identity.serial, explain(place.bundle, await take_snapshot(device, place.bundle))


def devices_command(a: argparse.Namespace) -> int:
    drivers = [dataclasses.asdict(d) for d in listed()]
    profiles = [_profile(path) for path in sorted(BUILT_IN.glob("*.toml"))]
    if a.json:
        emit({"format": "triaxcal.devices/1", "drivers": drivers, "profiles": profiles})
        return 0
    rows = [[d["name"], d["distribution"], d["target"], d["fault"] or "usable"] for d in drivers]
    table("drivers", ["name", "package", "class", "state"], rows)
    table("profiles", ["name", "title", "state"], [[p["name"], p["title"], p["fault"] or "usable"] for p in profiles])
    for broken in (x for x in (*drivers, *profiles) if x["fault"]):
        say(f"warning: {broken['name']}: {broken['fault']}")
    return 0


def _profile(path: Path) -> dict[str, Any]:
    try:
        profile = load_bundle(path).profile
    except (ProfileError, DriverMissing, DriverError) as e:
        return {"name": path.stem, "title": "", "driver": "", "fault": str(e)}
    return {"name": profile.name, "title": profile.title, "driver": profile.driver, "fault": None}
