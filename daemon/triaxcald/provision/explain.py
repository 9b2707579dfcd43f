"""A device's calibration registers in words, for people. No I/O."""

from __future__ import annotations

import math
from dataclasses import dataclass

import triaxcal_drivers as td
from triaxcald.provision.registers import Snapshot, checksum_of


@dataclass(frozen=True)
class Row:
    """One register. ``raw_hex`` as on the wire; ``crc_ok`` is None for
    registers other than the checksum."""

    register: str
    role: str
    raw_hex: str
    value: float
    unit: str
    description: str
    within_limits: bool
    crc_ok: bool | None


def explain(bundle: td.Bundle, snapshot: Snapshot) -> list[Row]:
    """A row for each register of the snapshot. Raises RegisterValueError on
    bytes of a wrong length."""
    return [_row(bundle.profile, snapshot, name) for name in snapshot.raw]


def _row(profile: td.Profile, snapshot: Snapshot, name: str) -> Row:
    register, raw = profile.registers[name], snapshot.raw[name]
    value = profile.decode(name, raw)
    low = -math.inf if register.minimum is None else register.minimum
    high = math.inf if register.maximum is None else register.maximum
    is_checksum = profile.crc is not None and profile.crc.register_name == name
    return Row(
        name,
        register.role or "",
        raw.hex(),
        value,
        register.unit,
        register.description,
        math.isfinite(value) and low <= value <= high,
        _checksum_ok(profile, snapshot, value) if is_checksum else None,
    )


def _checksum_ok(profile: td.Profile, snapshot: Snapshot, held: float) -> bool:
    try:
        return checksum_of(profile, snapshot.raw) == held
    except td.RegisterValueError:  # a register holds no number
        return False
