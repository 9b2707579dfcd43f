"""A Modbus line: one open connection for all units of this process that are
reached by it; and one unit on it, with its registers read and written, and its
replies checked. The one file that knows pymodbus.

A serial port has one owner, and a gateway serves few connections. So the units
on them share one `Line`, which asks one unit at a time, in the order in which
they come, also by TCP: what is behind a gateway is mostly one line. A unit that
does not answer costs the others one time-out.

pymodbus frames (MBAP, RTU with its CRC), encodes requests and drives the serial
port. Its client and server are not used: the client closes the connection on a
reply that it cannot decode, where ours hands the bytes on; the server can
neither stay silent for a while nor refuse a bad count in the protocol's terms.
What leaves this file is plain bytes and our own errors.
"""

from __future__ import annotations

import asyncio
import logging
import math
import os
import struct
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager, suppress
from typing import cast
from weakref import WeakKeyDictionary

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

from triaxcal_drivers.claim import canonical_host, canonical_port
from triaxcal_drivers.errors import BusError, DeviceSilent
from triaxcal_drivers.modbus.protocol import (
    READ_INPUT,
    WRITE_MULTIPLE,
    WRITE_SINGLE,
    DamagedReply,
    Handler,
    MalformedReply,
    Misanswered,
    ModbusRefusal,
    SerialLine,
    TcpAddress,
    Unanswered,
    answer,
    read_reply_bytes,
)
from triaxcal_drivers.stall_clock import StallTolerantClock
from triaxcal_drivers.two_senders import Answers, Extra

# Connections: frames over TCP and serial lines.

_SETTINGS_REFUSED: tuple[type[Exception], ...] = ()
with suppress(ImportError):  # there is none outside POSIX
    import termios

    _SETTINGS_REFUSED = (termios.error,)  # not an OSError

_MAX_ADU = 260
# pymodbus logs nothing unless the application sets up logging: faults come out as
# errors.
logging.getLogger("pymodbus").addHandler(logging.NullHandler())


Received = Callable[["Link", int, int, bytes], None]


class Link(asyncio.Protocol):
    """One connection. Divides its bytes into frames and passes each on as (unit,
    transaction, PDU)."""

    def __init__(self, framer: FramerBase, received: Received) -> None:
        self.framer = framer
        self.transport: asyncio.Transport | None = None
        self.last_byte_s = 0.0
        self.lost: Callable[[], None] = lambda: None
        self._received = received
        self._buffer = b""
        self._sent, self._head, self._byte_count = b"", b"", 0
        self.sent_s = 0.0

    @property
    def byte_count(self) -> int:
        """Number of bytes since the last request."""
        return self._byte_count

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast(asyncio.Transport, transport)

    def connection_lost(self, exc: Exception | None) -> None:
        self.transport = None
        self.lost()

    def data_received(self, data: bytes) -> None:
        self.last_byte_s = asyncio.get_running_loop().time()
        self._head += data[: len(self._sent) - len(self._head)]
        self._byte_count += len(data)
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
        # Drop bytes that cannot become a frame: another protocol than Modbus, or too
        # many.
        foreign = isinstance(self.framer, FramerSocket) and self._buffer[2:4].strip(b"\0")
        if foreign or len(self._buffer) > _MAX_ADU:
            self.forget()

    def forget(self) -> None:
        """Drops bytes that have not become a frame."""
        self._buffer = b""

    def send(self, unit: int, transaction: int, pdu: bytes) -> None:
        if self.transport is not None:
            self._sent, self._head, self._byte_count = self.framer.encode(pdu, unit, transaction), b"", 0
            self.sent_s = asyncio.get_running_loop().time()
            self.transport.write(self._sent)

    def bytes_report(self) -> str | None:
        """The bytes since the last request, in words; None if none came."""
        if not self._byte_count:
            return None
        if self._head == self._sent:
            return "what is sent comes back: the adapter echoes"
        return f"{self._byte_count} bytes came, and no whole reply"

    def close(self) -> None:
        if self.transport is not None:
            self.transport.close()
            self.transport = None


