"""The simulated units of one bus, in a process of their own: `python -m benchmarks.soak.units FOLDER BUS SEED`.

Says `ready` on standard output, then takes commands as JSON lines on standard input until that ends. What each unit
sends is written down as it goes.
"""

from __future__ import annotations

import asyncio
import json
import os
import sys
import time
import traceback
from collections.abc import Callable
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any, BinaryIO

import can
import numpy as np
from numpy.typing import NDArray

from benchmarks.soak.bench import BAUDRATE, RATE_HZ, Bench, Unit
from benchmarks.soak.faults import FLOOD_HZ
from benchmarks.soak.replies import FRAME, HEADER, Gateway, Replies, SerialCable, foreign_on_line, foreign_on_tcp
from triaxcal_drivers.can.model import CanBus
from triaxcal_drivers.modbus.line import serve_serial, serve_tcp
from triaxcal_drivers.modbus.protocol import SerialLine, TcpAddress
from triaxcald.simulation.can_unit import CanUnit
from triaxcald.simulation.modbus_unit import ModbusMap
from triaxcald.simulation.time_base import ElasticTimeBase
from triaxcald.simulation.unit import RESTART_S, ReferenceUnit, SampleRun

SENT = np.dtype(
    [("time_ns", "<i8"), ("start_s", "<f8"), ("counter", "<u2"), ("readings", "<i4", 3), ("corrected", "<i4", 3)]
)
"""A sample that a unit has sent, or has put into its FIFO; ``start_s`` tells its starts apart."""
FILL_S = 0.25
FOREIGN = (0x0A0, 0x0FF)
"""Identifiers of nobody on the bench, between synchronisation and the units' own."""
BATCH = 40  # frames of a flood between two looks at the clock


class WhiteNoise:
    """Physics whose samples are all different, so that each can be found again."""

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)

    def sample(self, unit_time_s: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        n = len(unit_time_s)
        return self._rng.uniform(-5.0, 5.0, (n, 3)), np.full(n, 25.0)

    def restarted(self, unit_time_s: float) -> None:
        pass


class WrittenDown(ReferenceUnit):
    """Notes in ``out`` what it samples while it ``sends``."""

    def __init__(self, unit: Unit, seed: int, out: BinaryIO) -> None:
        super().__init__(WhiteNoise(seed), serial_number=unit.serial, rate_hz=RATE_HZ[unit.kind])
        self.sends: Callable[[], bool] = lambda: True
        self._out = out

    def advance(self, unit_time_s: float) -> SampleRun:
        run = super().advance(unit_time_s)
        if len(run) and self.sends():
            self._out.write(rows(run, time.time_ns(), self.started_s).tobytes())
        return run


def rows(run: SampleRun, time_ns: int, start_s: float) -> NDArray[np.void]:
    sent = np.zeros(len(run), SENT)
    sent["time_ns"], sent["start_s"] = time_ns, start_s
    sent["counter"], sent["readings"], sent["corrected"] = run.counter, run.counts, run.corrected
    return sent


class Served:
    """One bus with its units, and the faults that it can have."""

    def __init__(self, bench: Bench, bus: str, seed: int) -> None:
        self._bench, self._bus, self._seed = bench, bus, seed
        self._units: dict[str, tuple[WrittenDown, ElasticTimeBase]] = {}
        self._cut: Callable[[float], Any] | None = None
        self._replies: Replies | None = None
        self._begun: set[asyncio.Task[Any]] = set()

    async def serve(self, stack: AsyncExitStack) -> None:
        maps = {}
        for unit in self._bench.units:
            if unit.bus != self._bus:
                continue
            out = stack.enter_context(self._bench.sent_by(unit).open("wb"))
            made, time_base = WrittenDown(unit, self._seed + unit.serial, out), ElasticTimeBase()
            self._units[unit.name] = made, time_base
            if unit.bus == "can":
                node = CanUnit(made, time_base, CanBus.model_validate(self._bench.settings(unit)))
                made.sends = lambda node=node: node.operational  # type: ignore[misc]
                await stack.enter_async_context(node)
            else:
                maps[unit.address] = ModbusMap(made, time_base)
                self._begin(_fill(maps[unit.address], time_base))
        if self._bus == "rtu":
            self._replies = Replies(self._seed, foreign_on_line, FRAME)
            cable = SerialCable(self._bench.line, self._replies)
            stack.callback(cable.close)
            await stack.enter_async_context(serve_serial(maps, SerialLine(cable.far, BAUDRATE, parity="N")))
            cable.open()
            self._cut = cable.cut
        elif self._bus == "tcp":
            self._replies = Replies(self._seed, foreign_on_tcp, HEADER)
            inner = await stack.enter_async_context(serve_tcp(maps, TcpAddress("127.0.0.1", 0)))
            gateway = Gateway(self._bench.tcp_port, inner, self._replies)
            stack.callback(gateway.close)
            await gateway.open()
            self._cut = gateway.cut

    def command(self, place: str, what: str, seconds: float, share: float) -> None:
        if what == "supply off":
            unit, time_base = self._units[place]
            unit.power_cycle(time_base.now_s() + seconds - RESTART_S)
        elif what == "flood":
            self._begin(asyncio.to_thread(flood, self._bench, seconds, self._seed))
        elif what == "connection gone" and self._cut is not None:
            self._begin(self._cut(seconds))
        elif what.startswith("replies ") and self._replies is not None:
            self._replies.begin(what.removeprefix("replies "), share, seconds)

    def _begin(self, work: Any) -> None:
        task = asyncio.ensure_future(work)
        self._begun.add(task)
        task.add_done_callback(self._ended)

    def _ended(self, task: asyncio.Task[Any]) -> None:
        self._begun.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            traceback.print_exception(error)
            os._exit(1)  # the bench itself is at fault: nothing that follows would mean anything


async def _fill(unit: ModbusMap, time_base: ElasticTimeBase) -> None:
    """Also while nobody asks."""
    while True:
        await time_base.wait_until(time_base.now_s() + FILL_S)
        unit.fill()


def flood(bench: Bench, seconds: float, seed: int) -> None:
    """Foreign frames, as fast as a bus carries them."""
    settings = bench.settings(bench.units[0])
    rng = np.random.default_rng(seed)
    with can.Bus(settings["channel"], "udp_multicast", ignore_config=True, port=bench.can_port) as bus:
        begin = time.monotonic()
        for i in range(round(seconds * FLOOD_HZ)):
            if i % BATCH == 0 and (ahead_s := begin + i / FLOOD_HZ - time.monotonic()) > 0:
                time.sleep(ahead_s)
            identifier = int(rng.integers(*FOREIGN))
            bus.send(can.Message(arbitration_id=identifier, data=bytes(8), is_extended_id=bool(i % 2)))


async def main(folder: Path, bus: str, seed: int) -> None:
    loop = asyncio.get_running_loop()
    commands = asyncio.StreamReader()
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(commands), sys.stdin)
    async with AsyncExitStack() as stack:
        served = Served(Bench.loaded(folder), bus, seed)
        await served.serve(stack)
        print("ready", flush=True)
        while line := await commands.readline():
            served.command(**json.loads(line))


if __name__ == "__main__":
    asyncio.run(main(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3])))
