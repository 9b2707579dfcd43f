"""The reference unit on a CAN bus: a CANopen node (CiA 301) that streams by TPDO and answers by SDO."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import can
import canopen
import numpy as np
from canopen.objectdictionary import ODVariable
from canopen.sdo.exceptions import SdoAbortedError
from numpy.typing import NDArray

from triaxcal_drivers.can.bus import open_bus
from triaxcal_drivers.can.description import object_dictionary
from triaxcal_drivers.can.model import CanBus, CanProfile, object_address
from triaxcal_drivers.errors import BusError
from triaxcal_drivers.profile import BUILT_IN, load_bundle
from triaxcald.simulation.time_base import TimeBase
from triaxcald.simulation.unit import (
    INVALID_CORRECTED,
    FaultKind,
    ReferenceUnit,
    RegisterFault,
    SampleRun,
    UnitSilent,
)

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
_INT24 = 2**23


def tpdos(run: SampleRun) -> tuple[list[bytes], list[bytes], list[bytes], list[bytes]]:
    """The eight bytes of TPDO1 to TPDO4 for every sample of ``run``."""
    counter, temperature = _bytes(run.counter, "<u2"), _bytes(run.temperature_raw, "<i2")
    status = _bytes(run.status, "<u2")[:, :1]
    corrected = np.where(
        run.corrected == INVALID_CORRECTED, -_INT24, np.clip(run.corrected, 1 - _INT24, _INT24 - 1)
    )
    frames = []
    for triples in (run.counts, corrected):
        x, y, z = (_bytes(triples[:, axis], "<i4")[:, :3] for axis in range(3))
        frames += [np.hstack([x, y, counter]), np.hstack([z, temperature, counter, status])]
    first, second, third, fourth = ([row.tobytes() for row in f] for f in frames)
    return first, second, third, fourth


def _bytes(numbers: NDArray[np.integer[Any]], kind: str) -> NDArray[np.uint8]:
    return (
        np.ascontiguousarray(numbers.astype(kind))
        .view(np.uint8)
        .reshape(len(numbers), np.dtype(kind).itemsize)
    )


_SAMPLE_OBJECTS = {
    (0x2300, 1): (0, slice(0, 3)), (0x2300, 2): (0, slice(3, 6)), (0x2300, 3): (1, slice(0, 3)),
    (0x2300, 4): (0, slice(6, 8)), (0x2300, 5): (1, slice(3, 5)), (0x2300, 6): (1, slice(7, 8)),
    (0x2301, 1): (2, slice(0, 3)), (0x2301, 2): (2, slice(3, 6)), (0x2301, 3): (3, slice(0, 3)),
}  # fmt: skip
"""The TPDO, and the bytes in it, that show each object of the latest sample."""


class _Answers(canopen.Network):
    """The network that canopen's SDO server answers on; nothing is received through it."""

    def __init__(self, send: Callable[[int, bytes], None]) -> None:
        super().__init__()
        self._send = send

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self._send(can_id, bytes(data))


class _Requests(can.Listener):
    """Hands what is received over to the event loop."""

    def __init__(self, loop: asyncio.AbstractEventLoop, received: Callable[[can.Message], None]) -> None:
        self.failure: Exception | None = None
        self._loop = loop
        self._received = received

    def on_message_received(self, msg: can.Message) -> None:
        self._loop.call_soon_threadsafe(self._received, msg)

    def on_error(self, exc: Exception) -> None:
        self.failure = exc
        raise SystemExit  # ends the receive thread without a trace back


