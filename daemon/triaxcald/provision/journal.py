"""The journal of a provisioning: its old and wanted registers, on disk from before
the first write, a probe too, until the state of the device is settled."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import triaxcal_drivers as td
from triaxcald.documents import json_value
from triaxcald.errors import DiskError, InputError
from triaxcald.files import in_a_name, synchronise, write_durably
from triaxcald.provision.access import RegisterLink
from triaxcald.provision.identity import check_identity
from triaxcald.provision.registers import (
    RegisterImage,
    Snapshot,
    calibration_registers,
    fits_its_checksum,
    image_of,
    take_snapshot,
)

FORMAT, FOLDER = "triaxcal.journal/1", "journal"
Step = Literal["probing", "writing", "storing", "stored", "unverified"]
"""``probing``: nothing is written but the probe of a restart check. ``unverified``: the
provisioning ended, but no restart has proven the stored values."""


_WHOLE = re.compile(r"(-?)([0-9]+)")
_RUN = "[0-9a-f]" * 8 + "-*"
"""Prefix pattern of the identifier of a run."""


@dataclass(frozen=True)
class Owner:
    """Owner of a journal: a unit by its product and serial number, or, without a
    serial number, any unit in the ``slot``."""

    product: str
    serial: str | None
    slot: str

    @staticmethod
    def of(profile: td.Profile, slot: str, serial: str | None) -> Owner:
        """``serial`` as a station file or a device states it."""
        stated = serial.strip() if serial else None
        if stated and (number := _WHOLE.fullmatch(stated)):  # as `serial_text` has it
            sign, digits = number.groups()
            stated = sign + (digits.lstrip("0") or "0").rjust(4 - len(sign), "0")
        return Owner(profile.identity.product, stated or None, slot)


@dataclass(frozen=True)
class Entry:
    """``before`` and ``wanted`` are raw register bytes as on the wire, in the
    order in which they are written. ``product`` and ``run`` are empty in a
    journal of a version before 0.2."""

    unit: str
    serial: str | None
    profile_sha256: str
    started: str
    before: Mapping[str, bytes]
    wanted: Mapping[str, bytes]
    step: Step = "writing"
    product: str = ""
    run: str = ""


@dataclass(frozen=True)
class Journal:
    """The journal of one device, in the station's folder."""

    path: Path

    @staticmethod
    def of(folder: Path, owner: Owner, run: str) -> Journal:
        """The journal of a provisioning by that run."""
        return Journal(folder / FOLDER / f"{_own_name(owner, run)}.json")

    @staticmethod
    def existing(folder: Path, owner: Owner) -> list[Journal]:
        """Existing journals that may belong to the unit, the newest first; names of
        earlier versions last. Without a serial number they may belong to other units
        of the same slot."""
        within = folder / FOLDER
        if owner.serial is None:
            runs = sorted(within.glob(f"{in_a_name(owner.slot)}-{_RUN}.json"), reverse=True)
            paths = [*runs, within / f"unit-{owner.slot}.json"]
        else:
            paths = [within / f"{_own_name(owner, '')}.json", within / f"{in_a_name(owner.serial)}.json"]
        return [Journal(path) for path in paths if path.exists()]

    def read(self) -> Entry | None:
        """The entry; None if there is no file. Raises InputError on a file that is no
        journal."""
        try:
            text = self.path.read_bytes()
        except FileNotFoundError:
            return None
        except OSError as e:
            raise InputError(f"{self.path}: cannot be read: {e.strerror}") from e
        try:
            return parse(text, where=str(self.path))
        except InputError as e:
            raise InputError(
                f"{e}; without that file the unit can be provisioned as if nothing had been cut short"
            ) from e

    def write(self, entry: Entry) -> None:
        """Write the entry, and return once it is on the disk. Raises DiskError."""
        document = {
            "format": FORMAT,
            "unit": entry.unit,
            "product": entry.product,
            "run": entry.run,
            "serial": entry.serial,
            "profile_sha256": entry.profile_sha256,
            "started": entry.started,
            "step": entry.step,
            "before": {name: raw.hex() for name, raw in entry.before.items()},
            "wanted": {name: raw.hex() for name, raw in entry.wanted.items()},
        }
        try:
            if not self.path.parent.is_dir():
                self.path.parent.mkdir(parents=True, exist_ok=True)
                synchronise(self.path.parent.parent)
            write_durably(self.path, json.dumps(document, indent=2) + "\n")
        except OSError as e:
            raise DiskError(f"{self.path}: cannot be written: {e.strerror}") from e

    def remove(self) -> None:
        """Raises DiskError."""
        try:
            self.path.unlink(missing_ok=True)
        except OSError as e:
            raise DiskError(f"{self.path}: cannot be removed: {e.strerror}") from e


def _own_name(owner: Owner, run: str) -> str:
    name = f"{owner.slot}-{run}" if owner.serial is None else f"{owner.product}-{owner.serial}"
    return in_a_name(name)


