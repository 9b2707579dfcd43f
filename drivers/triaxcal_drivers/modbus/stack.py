"""Modbus over TCP and serial lines: the one file that knows pymodbus.

pymodbus frames (MBAP, RTU with its CRC), encodes requests and drives the serial port. Its client and server
are not used: the client closes the connection on a reply that it cannot decode, where ours hands the bytes
on; the server can neither stay silent for a while nor refuse a bad count in the protocol's terms.
What leaves this file is plain bytes and our own errors.
"""

from __future__ import annotations

import asyncio
import logging
import os
import struct
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
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

from triaxcal_drivers.attention import Attention
from triaxcal_drivers.errors import BusError, DeviceSilent
from triaxcal_drivers.modbus.protocol import (
    READ_INPUT,
    WRITE_MULTIPLE,
    WRITE_SINGLE,
    Handler,
    MalformedReply,
    ModbusRefusal,
    SerialLine,
    TcpAddress,
    Unanswered,
    answer,
)

_SETTINGS_REFUSED: tuple[type[Exception], ...] = ()
with suppress(ImportError):  # there is none outside POSIX
    import termios

    _SETTINGS_REFUSED = (termios.error,)  # not an OSError

_MAX_ADU = 260
# Silent where the application has not set up logging: what matters comes out as an error.
logging.getLogger("pymodbus").addHandler(logging.NullHandler())


class _Link(asyncio.Protocol):
    """Bytes of one connection cut into frames, each handed on as (unit, transaction, PDU)."""

    def __init__(self, framer: FramerBase, received: Callable[[_Link, int, int, bytes], None]) -> None:
        self.framer = framer
        self.transport: asyncio.Transport | None = None
        self.last_byte_s = 0.0
        self.lost: Callable[[], None] = lambda: None
        self._received = received
        self._buffer = b""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast(asyncio.Transport, transport)

    def connection_lost(self, exc: Exception | None) -> None:
        self.transport = None
        self.lost()

    def data_received(self, data: bytes) -> None:
        self.last_byte_s = asyncio.get_running_loop().time()
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
            self.transport.write(self.framer.encode(pdu, unit, transaction))

    def close(self) -> None:
        if self.transport is not None:
            self.transport.close()
            self.transport = None


class ModbusClient:
    """One connection to one unit; requests queue and go out one at a time. To be made in a running event loop.

    ``attention`` is what its time-outs count.
    """

    def __init__(self, where: str, unit_id: int, reply_timeout_s: float) -> None:
        self.where = where
        self.attention = Attention(asyncio.get_running_loop())
        self._unit_id = unit_id
        self._reply_timeout_s = reply_timeout_s
        self._lock = asyncio.Lock()
        self._frame_gap_s = 0.0
        self._quiet_until_s = 0.0
        self._transaction = 0
        self._expected: asyncio.Future[bytes] | None = None
        self._link: _Link

    @classmethod
    async def over_tcp(cls, address: TcpAddress, *, unit_id: int, reply_timeout_s: float) -> ModbusClient:
        """Raises BusError where the connection is refused or not made in time."""
        host, port = address.host, address.port
        client = cls(f"{host}:{port} unit {unit_id}", unit_id, reply_timeout_s)
        link = client._link = _Link(FramerSocket(DecodePDU(False)), client._on_frame)
        link.lost = client._on_lost
        with client._closed_unless_made():
            try:
                async with client.attention.timeout(reply_timeout_s):
                    await asyncio.get_running_loop().create_connection(lambda: link, host, port)
            except TimeoutError as e:
                raise BusError(f"cannot connect to {host}:{port}: no answer in {reply_timeout_s:g} s") from e
            except OSError as e:
                raise BusError(f"cannot connect to {host}:{port}: {_reason(e)}") from e
        return client

    @classmethod
    async def over_serial(
        cls, line: SerialLine, *, unit_id: int, reply_timeout_s: float, quiet_s: float = 0.0
    ) -> ModbusClient:
        """``quiet_s`` is what an earlier client still owed the line (`owed_s`). Raises BusError where the port cannot
        be opened."""
        client = cls(f"{line.port} unit {unit_id}", unit_id, reply_timeout_s)
        client._quiet_until_s = client.attention.now_s() + quiet_s
        client._frame_gap_s = line.frame_gap_s
        with client._closed_unless_made():
            link = client._link = await _open_serial(line, lambda: _Link(FramerRTU(DecodePDU(False)), client._on_frame))
        link.lost = client._on_lost
        return client

    @contextmanager
    def _closed_unless_made(self) -> Iterator[None]:
        try:
            yield
        except BaseException:
            self.attention.close()
            raise

    @property
    def owed_s(self) -> float:
        """So long the late reply of a request that was given up may still come, which on RTU would pass for the reply
        to the next one."""
        return max(self._quiet_until_s - self.attention.now_s(), 0.0)

    async def close(self) -> None:
        self.attention.close()
        self._link.close()
        self._on_lost()

    async def read(self, function: int, address: int, count: int) -> bytes:
        """``count`` registers as 2·count bytes, as on the wire.

        Raises ModbusRefusal, MalformedReply, DeviceSilent (no reply in time), BusError (connection lost).
        """
        kind = ReadInputRegistersRequest if function == READ_INPUT else ReadHoldingRegistersRequest
        pdu = await self._transact(kind(address=address, count=count))
        if pdu[0] != function or len(pdu) != 2 + 2 * count or pdu[1] != 2 * count:
            raise MalformedReply(
                f"{self.where}: reply to function {function} at 0x{address:04X} does not hold {count} words: "
                f"{pdu.hex(' ')}",
                pdu,
            )
        return pdu[2:]

    async def write(self, address: int, data: bytes, *, single: bool = False, timeout_s: float | None = None) -> None:
        """Register bytes, most significant of each word first; ``single`` writes one word with function 6.

        ``timeout_s`` takes the place of the client's time-out. Raises as `read` does.
        """
        words = list(struct.unpack(f">{len(data) // 2}H", data))
        request: ModbusPDU
        if single:
            request = WriteSingleRegisterRequest(address=address, registers=words[:1])
            echo = bytes([WRITE_SINGLE]) + struct.pack(">HH", address, words[0])
        else:
            request = WriteMultipleRegistersRequest(address=address, registers=words)
            echo = bytes([WRITE_MULTIPLE]) + struct.pack(">HH", address, len(words))
        pdu = await self._transact(request, timeout_s)
        if pdu != echo:
            raise MalformedReply(f"{self.where}: reply to a write at 0x{address:04X}: {pdu.hex(' ')}", pdu)

    async def _transact(self, request: ModbusPDU, timeout_s: float | None = None) -> bytes:
        patience_s = self._reply_timeout_s if timeout_s is None else timeout_s
        async with self._lock:
            if self._link.transport is None:
                raise BusError(f"{self.where}: the connection is closed")
            await self._wait_for_the_line()
            expected = self._expected = asyncio.get_running_loop().create_future()
            if not self._frame_gap_s:
                self._transaction = self._transaction % 0xFFFF + 1
            pdu = bytes([request.function_code]) + request.encode()
            self._link.send(self._unit_id, self._transaction, pdu)
            try:
                async with self.attention.timeout(patience_s):
                    reply: bytes = await expected
            except TimeoutError as e:
                raise DeviceSilent(f"{self.where}: no reply in {patience_s:g} s") from e
            finally:
                self._expected = None
                if not expected.done() or expected.cancelled():
                    self._quiet_until_s = self.attention.now_s() + self._reply_timeout_s
        if reply[0] == request.function_code | 0x80 and len(reply) == 2:
            raise ModbusRefusal(reply[1])
        return reply

    async def _wait_for_the_line(self) -> None:
        """Drops half-received replies. On RTU, keeps the gap between frames and sits out the late reply of a
        request given up: its frames have no transaction number, so that it would pass for the next one's.
        """
        loop = asyncio.get_running_loop()
        while self._frame_gap_s and (left := self._quiet_until_s - self.attention.now_s()) > 0:
            await asyncio.sleep(min(left, 0.01))
        while self._frame_gap_s and (left := self._link.last_byte_s + self._frame_gap_s - loop.time()) > 0:
            await asyncio.sleep(left)
        self._link.forget()

    def _on_frame(self, _: _Link, unit: int, transaction: int, pdu: bytes) -> None:
        # Replies of other units and late ones are no answer to what was asked: go on waiting.
        if unit != self._unit_id or transaction != self._transaction:
            return
        if self._expected is None:
            self._quiet_until_s = 0.0  # the late reply has come
        elif not self._expected.done():
            self._expected.set_result(pdu)

    def _on_lost(self) -> None:
        if self._expected is not None and not self._expected.done():
            self._expected.set_exception(BusError(f"{self.where}: the connection was lost"))


