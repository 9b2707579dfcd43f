"""The types of raw numbers: how a register or a field of a stream holds a
number in bytes.

`TYPES` is the one table of them. What a profile may declare, its JSON Schema,
the bytes written and read, the samples decoded and the page of the reference
all come from it. Bytes are most significant first here. No I/O.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

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
class Whole:
    """Whole numbers of up to 8 bytes, signed ones in two's complement."""

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
    "int16": Whole(2, signed=True),
    "uint16": Whole(2, signed=False),
    "int24": Whole(3, signed=True),
    "uint24": Whole(3, signed=False),
    "int32": Whole(4, signed=True),
    "uint32": Whole(4, signed=False),
    "int64": Whole(8, signed=True),
    "uint64": Whole(8, signed=False),
    "float32": Floating("f", 24),
    "float64": Floating("d", 53),
}


def in_words(name: str) -> bool:
    """Whether the type fills registers of 16 bits, as on Modbus."""
    return TYPES[name].size % WORD == 0


def counts(name: str) -> bool:
    """Whether the type can be a counter's or a clock's: it fills registers and
    wraps to zero."""
    type_ = TYPES[name]
    return in_words(name) and isinstance(type_, Whole) and not type_.signed


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
    WordType = str
    TimeType = str
    CounterType = str
else:
    RawType = Literal[tuple(TYPES)]
    """What a register of a profile may be."""
    WordType = Literal[tuple(filter(in_words, TYPES))]
    """What a register or channel on Modbus may be."""
    TimeType = Literal[tuple(filter(counts, TYPES))]
    """What a device's time stamp may be."""
    CounterType = Literal[tuple(name for name in TYPES if counts(name) and TYPES[name].size <= 4)]
    """What a sample counter may be: one of 2^32 samples turns once in decades."""
