"""The reference unit on a CAN bus: a CANopen node (CiA 301) that streams by
TPDO and answers by SDO."""

from __future__ import annotations

import asyncio
import queue
import struct
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import can
import numpy as np
from canopen.objectdictionary import ODVariable
from canopen.sdo.exceptions import SdoAbortedError
from numpy.typing import NDArray

import triaxcal_drivers as td
from triaxcald.simulation.time_base import TimeBase
from triaxcald.simulation.unit import INVALID_CORRECTED, FaultKind, ReferenceUnit, RegisterFault, SampleRun, UnitSilent

# How many frames on a simulated bus are still waiting for those that read it.

BEHIND_FRAMES = 256
"""In a queue: a batch of our own driver."""
BEHIND_BYTES = 1 << 15
"""In a socket, of the 200 KiB that it holds: some forty frames with what the
kernel keeps beside each."""
_SOCKETS = tuple(map(Path, ("/proc/net/udp", "/proc/net/udp6")))
_MULTICAST_PORT = 43113  # python-can's, where the options name none


def reader_is_behind(settings: td.can.CanBus, bus: can.BusABC) -> bool:
    """Whether somebody on the bus has much left to fetch; our own end counts
    too."""
    if settings.interface == "virtual":
        queues: list[queue.Queue[Any]] = getattr(bus, "channel", [])
        return any(q.qsize() > BEHIND_FRAMES for q in list(queues))
    if settings.interface == "udp_multicast":
        return waiting_bytes(int(dict(settings.options).get("port", _MULTICAST_PORT))) > BEHIND_BYTES
    return False


def waiting_bytes(port: int) -> int:
    """The most that any UDP socket on this port of this machine holds unread; 0
    where the system does not say."""
    most, here = 0, f":{port:04X}"
    for table in _SOCKETS:
        try:
            lines = table.read_text("ascii").splitlines()[1:]
        except OSError:
            continue
        for fields in map(str.split, lines):
            if fields[1].endswith(here):
                most = max(most, int(fields[4].partition(":")[2], 16))
    return most


ABORT_CODES: dict[FaultKind, int] = {
    "unknown": 0x06020000,
    "read_only": 0x06010002,
    "write_only": 0x06010001,
    "locked": 0x08000022,
    "bad_value": 0x06090030,
}
HEARTBEAT_S = 1.0
_BOOT_UP, _STOPPED, _OPERATIONAL, _PRE_OPERATIONAL = 0x00, 0x04, 0x05, 0x7F
_COMMANDS = {0x01: _OPERATIONAL, 0x02: _STOPPED, 0x80: _PRE_OPERATIONAL}
_RESET_NODE, _RESET_COMMUNICATION = 0x81, 0x82
_UPLOAD, _DOWNLOAD, _ABORT = 2, 1, 4  # client command specifiers: the top three bits
_EXPEDITED, _SIZED = 2, 1
_INT24 = 2**23


def tpdos(run: SampleRun) -> tuple[list[bytes], list[bytes], list[bytes], list[bytes]]:
    """The eight bytes of TPDO1 to TPDO4 for every sample of ``run``."""
    counter, temperature = _bytes(run.counter, "<u2"), _bytes(run.temperature_raw, "<i2")
    status = _bytes(run.status, "<u2")[:, :1]
    corrected = np.where(run.corrected == INVALID_CORRECTED, -_INT24, np.clip(run.corrected, 1 - _INT24, _INT24 - 1))
    frames = []
    for triples in (run.counts, corrected):
        x, y, z = (_bytes(triples[:, axis], "<i4")[:, :3] for axis in range(3))
        frames += [np.hstack([x, y, counter]), np.hstack([z, temperature, counter, status])]
    first, second, third, fourth = ([row.tobytes() for row in f] for f in frames)
    return first, second, third, fourth


def _bytes(numbers: NDArray[np.integer[Any]], kind: str) -> NDArray[np.uint8]:
    return np.ascontiguousarray(numbers.astype(kind)).view(np.uint8).reshape(len(numbers), np.dtype(kind).itemsize)


