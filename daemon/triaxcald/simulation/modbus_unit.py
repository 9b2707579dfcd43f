"""The reference unit on Modbus, over TCP or RTU on a serial line: register map
and FIFO windows."""

from __future__ import annotations

import asyncio
import math
import os
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, ExitStack, asynccontextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

import triaxcal_drivers as td
from triaxcald.simulation.time_base import TimeBase
from triaxcald.simulation.unit import CALIBRATION, TABLE, ReferenceUnit, RegisterFault, SampleRun, UnitSilent

# A serial line without hardware: two pseudo-terminals, each the other's far end.


@asynccontextmanager
async def pty_pair(link: Path | None = None) -> AsyncIterator[tuple[str, str]]:
    """Paths of the two ends. Both open as serial ports, in this process or
    another; parity and baud rate are taken and mean nothing. ``link`` becomes a
    symbolic link to the second end while the pair is open.

    What an end does not read in time is lost, as on a line. Raises BusError
    where ``link`` is in the way or cannot be made.
    """
    import tty  # which Windows has not

    loop = asyncio.get_running_loop()
    with ExitStack() as stack:
        masters, paths = [], []
        for _ in range(2):
            master, slave = os.openpty()
            # The slave stays open here: a master whose slave nobody holds reads
            # as an error.
            stack.callback(os.close, master)
            stack.callback(os.close, slave)
            tty.setraw(slave)
            os.set_blocking(master, False)
            masters.append(master)
            paths.append(os.ttyname(slave))
        for near, far in (masters, masters[::-1]):
            loop.add_reader(near, _pump, near, far)
            stack.callback(loop.remove_reader, near)
        if link is not None:
            try:
                if link.is_symlink():  # left behind by a process that was killed
                    link.unlink()
                link.symlink_to(paths[1])
            except OSError as e:
                raise td.BusError(f"cannot link a serial line to {link}: {e.strerror}") from e
            stack.callback(link.unlink, missing_ok=True)
        yield paths[0], paths[1]


def _pump(near: int, far: int) -> None:
    with suppress(BlockingIOError):  # the far end's buffer is full: nobody reads there
        os.write(far, os.read(near, 4096))


READINGS_WINDOW, CORRECTED_WINDOW = 0x0000, 0x0400
HEADER_WORDS, RECORD_WORDS, WINDOW_RECORDS = 3, 10, 12
WINDOW_WORDS = HEADER_WORDS + RECORD_WORDS * WINDOW_RECORDS
FIFO_RECORDS = 4096
BEHIND_RECORDS = 10 * WINDOW_RECORDS
"""A reader that has left so many in a FIFO does not keep up with the unit."""
GONE_S = 10.0
"""A reader that has not read for so long has gone, and keeps no other unit of the
fixture waiting: a quarter of the time in which the FIFO fills."""
PTY = "pty:"
_FILL_PERIOD_S = 1.0
_CODES = {
    "unknown": td.modbus.ILLEGAL_ADDRESS,
    "read_only": td.modbus.ILLEGAL_ADDRESS,
    "write_only": td.modbus.ILLEGAL_ADDRESS,
    "locked": td.modbus.DEVICE_FAILURE,
    "bad_value": td.modbus.ILLEGAL_VALUE,
}


def _addresses() -> dict[int, str]:
    """First word of every holding register."""
    at = {
        0x0000: "vendor_id",
        0x0002: "product_code",
        0x0004: "firmware_version",
        0x0006: "serial_number",
        0x0008: "status",
        0x0009: "write_counter",
        0x0010: "unlock_key",
        0x0011: "store",
        0x0013: "reset",
    }
    address = 0x0100
    for name in CALIBRATION:
        at[address], at[address + 0x0100] = name, "stored_" + name
        address += TABLE[name].size // 2
    return at


