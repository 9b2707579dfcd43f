"""Units on one CAN bus and on one RS-485 line, calibrated at once: one dies, two restart on the way."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack
from typing import Any

import numpy as np
import pytest

from tests.conftest import Workshop
from triaxcal_drivers.modbus.line import serve_serial
from triaxcal_drivers.modbus.protocol import SerialLine
from triaxcald.audit import audit
from triaxcald.run.unit_run import Outcome, TrayRun
from triaxcald.schema.codes import Stage
from triaxcald.simulation.bench import SimulatedUnit, load_device, simulate
from triaxcald.simulation.modbus_unit import ModbusMap, pty_pair
from triaxcald.station.config import check_lines, load_station
from triaxcald.text import IS_BACK, STAGES

pytestmark = pytest.mark.slow

ON_CAN, ON_RS485 = range(1, 4), range(1, 3)
SPEED, BAUDRATE = 4.0, 460_800
FIXTURE = {"poses": 10, "hold_s": 1.4, "move_s": 0.6}
PLAN = {"poses": 10, "hold_s": 0.6, "check_poses": 1, "comes_back_s": 0.0}
DIES, RESTARTS, RESTARTS_ON_RS485 = "can1", "can2", "rtu2"


class Told:
    def __init__(self) -> None:
        self.said: list[tuple[str, str]] = []

    def stage(self, unit: str, stage: Stage) -> None:
        self.note(unit, STAGES[stage])

    def back(self, unit: str) -> None:
        self.note(unit, IS_BACK)

    def note(self, unit: str, text: str) -> None:
        self.said.append((unit, text))

    def lost(self, unit: str, code: object, trouble: str) -> None:
        self.said.append((unit, f"lost: {trouble}"))

    def poses(self, unit: str, phase: str, guide: Any) -> None:
        self.said.append((unit, f"{guide.found} poses"))


class Bench:
    """All units served by one event loop, as the station runs."""

    def __init__(self, workshop: Workshop, channel: str) -> None:
        self.units: dict[str, SimulatedUnit] = {}
        for node in ON_CAN:
            bus = {"interface": "virtual", "channel": channel, "node_id": node}
            self._make(workshop, f"can{node}", profile="triax-ref-can", serial=100 + node, bus=bus, seed=node)
        for number in ON_RS485:
            bus = {"serial_port": "unused", "unit_id": number}
            self._make(workshop, f"rtu{number}", serial=200 + number, bus=bus, seed=50 + number)

    def _make(self, workshop: Workshop, name: str, **settings: Any) -> None:
        path = workshop.device(f"{name}.toml", speed=SPEED, fixture=FIXTURE, **settings)
        self.units[name] = simulate(load_device(path), where=name)

    async def serve(self, stack: AsyncExitStack) -> str:
        """The port of the RS-485 line."""
        maps = {}
        for name, unit in self.units.items():
            if name.startswith("can"):
                await stack.enter_async_context(unit.serve())
            else:
                maps[unit.bus.unit_id] = ModbusMap(unit.unit, unit.time_base)
        near, far = await stack.enter_async_context(pty_pair())
        await stack.enter_async_context(serve_serial(maps, SerialLine(far, BAUDRATE, parity="N")))
        return str(near)

    async def trouble(self, told: Told) -> None:
        """Once each has three poses."""
        waiting = {DIES, RESTARTS, RESTARTS_ON_RS485}
        while waiting:
            for name in sorted(waiting):
                if (name, "3 poses") in told.said:
                    waiting.discard(name)
                    unit = self.units[name]
                    if name == DIES:
                        unit.unit._died_s = unit.time_base.now_s()
                    else:
                        unit.unit.power_cycle(unit.time_base.now_s())
            await asyncio.sleep(0.02)


async def run_all(workshop: Workshop, bench: Bench, told: Told, ended: list[str]) -> list[Outcome]:
    async with AsyncExitStack() as stack:
        port = await bench.serve(stack)
        profiles = {kind: workshop.impatient_profile(f"triax-ref-{kind}") for kind in ("can", "modbus")}
        units = []
        for name, unit in bench.units.items():
            if name.startswith("can"):
                units.append({"name": name, "bus": dict(unit.device.bus), "profile": profiles["can"]})
            else:
                bus = {"serial_port": port, "baudrate": BAUDRATE, "parity": "N", "unit_id": unit.bus.unit_id}
                units.append({"name": name, "bus": bus, "profile": profiles["modbus"]})
        station = load_station(workshop.station(*units, plan=PLAN, provisioning={"write": False}))
        check_lines(station.places, where="station.toml")
        trouble = asyncio.ensure_future(bench.trouble(told))
        outcomes = await TrayRun(station, told, ended=lambda outcome: ended.append(outcome.unit))
        trouble.cancel()
    return outcomes


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> Any:
    workshop = Workshop(tmp_path_factory.mktemp("many"))
    bench, told, ended = Bench(workshop, f"many-{id(workshop)}"), Told(), list[str]()
    outcomes = asyncio.run(run_all(workshop, bench, told, ended))
    return bench, told, {outcome.unit: outcome for outcome in outcomes}, ended


def test_all_but_the_dead_one_are_calibrated(ran: Any) -> None:
    bench, _, outcomes, _ = ran
    assert set(outcomes) == set(bench.units)
    for name, outcome in outcomes.items():
        if name == DIES:
            assert outcome.exit_code == 4
            assert outcome.error is not None
            assert f"unit {DIES}: " in outcome.error
        else:
            assert outcome.error is None, outcome.error
            found = outcome.certified.document["result"]["calibration"]
            np.testing.assert_allclose(found["scale_factor"], bench.units[name].device.sensor.scale_factor, rtol=1e-3)


def test_the_dead_one_is_told_at_once_and_given_up_when_the_others_are_done(ran: Any) -> None:
    _, told, _, ended = ran
    assert ended[-1] == DIES
    waits = next(i for i, (unit, text) in enumerate(told.said) if unit == DIES and text.startswith("lost: "))
    assert waits < max(i for i, (unit, _) in enumerate(told.said) if unit != DIES)


def test_a_recording_with_gaps_agrees_with_itself(ran: Any) -> None:
    _, _, outcomes, _ = ran
    assert audit(outcomes[RESTARTS].recording).differences == ()
