"""What a Modbus unit answers: request PDUs to reply PDUs, written from the application protocol. No I/O."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from tests.devices.memory import Electronics, Refused, Silent
from tests.devices.motion import Motion
from tests.devices.place import Exchange, Place

READ_HOLDING, READ_INPUT, WRITE_SINGLE, WRITE_MULTIPLE = 3, 4, 6, 16
READINGS, CORRECTED, BLOCK_WORDS, AXIS_WORDS = 0x0000, 0x0040, 6, 2
"""Input registers: x, y, z of two words each, read from their first word on."""
EXCEPTIONS = {
    "unknown": 2, "read-only": 2, "write-only": 2, "length": 3, "value": 3, "locked": 4, "failed": 4, "busy": 6,
}  # fmt: skip
ILLEGAL_FUNCTION = 1


@dataclass(frozen=True)
class ModbusUnit:
    """The unit at a place, as it answers PDUs."""

    place: Place
    motion: Motion | None = None

    def exchange(self, pdu: bytes, now: float) -> Exchange:
        return self.place.exchange(
            now,
            lambda unit: _Answer(unit, self.motion, now).to(pdu),
            lambda refused: bytes([pdu[0] | 0x80, refused.code or EXCEPTIONS[refused.why]]),
        )


@dataclass(frozen=True)
class _Answer:
    unit: Electronics
    motion: Motion | None
    now: float

    def to(self, pdu: bytes) -> tuple[bytes, float]:
        """The reply and how long it takes. Raises Refused, Silent."""
        function = pdu[0]
        if function not in (READ_HOLDING, READ_INPUT, WRITE_SINGLE, WRITE_MULTIPLE):
            raise Refused("failed", ILLEGAL_FUNCTION)
        if function == self.unit.habits.lacks_function:
            raise Silent if self.unit.habits.when_lacking == "silent" else Refused("failed", ILLEGAL_FUNCTION)
        if len(pdu) < 5:
            raise Refused("length")
        address, number = struct.unpack(">HH", pdu[1:5])
        if function == WRITE_SINGLE:
            return pdu, self._write(address, pdu[3:5])
        if function == WRITE_MULTIPLE:
            data = pdu[6:]
            if not 1 <= number <= 123 or pdu[5:6] != bytes([2 * number]) or len(data) != 2 * number:
                raise Refused("length")
            return pdu[:5], self._write(address, data)
        if not 1 <= number <= 125:
            raise Refused("length")
        data = self._input(address, number) if function == READ_INPUT else self._holding(address, number)
        return bytes([function, len(data)]) + data, 0.0

    def _holding(self, address: int, count: int) -> bytes:
        names = self._covered(address, count)
        return b"".join(self._shown(name) for name in names)

    def _shown(self, name: str) -> bytes:
        """Text keeps its registers in order."""
        raw = self.unit.read(name, self.now)
        if self.unit.table[name].type != "ascii":
            return self._swapped(self._ordered(raw))
        return self._swapped(raw)

    def _swapped(self, raw: bytes) -> bytes:
        if self.unit.habits.byte_order == "big":
            return raw
        return b"".join(raw[i : i + 2][::-1] for i in range(0, len(raw), 2))

    def _write(self, address: int, data: bytes) -> float:
        longest = 0.0
        for name in self._covered(address, len(data) // 2):
            size = self.unit.table[name].size
            longest = max(longest, self.unit.write(name, self._ordered(self._swapped(data[:size])), self.now))
            data = data[size:]
        return longest

    def _covered(self, address: int, count: int) -> list[str]:
        """The registers that lie in the block, which may neither cut one nor have a gap."""
        starts = {entry.address: name for name, entry in self.unit.table.items()}
        names, end = [], address + count
        while address < end:
            if address not in starts:
                raise Refused("unknown")
            names.append(starts[address])
            address += self.unit.table[names[-1]].words
        if address > end:
            raise Refused("unknown")
        return names

    def _input(self, address: int, count: int) -> bytes:
        if self.motion is None:
            raise Refused("unknown")
        if address in self.motion.beside and count == 1:
            return self._swapped(struct.pack(">H", self.motion.beside[address](self.now)))
        start = next((at for at in (READINGS, CORRECTED) if at <= address < at + BLOCK_WORDS), address)
        begins = range(0, BLOCK_WORDS, AXIS_WORDS) if self.motion.apart else (0,)
        if start not in (READINGS, CORRECTED) or address - start not in begins:
            raise Refused("unknown")
        if count > (AXIS_WORDS if self.motion.apart else BLOCK_WORDS):
            raise Refused("unknown")
        triple = self.motion.shown if start == READINGS else self.motion.corrected
        shown = b"".join(map(self._ordered, self.motion.encode(triple(self.unit, self.now))))
        return self._swapped(shown)[2 * (address - start) :][: 2 * count]

    def _ordered(self, raw: bytes) -> bytes:
        if self.unit.habits.word_order == "big":
            return raw
        return b"".join(raw[i : i + 2] for i in range(len(raw) - 2, -1, -2))


def damaged_pdu(pdu: bytes, garbage: str) -> bytes:
    """With another function, or a byte too short. Other garbage is the framing's."""
    if garbage == "function":
        return bytes([pdu[0] + 1]) + pdu[1:]
    return pdu[:-1] if garbage == "length" else pdu