HOLDING = _addresses()
_WORDS = {address + word: (name, word) for address, name in HOLDING.items() for word in range(TABLE[name].size // 2)}


class Fifo:
    """Records of ten words; when it is full the oldest one goes, and is
    counted."""

    def __init__(self) -> None:
        self._records = bytearray()
        self.lost = 0
        self._read_s = -math.inf

    def behind(self, unit_s: float) -> bool:
        """Whether a reader fetches and does not keep up."""
        return unit_s - self._read_s < GONE_S and len(self) > BEHIND_RECORDS

    def __len__(self) -> int:
        return len(self._records) // (2 * RECORD_WORDS)

    def push(self, records: bytes) -> None:
        self._records += records
        excess = max(0, len(self) - FIFO_RECORDS)
        del self._records[: excess * 2 * RECORD_WORDS]
        self.lost += excess

    def window(self, words: int, unit_s: float) -> bytes:
        """The first ``words`` words of the window; takes out the records that
        lie in them whole."""
        self._read_s = unit_s
        number = min(len(self), WINDOW_RECORDS, max(0, words - HEADER_WORDS) // RECORD_WORDS)
        taken = bytes(self._records[: number * 2 * RECORD_WORDS])
        del self._records[: len(taken)]
        header = b"".join(v.to_bytes(2, "big") for v in (number, len(self), self.lost % 2**16))
        return (header + taken).ljust(2 * WINDOW_WORDS, b"\0")[: 2 * words]

    def clear(self) -> None:
        self._records.clear()
        self.lost = 0
        self._read_s = -math.inf


class ModbusMap:
    """The unit's registers and FIFO windows as Modbus sees them; implements
    `protocol.Handler`."""

    def __init__(self, unit: ReferenceUnit, time_base: TimeBase) -> None:
        self._unit = unit
        self._time_base = time_base
        self._started_s = unit.started_s
        self._windows = {READINGS_WINDOW: Fifo(), CORRECTED_WINDOW: Fifo()}
        self._filled_s = 0.0
        time_base.wait_for_reader(lambda: any(fifo.behind(self._filled_s) for fifo in self._windows.values()))

    def fill(self) -> None:
        """Moves the samples that have come due into the FIFOs; empties these
        where the unit has restarted."""
        self._filled_s = self._time_base.now_s()
        run = self._unit.advance(self._filled_s)
        if self._unit.started_s != self._started_s:
            self._started_s = self._unit.started_s
            for fifo in self._windows.values():
                fifo.clear()
        stamp_us = np.rint((run.unit_time_s - self._started_s) * 1e6).astype(np.int64) % 2**32
        self._windows[READINGS_WINDOW].push(_records(run, stamp_us, run.counts))
        self._windows[CORRECTED_WINDOW].push(_records(run, stamp_us, run.corrected))

    def alive(self) -> bool:
        return self._unit.alive(self._time_base.now_s())

    def read(self, function: int, address: int, count: int) -> bytes:
        self.fill()
        if function == td.modbus.READ_INPUT:
            if address not in self._windows or count > WINDOW_WORDS:
                raise td.modbus.ModbusRefusal(td.modbus.ILLEGAL_ADDRESS)
            return self._windows[address].window(count, self._filled_s)
        words = []
        for at in range(address, address + count):
            if at not in _WORDS:
                raise td.modbus.ModbusRefusal(td.modbus.ILLEGAL_ADDRESS)
            name, word = _WORDS[at]
            words.append(self._read(name)[2 * word : 2 * word + 2])
        return b"".join(words)

    def write(self, address: int, data: bytes) -> None:
        """Whole registers, in order of address; the first that is refused ends
        it."""
        names, at, end = [], address, address + len(data) // 2
        while at < end:
            if at not in _WORDS:
                raise td.modbus.ModbusRefusal(td.modbus.ILLEGAL_ADDRESS)
            name, word = _WORDS[at]
            size = TABLE[name].size // 2
            if word or at + size > end:
                raise td.modbus.ModbusRefusal(td.modbus.ILLEGAL_VALUE)  # a part of a register
            names.append(name)
            at += size
        self.fill()  # the samples before the write were made with the old registers
        for name in names:
            self._write(name, data[: TABLE[name].size])
            data = data[TABLE[name].size :]

    def _read(self, name: str) -> bytes:
        try:
            return self._unit.read(name, self._time_base.now_s())
        except RegisterFault as e:
            raise td.modbus.ModbusRefusal(_CODES[e.kind]) from e
        except UnitSilent as e:
            raise td.modbus.Unanswered from e

    def _write(self, name: str, raw: bytes) -> None:
        try:
            self._unit.write(name, raw, self._time_base.now_s())
        except RegisterFault as e:
            raise td.modbus.ModbusRefusal(_CODES[e.kind]) from e
        except UnitSilent as e:
            raise td.modbus.Unanswered from e


def _records(run: SampleRun, stamp_us: NDArray[np.int64], xyz: NDArray[np.int32]) -> bytes:
    records = np.empty(
        len(run), dtype=[("counter", ">u2"), ("stamp_us", ">u4"), ("xyz", ">i4", 3), ("temperature", ">i2")]
    )
    records["counter"], records["stamp_us"] = run.counter, stamp_us
    records["xyz"], records["temperature"] = xyz, run.temperature_raw
    return records.tobytes()


class ModbusUnit:
    """Serves the unit while the context is open; ``bus`` then says how to reach
    it.

    A serial port ``pty:/tmp/link`` is a pseudo-terminal made for the purpose,
    with a symbolic link to the end that a driver opens. Raises BusError where
    the port or the address is not to be had.
    """

    def __init__(
        self,
        unit: ReferenceUnit,
        time_base: TimeBase,
        where: td.modbus.TcpAddress | td.modbus.SerialLine = td.modbus.TcpAddress("127.0.0.1", 0),  # noqa: B008 - frozen
        *,
        unit_id: int = 1,
    ) -> None:
        self._map = ModbusMap(unit, time_base)
        self._time_base = time_base
        self._where = where
        self._unit_id = unit_id
        self._stack = AsyncExitStack()
        self.bus: td.modbus.ModbusBus

    async def __aenter__(self) -> Self:
        async with AsyncExitStack() as stack:
            self.bus = await self._serve(stack)
            filling = asyncio.create_task(self._fill())
            stack.callback(filling.cancel)
            self._stack = stack.pop_all()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, e: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._stack.aclose()

    async def _serve(self, stack: AsyncExitStack) -> td.modbus.ModbusBus:
        if isinstance(self._where, td.modbus.TcpAddress):
            port = await stack.enter_async_context(td.modbus.serve_tcp({self._unit_id: self._map}, self._where))
            return td.modbus.ModbusBus(host=self._where.host, port=port, unit_id=self._unit_id)
        line = self._where
        outside = line.port
        if line.port.startswith(PTY):
            outside = line.port.removeprefix(PTY)
            near, _ = await stack.enter_async_context(pty_pair(Path(outside)))
            line = td.modbus.SerialLine(near, line.baudrate, parity="N")  # a pseudo-terminal takes no parity
        await stack.enter_async_context(td.modbus.serve_serial({self._unit_id: self._map}, line))
        return td.modbus.ModbusBus(
            serial_port=outside,
            baudrate=line.baudrate,
            parity=line.parity,
            stopbits=line.stopbits,
            unit_id=self._unit_id,
        )

    async def _fill(self) -> None:
        """So that a unit that nobody reads overflows as it goes, and not in one
        long run later."""
        while True:
            await self._time_base.wait_until(self._time_base.now_s() + _FILL_PERIOD_S)
            self._map.fill()