def journals_of(folder: Path, owner: Owner, profile: td.Profile) -> list[tuple[Journal, Entry]]:
    """The journals in the station's folder that may be of the unit, the newest
    first, without those that are known to be of another product.

    Raises InputError on a file that is no journal, and on one under the unit's
    own name that is of another unit or has other registers.
    """
    found = []
    for journal in Journal.existing(folder, owner):
        entry = journal.read()
        if entry is None:  # removed since
            continue
        alike = set(entry.before) == set(calibration_registers(profile))
        if not entry.product and owner.serial is not None:  # by serial number alone: of any product
            if alike:
                found.append((journal, entry))
        elif (entry.product or owner.product, entry.serial) != (owner.product, owner.serial):
            raise InputError(f"{journal.path}: is the journal of {entry.product} with serial number {entry.serial}")
        elif not alike:
            raise InputError(f"{journal.path}: its registers are not those of profile {profile.name}")
        else:
            found.append((journal, entry))
    return found


def open_journal(folder: Path, profile: td.Profile, slot: str, serial: str | None) -> Path | None:
    """The path of the newest journal that may be of the unit. None if there is
    none, or if the serial number of the unit is not known yet."""
    if serial is None and profile.identity.serial_register is not None:
        return None
    found = Journal.existing(folder, Owner.of(profile, slot, serial))
    return found[0].path if found else None


def parse(text: bytes, *, where: str) -> Entry:
    """Raises InputError."""
    try:
        held: Any = json_value(text)
        if held["format"] != FORMAT:
            raise ValueError(f"format: expected '{FORMAT}'")
        if held["step"] not in get_args(Step):
            raise ValueError(f"step: expected one of {', '.join(get_args(Step))}")
        serial = held["serial"]
        return Entry(
            unit=str(held["unit"]),
            serial=None if serial is None else str(serial),
            profile_sha256=str(held["profile_sha256"]),
            started=str(held["started"]),
            before=registers_of(held["before"]),
            wanted=registers_of(held["wanted"]),
            step=held["step"],
            product=str(held.get("product") or ""),
            run=str(held.get("run") or ""),
        )
    except (ValueError, RecursionError) as e:
        raise InputError(f"{where}: no journal of a provisioning: {e}") from e
    except (KeyError, TypeError, AttributeError) as e:
        raise InputError(f"{where}: no journal of a provisioning: {e.args[0]} is missing or of another kind") from e


def registers_of(held: Mapping[str, str]) -> dict[str, bytes]:
    """Raw bytes by register from a document. Raises ValueError, TypeError,
    AttributeError."""
    return {str(name): bytes.fromhex(raw) for name, raw in held.items()}


# The image of an interrupted provisioning, from its journal.


async def journaled_image(
    link: RegisterLink, bundle: td.Bundle, *, folder: Path, unit: str, expected_serial: str | None, where: str
) -> tuple[RegisterImage, str | None]:
    """The wanted image of this device's interrupted provisioning, and the device's
    serial number.

    Raises InputError where there is none, or where it was begun with another
    profile; WrongUnit, DriverError.
    """
    identity = await check_identity(link, bundle, expected_serial, where=where)
    owner = Owner.of(bundle.profile, unit, identity.serial)
    found = journals_of(folder, owner, bundle.profile)
    if not found:
        path = Journal.of(folder, owner, "RUN").path
        raise InputError(f"{path}: no such file: no provisioning of this unit was cut short")
    journal, entry = found[0]
    if len(found) > 1:  # several units were in this slot, one after the other
        held = await take_snapshot(link, bundle)
        journal, entry = next(((j, e) for j, e in found if _fits(e, held)), found[0])
    if entry.profile_sha256 != bundle.digest():
        raise InputError(f"{journal.path}: was begun with another version of the profile {bundle.profile.name}")
    return image_of(bundle.profile, entry.wanted), identity.serial


def _fits(entry: Entry, held: Snapshot) -> bool:
    """Whether each register holds its old value or its new one."""
    return all(raw in (entry.before.get(name), entry.wanted.get(name)) for name, raw in held.raw.items())


def was_cut_short(entry: Entry, profile: td.Profile, found: Snapshot, image: RegisterImage, restarted: bool) -> bool:
    """Whether a device with a journal still is as that provisioning left it,
    and not as somebody has made it since.

    ``found`` was read after a restart, where ``restarted`` says so; ``image``
    is what is to be written now.
    """
    if not found.differing(entry.before):  # which is in use, and may not be what is stored
        return bool(profile.sequences.store) and not restarted
    if not found.differing(entry.wanted):
        return entry.step != "unverified" or not found.differing(image.raw)
    torn = [n for n, raw in found.raw.items() if raw not in (entry.before[n], entry.wanted.get(n))]
    if profile.crc is None:
        return len(torn) <= 1  # a supply that fails in a write leaves one register half written
    # Without a serial number, a blank unit at the same place is not to be taken
    # for one that was cut short.
    known = profile.identity.serial_register is not None or len(torn) <= 1
    return known and not fits_its_checksum(profile, found)
