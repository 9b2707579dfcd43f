"""What the devices measure, and what they make of it with their own registers. No I/O."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from tests.devices.memory import Electronics
from tests.devices.table import AXES, FACTORY, QUANTITIES, Entry

Triple = tuple[float, float, float]
OVER_RANGE = -(2**31)


def at_rest(_: float) -> Triple:
    """One g along z, as a sensor of -2.4 V/g without errors shows it."""
    return (0.0, 0.0, -2.4)


def correct(readings: Triple, entries: Mapping[str, Entry], image: Mapping[str, bytes]) -> Triple:
    """a = R⁻¹ (K⁻¹ u − b), R = [[1, az, ay], [0, 1, ax], [0, 0, 1]], with the registers of ``image``."""
    k, m, b = ([entries[f"{q}_{axis}"].decode(image[f"{q}_{axis}"]) for axis in AXES] for q in QUANTITIES)
    if 0.0 in k:
        return (math.nan,) * 3
    x, y, z = (u / k_ - b_ for u, k_, b_ in zip(readings, k, b, strict=True))
    y -= m[0] * z
    x -= m[2] * y + m[1] * z
    return (x, y, z)


@dataclass(frozen=True)
class Motion:
    """``readings`` [V] by the device's clock. With ``follows_registers`` False the device corrects with what lies in
    its ROM, whatever its registers hold. With ``corrects_all`` it has no output but the corrected one, and sends it as
    its readings. ``number``: type of both blocks on Modbus; int32 in units of 1e-6. ``apart``: on Modbus each axis is
    a block of its own. ``beside``: further input registers there, by their addresses."""

    readings: Callable[[float], Triple] = at_rest
    follows_registers: bool = True
    number: str = "float32"
    corrects_all: bool = False
    apart: bool = False
    beside: Mapping[int, Callable[[float], int]] = field(default_factory=dict)

    def shown(self, unit: Electronics, now: float) -> Triple:
        """What the device sends as its readings."""
        return self.corrected(unit, now) if self.corrects_all else self.readings(now)

    def corrected(self, unit: Electronics, now: float) -> Triple:
        """In g."""
        image = unit.in_use if self.follows_registers else FACTORY.image(unit.habits)
        return correct(self.readings(now), unit.table, image)

    def encode(self, values: Triple) -> list[bytes]:
        """Each most significant byte first."""
        if self.number == "float32":
            return [struct.pack(">f", v) for v in values]
        raw = [round(v * 1e6) if math.isfinite(v) and abs(v) < 2147 else OVER_RANGE for v in values]
        return [struct.pack(">i", v) for v in raw]
