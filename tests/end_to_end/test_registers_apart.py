"""A unit whose registers lie apart, served by pymodbus, which refuses what is between them: from record to fit."""

from __future__ import annotations

import asyncio
import csv
import json
import math
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

PERIOD_S = 0.02
"""Between two samples by the unit's clock, however late they are read: five times what the host waits."""
HELD_S, TURN_S, POSES = 3.0, 0.6, 16
NOISE = 4.0
SCALE = 8192 * np.array([1.012, 0.985, 1.021])
MISALIGNMENT = np.array([0.004, -0.006, 0.003])
BIAS = np.array([0.021, -0.034, 0.018])
HOLDING, INPUT = 3, 4
GARBAGE = 32767

PROFILE = """
format = "triaxcal.profile/1"
name = "apart"
driver = "modbus"
identity = { vendor = "ACME", product = "apart" }
output = { unit = "counts", nominal_scale_factor = [8192, 8192, 8192] }
sampling = { rate_hz = 50.0, reply_timeout_s = 5.0, silence_timeout_s = 10.0 }

[streams.readings]
layout = "poll"
table = "holding"
address = 0x0100
poll_period_s = 0.004
max_gap = 0
time_stamp = { word = 8, type = "uint32", unit_s = 0.001 }
valid = [{ word = 12, values = [1], mask = 1 }, { word = 14, values = [7, 8] }]

[streams.readings.channels]
ux = { word = 0, type = "int16" }
uy = { word = 2, type = "int16" }
uz = { word = 4, type = "int16" }
temp_c = { table = "input", address = 0x40, type = "int16", scale = 0.1, latest_s = 0.5 }
"""
STATION = """
format = "triaxcal.station/1"
name = "bench"
[[units]]
name = "u"
profile = "apart.toml"
bus = { host = "127.0.0.1", port = %d, unit_id = 1 }
[plan]
poses = 16
hold_s = 1.0
repeat = false
patience_s = 120.0
"""


def direction(number: int) -> np.ndarray:
    """Evenly over the sphere, one after the other."""
    z = 1 - (2 * (number % POSES) + 1) / POSES
    angle, r = number % POSES * math.pi * (3 - math.sqrt(5)), math.sqrt(1 - z * z)
    return np.array([r * math.cos(angle), r * math.sin(angle), z])


class Unit:
    """It takes a sample when its first register is read, and keeps it until then. Every tenth is not valid."""

    def __init__(self, seed: int) -> None:
        self._random = np.random.default_rng(seed)
        self._samples = 0
        self.slow_s: list[float] = []
        self.requests: list[tuple[int, int, int]] = []
        self._held: dict[int, list[int]] = {}
        self._take()

    def _take(self) -> None:
        now_s = PERIOD_S * self._samples
        number, inside_s = divmod(now_s, HELD_S + TURN_S)
        share = min(max((inside_s - HELD_S) / TURN_S, 0.0), 1.0)
        a = (1 - share) * direction(int(number)) + share * direction(int(number) + 1)
        a /= np.linalg.norm(a)
        x, y, z = MISALIGNMENT
        u = SCALE * (np.array([[1, z, y], [0, 1, x], [0, 0, 1]]) @ a + BIAS) + NOISE * self._random.standard_normal(3)
        self._samples += 1
        invalid = self._samples % 10 == 0
        values = [GARBAGE] * 3 if invalid else np.rint(u).astype(int).tolist()
        stamp = int(now_s * 1000)
        self._held = {
            **{0x100 + 2 * i: [v % 0x10000] for i, v in enumerate(values)},
            0x108: [stamp >> 16 & 0xFFFF, stamp & 0xFFFF],
            0x10C: [0x00F0 | (not (invalid and self._samples % 20))],
            0x10E: [9 if invalid and not self._samples % 20 else 7],
        }

    async def answer(self, function: int, start: int, address: int, count: int, registers: list[int], _: Any) -> None:
        self.requests.append((function, address, count))
        if function == INPUT:
            self.slow_s.append(time.monotonic())
            registers[address - start] = 215
            return
        if address == 0x100:
            self._take()
        for at in range(address, address + count):
            for first, words in self._held.items():
                if first <= at < first + len(words):
                    registers[at - start] = words[at - first]


