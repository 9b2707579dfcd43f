"""The registers of the devices: names, types, addresses, and the bytes that numbers become. No I/O.

Raw bytes are most significant first here; a transport puts them in its own order.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from tests.devices.habits import Habits

AXES = "xyz"
QUANTITIES = ("scale_factor", "misalignment", "bias")
NINE = tuple(f"{quantity}_{axis}" for quantity in QUANTITIES for axis in AXES)
CHECKSUM, DATE = "calibration_crc", "calibration_date"
UNLOCK_KEY, STORE_COMMAND, RESET_COMMAND = 0xC0DE, 0x65766173, 0x5253
INT32_UNIT = 1e-6
UNITS = {"scale_factor": "V/g", "misalignment": "rad", "bias": "g"}
LIMITS = {"scale_factor": 10.0, "misalignment": 0.1, "bias": 0.5}
_FORMATS = {"int16": ">h", "uint16": ">H", "int32": ">i", "uint32": ">I", "int64": ">q", "uint64": ">Q",
            "float32": ">f", "ascii": ">12s"}  # fmt: skip

Access = Literal["ro", "rw", "wo"]


@dataclass(frozen=True)
class Entry:
    """A register: ``address`` counts Modbus words from 0, ``object`` is index and sub-index of CANopen."""

    type: str
    address: int
    object: tuple[int, int]
    access: Access = "ro"
    role: str | None = None
    unit: str = ""
    limit: float | None = None
    scale: float = 1.0

    @property
    def size(self) -> int:
        return struct.calcsize(_FORMATS[self.type])

    @property
    def words(self) -> int:
        return self.size // 2

    def encode(self, value: float | str) -> bytes:
        if isinstance(value, str):
            return value.encode("latin-1").ljust(self.size, b"\0")
        raw = value / self.scale
        return struct.pack(_FORMATS[self.type], raw if self.type == "float32" else round(raw))

    def decode(self, raw: bytes) -> float:
        return float(struct.unpack(_FORMATS[self.type], raw)[0]) * self.scale


def registers_of(habits: Habits) -> dict[str, Entry]:
    """The registers of a device with these habits, in order."""
    short = habits.serial_type == "uint32"
    where = (0x0000, (0x1018, 4)) if short else (0x0010, (0x2F03, 0))  # four words; CANopen's own has 32 bits
    held = {
        "serial_number": Entry(habits.serial_type, *where, role="serial_number"),
        "product_code": Entry("uint32", 0x0002, (0x1018, 2)),
    }
    if habits.status:
        held["status"] = Entry("uint16", 0x0004, (0x2F01, 0))
    if habits.counter:
        held["write_counter"] = Entry("uint32", 0x0005, (0x2F02, 0), role="write_counter")
    if habits.unlock:
        held["unlock_key"] = Entry("uint16", 0x0020, (0x2F10, 1), "wo")
    if habits.store_command:
        held["store"] = Entry("uint32", 0x0022, (0x1010, 1), "wo")
    if habits.reset_command:
        held["reset"] = Entry("uint16", 0x0024, (0x2F10, 2), "wo")
    calibration = _calibration(habits)
    held |= calibration
    if habits.mirror:
        for name, e in calibration.items():
            index, subindex = e.object
            held[f"stored_{name}"] = Entry(e.type, e.address + 0x100, (index + 0x100, subindex), "ro", scale=e.scale)
    return held


def _calibration(habits: Habits) -> dict[str, Entry]:
    if habits.roles:
        return {
            role.replace(".", "_"): Entry("float32", 0x0100 + 2 * j, (0x2400, 1 + j), "rw", role)
            for j, role in enumerate(habits.roles)
        }
    held = {}
    scale = INT32_UNIT if habits.number == "int32" else 1.0
    for i, quantity in enumerate(QUANTITIES):
        for j, axis in enumerate(AXES):
            held[f"{quantity}_{axis}"] = Entry(
                habits.number, 0x0100 + 6 * i + 2 * j, (0x2400 + i, 1 + j), "rw", f"{quantity}.{axis}",
                UNITS[quantity], LIMITS[quantity], scale,
            )  # fmt: skip
    if habits.date:
        held[DATE] = Entry("uint32", 0x0112, (0x2404, 0), "rw", DATE)
    if habits.checksum:
        held[CHECKSUM] = Entry("uint16", 0x0114, (0x2405, 0), "rw", CHECKSUM)
    return held


def calibration_names(habits: Habits) -> tuple[str, ...]:
    """The registers that lie in the EEPROM, in its order; the checksum last."""
    return tuple(_calibration(habits))


def crc16(data: bytes) -> int:
    """CRC-16/MODBUS: polynomial 0x8005 reflected, initial value 0xFFFF."""
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ 0xA001 if value & 1 else value >> 1
    return value


def checksum_of(image: Mapping[str, bytes]) -> bytes:
    """What the checksum register should hold beside these nine."""
    return crc16(b"".join(image[name] for name in NINE)).to_bytes(2, "big")


@dataclass(frozen=True)
class Coefficients:
    """A calibration: output per g, radians, g."""

    scale_factor: tuple[float, float, float]
    misalignment: tuple[float, float, float]
    bias: tuple[float, float, float]

    def image(self, habits: Habits, *, date_days: int = 0) -> dict[str, bytes]:
        """The calibration registers that hold it, raw."""
        entries = _calibration(habits)
        values = [*self.scale_factor, *self.misalignment, *self.bias]
        held = {name: entries[name].encode(value) for name, value in zip(NINE, values, strict=True)}
        if habits.date:
            held[DATE] = entries[DATE].encode(date_days)
        if habits.checksum:
            held[CHECKSUM] = checksum_of(held)
        return held


OLD = Coefficients((-2.4, -2.38, -2.42), (0.001, -0.002, 0.0015), (0.01, -0.02, 0.03))
NEW = Coefficients((-2.4127, -2.3913, -2.4291), (0.0031, 0.0012, -0.0043), (-0.0119, 0.0217, -0.0061))
FACTORY = Coefficients((-2.5, -2.5, -2.5), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
"""What the devices hold at first, what is to be written, and what lies in their ROM: different in every register."""
