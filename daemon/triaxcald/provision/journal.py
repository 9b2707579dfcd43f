"""What a provisioning sets out to do, on disk before the first register is
written, until the device is settled."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from triaxcald.errors import DiskError, InputError
from triaxcald.files import synchronise, write_durably

FORMAT, FOLDER = "triaxcal.journal/1", "journal"
Step = Literal["writing", "storing", "stored", "unverified"]
"""``unverified``: it came to its end, on a device that no restart has shown to
hold it."""


@dataclass(frozen=True)
class Entry:
    """``before`` and ``wanted`` are raw register bytes as on the wire, in the
    order in which they are written."""

    unit: str
    serial: str | None
    profile_sha256: str
    started: str
    before: Mapping[str, bytes]
    wanted: Mapping[str, bytes]
    step: Step = "writing"


@dataclass(frozen=True)
class Journal:
    """The journal of one device, in the station's folder."""

    path: Path

    @staticmethod
    def of(folder: Path, unit: str, serial: str | None) -> Journal:
        """By serial number; by the unit's name in the station file where the
        device has none."""
        return Journal(folder / FOLDER / f"{serial or f'unit-{unit}'}.json")

    def read(self) -> Entry | None:
        """None where nothing was cut short. Raises InputError on a file that is
        no journal."""
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
        """Returns once it is on the disk. Raises DiskError."""
        document = {
            "format": FORMAT,
            "unit": entry.unit,
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


def open_journal(folder: Path, unit: str, serial: str | None) -> Path | None:
    """The path of a unit's journal, where one lies in the station's folder."""
    path = Journal.of(folder, unit, serial).path
    return path if path.exists() else None


def parse(text: bytes, *, where: str) -> Entry:
    """Raises InputError."""
    try:
        held: Any = json.loads(text)
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
        )
    except (ValueError, RecursionError) as e:
        raise InputError(f"{where}: no journal of a provisioning: {e}") from e
    except (KeyError, TypeError, AttributeError) as e:
        raise InputError(f"{where}: no journal of a provisioning: {e.args[0]} is missing or of another kind") from e


def registers_of(held: Mapping[str, str]) -> dict[str, bytes]:
    """Raw bytes by register from a document. Raises ValueError, TypeError,
    AttributeError."""
    return {str(name): bytes.fromhex(raw) for name, raw in held.items()}
