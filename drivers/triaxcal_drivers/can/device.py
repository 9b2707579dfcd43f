"""A unit on a CAN bus: its stream of frames, and its registers by CANopen SDO."""

from __future__ import annotations

import asyncio
import queue
import struct
import threading
from collections.abc import AsyncGenerator, Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TypeVar, cast

import canopen
from canopen.sdo.client import SdoClient
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from triaxcal_drivers.can.adapter import Frame, Identifier
from triaxcal_drivers.can.layout import Layout
from triaxcal_drivers.can.line import BATCH_FRAMES, CanLine, FrameQueue, Matching, join, leave
from triaxcal_drivers.can.model import CanBus, CanProfile, object_address
from triaxcal_drivers.errors import (
    BusError,
    DeviceAbsent,
    DeviceBusy,
    DeviceRestarted,
    DeviceSilent,
    ProfileError,
    RegisterRefused,
)
from triaxcal_drivers.hints import nearest
from triaxcal_drivers.interface import BUSY_PAUSE_S, BUSY_S, RawBatch, RawFlag
from triaxcal_drivers.stall_clock import TICK_S, StallTolerantClock
from triaxcal_drivers.two_senders import Answers, ExtraAnswer

T = TypeVar("T")

_NMT_START = 1
_HEARTBEAT, _BOOTED = 0x700, b"\0"
"""CiA 301: a node sends a heartbeat of state 0 after booting."""
_BOOT_LOOK_S = 0.1
"""How often a stream that brings nothing checks whether the node has booted."""
_ABORTED, _ABORT = 0x80, b"\x80"
_DOWNLOAD, _UPLOAD = 1, 2
_BEGINS = (2, 3)
"""The server's command specifiers of answers that begin an upload or a download."""
_ANSWERED_BY = {_DOWNLOAD: 3, _UPLOAD: 2, 0: 1, 3: 0}
"""The server's command specifier for the client's (CiA 301): starts of
transfers, then segments."""


class PatientSdo(SdoClient):
    """canopen's client, whose time-out tolerates stalls, and which takes no
    answer to somebody else's request.

    It waits in a thread of its own, and where the event loop is held up so may
    be all else that an answer passes. A late answer, or one to another client
    of the node, is skipped.
    """

    def __init__(self, node_id: int, clock: StallTolerantClock, answers: Answers[bytes]) -> None:
        self.answers = answers
        self._in_segments = False
        nothing_known = canopen.ObjectDictionary()  # type: ignore[no-untyped-call]
        super().__init__(0x600 + node_id, 0x580 + node_id, nothing_known)  # type: ignore[no-untyped-call]
        self._clock = clock
        self._asked, self._object = 0, bytes(3)

    def send_request(self, request: bytes) -> None:
        self._asked = request[0] >> 5
        self._in_segments = self._asked not in (_DOWNLOAD, _UPLOAD)
        if not self._in_segments:
            self._object = bytes(request[1:4])
            self.answers.asked(self._object)
        super().send_request(request)  # type: ignore[no-untyped-call]

    def receive(self, response: bytes) -> None:
        """Take an answer of the node to any client. Runs in the receive thread."""
        # Segments name no object: only the answer that begins a transfer counts.
        # An abort of the segments belongs to the same transfer.
        ends_segments = self._in_segments and response[:1] == _ABORT and self._named_by(response) == self._object
        if ends_segments:
            self._in_segments = False
        elif response and (response[0] == _ABORTED or response[0] >> 5 in _BEGINS):
            self.answers.answered(self._named_by(response), response)
        self.responses.put(response)

    def _named_by(self, response: bytes) -> bytes:
        """Some nodes name no object when they refuse one."""
        named = response[1:4]
        return self._object if response[0] == _ABORTED and named == bytes(3) else named

    def read_response(self) -> bytes:
        """Raises SdoAbortedError, SdoCommunicationError; struct.error for one
        cut short."""
        response = self._response()
        if response[0] == _ABORTED:
            raise SdoAbortedError(*struct.unpack_from("<L", response, 4))
        return response

    def _response(self) -> bytes:
        deadline_s = self._clock.now_s() + self.RESPONSE_TIMEOUT
        while True:
            late = self._clock.now_s() >= deadline_s
            with suppress(queue.Empty):
                response = bytes(self.responses.get(timeout=TICK_S))
                if self._is_mine(response):
                    return response
            if late:
                raise SdoCommunicationError("no answer")

    def _is_mine(self, response: bytes) -> bool:
        if not response:
            return False
        if response[0] == _ABORTED:  # some nodes name no object where they refuse one
            return response[1:4] in (self._object, bytes(3))
        if response[0] >> 5 != _ANSWERED_BY.get(self._asked):
            return False
        return self._asked not in (_DOWNLOAD, _UPLOAD) or response[1:4] == self._object


class _Sender:
    """Replaces canopen's network, which needs a bus of its own."""

    def __init__(self, line: CanLine) -> None:
        self._line = line

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """Raises BusError."""
        self._line.send(can_id, bytes(data))