_SAMPLE_OBJECTS = {
    (0x2300, 1): (0, slice(0, 3)), (0x2300, 2): (0, slice(3, 6)), (0x2300, 3): (1, slice(0, 3)),
    (0x2300, 4): (0, slice(6, 8)), (0x2300, 5): (1, slice(3, 5)), (0x2300, 6): (1, slice(7, 8)),
    (0x2301, 1): (2, slice(0, 3)), (0x2301, 2): (2, slice(3, 6)), (0x2301, 3): (3, slice(0, 3)),
}  # fmt: skip
"""The TPDO, and the bytes in it, that show each object of the latest sample."""


class _Requests(can.Listener):
    """Hands what is received over to the event loop."""

    def __init__(self, loop: asyncio.AbstractEventLoop, received: Callable[[can.Message], None]) -> None:
        self.failure: Exception | None = None
        self._loop = loop
        self._received = received

    def on_message_received(self, msg: can.Message) -> None:
        with suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._received, msg)

    def on_error(self, exc: Exception) -> None:
        self.failure = exc
        raise SystemExit  # ends the receive thread without a trace back


class CanUnit:
    """Serves ``unit`` as node ``bus.node_id`` while the context is entered.

    Everything runs in the event loop; python-can's thread only receives. SDO is
    served here and not by canopen's LocalNode, which stumbles over malformed
    requests, invents members of arrays and cannot keep silent; NMT, heartbeat
    and TPDOs run in the unit's time. Expedited SDO transfers only: no object is
    longer than four bytes. Raises BusError on entering where the bus cannot be
    opened, on leaving where it has failed meanwhile.
    """

    def __init__(self, unit: ReferenceUnit, time_base: TimeBase, bus: td.can.CanBus) -> None:
        self._unit = unit
        self._time = time_base
        self._settings = bus
        if bus.node_id is None:
            raise td.AddressError("bus: node_id: missing, 1 to 127")
        self._node_id: int = bus.node_id
        self._state = _BOOT_UP
        self._started_s: float | None = None  # of the start that was announced by a boot-up message
        self._heartbeat_s = 0.0
        self._latest: tuple[bytes, ...] = ()
        self._failure: Exception | None = None
        profile = td.load_bundle(Path("triax-ref-can")).profile
        assert isinstance(profile, td.can.CanProfile)
        self._objects = _objects(self._node_id)
        self._registers = {td.can.object_address(r.object): name for name, r in profile.registers.items()}
        self._task: asyncio.Task[None] | None = None
        self._reader_behind = False
        time_base.wait_for_reader(lambda: self._reader_behind)

    @property
    def operational(self) -> bool:
        """Whether the samples that come due go onto the bus."""
        return self._state == _OPERATIONAL

    async def __aenter__(self) -> Self:
        self._bus = await td.can.opened(lambda: td.can.open_python_can(self._settings), can.BusABC.shutdown)
        node = self._node_id
        self._bus.set_filters([{"can_id": i, "can_mask": 0x7FF, "extended": False} for i in (0x000, 0x600 + node)])
        self._requests = _Requests(asyncio.get_running_loop(), self._received)
        self._notifier = can.Notifier(self._bus, [self._requests], timeout=0.1)
        self._task = asyncio.create_task(self._run())
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        assert self._task is not None
        self._task.cancel()
        try:
            outcome = (await asyncio.gather(self._task, return_exceptions=True))[0]
        finally:
            await asyncio.to_thread(self._close)
        if isinstance(outcome, (can.CanError, OSError)):
            raise td.BusError(f"simulated unit, {self._settings}: {outcome}") from outcome
        if isinstance(outcome, Exception):
            raise outcome

    def _close(self) -> None:
        self._notifier.stop()
        self._bus.shutdown()

    async def _run(self) -> None:
        while True:
            self._reader_behind = reader_is_behind(self._settings, self._bus)
            self._work(self._time.now_s())
            if failure := self._failure or self._requests.failure:
                raise failure
            now_s = self._time.now_s()
            await self._time.wait_until(self._time.later_s(now_s, 1 / self._unit.rate_hz))

    def _work(self, now_s: float) -> None:
        """Everything due by ``now_s``: boot-up after a start, heartbeat,
        samples."""
        if not self._unit.alive(now_s):
            return
        if self._started_s != self._unit.started_s:
            self._started_s = self._unit.started_s
            self._boot(now_s)
        if now_s >= self._heartbeat_s - 1e-9:
            self._send(0x700 + self._node_id, bytes([self._state]))
            self._heartbeat_s += HEARTBEAT_S
        for frames in zip(*tpdos(self._unit.advance(now_s)), strict=True):
            self._latest = frames
            if self._state == _OPERATIONAL:
                for number, data in enumerate(frames):
                    self._send(0x180 + 0x100 * number + self._node_id, data)

    def _boot(self, now_s: float) -> None:
        self._send(0x700 + self._node_id, bytes([_BOOT_UP]))
        self._state = _PRE_OPERATIONAL
        self._heartbeat_s = now_s + HEARTBEAT_S

    def _send(self, identifier: int, data: bytes) -> None:
        try:
            self._bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))
        except (can.CanError, OSError) as e:
            self._failure = e

    def _received(self, message: can.Message) -> None:
        now_s = self._time.now_s()
        self._work(now_s)  # the samples before the request are taken with the registers before it
        if not self._unit.alive(now_s) or message.is_error_frame or message.is_remote_frame:
            return
        data = bytes(message.data)
        if message.arbitration_id == 0:
            if len(data) == 2 and data[1] in (0, self._node_id):
                self._command(data[0], now_s)
        elif len(data) == 8 and self._state != _STOPPED and (answer := self._answer(data)) is not None:
            self._send(0x580 + self._node_id, answer)

    def _command(self, command: int, now_s: float) -> None:
        if command == _RESET_NODE:
            self._unit.power_cycle(now_s)
        elif command == _RESET_COMMUNICATION:
            self._boot(now_s)
        else:
            self._state = _COMMANDS.get(command, self._state)

    def _answer(self, request: bytes) -> bytes | None:
        """The SDO server (CiA 301): one request, its answer or an abort; None
        for silence."""
        command, index, subindex = struct.unpack_from("<BHB", request)
        try:
            if command >> 5 == _UPLOAD:
                data = self._read(index, subindex)
                return struct.pack("<BHB4s", 0x43 | (4 - len(data)) << 2, index, subindex, data)
            if command >> 5 == _DOWNLOAD and command & _EXPEDITED:
                size = 4 - (command >> 2 & 3) if command & _SIZED else 4
                self._write(index, subindex, request[4 : 4 + size])
                return struct.pack("<BHB4x", 0x60, index, subindex)
            if command >> 5 == _ABORT:
                return None
            raise SdoAbortedError(0x05040001)
        except RegisterFault as fault:
            code = ABORT_CODES[fault.kind]
        except SdoAbortedError as abort:
            code = abort.code
        except UnitSilent:
            return None
        return struct.pack("<BHBI", 0x80, index, subindex, code)

    def _object(self, index: int, subindex: int) -> ODVariable:
        if (index, subindex) not in self._objects:
            raise SdoAbortedError(0x06090011 if any(i == index for i, _ in self._objects) else 0x06020000)
        return self._objects[index, subindex]

    def _read(self, index: int, subindex: int) -> bytes:
        variable = self._object(index, subindex)
        if not variable.readable:
            raise SdoAbortedError(ABORT_CODES["write_only"])
        if name := self._registers.get((index, subindex)):
            return self._unit.read(name, self._time.now_s())[::-1]
        if variable.default is not None:
            return variable.encode_raw(variable.default)
        if not self._latest:
            raise SdoAbortedError(0x08000024)  # no data yet
        number, part = _SAMPLE_OBJECTS[index, subindex]
        return self._latest[number][part]

    def _write(self, index: int, subindex: int, raw: bytes) -> None:
        variable = self._object(index, subindex)
        if not variable.writable:
            raise SdoAbortedError(ABORT_CODES["read_only"])
        if len(raw) * 8 != len(variable):
            raise SdoAbortedError(0x06070010)
        self._unit.write(self._registers[index, subindex], raw[::-1], self._time.now_s())


def _objects(node_id: int) -> dict[tuple[int, int], ODVariable]:
    """Every object of the unit's EDS by index and sub-index."""
    eds = td.BUILT_IN / "triax-ref-can.eds"
    found = {}
    for entry in td.can.object_dictionary(eds.read_bytes(), node_id=node_id, where=eds.name).values():
        members = [entry] if isinstance(entry, ODVariable) else entry.subindices.values()
        found.update({(v.index, v.subindex): v for v in members})
    return found
