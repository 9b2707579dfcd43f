"""A Modbus RTU server on a pseudo-terminal, with its own CRC."""

from __future__ import annotations

import os
import select
import tty
from collections.abc import Mapping
from itertools import groupby
from typing import Any

from tests.devices.modbus import WRITE_MULTIPLE, ModbusUnit, damaged_pdu
from tests.devices.place import Reply
from tests.devices.serving import LOOK_UP_S, Serving
from tests.devices.table import crc16

GARBAGE = ("checksum", "function", "length", "unit", "truncated", "noise")
NOISE = bytes.fromhex("ff00 55aa 0001 fe")
BAUDRATE = 115200
"""A pseudo-terminal takes any; above 19200 the gap between frames is 1.75 ms, which tests like."""


class ModbusRtu(Serving):
    """``path`` is the line's other end."""

    def __init__(self, unit: ModbusUnit, *, unit_id: int = 1) -> None:
        super().__init__()
        self.unit = unit
        self.unit_id = unit_id
        self.path = ""
        self._buffer = b""
        self._last_byte_s = 0.0

    @property
    def bus(self) -> Mapping[str, Any]:
        """Where a master finds it, as a station file says it."""
        return {"serial_port": self.path, "baudrate": BAUDRATE, "parity": "N", "unit_id": self.unit_id}

    def _open(self) -> None:
        # The other end stays open here too, or a master that closes it would make reading fail.
        self._line, self._other_end = os.openpty()
        tty.setraw(self._other_end)
        self.path = os.ttyname(self._other_end)
        self._woken, self._alarm = os.pipe()

    def _close(self) -> None:
        for descriptor in (self._line, self._other_end, self._woken, self._alarm):
            os.close(descriptor)

    def _wake(self) -> None:
        os.write(self._alarm, b"!")

    def _hear(self, patience_s: float) -> bool:
        ready, _, _ = select.select([self._line, self._woken], [], [], patience_s)
        if self._line not in ready:
            return False
        if self.now() > self._last_byte_s + LOOK_UP_S:
            self._buffer = b""  # a silence ends a frame, whole or not
        self._buffer += os.read(self._line, 4096)
        self._last_byte_s = self.now()
        while frame := self._next_frame():
            self._answer(frame)
        return True

    def _next_frame(self) -> bytes | None:
        buffer = self._buffer
        if len(buffer) < 8:
            return None
        length = 9 + buffer[6] if buffer[1] == WRITE_MULTIPLE else 8
        if len(buffer) < length:
            return None
        frame, self._buffer = buffer[:length], buffer[length:]
        if crc16(frame[:-2]) != int.from_bytes(frame[-2:], "little"):
            self._buffer = b""
            return None
        return frame

    def _answer(self, frame: bytes) -> None:
        if frame[0] != self.unit_id:
            return
        replies = self.unit.exchange(frame[1:-2], self.now()).replies
        # What comes twice comes in one piece: on a busy machine the second would answer the next request.
        for (after_s, out), same in groupby((reply.after_s, self.framed(reply)) for reply in replies):
            piece = out * len(list(same))
            self.later(after_s, lambda piece=piece: self._send(piece))  # type: ignore[misc]

    def _send(self, out: bytes) -> None:
        os.write(self._line, out)

    def framed(self, reply: Reply) -> bytes:
        """The reply with address and CRC, damaged as it asks."""
        if reply.garbage is not None and reply.garbage not in GARBAGE:
            raise ValueError(f"Modbus RTU has no garbage '{reply.garbage}', only {', '.join(GARBAGE)}")
        if reply.garbage == "noise":
            return NOISE
        frame = bytes([self.unit_id + (reply.garbage == "unit")]) + damaged_pdu(reply.data, reply.garbage or "")
        frame += (crc16(frame) ^ 0xFF00 * (reply.garbage == "checksum")).to_bytes(2, "little")
        return frame[: 3 if reply.garbage == "truncated" else None]
