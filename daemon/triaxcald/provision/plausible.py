"""Is what the device holds a calibration at all? Values alone, no I/O.

Registers read with the wrong word order, scaling or address hold absurd
numbers, and what is written the same way leaves absurd numbers behind.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from triaxcal_drivers.errors import ProfileError, RegisterValueError
from triaxcal_drivers.profile import SCALE_FACTOR_RATIO, Profile
from triaxcald.provision.image import CRC_ROLE, DATE_ROLE, REFERENCE_ROLE, RegisterImage, checksum_of
from triaxcald.provision.snapshot import Snapshot

Kind = Literal["not_a_number", "outside_limits", "implausible", "unstable", "checksum", "corrected_output"]

BOUNDS: Mapping[str, tuple[float, float]] = {
    "misalignment": (-0.5, 0.5),  # rad: half a right angle's worth; housings are square to a hundredth of that
    "bias": (-20.0, 20.0),  # g: the full scale of the triads in question
    REFERENCE_ROLE: (-273.15, 1000.0),  # °C
    DATE_ROLE: (0.0, 100_000.0),  # days: until the year 2243
}
EFFECT_BOUND = 10.0
"""g per g², per K and so on: an effect as large as this would leave nothing of
the measurement."""


@dataclass(frozen=True)
class Doubt:
    """Why a snapshot is hardly a calibration. ``low`` and ``high`` bound what
    was expected of ``value``."""

    kind: Kind
    register: str
    value: float
    low: float = math.nan
    high: float = math.nan


def is_blank(snapshot: Snapshot) -> bool:
    """Never written: every byte 0xFF, or every byte 0x00."""
    held = b"".join(snapshot.raw.values())
    return bool(held) and len(set(held)) == 1 and held[0] in (0x00, 0xFF)


def unstable(profile: Profile, first: Snapshot, second: Snapshot) -> list[Doubt]:
    """Registers that two readings in a row do not agree on."""
    return [Doubt("unstable", name, profile.decode(name, second.raw[name])) for name in first.differing(second.raw)]


def doubts(profile: Profile, snapshot: Snapshot, image: RegisterImage) -> list[Doubt]:
    """None for a blank device, and none for what looks like a calibration."""
    if is_blank(snapshot):
        return []
    wanted = {word.register: word.value for word in image.words}
    found = [doubt for name, raw in snapshot.raw.items() if (doubt := _of(profile, name, raw, wanted))]
    return [*found, *_checksum(profile, snapshot)]


def _of(profile: Profile, name: str, raw: bytes, wanted: Mapping[str, float]) -> Doubt | None:
    value = profile.decode(name, raw)
    if not math.isfinite(value):
        return Doubt("not_a_number", name, value)
    register = profile.registers[name]
    low = -math.inf if register.minimum is None else register.minimum
    high = math.inf if register.maximum is None else register.maximum
    if not low <= value <= high:
        return Doubt("outside_limits", name, value, low, high)
    quantity, _, axis = (register.role or "").partition(".")
    if quantity == "scale_factor":
        nominal = profile.output.nominal_scale_factor
        size = abs(nominal["xyz".index(axis)] if nominal else wanted.get(name, math.nan))
        low, high = size / SCALE_FACTOR_RATIO, size * SCALE_FACTOR_RATIO
        implausible = abs(value) < low or abs(value) > high
    else:
        low, high = BOUNDS.get(quantity, (-EFFECT_BOUND, EFFECT_BOUND))
        implausible = quantity != CRC_ROLE and not low <= value <= high
    return Doubt("implausible", name, value, low, high) if implausible else None


def fits_its_checksum(profile: Profile, snapshot: Snapshot) -> bool:
    """Whether the device has a checksum, and holds the one that belongs to its
    registers."""
    return profile.crc is not None and not _checksum(profile, snapshot)


def _checksum(profile: Profile, snapshot: Snapshot) -> Sequence[Doubt]:
    if profile.crc is None or profile.crc.register_name not in snapshot.raw:
        return []
    name = profile.crc.register_name
    held = profile.decode(name, snapshot.raw[name])
    try:
        right = float(checksum_of(profile, snapshot.raw))
    except (RegisterValueError, ProfileError, OverflowError, ValueError):  # a register holds no number
        right = math.nan
    return [] if held == right else [Doubt("checksum", name, held, right, right)]
