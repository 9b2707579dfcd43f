"""The reference unit's registers as data, and its memory: the RAM copy in use
and the stored copy."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from triaxcal_drivers.register_types import TYPES
from triaxcal_drivers.registers import crc

Access = Literal["ro", "rw", "wo"]

VENDOR_ID, PRODUCT_CODE, FIRMWARE_VERSION = 0x54524941, 0x7A01, 0x00010000
UNLOCK, LOCK, SAVE, RESTART = 0x5A17, 0, 0x65766173, 0xB007


@dataclass(frozen=True)
class Entry:
    type: Literal["uint16", "uint32", "float32"]
    access: Access

    @property
    def size(self) -> int:
        return TYPES[self.type].size

    def encode(self, value: float) -> bytes:
        """Most significant byte first."""
        if self.type == "float32":
            return struct.pack(">f", value)
        return int(value).to_bytes(self.size, "big")

    def decode(self, raw: bytes) -> float:
        if self.type == "float32":
            return float(struct.unpack(">f", raw)[0])
        return int.from_bytes(raw, "big")


_PER_AXIS = (
    "scale_factor", "misalignment", "bias", "second_order", "temperature_bias", "temperature_scale_factor",
)  # fmt: skip

CRC = "calibration_crc"
COVERED = (*(f"{name}_{axis}" for name in _PER_AXIS for axis in "xyz"),
           "reference_temperature", "calibration_date")  # fmt: skip
"""The calibration registers that the checksum covers, in its order."""
CALIBRATION = (*COVERED, CRC)

_INTEGERS: dict[str, Literal["uint16", "uint32"]] = {"calibration_date": "uint32", CRC: "uint16"}

TABLE: Mapping[str, Entry] = {
    "vendor_id": Entry("uint32", "ro"),
    "product_code": Entry("uint32", "ro"),
    "firmware_version": Entry("uint32", "ro"),
    "serial_number": Entry("uint32", "ro"),
    "status": Entry("uint16", "ro"),
    "write_counter": Entry("uint32", "ro"),
    "unlock_key": Entry("uint16", "wo"),
    "store": Entry("uint32", "wo"),
    "reset": Entry("uint16", "wo"),
    **{name: Entry(_INTEGERS.get(name, "float32"), "rw") for name in CALIBRATION},
    **{"stored_" + name: Entry(_INTEGERS.get(name, "float32"), "ro") for name in CALIBRATION},
}
"""Every register of the unit by name; ``stored_`` + name mirrors the stored
copy."""


def checksum(copy: Mapping[str, bytes]) -> bytes:
    """The calibration_crc that belongs to a copy of the calibration registers,
    as raw bytes."""
    return crc("crc-16/modbus", b"".join(copy[name] for name in COVERED)).to_bytes(2, "big")


def factory_calibration() -> dict[str, bytes]:
    """The nominal scale factor and the reference temperature; nothing else,
    dated 1970-01-01."""
    values = {f"scale_factor_{axis}": -2.4 for axis in "xyz"} | {"reference_temperature": 25.0}
    copy = {name: TABLE[name].encode(values.get(name, 0.0)) for name in COVERED}
    return copy | {CRC: checksum(copy)}


@dataclass(frozen=True)
class Stored:
    """The stored copy: calibration registers as raw bytes, times stored, and
    whether it was read whole."""

    calibration: Mapping[str, bytes]
    write_counter: int = 0
    intact: bool = True

    @property
    def valid(self) -> bool:
        return self.intact and checksum(self.calibration) == self.calibration[CRC]

    def image(self) -> bytes:
        """The bytes of the EEPROM: calibration registers in order, write
        counter, CRC-32 over both."""
        body = b"".join(self.calibration[name] for name in CALIBRATION) + self.write_counter.to_bytes(4, "big")
        return body + zlib.crc32(body).to_bytes(4, "big")

    @staticmethod
    def from_image(image: bytes) -> Stored:
        """What the unit finds at start-up. An image that is damaged, or of
        another length, is not intact."""
        sizes = [TABLE[name].size for name in CALIBRATION]
        expected = sum(sizes) + 8
        whole = image[:expected].ljust(expected, b"\xff")  # an erased cell reads as ones
        copy, at = {}, 0
        for name, size in zip(CALIBRATION, sizes, strict=True):
            copy[name] = whole[at : at + size]
            at += size
        intact = len(image) == expected and zlib.crc32(whole[:-4]).to_bytes(4, "big") == whole[-4:]
        return Stored(copy, int.from_bytes(whole[at : at + 4], "big"), intact)
