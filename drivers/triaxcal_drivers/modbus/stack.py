"""Modbus over TCP and serial lines: the one file that knows pymodbus.

pymodbus frames (MBAP, RTU with its CRC), encodes requests and drives the serial
port. Its client and server are not used: the client closes the connection on a
reply that it cannot decode, where ours hands the bytes on; the server can
neither stay silent for a while nor refuse a bad count in the protocol's terms.
What leaves this file is plain bytes and our own errors.
"""

from __future__ import annotations

import asyncio
import logging
import os
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager, suppress
from typing import cast

from pymodbus.exceptions import ModbusException
from pymodbus.framer import FramerBase, FramerRTU, FramerSocket
from pymodbus.pdu import DecodePDU, ModbusPDU
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    ReadInputRegistersRequest,
    WriteMultipleRegistersRequest,
    WriteSingleRegisterRequest,
)
from pymodbus.transport.serialtransport import create_serial_connection

from triaxcal_drivers.errors import BusError
from triaxcal_drivers.modbus.protocol import READ_INPUT, Handler, SerialLine, TcpAddress, Unanswered, answer

_SETTINGS_REFUSED: tuple[type[Exception], ...] = ()
with suppress(ImportError):  # there is none outside POSIX
    import termios

    _SETTINGS_REFUSED = (termios.error,)  # not an OSError

_MAX_ADU = 260
# Silent where the application has not set up logging: what matters comes out as
# an error.
logging.getLogger("pymodbus").addHandler(logging.NullHandler())


Received = Callable[["Link", int, int, bytes], None]


class Link(asyncio.Protocol):
    """Bytes of one connection cut into frames, each handed on as (unit,
    transaction, PDU)."""

    def __init__(self, framer: FramerBase, received: Received) -> None:
        self.framer = framer
        self.transport: asyncio.Transport | None = None
        self.last_byte_s = 0.0
        self.lost: Callable[[], None] = lambda: None
        self._received = received
        self._buffer = b""
        self._sent, self._head, self._came = b"", b"", 0
        self.sent_s = 0.0

    @property
    def bytes_came(self) -> int:
        """Since the last request."""
        return self._came

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast(asyncio.Transport, transport)

    def connection_lost(self, exc: Exception | None) -> None:
        self.transport = None
        self.lost()

    def data_received(self, data: bytes) -> None:
        self.last_byte_s = asyncio.get_running_loop().time()
        self._head += data[: len(self._sent) - len(self._head)]
        self._came += len(data)
        self._buffer += data
        while self._buffer:
            try:
                used, unit, transaction, pdu = self.framer.decode(self._buffer)
            except ModbusException:  # a function whose frame length pymodbus cannot tell
                self.forget()
                return
            if not used:
                break
            self._buffer = self._buffer[used:]
            if pdu:
                self._received(self, unit, transaction, pdu)
        foreign = isinstance(self.framer, FramerSocket) and self._buffer[2:4].strip(b"\0")
        if foreign or len(self._buffer) > _MAX_ADU:
            self.forget()

    def forget(self) -> None:
        """Drop bytes that have not become a frame."""
        self._buffer = b""

    def send(self, unit: int, transaction: int, pdu: bytes) -> None:
        if self.transport is not None:
            self._sent, self._head, self._came = self.framer.encode(pdu, unit, transaction), b"", 0
            self.sent_s = asyncio.get_running_loop().time()
            self.transport.write(self._sent)

    def came(self) -> str | None:
        """What bytes have come since the last request, in words; None where
        none have."""
        if not self._came:
            return None
        if self._head == self._sent:
            return "what is sent comes back: the adapter echoes"
        return f"{self._came} bytes came, and no whole reply"

    def close(self) -> None:
        if self.transport is not None:
            self.transport.close()
            self.transport = None


async def connect_tcp(address: TcpAddress, received: Received) -> Link:
    """A connection to a unit or a gateway. Raises OSError."""
    loop = asyncio.get_running_loop()
    _, link = await loop.create_connection(
        lambda: Link(FramerSocket(DecodePDU(False)), received), address.host, address.port
    )
    return link


async def connect_serial(line: SerialLine, received: Received) -> Link:
    """A serial port, as the master of its line. Raises BusError where it cannot
    be opened."""
    return await _open_serial(line, lambda: Link(FramerRTU(DecodePDU(False)), received))


def read_request(function: int, address: int, count: int) -> bytes:
    """The PDU that asks for ``count`` registers."""
    kind = ReadInputRegistersRequest if function == READ_INPUT else ReadHoldingRegistersRequest
    return _pdu(kind(address=address, count=count))


def write_request(address: int, words: Sequence[int], *, single: bool) -> bytes:
    """The PDU that writes registers; ``single`` writes one word with function
    6."""
    if single:
        return _pdu(WriteSingleRegisterRequest(address=address, registers=list(words[:1])))
    return _pdu(WriteMultipleRegistersRequest(address=address, registers=list(words)))


def _pdu(request: ModbusPDU) -> bytes:
    return bytes([request.function_code]) + request.encode()


@asynccontextmanager
async def serve_tcp(units: Mapping[int, Handler], address: TcpAddress) -> AsyncIterator[int]:
    """Serves units by their ids over TCP and gives the port listened on. Raises
    BusError."""
    links: set[Link] = set()

    def accept() -> Link:
        link = Link(FramerSocket(DecodePDU(True)), _answering(units))
        link.lost = lambda: links.discard(link)
        links.add(link)
        return link

    try:
        server = await asyncio.get_running_loop().create_server(accept, address.host, address.port)
    except OSError as e:
        raise BusError(f"cannot listen on {address.host}:{address.port}: {reason_of(e)}") from e
    try:
        yield int(server.sockets[0].getsockname()[1])
    finally:
        server.close()
        for link in list(links):
            link.close()


@asynccontextmanager
async def serve_serial(units: Mapping[int, Handler], line: SerialLine) -> AsyncIterator[None]:
    """Serves units by their ids as RTU on a serial port. Raises BusError where
    it cannot be opened."""
    link = await _open_serial(line, lambda: Link(FramerRTU(DecodePDU(True)), _answering(units)))
    try:
        yield
    finally:
        link.close()


def _answering(units: Mapping[int, Handler]) -> Received:
    def received(link: Link, unit: int, transaction: int, pdu: bytes) -> None:
        handler = units.get(unit)
        if handler is not None and handler.alive():
            with suppress(Unanswered):
                link.send(unit, transaction, answer(handler, pdu))

    return received


async def _open_serial(line: SerialLine, make: Callable[[], Link]) -> Link:
    try:
        transport, link = await create_serial_connection(
            asyncio.get_running_loop(),
            make,
            line.port,
            baudrate=line.baudrate,
            bytesize=8,
            parity=line.parity,
            stopbits=line.stopbits,
            timeout=0,
        )
    except (OSError, ValueError) as e:
        raise BusError(f"cannot open {line.port}: {reason_of(e)}") from e
    except _SETTINGS_REFUSED as e:
        raise BusError(
            f"{line.port} does not take {line.baudrate} baud, parity {line.parity}, {line.stopbits} stop bits: "
            f"{reason_of(e)}"
        ) from e
    link = cast(Link, link)
    link.transport = transport  # the port is open; connection_made follows on the loop's next turn
    return link


def reason_of(e: Exception) -> str:
    """What an operating system's error says, without its number and the path it
    repeats."""
    if isinstance(e, OSError) and e.errno and e.errno > 0:
        return os.strerror(e.errno)
    return str(e.args[-1]) if e.args else type(e).__name__
