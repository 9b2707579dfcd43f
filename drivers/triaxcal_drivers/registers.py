"""Numbers to raw bytes and back: the types of raw numbers that a register, or a
field of a stream, holds, and what a register's format costs.

`TYPES` is the one table of types. What a profile may declare, its JSON Schema,
the bytes written and read, the samples decoded and the page of the reference
all come from it. The types' bytes are most significant first. No I/O.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from triaxcal_drivers.errors import RegisterValueError

WORD = 2
"""Bytes of a Modbus register."""


class RegisterType(Protocol):
    """A type of raw numbers, of ``size`` bytes."""

    @property
    def size(self) -> int: ...
    @property
    def lowest(self) -> float: ...
    @property
    def highest(self) -> float: ...

    def encode(self, raw: float) -> bytes:
        """The number nearest to ``raw``. Raises OverflowError or ValueError
        where there is none."""

    def decode(self, data: bytes) -> float:
        """The number that ``size`` bytes hold; an int where the type holds
        whole numbers."""

    def decode_all(self, data: NDArray[np.uint8]) -> NDArray[Any]:
        """The numbers (n,) that rows of bytes (n, size) hold."""

    def step(self, raw: float) -> float:
        """How far apart the numbers near ``raw`` are."""


@dataclass(frozen=True)
class Integer:
    """Integers of up to 8 bytes, signed ones in two's complement."""

    size: int
    signed: bool

    @property
    def lowest(self) -> int:
        return -(1 << 8 * self.size - 1) if self.signed else 0

    @property
    def highest(self) -> int:
        return (1 << 8 * self.size - self.signed) - 1

    def encode(self, raw: float) -> bytes:
        return round(raw).to_bytes(self.size, "big", signed=self.signed)

    def decode(self, data: bytes) -> int:
        return int.from_bytes(data, "big", signed=self.signed)

    def decode_all(self, data: NDArray[np.uint8]) -> NDArray[Any]:
        wide = np.zeros((len(data), 8), np.uint8)
        if self.signed:
            wide[data[:, 0] >= 0x80] = 0xFF
        wide[:, 8 - self.size :] = data
        return wide.view(">i8" if self.signed else ">u8")[:, 0]

    def step(self, raw: float) -> float:
        return 1.0


@dataclass(frozen=True)
class Floating:
    """IEEE 754 numbers: ``code`` is the letter of `struct`, ``digits`` the bits
    of the significand."""

    code: str
    digits: int

    @property
    def size(self) -> int:
        return struct.calcsize(self.code)

    @property
    def lowest(self) -> float:
        return -self.highest

    @property
    def highest(self) -> float:
        return float(np.finfo(self.code).max)

    def encode(self, raw: float) -> bytes:
        data = struct.pack(">" + self.code, raw)
        if not math.isfinite(self.decode(data)):
            raise OverflowError
        return data

    def decode(self, data: bytes) -> float:
        return float(struct.unpack(">" + self.code, data)[0])

    def decode_all(self, data: NDArray[np.uint8]) -> NDArray[Any]:
        return np.ascontiguousarray(data).view(">" + self.code)[:, 0]

    def step(self, raw: float) -> float:
        normal = math.ulp(raw) * 2.0 ** (53 - self.digits)  # a float of Python has 53
        return max(normal, float(np.finfo(self.code).smallest_subnormal))


TYPES: Mapping[str, RegisterType] = {
    "int8": Integer(1, signed=True),
    "uint8": Integer(1, signed=False),
    "int16": Integer(2, signed=True),
    "uint16": Integer(2, signed=False),
    "int24": Integer(3, signed=True),
    "uint24": Integer(3, signed=False),
    "int32": Integer(4, signed=True),
    "uint32": Integer(4, signed=False),
    "int64": Integer(8, signed=True),
    "uint64": Integer(8, signed=False),
    "float32": Floating("f", 24),
    "float64": Floating("d", 53),
}


ASCII = "ascii"
"""Text, one byte a character: no number, and not in `TYPES`."""


def in_words(name: str) -> bool:
    """Whether the type fills registers of 16 bits, as on Modbus."""
    return TYPES[name].size % WORD == 0


def counts(name: str) -> bool:
    """Whether the type can be a counter's or a clock's: it fills registers and
    wraps to zero."""
    type_ = TYPES[name]
    return in_words(name) and isinstance(type_, Integer) and not type_.signed


def next_in_words(name: str) -> str | None:
    """The shortest longer type of the same kind that fills registers of 16
    bits."""
    short = TYPES[name]

    def serves(other: RegisterType) -> bool:
        alike = type(other) is type(short) and (other.lowest < 0) == (short.lowest < 0)
        return alike and other.size > short.size and other.size % WORD == 0

    longer = [other for other in TYPES if serves(TYPES[other])]
    return min(longer, key=lambda other: TYPES[other].size, default=None)


if TYPE_CHECKING:
    RawType = str
    RegisterKind = str
    WordType = str
    TimeType = str
    CounterType = str
else:
    RawType = Literal[tuple(TYPES)]
    """A number that a register of a profile may hold."""
    RegisterKind = Literal[(*TYPES, ASCII)]
    """What a register of a profile may be."""
    WordType = Literal[tuple(filter(in_words, TYPES))]
    """What a register or channel on Modbus may be."""
    TimeType = Literal[tuple(filter(counts, TYPES))]
    """What a device's time stamp may be."""
    CounterType = Literal[tuple(name for name in TYPES if counts(name) and TYPES[name].size <= 4)]
    """What a sample counter may be: one of 2^32 samples turns once in decades."""


ByteOrder = Literal["big", "little"]


class Format(Protocol):
    """What a register's bytes mean; `triaxcal_drivers.profile.Register` is one."""

    @property
    def type(self) -> str: ...
    @property
    def length(self) -> int | None: ...
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


def size_of(register: Format) -> int:
    """Bytes that the register holds; of a text, the most."""
    return register.length or 0 if register.type == ASCII else TYPES[register.type].size


def text(register: Format, raw: bytes, *, name: str) -> str:
    """What a register of type "ascii" holds, without the NULs and spaces that fill
    it up. Raises RegisterValueError on too many bytes, and on others than
    printable characters."""
    if len(raw) > size_of(register):
        raise RegisterValueError(f"register {name}: {len(raw)} bytes, expected {size_of(register)} ({ASCII})")
    found = raw.decode("ascii", "replace").strip("\0 ")
    if not (found.isascii() and found.isprintable()):
        raise RegisterValueError(
            f"register {name}: {raw.hex()} is no text of printable ASCII characters: check its address, length and "
            "byte_order"
        )
    return found


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
    _require_number(register, name)
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
    return isinstance(TYPES.get(register.type), Integer) and register.scale % 1 == 0 and register.offset % 1 == 0


def _number(register: Format, raw: bytes, order: ByteOrder, name: str) -> float:
    _require_number(register, name)
    type_ = TYPES[register.type]
    if len(raw) != type_.size:
        raise RegisterValueError(f"register {name}: {len(raw)} bytes, expected {type_.size} ({register.type})")
    return type_.decode(raw if order == "big" else raw[::-1])


def _require_number(register: Format, name: str) -> None:
    if register.type == ASCII:
        raise RegisterValueError(f"register {name}: its type is ascii, which is no number")


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
