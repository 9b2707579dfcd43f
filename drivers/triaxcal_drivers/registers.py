"""Numbers to raw register bytes and back, and what the register's format costs. No I/O."""

from __future__ import annotations

import math
import struct
import zlib
from typing import Literal, Protocol

from triaxcal_drivers.errors import RegisterValueError

ByteOrder = Literal["big", "little"]
_FORMATS = {
    "int16": "h", "uint16": "H", "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q",
    "float32": "f", "float64": "d",
}  # fmt: skip
SIZES = {"int24": 3, "uint24": 3} | {name: struct.calcsize(code) for name, code in _FORMATS.items()}


class Format(Protocol):
    """What a register's bytes mean; `triaxcal_drivers.profile.Register` is one."""

    @property
    def type(self) -> str: ...
    @property
    def unit(self) -> str: ...
    @property
    def scale(self) -> float: ...
    @property
    def offset(self) -> float: ...
    @property
    def minimum(self) -> float | None: ...
    @property
    def maximum(self) -> float | None: ...


def encode(register: Format, value: float, *, order: ByteOrder, name: str) -> bytes:
    """``value`` in the register's unit as raw bytes, most or least significant first.

    Raises RegisterValueError where it is outside the register's limits or type.
    """
    for bound, outside in ((register.minimum, value < (register.minimum or 0)),
                           (register.maximum, value > (register.maximum or 0))):  # fmt: skip
        if bound is not None and outside:
            raise RegisterValueError(
                f"register {name}: {value:g} {register.unit} is outside its limits "
                f"{register.minimum} to {register.maximum}"
            )
    raw = (value - register.offset) / register.scale
    try:
        if register.type.startswith("float"):
            data = struct.pack(">" + _FORMATS[register.type], raw)
            if struct.unpack(">" + _FORMATS[register.type], data)[0] in (float("inf"), float("-inf")) or raw != raw:
                raise OverflowError
        elif register.type.endswith("24"):
            data = round(raw).to_bytes(3, "big", signed=register.type == "int24")
        else:
            data = struct.pack(">" + _FORMATS[register.type], round(raw))
    except (OverflowError, struct.error, ValueError) as e:
        raise RegisterValueError(f"register {name}: {value!r} does not fit {register.type}") from e
    return data if order == "big" else data[::-1]


def step(register: Format, value: float) -> float:
    """How far apart the numbers are that a register can hold near ``value``, in its unit."""
    if not register.type.startswith("float"):
        return abs(register.scale)
    raw = abs((value - register.offset) / register.scale)
    digits = 24 if register.type == "float32" else 53
    return abs(register.scale) * math.ulp(raw) * 2.0 ** (53 - digits)


def decode(register: Format, raw: bytes, *, order: ByteOrder, name: str) -> float:
    """Raw bytes as a value in the register's unit. Raises RegisterValueError on a wrong length."""
    if len(raw) != SIZES[register.type]:
        raise RegisterValueError(
            f"register {name}: {len(raw)} bytes, expected {SIZES[register.type]} ({register.type})"
        )
    data = raw if order == "big" else raw[::-1]
    if register.type.endswith("24"):
        number: float = int.from_bytes(data, "big", signed=register.type == "int24")
    else:
        number = struct.unpack(">" + _FORMATS[register.type], data)[0]
    if register.scale == 1.0 and register.offset == 0.0:
        return number
    return number * register.scale + register.offset


def crc(algorithm: str, data: bytes) -> int:
    """``crc-16/modbus`` (reflected 0x8005, initial 0xFFFF; check value 0x4B37) or ``crc-32`` (zlib's)."""
    if algorithm == "crc-32":
        return zlib.crc32(data)
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = (value >> 1) ^ (0xA001 if value & 1 else 0)
    return value
