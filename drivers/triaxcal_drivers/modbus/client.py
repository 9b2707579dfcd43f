"""One unit on a Modbus line: its registers read and written, and its replies
checked."""

from __future__ import annotations

import struct

from triaxcal_drivers.answers import Extra
from triaxcal_drivers.errors import BusError
from triaxcal_drivers.modbus.line import Line, join, leave
from triaxcal_drivers.modbus.protocol import (
    WRITE_MULTIPLE,
    WRITE_SINGLE,
    MalformedReply,
    ModbusRefusal,
    SerialLine,
    TcpAddress,
)
from triaxcal_drivers.modbus.stack import read_request, write_request


class ModbusClient:
    """To be had by `joined`. The line may have other units of this process."""

    def __init__(self, line: Line, unit_id: int, reply_timeout_s: float) -> None:
        self.where = f"{line.name} unit {unit_id}"
        self._line = line
        self._closed = False
        self._unit_id = unit_id
        self._reply_timeout_s = reply_timeout_s

    @classmethod
    async def joined(
        cls, where: TcpAddress | SerialLine, *, unit_id: int, reply_timeout_s: float, owed_s: float = 0.0
    ) -> ModbusClient:
        """``owed_s`` is what an earlier client of this unit still owed the
        line. Raises BusError where a connection is refused or not made in time,
        a port cannot be opened, or other units have it with other settings."""
        line = await join(where, reply_timeout_s)
        line.owe(unit_id, owed_s)
        return cls(line, unit_id, reply_timeout_s)

    @property
    def owed_s(self) -> float:
        return self._line.owed_s(self._unit_id)

    @property
    def attention_s(self) -> float:
        """Time [s] that goes on while this process looks at the line."""
        return self._line.attention.now_s()

    @property
    def own_s(self) -> float:
        """Time [s] that goes on while this unit has the line or could have it:
        the line's attention, less what other units took while a request of this
        one waited."""
        return self._line.attention.now_s() - self._line.waited_s(self._unit_id)

    @property
    def alone(self) -> bool:
        """Whether no other unit uses the line."""
        return self._line.users < 2

    def extra(self) -> list[Extra[tuple[int, int]]]:
        """The replies of the unit since the last call that no request
        explains."""
        return self._line.extra(self._unit_id)

    async def close(self) -> None:
        if not self._closed:
            self._closed = True
            self._line.forsake(self._unit_id)
            leave(self._line)

    async def read(self, function: int, address: int, count: int) -> bytes:
        """``count`` registers as 2·count bytes, as on the wire.

        Raises ModbusRefusal, MalformedReply, DeviceSilent (no reply in time),
        BusError (connection lost).
        """
        pdu = await self._transact(read_request(function, address, count))
        if pdu[0] != function or len(pdu) != 2 + 2 * count or pdu[1] != 2 * count:
            raise MalformedReply(
                f"{self.where}: reply to function {function} at 0x{address:04X} does not hold {count} words: "
                f"{pdu.hex(' ')}",
                pdu,
            )
        return pdu[2:]

    async def write(self, address: int, data: bytes, *, single: bool = False, timeout_s: float | None = None) -> None:
        """Register bytes, most significant of each word first; ``single``
        writes one word with function 6.

        ``timeout_s`` takes the place of the client's time-out. Raises as `read`
        does.
        """
        words = struct.unpack(f">{len(data) // 2}H", data)
        if single:
            echo = bytes([WRITE_SINGLE]) + struct.pack(">HH", address, words[0])
        else:
            echo = bytes([WRITE_MULTIPLE]) + struct.pack(">HH", address, len(words))
        pdu = await self._transact(write_request(address, words, single=single), timeout_s)
        if pdu != echo:
            raise MalformedReply(f"{self.where}: reply to a write at 0x{address:04X}: {pdu.hex(' ')}", pdu)

    async def _transact(self, request: bytes, timeout_s: float | None = None) -> bytes:
        if self._closed:
            raise BusError(f"{self.where}: the device is closed")
        patience_s = self._reply_timeout_s if timeout_s is None else timeout_s
        reply = await self._line.transact(self._unit_id, request, patience_s=patience_s, late_s=self._reply_timeout_s)
        if reply[0] == request[0] | 0x80 and len(reply) == 2:
            raise ModbusRefusal(reply[1])
        return reply
