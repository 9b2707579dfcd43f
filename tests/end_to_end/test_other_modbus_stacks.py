"""libmodbus, by way of mbpoll, reads and writes the simulated unit as our own driver does."""

from __future__ import annotations

import asyncio
import os
import re
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest

from triaxcal_drivers.modbus.protocol import SerialLine, TcpAddress
from triaxcald.simulation.modbus_unit import ModbusUnit
from triaxcald.simulation.time_base import SteppedTimeBase
from triaxcald.simulation.unit import ConstantPhysics, ReferenceUnit

MBPOLL = shutil.which("mbpoll")
if MBPOLL is None and os.environ.get("CI"):
    raise RuntimeError("mbpoll is missing, and CI has to install it")
pytestmark = pytest.mark.skipif(MBPOLL is None, reason="mbpoll is not installed (apt-get install mbpoll)")

PLACES = ["tcp", "rtu"]


def unit_of() -> ReferenceUnit:
    physics = ConstantPhysics(np.array([1.25, -2.5, 0.625]), 21.5)
    return ReferenceUnit(physics, serial_number=0xCAFE0001)


async def mbpoll(served: ModbusUnit, *arguments: str) -> str:
    bus = served.bus
    if bus.host is not None:
        place = ["-m", "tcp", "-p", str(bus.port), "-a", "1", "-0", "-1", *arguments[:-1], bus.host]
    else:
        line = ["-b", str(bus.baudrate), "-P", "none"]
        place = ["-m", "rtu", *line, "-a", "1", "-0", "-1", *arguments[:-1], str(bus.serial_port)]
    if arguments[-1]:
        place += arguments[-1].split()
    process = await asyncio.create_subprocess_exec(
        str(MBPOLL), *place, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT
    )
    async with asyncio.timeout(20):
        out, _ = await process.communicate()
    return out.decode()


def words(text: str) -> list[int]:
    return [int(w, 16) for w in re.findall(r"^\[\d+\]:\s+0x([0-9A-F]+)", text, flags=re.M)]


@pytest.fixture(params=PLACES)
def place(request: pytest.FixtureRequest, tmp_path: Path) -> TcpAddress | SerialLine:
    if request.param == "tcp":
        return TcpAddress("127.0.0.1", 0)
    return SerialLine(f"pty:{tmp_path}/line", 19200, "N", 1)


async def test_it_reads_identity_and_calibration(place: TcpAddress | SerialLine) -> None:
    async with ModbusUnit(unit_of(), SteppedTimeBase(), place) as served:
        assert words(await mbpoll(served, "-t", "4:hex", "-r", "6", "-c", "2", "")) == [0xCAFE, 0x0001]
        factory = struct.unpack(">HH", struct.pack(">f", -2.4))
        assert words(await mbpoll(served, "-t", "4:hex", "-r", "256", "-c", "2", "")) == list(factory)


async def test_it_reads_the_fifo_window(place: TcpAddress | SerialLine) -> None:
    time_base = SteppedTimeBase()
    async with ModbusUnit(unit_of(), time_base, place) as served:
        await time_base.advance(0.02)
        window = words(await mbpoll(served, "-t", "3:hex", "-r", "0", "-c", "123", ""))
    count, remaining, lost = window[:3]
    assert (count, remaining, lost) == (3, 0, 0)
    counter, _, _, x_high, x_low, *_, temperature = window[13:23]
    assert counter == 1
    assert (x_high << 16 | x_low) == 1.25 / 10 * 2**23
    assert temperature == 2150


async def test_a_write_while_locked_is_refused_and_goes_through_once_unlocked(
    place: TcpAddress | SerialLine,
) -> None:
    unit = unit_of()
    high, low = struct.unpack(">HH", struct.pack(">f", 0.0125))
    async with ModbusUnit(unit, SteppedTimeBase(), place) as served:
        write_bias = ("-t", "4:hex", "-r", str(0x010C), f"0x{high:04X} 0x{low:04X}")
        assert "failure" in (await mbpoll(served, *write_bias)).lower()
        assert unit.read("bias_x", 0.0) == struct.pack(">f", 0.0)
        assert "Written 1 references" in await mbpoll(served, "-t", "4:hex", "-r", "16", "0x5A17")
        assert "Written 2 references" in await mbpoll(served, *write_bias)
        assert unit.read("bias_x", 0.0) == struct.pack(">f", 0.0125)