class CanUnit:
    """Serves ``unit`` as node ``bus.node_id`` while the context is entered.

    Everything runs in the event loop; python-can's thread only receives. SDO goes through canopen's server
    on the unit's EDS; NMT, heartbeat and TPDOs are done here, since they run in the unit's time.
    Raises BusError on entering where the bus cannot be opened, on leaving where it has failed meanwhile.
    """

    def __init__(self, unit: ReferenceUnit, time_base: TimeBase, bus: CanBus) -> None:
        self._unit = unit
        self._time = time_base
        self._settings = bus
        self._node_id = bus.node_id
        self._state = _BOOT_UP
        self._started_s: float | None = None  # of the start that was announced by a boot-up message
        self._heartbeat_s = 0.0
        self._latest: tuple[bytes, ...] = ()
        self._silent = False  # the unit gives no answer to the request in hand
        self._failure: Exception | None = None
        profile = load_bundle(Path("triax-ref-can")).profile
        assert isinstance(profile, CanProfile)
        self._registers = {object_address(r.object): name for name, r in profile.registers.items()}
        self._task: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        self._bus = await asyncio.to_thread(open_bus, self._settings)
        node = self._node_id
        self._bus.set_filters(
            [{"can_id": i, "can_mask": 0x7FF, "extended": False} for i in (0x000, 0x600 + node)]
        )
        eds = BUILT_IN / "triax-ref-can.eds"
        objects = object_dictionary(eds.read_bytes(), node_id=node, where=eds.name)
        self._node = canopen.LocalNode(node, objects)
        self._node.add_read_callback(self._read)  # type: ignore[no-untyped-call]
        self._node.add_write_callback(self._write)  # type: ignore[no-untyped-call]
        self._node.associate_network(_Answers(self._answer))
        self._requests = _Requests(asyncio.get_running_loop(), self._received)
        self._notifier = can.Notifier(self._bus, [self._requests], timeout=0.1)
        self._task = asyncio.create_task(self._run())
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await asyncio.to_thread(self._notifier.stop)
        assert self._task is not None
        self._task.cancel()
        outcome = (await asyncio.gather(self._task, return_exceptions=True))[0]
        await asyncio.to_thread(self._bus.shutdown)
        if isinstance(outcome, (can.CanError, OSError)):
            raise BusError(f"simulated unit, {self._settings}: {outcome}") from outcome
        if isinstance(outcome, Exception):
            raise outcome

    async def _run(self) -> None:
        while True:
            self._work(self._time.now_s())
            if failure := self._failure or self._requests.failure:
                raise failure
            await self._time.wait_until(self._time.now_s() + 1 / self._unit.rate_hz)

    def _work(self, now_s: float) -> None:
        """Everything due by ``now_s``: boot-up after a start, heartbeat, samples."""
        if not self._unit.alive(now_s):
            return
        if self._started_s != self._unit.started_s:
            self._started_s = self._unit.started_s
            self._boot(now_s)
        if now_s >= self._heartbeat_s:
            self._send(0x700 + self._node_id, bytes([self._state]))
            self._heartbeat_s = now_s + HEARTBEAT_S
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

    def _answer(self, identifier: int, data: bytes) -> None:
        if not self._silent:
            self._send(identifier, data)

    def _received(self, message: can.Message) -> None:
        now_s = self._time.now_s()
        self._work(now_s)  # the samples before the request are taken with the registers before it
        if not self._unit.alive(now_s) or message.is_error_frame or message.is_remote_frame:
            return
        data = bytes(message.data)
        if message.arbitration_id == 0:
            if len(data) == 2 and data[1] in (0, self._node_id):
                self._command(data[0], now_s)
        elif len(data) == 8 and self._state != _STOPPED:
            self._silent = False
            self._node.sdo.on_request(0x600 + self._node_id, bytearray(data), 0.0)  # type: ignore[no-untyped-call]

    def _command(self, command: int, now_s: float) -> None:
        if command == _RESET_NODE:
            self._unit.power_cycle(now_s)
        elif command == _RESET_COMMUNICATION:
            self._boot(now_s)
        else:
            self._state = _COMMANDS.get(command, self._state)

    def _read(self, *, index: int, subindex: int, od: ODVariable) -> bytes | None:
        """For canopen's SDO server; None where the EDS has the value."""
        if (index, subindex) in _SAMPLE_OBJECTS and self._latest:
            number, part = _SAMPLE_OBJECTS[index, subindex]
            return self._latest[number][part]
        name = self._registers.get((index, subindex))
        if name is None:
            return None
        try:
            return self._unit.read(name, self._time.now_s())[::-1]
        except (RegisterFault, UnitSilent) as fault:
            raise self._abort(fault) from fault

    def _write(self, *, index: int, subindex: int, od: ODVariable, data: bytes) -> None:
        name = self._registers.get((index, subindex))
        if name is None:
            return
        try:
            self._unit.write(name, bytes(data)[::-1], self._time.now_s())
        except (RegisterFault, UnitSilent) as fault:
            raise self._abort(fault) from fault

    def _abort(self, fault: RegisterFault | UnitSilent) -> SdoAbortedError:
        self._silent = isinstance(fault, UnitSilent)
        return SdoAbortedError(ABORT_CODES[fault.kind] if isinstance(fault, RegisterFault) else 0x08000000)