async def connect_tcp(address: TcpAddress, received: Received) -> Link:
    """Connects to a unit or a gateway. Raises OSError."""
    loop = asyncio.get_running_loop()
    _, link = await loop.create_connection(
        lambda: Link(FramerSocket(DecodePDU(False)), received), address.host, address.port
    )
    return link


async def connect_serial(line: SerialLine, received: Received) -> Link:
    """Opens a serial port as the master of its line. Raises BusError."""
    return await _open_serial(line, lambda: Link(FramerRTU(DecodePDU(False)), received))


def read_request(function: int, address: int, count: int) -> bytes:
    """The PDU that asks for ``count`` registers."""
    kind = ReadInputRegistersRequest if function == READ_INPUT else ReadHoldingRegistersRequest
    return _pdu(kind(address=address, count=count))


def write_request(address: int, words: Sequence[int], *, single: bool) -> bytes:
    """The PDU that writes registers. ``single`` writes one word with function 6."""
    if single:
        return _pdu(WriteSingleRegisterRequest(address=address, registers=list(words[:1])))
    return _pdu(WriteMultipleRegistersRequest(address=address, registers=list(words)))


def _pdu(request: ModbusPDU) -> bytes:
    return bytes([request.function_code]) + request.encode()


@asynccontextmanager
async def serve_tcp(units: Mapping[int, Handler], address: TcpAddress) -> AsyncIterator[int]:
    """Serves units by their ids over TCP and yields the port. Raises BusError."""
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
    """Serves units by their ids as RTU on a serial port. Raises BusError if the port
    cannot be opened."""
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
    """The text of an operating system's error, without its number and its path."""
    if isinstance(e, OSError) and e.errno and e.errno > 0:
        return os.strerror(e.errno)
    return str(e.args[-1]) if e.args else type(e).__name__


# The line that units share, and one unit on it.

_PRELIMINARY = (b"\x05", b"\x06", b"\x0a", b"\x0b")
"""Exceptions after which the unit's own reply may still come: the unit is busy, or a
gateway did not wait for it."""
_LOOK_S = 0.01
"""Period of the checks for a late reply and for a silent line."""
_QUIET_S = 0.03
"""Silence on an RTU line after which the bytes so far are all of a damaged reply:
twice as long as a USB adapter delays bytes."""


