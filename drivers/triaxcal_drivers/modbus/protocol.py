"""The Modbus application protocol as far as it is used here: names, errors, and
what a unit answers. No I/O."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Literal, Protocol

from triaxcal_drivers.errors import DeviceSilent, DriverError

READ_HOLDING, READ_INPUT, WRITE_SINGLE, WRITE_MULTIPLE = 3, 4, 6, 16
ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE, DEVICE_FAILURE = 1, 2, 3, 4
MAX_READ_WORDS, MAX_WRITE_WORDS = 125, 123
_REASONS = {
    1: "illegal function",
    2: "illegal data address",
    3: "illegal data value",
    4: "device failure",
    5: "acknowledged, still busy",
    6: "device busy",
    8: "memory parity error",
    10: "gateway path unavailable",
    11: "gateway target device failed to respond",
}
GATEWAY_CODES = frozenset({0x0A, 0x0B})
"""Exceptions of a gateway that has not reached the unit, or had no answer from it. The
unit may have carried out the request, and has refused nothing."""


class ModbusRefusal(DriverError):
    """The device answered with an exception. ``code`` is the protocol's."""

    def __init__(self, code: int) -> None:
        super().__init__(f"exception 0x{code:02X} ({_REASONS.get(code, 'unknown')})")
        self.code = code


class MalformedReply(DriverError):
    """A reply of the wrong function, length or address. ``pdu`` is that reply, function
    code first."""

    def __init__(self, message: str, pdu: bytes) -> None:
        super().__init__(message)
        self.pdu = pdu


class Misanswered(DeviceSilent):
    """Other bytes than the reply came during the time-out."""


class DamagedReply(Misanswered):
    """Noise damaged the reply to a read: other bytes came, and then the line was
    silent. Raised before the time-out."""


@dataclass(frozen=True)
class TcpAddress:
    """``port`` 0 means any free port, for a unit that this process serves."""

    host: str
    port: int


@dataclass(frozen=True)
class SerialLine:
    """A serial port and its settings; 8 data bits, as RTU demands."""

    port: str
    baudrate: int = 19200
    parity: Literal["N", "E", "O"] = "E"
    stopbits: Literal[1, 2] = 1

    @property
    def frame_gap_s(self) -> float:
        """The silence that separates RTU frames: 3.5 characters, 1.75 ms above
        19200 baud."""
        return 1.75e-3 if self.baudrate > 19200 else 3.5 * self.character_s

    @property
    def character_s(self) -> float:
        """A byte on the line: start bit, eight data bits, parity and stop bits."""
        return (9 + (self.parity != "N") + self.stopbits) / self.baudrate

    @property
    def settings(self) -> str:
        return f"{self.baudrate} baud, parity {self.parity}, {self.stopbits} stop bits"

    def read_s(self, words: int) -> float:
        """Shortest time [s] for which a read of so many registers occupies the line:
        its request, its reply and their gaps, for a unit that answers at once."""
        request, reply = 8, 5 + 2 * words
        return (request + reply) * self.character_s + 2 * self.frame_gap_s


def read_reply_bytes(pdu: bytes) -> int | None:
    """Length of the RTU frame that answers a read; None for other requests."""
    return 5 + 2 * int.from_bytes(pdu[3:5], "big") if pdu[0] in (READ_HOLDING, READ_INPUT) else None


class Unanswered(Exception):
    """Raised by a handler whose unit leaves this request without a reply."""


class Handler(Protocol):
    """A served unit. It answers no request while ``alive`` is False."""

    def alive(self) -> bool: ...

    def read(self, function: int, address: int, count: int) -> bytes:
        """2·count bytes. Raises ModbusRefusal, Unanswered."""

    def write(self, address: int, data: bytes) -> None:
        """Raises ModbusRefusal, Unanswered."""


def answer(handler: Handler, pdu: bytes) -> bytes:
    """The reply PDU to a request PDU; an exception if the request is wrong or
    refused."""
    try:
        return _carry_out(handler, pdu)
    except ModbusRefusal as e:
        return bytes([pdu[0] | 0x80, e.code])


def _carry_out(handler: Handler, pdu: bytes) -> bytes:
    function, body = pdu[0], pdu[1:]
    if function not in (READ_HOLDING, READ_INPUT, WRITE_SINGLE, WRITE_MULTIPLE):
        raise ModbusRefusal(ILLEGAL_FUNCTION)
    if len(body) < 4:
        raise ModbusRefusal(ILLEGAL_VALUE)
    address, number = struct.unpack(">HH", body[:4])
    if function in (READ_HOLDING, READ_INPUT):
        if not 1 <= number <= MAX_READ_WORDS:
            raise ModbusRefusal(ILLEGAL_VALUE)
        return bytes([function, 2 * number]) + handler.read(function, address, number)
    if function == WRITE_SINGLE:
        handler.write(address, body[2:4])
        return pdu
    data = body[5:]
    if not (1 <= number <= MAX_WRITE_WORDS and body[4:5] == bytes([2 * number]) and len(data) == 2 * number):
        raise ModbusRefusal(ILLEGAL_VALUE)
    handler.write(address, data)
    return pdu[:5]
