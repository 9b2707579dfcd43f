"""CAN messages and their signals, and the extraction of a signal from many frames at
once. No I/O."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

FIRST_BROADCAST = 240  # PDU format from which on a group has no destination (SAE J1939-21)
_FLOATS = {16: np.uint16, 32: np.uint32, 64: np.uint64}


@dataclass(frozen=True)
class Signal:
    """Up to 64 bits of a message, numbered as in a DBC file.

    Bit k is bit k % 8 (0 the least significant) of byte k // 8. ``start`` is
    the signal's least significant bit where it is little-endian, its most
    significant one where it is big-endian. ``selected`` says which frames of
    the message hold it; all of them where it is empty.
    """

    name: str
    start: int
    length: int
    big_endian: bool = False
    signed: bool = False
    is_float: bool = False
    scale: float = 1.0
    offset: float = 0.0
    selected: tuple[Selection, ...] = ()

    def _place(self) -> tuple[range, int]:
        """The bytes it touches, least significant first, and how far it lies
        above their lowest bit."""
        if not self.big_endian:
            return range(self.start // 8, (self.start + self.length - 1) // 8 + 1), self.start % 8
        last = 8 * (self.start // 8) + 7 - self.start % 8 + self.length - 1  # counted from the first byte's top
        return range(last // 8, self.start // 8 - 1, -1), 7 - last % 8

    @property
    def size(self) -> int:
        """Bytes that a message must have to hold it."""
        return max(self._place()[0]) + 1

    def raw(self, data: NDArray[np.uint8]) -> NDArray[Any]:
        """The unscaled numbers (n,) in messages ``data`` (n, bytes): uint64,
        int64 or a float type."""
        places, shift = self._place()
        bits = np.zeros(len(data), dtype=np.uint64)
        for k, place in enumerate(places[:8]):
            bits |= data[:, place].astype(np.uint64) << np.uint64(8 * k)
        bits >>= np.uint64(shift)
        if len(places) == 9:
            bits |= data[:, places[8]].astype(np.uint64) << np.uint64(64 - shift)
        spare = np.uint64(64 - self.length)
        bits <<= spare
        if self.signed and not self.is_float:
            return bits.view(np.int64) >> np.int64(spare)
        bits >>= spare
        if self.is_float:
            narrow = bits.astype(_FLOATS[self.length])
            return narrow.view(f"f{self.length // 8}")
        return bits

    def values(self, data: NDArray[np.uint8]) -> NDArray[np.float64]:
        with np.errstate(over="ignore", invalid="ignore"):  # a scale may be any
            scaled: NDArray[np.float64] = self.raw(data).astype(np.float64) * self.scale + self.offset
        return scaled


@dataclass(frozen=True)
class Selection:
    """Frames whose ``selector``, unscaled, is in one of the ``ranges`` (first,
    last)."""

    selector: Signal
    ranges: tuple[tuple[int, int], ...]

    def holds(self, data: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """Which of the frames ``data`` (n, bytes) are selected."""
        found = self.selector.raw(data).astype(np.int64)
        held = np.zeros(len(data), dtype=bool)
        for first, last in self.ranges:
            held |= (first <= found) & (found <= last)
        return held

    def within(self, other: Selection) -> bool:
        """Whether ``other`` selects every frame that this one selects."""
        return self.selector.name == other.selector.name and all(
            any(low <= first and last <= high for low, high in other.ranges) for first, last in self.ranges
        )

    def apart_from(self, other: Selection) -> bool:
        return self.selector.name == other.selector.name and all(
            last < low or high < first for first, last in self.ranges for low, high in other.ranges
        )

    def __str__(self) -> str:
        ranges = (str(first) if first == last else f"{first}-{last}" for first, last in self.ranges)
        return f"{self.selector.name} = {', '.join(ranges)}"


def implied(signal: Signal, selected: Sequence[Selection]) -> bool:
    """Whether frames that are so ``selected`` hold the signal."""
    return all(any(given.within(needed) for given in selected) for needed in signal.selected)


@dataclass(frozen=True)
class Message:
    """A CAN message, or those of its frames that are ``selected``. Where it is
    ``per_node``, a unit at node N sends it as ``identifier`` + N; one of ``j1939``
    has its priority, its source and its destination in the identifier too.
    ``length`` in bytes, 0 where it is not known. One with a ``fault`` cannot be
    used: it is disabled, or its file does not say what it holds."""

    name: str
    identifier: int
    signals: Mapping[str, Signal]
    extended: bool = False
    per_node: bool = False
    length: int = 0
    fault: str = ""
    selected: tuple[Selection, ...] = ()
    j1939: bool = False

    @property
    def group(self) -> tuple[int, int]:
        """The bits of an identifier that say the parameter group (SAE J1939-21), and
        what they are here: without a destination, which some groups have in it."""
        bits = 0x3FFFF00 if self.identifier >> 16 & 0xFF >= FIRST_BROADCAST else 0x3FF0000
        return bits, self.identifier & bits

    @property
    def title(self) -> str:
        return f"{self.name} ({', '.join(map(str, self.selected))})" if self.selected else self.name

    def identifier_of(self, node_id: int) -> int:
        if self.j1939:
            return self.identifier & ~0xFF | node_id
        return self.identifier + node_id if self.per_node else self.identifier