@dataclass(frozen=True)
class _Connection:
    line: CanLine
    frames: FrameQueue
    sdo: PatientSdo


class CanDevice:
    """A unit on a CAN bus; a CANopen node where the profile says so.

    The bus may have other units of this process; blocking calls run in worker
    threads.
    """

    def __init__(self, profile: CanProfile, bus: CanBus, layouts: Mapping[str, Layout]) -> None:
        self._profile = profile
        self._settings = bus
        self._layouts = layouts
        self._connection: _Connection | None = None
        self._node_id = bus.node_id or 0  # of one that has none nothing is asked by SDO
        self._source = bus.source_address if isinstance(bus.source_address, int) else None  # of J1939, once known
        self._dropped = 0
        # By object, as on the wire. They outlive a connection: an answer to a
        # request of the one before may come late.
        self._answers: Answers[bytes] = Answers()
        self._booted: asyncio.Event | None = None  # while a stream is open
        self._sdo_lock = threading.Lock()  # one transfer at a time, also after a caller was cancelled

    @property
    def dropped(self) -> int:
        """Frames lost in this process so far, because a stream was not read
        fast enough."""
        return self._dropped + (self._connection.frames.dropped if self._connection else 0)

    async def open(self) -> None:
        """Raises BusError, DeviceAbsent."""
        await self.close()
        line = await join(self._settings)
        sdo = PatientSdo(self._node_id, line.clock, self._answers)
        sdo.network = cast(canopen.Network, _Sender(line))
        self._connection = _Connection(line, FrameQueue(line.clock), sdo)
        started = False
        try:
            if self._profile.canopen:
                line.listen(sdo.tx_cobid, lambda frame: sdo.receive(frame.data))
                line.listen(self._boot_up, self._on_heartbeat)
                await self._start()
            started = True
        finally:
            if not started:
                await self.close()

    async def close(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            self._dropped += connection.frames.dropped
            connection.line.unhear(connection.frames)
            if self._profile.canopen:
                connection.line.ignore(connection.sdo.tx_cobid)
                connection.line.ignore(self._boot_up)
            connection.frames.fail(BusError(f"{self._settings} is closed"))
            await leave(connection.line)

    def _connected(self) -> _Connection:
        if self._connection is None:
            raise BusError(f"{self._settings} is not open")
        return self._connection

    @property
    def _boot_up(self) -> int:
        return _HEARTBEAT + self._node_id

    def _on_heartbeat(self, frame: Frame) -> None:
        """Take a heartbeat. Runs in the receive thread."""
        booted, connection = self._booted, self._connection
        if frame.data == _BOOTED and booted is not None and connection is not None:
            with suppress(RuntimeError):  # the loop has ended
                connection.line.clock.loop.call_soon_threadsafe(booted.set)

    async def _start(self) -> None:
        """NMT start, and the check that a device is there that has the registers
        of the identity. What they hold is compared by who opens it.

        A node that was stopped answers no SDO, one that is still booting misses
        the command: it is sent before and after the check.
        """
        await self.send(0, bytes([_NMT_START, self._node_id]))
        await self._identify()
        await self.send(0, bytes([_NMT_START, self._node_id]))

    async def _identify(self) -> None:
        identity = self._profile.identity
        asked = [*identity.expect, *([identity.serial_register] if identity.serial_register else [])]
        for name in asked or list(self._profile.registers)[:1]:
            try:
                await self._read_when_ready(name)
            except DeviceSilent as e:
                raise DeviceAbsent(f"nothing answers at {self._settings}") from e
            except DeviceBusy as e:
                raise DeviceAbsent(f"{self._settings} does not say for {BUSY_S:g} s what it is: {e}") from e
            except RegisterRefused as e:
                raise DeviceAbsent(f"{self._settings} is not a {identity.product}: {e}") from e

    async def _read_when_ready(self, register: str) -> bytes:
        """Read, and repeat the request while a starting or storing node refuses.
        Raises DeviceBusy after `BUSY_S`."""
        now_s = self._connected().line.clock.now_s
        until_s = now_s() + BUSY_S
        while True:
            try:
                return await self.read(register)
            except DeviceBusy:
                if now_s() >= until_s:
                    raise
            await asyncio.sleep(BUSY_PAUSE_S)

    async def stream(self, names: Sequence[str]) -> AsyncGenerator[RawBatch, None]:
        """Frames of the named streams and error frames, until the iterator is
        closed; one at a time.

        Raises DeviceSilent when no frame of theirs has come for
        ``silence_timeout_s``, DeviceRestarted when the node has booted,
        BusError.
        """
        connection = self._connected()
        frames, now_s = connection.frames, connection.line.clock.now_s
        opened = frames.open(self._identifiers(names))
        booted = self._booted = asyncio.Event()
        connection.line.hear(frames)
        timeout_s = self._profile.sampling.silence_timeout_s
        deadline_s = now_s() + timeout_s
        asked = [p for name in names if (p := self._profile.streams[name].sync_period_s) is not None]
        sync = connection.line.sync(min(asked)) if asked else None
        try:
            while True:
                batch = await frames.batch(min(deadline_s - now_s(), _BOOT_LOOK_S))
                if batch is not None and ((batch.flags & RawFlag.ERROR) == 0).any():
                    deadline_s = now_s() + timeout_s
                more_waits = batch is not None and len(batch) == BATCH_FRAMES
                silent = now_s() >= deadline_s and not more_waits
                if batch:
                    yield batch  # which may take whoever has it a while
                if booted.is_set():
                    raise DeviceRestarted(f"a unit at {self._settings} has started: it sent its boot-up message")
                if silent:
                    raise DeviceSilent(f"{self._settings} has sent nothing of {', '.join(names)} for {timeout_s:g} s")
        finally:
            if sync is not None:
                connection.line.unsync(sync)
            if frames.close(opened):
                self._booted = None
                connection.line.unhear(frames)

    def _identifiers(self, names: Sequence[str]) -> Collection[Identifier]:
        for name in names:
            if name not in self._layouts:
                raise ProfileError(f"profile {self._profile.name}: no stream '{name}'{nearest(name, self._layouts)}")
        messages = [m for name in names for m in self._layouts[name].messages]
        fixed = {(m.identifier_of(self._node_id), m.extended) for m in messages if not m.j1939}
        groups = {m.group for m in messages if m.j1939}
        return Matching(lambda i: i in fixed or self._is_own(i, groups)) if groups else fixed

    def _is_own(self, identifier: Identifier, groups: Collection[tuple[int, int]]) -> bool:
        """Whether a frame is of one of the parameter groups and of this unit, which is
        the first that is heard where nobody says which. Runs in the receive thread."""
        number, extended = identifier
        if not extended or all(number & bits != group for bits, group in groups):
            return False
        if self._source is None:
            self._source = number & 0xFF
        return self._source == number & 0xFF

    async def read(self, register: str) -> bytes:
        """Least significant byte first. Raises RegisterRefused, DeviceSilent,
        BusError."""
        address = object_address(self._profile.registers[register].object)
        try:
            return await self._transfer(register, lambda sdo: bytes(sdo.upload(*address)))
        except RegisterRefused as e:
            if e.code not in self._profile.busy_codes:
                raise
            raise DeviceBusy(str(e), register=register, code=e.code) from e

    async def write(self, register: str, raw: bytes, *, timeout_s: float | None = None) -> None:
        """``raw`` least significant byte first. Raises RegisterRefused,
        DeviceSilent, BusError."""
        address = object_address(self._profile.registers[register].object)
        await self._transfer(register, lambda sdo: sdo.download(*address, raw), timeout_s)

    async def listen(self, seconds: float) -> list[ExtraAnswer]:
        """Waits so long by the host's clock. Returns the answers since the last
        call that no request explains."""
        await asyncio.sleep(seconds)
        if self._connection is None:
            return []
        names = {_on_the_wire(entry.object): name for name, entry in self._profile.registers.items()}
        return [
            ExtraAnswer(names.get(e.key, ""), _data(e.answer), None if e.first is None else _data(e.first))
            for e in self._connection.sdo.answers.take()
        ]

    async def _transfer(self, register: str, transfer: Callable[[SdoClient], T], timeout_s: float | None = None) -> T:
        connection = self._connected()
        place = f"register {register} ({self._profile.registers[register].object}) of {self._settings}"
        patience_s = self._profile.sampling.reply_timeout_s if timeout_s is None else timeout_s

        def locked() -> T:
            with self._sdo_lock, connection.line.clock.thread_waiting():
                connection.sdo.RESPONSE_TIMEOUT = patience_s
                return transfer(connection.sdo)

        try:
            return await asyncio.to_thread(locked)
        except SdoAbortedError as e:
            reason = SdoAbortedError.CODES.get(e.code, "unknown reason")
            raise RegisterRefused(f"{place}: refused, 0x{e.code:08X} {reason}", register=register, code=e.code) from e
        except (SdoCommunicationError, struct.error) as e:  # the latter: an answer cut short
            connection.line.check()
            raise DeviceSilent(f"{place}: no valid answer within {patience_s:g} s") from e
        except BusError as e:
            raise BusError(f"{place}: {e}") from e

    async def send(self, identifier: int, data: bytes, *, extended: bool = False) -> None:
        """Raises BusError."""
        await asyncio.to_thread(self._connected().line.send, identifier, data, extended=extended)


def _on_the_wire(name: str) -> bytes:
    """An object as SDO frames name it."""
    return struct.pack("<HB", *object_address(name))


def _data(response: bytes) -> bytes:
    """The data of an expedited upload; any other answer as it came."""
    expedited, size_told = response[0] & 2, response[0] & 1
    if response[0] >> 5 != 2 or not expedited:
        return response
    return response[4 : 8 - (response[0] >> 2 & 3)] if size_told else response[4:]