class Line:
    """A shared line; `join` returns it. ``clock`` measures its time-outs."""

    def __init__(self, where: TcpAddress | SerialLine) -> None:
        self.where = where
        self.name = where.port if isinstance(where, SerialLine) else f"{where.host}:{where.port}"
        self.users = 0
        self.clock = StallTolerantClock(asyncio.get_running_loop())
        self._frame_gap_s = where.frame_gap_s if isinstance(where, SerialLine) else 0.0
        self._opening, self._turn = asyncio.Lock(), asyncio.Lock()
        self._link: Link | None = None
        self._late_until_s: dict[int, float] = {}
        self._damaged_reads: dict[int, bytes] = {}
        """By unit, the read whose reply was damaged and may still come late."""
        self._request = b""
        self._latency_s: dict[int, float] = {}
        """By unit, the longest time to reply, less a tenth with each reply."""
        self._waited_s: dict[int, float] = {}
        self._stalled = False
        self._transaction = 0
        self._current_unit = 0
        self._expected: asyncio.Future[bytes] | None = None
        self._answers: Answers[tuple[int, int]] = Answers()
        """By unit and, where the frames have one, transaction."""
        self._extra: dict[int, list[Extra[tuple[int, int]]]] = {}
        self._unexpected: str | None = None
        """Description of an unexpected reply, in words."""

    async def open(self, timeout_s: float) -> None:
        """Nothing where it is open and answers; a TCP connection that went mute
        is made anew. Raises BusError where it cannot be opened, by TCP within
        ``timeout_s``."""
        async with self._opening:
            if self._link is not None and self._link.transport is not None and not self._stalled:
                return
            async with self._turn:  # no request of another unit is under way, nor begins on a closed link
                if self._link is not None:
                    self._link.lost = lambda: None
                    self._link.close()
                if isinstance(self.where, SerialLine):
                    self._link = await connect_serial(self.where, self._on_frame)
                else:
                    self._link = await self._connected(self.where, timeout_s)
                self._link.lost, self._stalled = self._on_lost, False

    async def _connected(self, address: TcpAddress, timeout_s: float) -> Link:
        try:
            async with self.clock.timeout(timeout_s):
                return await connect_tcp(address, self._on_frame)
        except TimeoutError as e:
            raise BusError(f"cannot connect to {self.name}: no answer in {timeout_s:g} s") from e
        except (OSError, UnicodeError) as e:  # the latter: no host can have that name
            raise BusError(f"cannot connect to {self.name}: {reason_of(e)}") from e

    def close(self) -> None:
        self.clock.close()
        if self._link is not None:
            self._link.close()
        self._on_lost()

    def owed_s(self, unit: int) -> float:
        """Time [s] for which the late reply to an abandoned request of this unit may
        still come. On RTU it would pass for the reply to the next request."""
        now_s = self.clock.now_s()
        if not self._frame_gap_s or math.isinf(now_s):  # closed: nothing is asked any more
            return 0.0
        return max(self._late_until_s.get(unit, 0.0) - now_s, 0.0)

    def owe(self, unit: int, seconds: float) -> None:
        now_s = self.clock.now_s()
        if seconds > 0 and math.isfinite(now_s):
            self._late_until_s[unit] = now_s + seconds
            self._damaged_reads.pop(unit, None)

    def _owed_before_s(self, unit: int, pdu: bytes) -> float:
        """Time [s] as by `owed_s` before this request. After a damaged reply the line
        may repeat the same read at once, or send a read whose reply has another length:
        `_on_frame` tells a late reply by its length."""
        damaged = self._damaged_reads.get(unit)
        length = read_reply_bytes(pdu)
        if damaged is not None and length is not None and (pdu == damaged or length != read_reply_bytes(damaged)):
            return 0.0
        return self.owed_s(unit)

    def waited_s(self, unit: int) -> float:
        """Total time [s] for which a unit's requests waited while other units had the
        line."""
        return self._waited_s.get(unit, 0.0)

    def cancel(self, unit: int) -> None:
        """Lets the pending request of this unit fail; its caller is closed."""
        if self._current_unit == unit and self._expected is not None and not self._expected.done():
            self._expected.set_exception(BusError(f"{self.name} unit {unit}: the device is closed"))

    async def transact(self, unit: int, pdu: bytes, *, timeout_s: float, late_s: float) -> bytes:
        """The reply to a request, function code first. A reply that does not come
        within ``timeout_s`` may still come ``late_s`` later. Raises DeviceSilent,
        BusError."""
        async with self._turn_of(unit, pdu):
            if self._link is None or self._link.transport is None:
                raise BusError(f"{self.name} unit {unit}: the connection is closed")
            await self._keep_the_gap(self._link)
            if self._link.transport is None:
                raise BusError(f"{self.name} unit {unit}: the connection was lost")
            # Send the request.
            expected = self._expected = asyncio.get_running_loop().create_future()
            self._current_unit, self._request, self._unexpected = unit, pdu, None
            if not self._frame_gap_s:
                self._transaction = self._transaction % 0xFFFF + 1
            until_s = self.clock.now_s() + timeout_s
            self._answers.asked(self._key(unit, self._transaction))
            self._link.send(unit, self._transaction, pdu)
            # Wait for its reply.
            try:
                async with self.clock.timeout(timeout_s):
                    reply = await self._reply(self._link, expected, unit, pdu)
            except TimeoutError as e:
                self._stalled = not self._frame_gap_s  # by TCP: until another frame comes
                silent = f"{self.name} unit {unit}: no reply in {timeout_s:g} s"
                if report := self._unexpected or self._link.bytes_report():
                    raise Misanswered(f"{silent}; {report}") from e
                raise DeviceSilent(silent) from e
            finally:
                self._expected = None
                if not expected.done() or expected.cancelled():
                    self._owe_after(self._link, unit, pdu, late_s + max(until_s - self.clock.now_s(), 0.0))
        return reply

    async def _reply(self, link: Link, expected: asyncio.Future[bytes], unit: int, pdu: bytes) -> bytes:
        """The reply. Raises DamagedReply, before the time-out, if damaged bytes came
        and the line is silent since."""
        loop = asyncio.get_running_loop()
        usual_s = self._latency_s.get(unit, math.inf)
        quiet_s = max(_QUIET_S, 2 * self._frame_gap_s)
        # TCP damages no bytes. A write has its whole time-out, as the unit may store.
        detects_damage = self._frame_gap_s and math.isfinite(usual_s) and read_reply_bytes(pdu) is not None
        while detects_damage and not expected.done():
            await asyncio.wait([expected], timeout=_LOOK_S)
            # Noise may precede the reply: the unit then still has its usual time.
            until_s = link.last_byte_s if _has_reply_length(link, pdu) else link.sent_s + 2 * usual_s
            since_s = loop.time() - max(link.last_byte_s, until_s)
            if not expected.done() and link.byte_count and since_s >= quiet_s:
                raise DamagedReply(f"{self.name} unit {unit}: no reply; {self._unexpected or link.bytes_report()}")
        reply = await expected
        self._latency_s[unit] = max(0.9 * self._latency_s.get(unit, 0.0), loop.time() - link.sent_s)
        return reply

    def _owe_after(self, link: Link, unit: int, pdu: bytes, seconds: float) -> None:
        """Records a late reply to expect after a request without a reply. If the bytes
        that came were the reply, no other one follows; else they may precede it."""
        damaged = self._frame_gap_s and link.byte_count and read_reply_bytes(pdu) is not None
        if damaged and _has_reply_length(link, pdu):
            return
        self.owe(unit, seconds)
        if damaged:
            self._damaged_reads[unit] = pdu

    @asynccontextmanager
    async def _turn_of(self, unit: int, pdu: bytes) -> AsyncIterator[None]:
        """Reserves the line once no late reply of this unit may come; other units have
        it meanwhile. RTU frames have no transaction number, so a late reply would pass
        for the next one."""
        while True:
            while (left_s := self._owed_before_s(unit, pdu)) > 0:
                await asyncio.sleep(min(left_s, _LOOK_S))
            begun_s = self.clock.now_s()
            async with self._turn:
                if math.isfinite(waited_s := self.clock.now_s() - begun_s):
                    self._waited_s[unit] = self._waited_s.get(unit, 0.0) + waited_s
                if self._owed_before_s(unit, pdu) == 0:
                    yield
                    return

    async def _keep_the_gap(self, link: Link) -> None:
        """Waits for the silence between RTU frames. Drops half-received replies."""
        loop = asyncio.get_running_loop()
        while self._frame_gap_s and (left := link.last_byte_s + self._frame_gap_s - loop.time()) > 0:
            await asyncio.sleep(left)
        link.forget()

    def _on_frame(self, link: Link, unit: int, transaction: int, pdu: bytes) -> None:
        if link is not self._link:
            return
        self._stalled = False
        # Record replies for the detection of a second unit. A reply in an unknown
        # transaction answers nothing.
        key = self._key(unit, transaction)
        if self._answers.was_asked(key):
            self._answers.answered(key, pdu, final=not (pdu[0] & 0x80 and pdu[1:2] in _PRELIMINARY))
        # Pass on the expected reply; describe any other one.
        if transaction != self._transaction:
            self._unexpected = f"a reply came as transaction {transaction}, expected {self._transaction}"
            return
        if self._expected is None or unit != self._current_unit:
            self._late_until_s.pop(unit, None)  # the late reply has come
            self._unexpected = f"a reply came as unit {unit}"
        elif self._is_late(unit, pdu):
            self._damaged_reads.pop(unit)
            self._unexpected = "a late reply came"
        elif not self._expected.done():
            self._expected.set_result(pdu)

    def _is_late(self, unit: int, pdu: bytes) -> bool:
        """Whether a reply on RTU is the late one: a late reply may come, and this one
        has another length than the request demands."""
        length = read_reply_bytes(self._request)
        refused = pdu[0] == self._request[0] | 0x80
        return unit in self._damaged_reads and length is not None and len(pdu) + 3 != length and not refused

    def _key(self, unit: int, transaction: int) -> tuple[int, int]:
        """Unit and transaction, which is 0 on RTU."""
        return unit, 0 if self._frame_gap_s else transaction

    def extra(self, unit: int) -> list[Extra[tuple[int, int]]]:
        """The replies of the unit since the last call that no request
        explains."""
        for e in self._answers.take():
            self._extra.setdefault(e.key[0], []).append(e)
        return self._extra.pop(unit, [])

    def _on_lost(self) -> None:
        if self._expected is not None and not self._expected.done():
            self._expected.set_exception(BusError(f"{self.name} unit {self._current_unit}: the connection was lost"))


