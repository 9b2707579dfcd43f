"""Numbers to raw register bytes and back, and what the register's format costs.
No I/O."""

from __future__ import annotations

import math
import zlib
from fractions import Fraction
from typing import Literal, Protocol

from triaxcal_drivers.errors import RegisterValueError
from triaxcal_drivers.register_types import TYPES, Whole

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
    first. Exact for whole numbers where the register `holds_integers`.

    Raises RegisterValueError where it is outside the register's limits or type.
    """
    for bound, outside in ((register.minimum, value < (register.minimum or 0)),
                           (register.maximum, value > (register.maximum or 0))):  # fmt: skip
        if bound is not None and outside:
            raise RegisterValueError(
                f"register {name}: {value:g} {register.unit} is outside its limits "
                f"{register.minimum} to {register.maximum}"
            )
    try:
        data = TYPES[register.type].encode(_unscaled(register, value))
    except (OverflowError, ValueError) as e:
        raise RegisterValueError(f"register {name}: {value!r} does not fit {register.type}") from e
    return data if order == "big" else data[::-1]


def step(register: Format, value: float) -> float:
    """How far apart the numbers are that a register can hold near ``value``, in
    its unit."""
    return abs(register.scale) * TYPES[register.type].step((value - register.offset) / register.scale)


def decode(register: Format, raw: bytes, *, order: ByteOrder, name: str) -> float:
    """Raw bytes as a value in the register's unit; an exact int where the
    register `holds_integers`. Raises RegisterValueError on a wrong length."""
    number = _number(register, raw, order, name)
    if holds_integers(register):
        return number * int(register.scale) + int(register.offset)
    if register.scale == 1.0 and register.offset == 0.0:
        return number
    return number * register.scale + register.offset


def raw_number(register: Format, raw: bytes, *, order: ByteOrder, name: str) -> int | None:
    """The number in the register as the device counts, without scale and
    offset: serial numbers and product codes are compared by it. None where the
    bytes are no number, as in an erased EEPROM. Raises RegisterValueError on a
    wrong length."""
    number = _number(register, raw, order, name)
    return round(number) if math.isfinite(number) else None


def holds_integers(register: Format) -> bool:
    """Whether every value of the register is an integer. Floats would round
    those from 2^53 on."""
    return isinstance(TYPES[register.type], Whole) and register.scale % 1 == 0 and register.offset % 1 == 0


def _number(register: Format, raw: bytes, order: ByteOrder, name: str) -> float:
    type_ = TYPES[register.type]
    if len(raw) != type_.size:
        raise RegisterValueError(f"register {name}: {len(raw)} bytes, expected {type_.size} ({register.type})")
    return type_.decode(raw if order == "big" else raw[::-1])


def _unscaled(register: Format, value: float) -> float:
    """``value`` as the device counts, not yet rounded to its type."""
    if holds_integers(register) and value % 1 == 0:
        return round(Fraction(int(value) - int(register.offset), int(register.scale)))
    return (value - register.offset) / register.scale


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
