"""`triaxcal sim` with several units in a process of its own: it follows events, and a wrong bench is named."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.daemon.simulation.test_operating import instruction

pytestmark = pytest.mark.slow


def on_multicast(port: int) -> dict[str, Any]:
    return {"interface": "udp_multicast", "channel": "239.74.163.2", "node_id": 5, "options": {"port": port}}


def two_files(workshop: Any) -> list[Path]:
    bus = {"interface": "virtual", "channel": "tray", "node_id": 5}
    return [
        workshop.device("can.toml", profile="triax-ref-can", serial=11, bus=bus),
        workshop.device("modbus.toml", serial=12),
    ]


@pytest.mark.parametrize("stop", [signal.SIGTERM, signal.SIGINT])
def test_it_announces_each_unit_and_follows_a_fifo_until_it_is_stopped(
    workshop: Any, start: Callable[..., Any], stop: signal.Signals
) -> None:
    events = workshop.folder / "events"
    os.mkfifo(events)
    sim = start("sim", *two_files(workshop), "--follow", events)
    sim.says("serving triax-ref-can, serial 0011, on ")
    sim.says("serving triax-ref-modbus, serial 0012, on ")
    for writers in (1, 2):
        events.write_bytes(instruction([1.0, 0.0, 0.0]) + b"\nno event\n")
        sim.says(f"{events}: a line that is no event of a run is ignored, {writers} so far")
        sim.says(f"{events}: the events have ended, {writers} lines were ignored")
    sim.send(stop)
    assert sim.wait() == (0 if stop is signal.SIGTERM else 130)
    assert sim.out == ""


def test_it_serves_on_once_standard_input_has_ended(workshop: Any) -> None:
    command = [sys.executable, "-m", "triaxcald.cli", "sim", *map(str, two_files(workshop)), "--follow", "-"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as sim:
        assert sim.stdin is not None
        assert sim.stderr is not None
        sim.stdin.write(b"no event")
        sim.stdin.close()
        said = [sim.stderr.readline().decode() for _ in range(4)]
        assert "standard input: the events have ended, 1 lines were ignored" in said[-1]
        assert sim.poll() is None
        sim.terminate()
        assert sim.wait(30) == 0


@pytest.mark.parametrize("own_unit", [False, True])
def test_a_run_that_meets_the_unit_of_another_bench_names_that_bench_and_its_port(
    workshop: Any, start: Callable[..., Any], free_port: int, multicast_fault: str | None, own_unit: bool
) -> None:
    if multicast_fault is not None:
        pytest.skip(f"multicast does not work on this machine: {multicast_fault}")
    bus = on_multicast(free_port)
    can = {"profile": "triax-ref-can", "bus": bus}
    other = workshop.device("other.toml", serial=1099, speed=1.0, **can)
    start("sim", other).says("serving ")
    if own_unit:
        start("sim", workshop.device("own.toml", serial=1042, speed=1.0, **can)).says("serving ")
    run = start("run", workshop.station({"serial": "1042", **can}))
    assert run.wait() == 4
    told = run.err.splitlines()[-1]
    assert ("two units answer" if own_unit else "is serial 1099, expected 1042") in told
    assert str(other) in told
    assert f"port {free_port}" in told
    assert "own.toml" not in told
