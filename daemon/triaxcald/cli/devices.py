"""registers, devices."""

from __future__ import annotations

import argparse
import dataclasses
from typing import Any

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald import text
from triaxcald.cli.console import emit, say, table
from triaxcald.cli.interrupt import run_interruptible
from triaxcald.provision.access import RegisterLink
from triaxcald.provision.identity import identified
from triaxcald.provision.journal import open_journal
from triaxcald.provision.registers import explain, take_snapshot
from triaxcald.station.config import Place, Station, load_station

# What a command that writes nothing owes to whoever reads a device in between.


def of_a_journal(station: Station, unit: str, serial: str | None) -> str | None:
    """Warning about an earlier provisioning of the unit that is not settled; None
    without one."""
    journal = open_journal(station.folder, station.place(unit).bundle.profile, unit, serial)
    return text.unfinished(journal, unit, station.path) if journal else None


def warn_of_a_journal(station: Station, unit: str, serial: str | None) -> None:
    """Print the warning of `of_a_journal` to standard error."""
    if warning := of_a_journal(station, unit, serial):
        say(f"warning: unit {unit}: {warning}")


def registers_command(a: argparse.Namespace) -> int:
    station = load_station(a.station)
    place = station.place(a.unit)
    serial, rows = run_interruptible(_registers(place))
    warn_of_a_journal(station, place.unit.name, serial)
    if a.json:
        emit(
            {
                "format": "triaxcal.registers/1",
                "unit": place.unit.name,
                "serial": serial,
                "registers": [
                    {**dataclasses.asdict(r), "value": tc.rounding.number(r.value, tc.rounding.REGISTER_DIGITS)}
                    for r in rows
                ],
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
        link = RegisterLink(device, place.bundle.profile, name=place.device_name)
        identity = await identified(link, place.bundle, place.unit.serial, where=place.address)
        return identity.serial, explain(place.bundle, await take_snapshot(link, place.bundle))


def devices_command(a: argparse.Namespace) -> int:
    drivers = [dataclasses.asdict(d) for d in td.listed()]
    profiles = [_profile(listed) for listed in td.listed_profiles()]
    effects = _effects()
    if a.json:
        emit({"format": "triaxcal.devices/1", "drivers": drivers, "profiles": profiles, "effects": effects})
        return 0
    rows = [[d["name"], d["distribution"], d["target"], d["fault"] or "usable"] for d in drivers]
    table("drivers", ["name", "package", "class", "state"], rows)
    shown = [[p["name"], p["title"], p["distribution"], p["source"], p["fault"] or "usable"] for p in profiles]
    table("profiles", ["name", "title", "package", "source", "state"], shown)
    table("effects", ["name", "from", "state"], [[e["name"], e["origin"], e["fault"] or "usable"] for e in effects])
    for broken in (x for x in (*drivers, *profiles, *effects) if x["fault"]):
        say(f"warning: {broken['name']}: {broken['fault']}")
    return 0


def _profile(listed: td.ListedProfile) -> dict[str, Any]:
    row = {"name": listed.name, "title": "", "driver": "", "fault": listed.fault,
           "distribution": listed.distribution, "source": ""}  # fmt: skip
    if listed.path is None:
        return row
    try:
        profile = td.load_bundle(listed.path).profile
    except (td.ProfileError, td.DriverMissing, td.DriverError) as e:
        return {**row, "fault": str(e)}
    return {**row, "title": profile.title, "driver": profile.driver, "source": profile.source}


def _effects() -> list[dict[str, Any]]:
    found, broken = tc.effects.plugins()
    own = [{"name": e.name, "origin": "triaxcal", "fault": None} for e in tc.effects.CATALOGUE]
    others = [{"name": e.name, "origin": tc.effects.package_of(e.name), "fault": None} for e in found]
    return [
        *own,
        *others,
        *({"name": name, "origin": tc.effects.package_of(name), "fault": why} for name, why in broken),
    ]