@contextmanager
def served(unit: Unit) -> Iterator[int]:
    """On a free port of the loopback, in a thread of its own."""

    def words(*addresses: int) -> list[SimData]:
        return [SimData(at, values=0, datatype=DataType.REGISTERS) for at in addresses]

    bits = [SimData(0, values=False, datatype=DataType.BITS)]
    holding = words(0x100, 0x102, 0x104, 0x108, 0x109, 0x10C, 0x10E)
    device = SimDevice(1, (bits, bits, holding, words(0x40)), action=unit.answer)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    loop, ready = asyncio.new_event_loop(), threading.Event()
    server: list[ModbusTcpServer] = []

    async def serve() -> None:
        server.append(ModbusTcpServer(device, address=("127.0.0.1", port)))
        await server[0].serve_forever(background=True)
        ready.set()

    def run() -> None:
        loop.create_task(serve())
        loop.run_forever()

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    assert ready.wait(10)
    try:
        yield port
    finally:
        asyncio.run_coroutine_threadsafe(server[0].shutdown(), loop).result(10)
        loop.call_soon_threadsafe(loop.stop)
        thread.join(10)
        loop.close()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_a_unit_with_registers_apart_is_recorded_and_calibrated(
    seed: int, tmp_path: Path, triaxcal: Callable[..., Any]
) -> None:
    (tmp_path / "apart.toml").write_text(PROFILE)
    unit = Unit(seed)
    with served(unit) as port:
        station = tmp_path / "station.toml"
        station.write_text(STATION % port)
        recording = tmp_path / "r.mcap"
        seconds = POSES * (HELD_S + TURN_S) + HELD_S
        done = triaxcal("record", station, "-o", recording, "--seconds", seconds)
    assert done.code == 0, done.err

    # The requests: registers that are there and no others, the temperature seldom.
    cycle = [(HOLDING, 0x100, 1), (HOLDING, 0x102, 1), (HOLDING, 0x104, 1), (HOLDING, 0x108, 2), (HOLDING, 0x10C, 1),
             (HOLDING, 0x10E, 1)]  # fmt: skip
    asked = [r for r in unit.requests[1:] if r[0] == HOLDING]  # after the probe
    assert asked[: 6 * 50] == cycle * 50
    assert len(unit.slow_s) >= 3
    assert np.diff(unit.slow_s[1:]).mean() >= 0.9 * 0.25  # half of what is asked for

    # The replay: every valid sample, and the device's time.
    exported = tmp_path / "r.csv"
    assert triaxcal("log", "export", recording, "-o", exported).code == 0
    rows = list(csv.DictReader(exported.open()))
    assert len(rows) == pytest.approx(0.9 * len(asked) / 6, rel=0.02)
    assert all(abs(float(row["ux"])) < 10_000 for row in rows)
    assert {float(row["temp_c"]) for row in rows} == {21.5}

    # The calibration.
    done = triaxcal("fit", recording, "--json")
    assert done.code == 0, done.err
    fit = json.loads(done.out)
    for name, truth in (("scale_factor", SCALE), ("misalignment", MISALIGNMENT), ("bias", BIAS)):
        off = np.abs(np.array(fit[name]) - truth) / np.array(fit["standard_error"][name])
        assert (off < 4).all(), (name, off)
    assert triaxcal("fit", recording, "--json").out == done.out


@pytest.mark.slow
def test_a_run_of_it_is_computed_anew_byte_for_byte(tmp_path: Path, triaxcal: Callable[..., Any]) -> None:
    (tmp_path / "apart.toml").write_text(PROFILE)
    station = tmp_path / "station.toml"
    with served(Unit(3)) as port:
        station.write_text(STATION % port)
        done = triaxcal("run", station, "--json")
    assert done.code == 0, done.err
    audited = triaxcal("audit", json.loads(done.out)["units"][0]["recording"], "--json")
    assert audited.code == 0, audited.err
    assert [found["result"] for found in json.loads(audited.out)["audits"]] == ["same_bytes"]
