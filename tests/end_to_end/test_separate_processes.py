"""A simulated unit in one process, the station in another: CAN over multicast, Modbus over TCP and RTU."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from triaxcald.documents import to_text
from triaxcald.inputs import measure
from triaxcald.schema.run import Run
from triaxcald.simulation.unit import Stored, factory_calibration

UNIT = {
    "unit", "exit_code", "error", "wanted_poses", "data_quality", "serial", "recording", "certificate", "report",
    "before", "after",
    "findings", "candidates", "choices", "registers_written", "verification", "device_state", "records_lost",
    "outcome", "outcome_file", "signature_file",
}  # fmt: skip


@pytest.fixture(params=["can", "tcp", "rtu"])
def buses(request: pytest.FixtureRequest, tmp_path: Path, free_port: int, multicast_fault: str | None) -> Any:
    """Profile, the bus as the unit names it and as the station does."""
    if request.param == "can":
        if multicast_fault is not None:
            pytest.skip(f"multicast does not work on this machine: {multicast_fault}")
        bus = {"interface": "udp_multicast", "channel": "239.74.163.2", "node_id": 5, "options": {"port": free_port}}
        return "triax-ref-can", bus, bus
    if request.param == "tcp":
        bus = {"host": "127.0.0.1", "port": free_port, "unit_id": 3}
        return "triax-ref-modbus", bus, bus
    line = tmp_path / "line"
    return (
        "triax-ref-modbus",
        {"serial_port": f"pty:{line}"},
        {"serial_port": str(line), "baudrate": 115200, "parity": "N"},
    )


@pytest.mark.slow
def test_a_unit_is_calibrated_across_processes_and_stays_so_when_its_power_goes(
    workshop: Any, triaxcal: Callable[..., Any], start: Callable[..., Any], buses: Any
) -> None:
    profile, unit_bus, station_bus = buses
    fixture = {"poses": 12, "hold_s": 2.0, "move_s": 0.8}
    device = workshop.device(profile=profile, bus=unit_bus, eeprom="eeprom.bin", fixture=fixture, speed=15.0)
    station = workshop.station(
        {"profile": profile, "serial": "4711", "bus": station_bus},
        plan={"poses": 12, "hold_s": 1.0, "check_poses": 3},
        limits={"rms_g": 1e-4, "verification_rms_g": 1e-4},
    )
    sim = start("sim", device)
    sim.says(f"serving {profile}, serial 4711, on ")

    run = start("run", station, "--json")
    assert run.wait() == 0, run.err
    document = json.loads(run.out)
    read = Run.read(document)
    assert read is not None
    assert to_text(read.document()) == to_text(document)
    (unit,) = document["units"]
    assert set(unit) == UNIT
    assert (unit["exit_code"], unit["error"], unit["serial"]) == (0, None, "4711")
    assert unit["verification"]["verdict"] == "within limits"
    assert unit["verification"]["before_rms_g"] > 1e-3 > 1e-4 > unit["verification"]["after_rms_g"]
    assert "bias_x" in unit["registers_written"]
    for paper in ("recording", "certificate", "report"):
        assert Path(unit[paper]).stat().st_size > 0
    assert triaxcal("audit", unit["recording"]).code == 0

    sim.send(signal.SIGTERM)
    assert sim.wait() == 0
    assert sim.out == ""
    held = Stored.from_image((workshop.folder / "eeprom.bin").read_bytes())
    assert held.valid
    assert held.write_counter == 1

    again = start("sim", device)
    again.says("serving ")
    rows = {r["register"]: r for r in triaxcal("registers", station, "--json").json["registers"]}
    assert rows["calibration_crc"]["crc_ok"] is True
    rec = workshop.folder / "after.mcap"
    assert triaxcal("record", station, "-o", rec, "--seconds", "15").code == 0
    poses = measure(str(rec), stream="corrected").poses
    assert len(poses) >= 3
    np.testing.assert_allclose([np.linalg.norm(p.mean) for p in poses], 1.0, atol=1e-4)
    again.send(signal.SIGINT)
    assert again.wait() == 130
    assert again.err.endswith("triaxcal: interrupted\n")
    assert (workshop.folder / "eeprom.bin").read_bytes() == held.image()


@pytest.mark.slow
def test_a_unit_that_was_never_written_keeps_its_factory_calibration(
    workshop: Any, start: Callable[..., Any], wait_until: Callable[..., None], free_port: int
) -> None:
    device = workshop.device(bus={"host": "127.0.0.1", "port": free_port}, eeprom="eeprom.bin")
    sim = start("sim", device)
    sim.says("serving ")
    path = workshop.folder / "eeprom.bin"
    wait_until(path.exists)
    sim.send(signal.SIGKILL)
    sim.wait()
    assert path.read_bytes() == Stored(factory_calibration()).image()
