"""Numbers to raw register bytes and back, and what the register's format costs.
No I/O."""

from __future__ import annotations

import zlib
from typing import Literal, Protocol

from triaxcal_drivers.errors import RegisterValueError
from triaxcal_drivers.register_types import TYPES

ByteOrder = Literal["big", "little"]


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
    """``value`` in the register's unit as raw bytes, most or least significant
    first.

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
        data = TYPES[register.type].encode(raw)
    except (OverflowError, ValueError) as e:
        raise RegisterValueError(f"register {name}: {value!r} does not fit {register.type}") from e
    return data if order == "big" else data[::-1]


def step(register: Format, value: float) -> float:
    """How far apart the numbers are that a register can hold near ``value``, in
    its unit."""
    return abs(register.scale) * TYPES[register.type].step((value - register.offset) / register.scale)


def decode(register: Format, raw: bytes, *, order: ByteOrder, name: str) -> float:
    """Raw bytes as a value in the register's unit. Raises RegisterValueError on
    a wrong length."""
    type_ = TYPES[register.type]
    if len(raw) != type_.size:
        raise RegisterValueError(f"register {name}: {len(raw)} bytes, expected {type_.size} ({register.type})")
    number = type_.decode(raw if order == "big" else raw[::-1])
    if register.scale == 1.0 and register.offset == 0.0:
        return number
    return number * register.scale + register.offset


def crc(algorithm: str, data: bytes) -> int:
    """``crc-16/modbus`` (reflected 0x8005, initial 0xFFFF; check value 0x4B37)
    or ``crc-32`` (zlib's)."""
    if algorithm == "crc-32":
        return zlib.crc32(data)
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = (value >> 1) ^ (0xA001 if value & 1 else 0)
    return value