def _has_reply_length(link: Link, pdu: bytes) -> bool:
    """Whether the number of bytes is that of the reply to a read, give or take one that
    noise adds or removes."""
    length = read_reply_bytes(pdu)
    return length is not None and abs(link.byte_count - length) <= 1


_lines: WeakKeyDictionary[asyncio.AbstractEventLoop, dict[str, Line]] = WeakKeyDictionary()
"""The lines that this process has open, by event loop and place."""


async def join(where: TcpAddress | SerialLine, timeout_s: float) -> Line:
    """The line at this place, opened if necessary. `leave` returns it.

    Raises BusError if it cannot be opened, or if other units have the port with other
    settings.
    """
    lines = _lines.setdefault(asyncio.get_running_loop(), {})
    line = lines.get(_key(where))
    if line is None:
        line = lines[_key(where)] = Line(where)
    elif isinstance(where, SerialLine) and isinstance(line.where, SerialLine) and where.settings != line.where.settings:
        raise BusError(
            f"{where.port}: another unit has it with {line.where.settings}; this one asks for {where.settings}"
        )
    line.users += 1
    try:
        await line.open(timeout_s)
    except BaseException:
        leave(line)
        raise
    return line


def leave(line: Line) -> None:
    """Closes the line after its last user."""
    line.users -= 1
    if line.users == 0:
        lines = _lines.get(line.clock.loop, {})
        # By identity: the port behind a link may be another one by now.
        for key in [key for key, known in lines.items() if known is line]:
            del lines[key]
        line.close()


