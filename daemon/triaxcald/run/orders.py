"""What the units of a run are measured for, and the rules under which it may begin."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

from triaxcald.errors import InputError
from triaxcald.provision.identity import same_serial
from triaxcald.station.config import Rules, Station
from triaxcald.store import History
from triaxcald.work import Work


class RuleBroken(InputError):
    """A rule of the station forbids to begin; ``rule`` is its key, ``work`` that of
    the unit that it forbids."""

    def __init__(self, rule: str, message: str, work: Work | None = None) -> None:
        super().__init__(message)
        self.rule = rule
        self.work = work


def with_serials(station: Station, serials: Sequence[tuple[str, str]]) -> Station:
    """The station with other expected serial numbers: ``serials`` are pairs of slot and
    serial number. Raises InputError for an unknown slot, a slot or a serial number
    given twice."""
    wanted: dict[str, str] = {}
    names = [place.unit.name for place in station.places]
    for slot, serial in serials:
        if slot not in names:
            raise InputError(f"--serial {slot}={serial}: {station.path} has no slot of that name: {', '.join(names)}")
        if slot in wanted:
            raise InputError(f"--serial {slot}={serial}: the slot {slot} has two serial numbers; give one")
        wanted[slot] = serial
    places = tuple(
        replace(place, unit=place.unit.model_copy(update={"serial": wanted.get(place.unit.name, place.unit.serial)}))
        for place in station.places
    )
    expected = [(place.unit.name, place.unit.serial) for place in places if place.unit.serial is not None]
    for i, (slot, serial) in enumerate(expected):
        for other, theirs in expected[:i]:
            if same_serial(serial, theirs):
                raise InputError(f"--serial: the slots {other} and {slot} expect the same serial number, {serial}")
    return replace(station, places=places)


def works(station: Station, given: Mapping[str, str | None]) -> dict[str, Work]:
    """The work of each slot: as ``given``, else as in the station file. Raises
    RuleBroken if a rule of the station forbids to begin."""
    rules = station.file.rules
    common = {**station.file.work.model_dump(), **{key: value for key, value in given.items() if value is not None}}
    if rules.operator and common.get("operator") is None:
        raise RuleBroken("operator", f"{station.path}: rules.operator: give --operator NAME")
    found = {}
    for place in station.places:
        work = Work(place.unit.name, place.unit.serial, **common)
        if work.serial is not None:
            require_serial(rules, work.serial, work.slot)
            require_allowed(rules, work, work.serial, History.of(station.folder, work.serial))
        found[work.slot] = work
    return found


def require_serial(rules: Rules, serial: str, slot: str) -> None:
    """Raises RuleBroken if the serial number does not match the rule, and is not that
    of the golden unit."""
    if rules.serial is not None and not rules.of_golden(serial) and not re.fullmatch(rules.serial, serial):
        raise RuleBroken("serial", f"unit {slot}: serial number {serial}: rules.serial expects {rules.serial}")


def require_allowed(rules: Rules, work: Work, serial: str, history: History) -> None:
    """Raises RuleBroken if the rules forbid another attempt at the serial number. The
    golden unit may always be verified."""
    if rules.of_golden(serial):
        return
    if rules.attempts is not None and history.attempts >= rules.attempts:
        raise RuleBroken(
            "attempts",
            f"unit {work.slot}: serial number {serial} has had {history.attempts} attempts, rules.attempts allows "
            f"{rules.attempts}",
        )
    if rules.retest_reason and history.passed and work.reason is None:
        raise RuleBroken(
            "retest_reason",
            f"unit {work.slot}: serial number {serial} has passed before, and rules.retest_reason asks for a reason; "
            "give --reason TEXT",
            work,
        )