@asynccontextmanager
async def serve_tcp(handler: Handler, address: TcpAddress, *, unit_id: int) -> AsyncIterator[int]:
    """Serves over TCP and gives the port listened on. Raises BusError."""
    links: set[_Link] = set()

    def accept() -> _Link:
        link = _Link(FramerSocket(DecodePDU(True)), _answering(handler, unit_id))
        link.lost = lambda: links.discard(link)
        links.add(link)
        return link

    try:
        server = await asyncio.get_running_loop().create_server(accept, address.host, address.port)
    except OSError as e:
        raise BusError(f"cannot listen on {address.host}:{address.port}: {_reason(e)}") from e
    try:
        yield int(server.sockets[0].getsockname()[1])
    finally:
        server.close()
        for link in list(links):
            link.close()


@asynccontextmanager
async def serve_serial(handler: Handler, line: SerialLine, *, unit_id: int) -> AsyncIterator[None]:
    """Serves RTU on a serial port. Raises BusError where it cannot be opened."""
    link = await _open_serial(line, lambda: _Link(FramerRTU(DecodePDU(True)), _answering(handler, unit_id)))
    try:
        yield
    finally:
        link.close()


def _answering(handler: Handler, unit_id: int) -> Callable[[_Link, int, int, bytes], None]:
    def received(link: _Link, unit: int, transaction: int, pdu: bytes) -> None:
        if unit == unit_id and handler.alive():
            with suppress(Unanswered):
                link.send(unit, transaction, answer(handler, pdu))

    return received


async def _open_serial(line: SerialLine, make: Callable[[], _Link]) -> _Link:
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
        raise BusError(f"cannot open {line.port}: {_reason(e)}") from e
    except _SETTINGS_REFUSED as e:
        raise BusError(
            f"{line.port} does not take {line.baudrate} baud, parity {line.parity}, {line.stopbits} stop bits: "
            f"{_reason(e)}"
        ) from e
    link = cast(_Link, link)
    link.transport = transport  # the port is open; connection_made follows on the loop's next turn
    return link


def _reason(e: Exception) -> str:
    """What an operating system's error says, without its number and the path it repeats."""
    if isinstance(e, OSError) and e.errno and e.errno > 0:
        return os.strerror(e.errno)
    return str(e.args[-1]) if e.args else type(e).__name__