def _key(where: TcpAddress | SerialLine) -> str:
    if isinstance(where, SerialLine):
        return canonical_port(where.port)
    return f"{canonical_host(where.host)}:{where.port}"


class ModbusClient:
    """One unit on a line; `joined` returns it. Other units of this process may share
    the line."""

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
        """``owed_s`` is the time for which a late reply to an earlier client of this
        unit may still come. Raises BusError if a connection is refused or not made in
        time, a port cannot be opened, or other units have it with other settings."""
        line = await join(where, reply_timeout_s)
        line.owe(unit_id, owed_s)
        return cls(line, unit_id, reply_timeout_s)

    @property
    def owed_s(self) -> float:
        return self._line.owed_s(self._unit_id)

    @property
    def clock_s(self) -> float:
        """Time [s] of the line's stall-tolerant clock."""
        return self._line.clock.now_s()

    @property
    def own_s(self) -> float:
        """Time [s] for which this unit has or could have the line: the line's clock
        less the time that its requests waited for other units."""
        return self._line.clock.now_s() - self._line.waited_s(self._unit_id)

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
            self._line.cancel(self._unit_id)
            leave(self._line)

    async def read(self, function: int, address: int, count: int) -> bytes:
        """``count`` registers as 2·count bytes in the order of the wire.

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
        """Writes register bytes, the most significant one of each word first.
        ``single`` writes one word with function 6.

        ``timeout_s`` replaces the client's time-out. Raises as `read` does.
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
        timeout_s = self._reply_timeout_s if timeout_s is None else timeout_s
        reply = await self._line.transact(self._unit_id, request, timeout_s=timeout_s, late_s=self._reply_timeout_s)
        if reply[0] == request[0] | 0x80 and len(reply) == 2:
            raise ModbusRefusal(reply[1])
        return reply
