"""A process that is killed or interrupted in mid-recording: what is on disk stays, what is lost is counted."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from triaxcal_drivers.modbus.protocol import READ_INPUT
from triaxcald.errors import RecordingError
from triaxcald.inputs import CALIBRATION, bundle_of
from triaxcald.raw_to_poses import Pipeline
from triaxcald.recording.reader import Recording
from triaxcald.simulation.unit import Stored, factory_calibration
from triaxcald.text import VERDICTS

ENDLESS = {"poses": 26, "hold_s": 1.0, "patience_s": 1e6}
"""More poses than the fixture of the simulated unit takes: such a run goes on for ever."""
SECOND_NS, BUSY_NS = 1_000_000_000, 500_000_000


def _state(path: Path) -> tuple[int, int]:
    """Still poses so far, and the host time of the last raw record; of a file that is being written."""
    with Recording.open(path, unfinished=True) as recording:
        pipeline, last_ns = Pipeline(bundle_of(recording), "readings"), 0
        for batch in recording.raw(CALIBRATION):
            pipeline.feed(batch)
            last_ns = int(batch.time_ns[-1])
        return len(pipeline.finish()), last_ns


def _overflowed(path: Path) -> int:
    """Samples that the unit dropped before anybody fetched them, by its own count in the windows of its FIFO.

    It runs 20 times as fast as a real one, and a machine that is busy may not keep up.
    """
    with Recording.open(path) as recording:
        batches = list(recording.raw(CALIBRATION))
    windows = []
    for batch in batches:
        ends = np.cumsum(batch.length, dtype=np.int64)
        good = (batch.source == READ_INPUT << 16) & (batch.flags == 0)
        windows += [batch.payload[end - n : end] for end, n in zip(ends[good], batch.length[good], strict=True)]
    first, last = (int.from_bytes(w[4:6], "big") for w in (windows[0], windows[-1]))
    return (last - first) % 2**16


def _poses_of(folder: Path) -> int:
    paths = list(folder.glob("*.mcap"))
    if not paths:
        return 0
    try:
        return _state(paths[0])[0]
    except RecordingError:  # its first chunk is not on disk yet
        return 0


@pytest.fixture
def at_work(workshop: Any, start: Callable[..., Any], free_port: int) -> Callable[[str], tuple[Any, Any]]:
    """A unit, and a station that records from it without end."""

    def begin(command: str) -> tuple[Any, Any]:
        bus = {"host": "127.0.0.1", "port": free_port}
        sim = start("sim", workshop.device(bus=bus, eeprom="eeprom.bin"))
        station = workshop.station({"name": "rec", "bus": bus}, plan=ENDLESS)
        sim.says("serving ")
        output = ["-o", workshop.folder / "rec.mcap"] if command == "record" else ["--json"]
        return sim, start(command, station, *output)

    return begin


@pytest.mark.slow
@pytest.mark.parametrize("command", ["record", "run"])
def test_a_killed_process_loses_at_most_a_second_and_the_rest_can_be_fitted(
    workshop: Any,
    triaxcal: Callable[..., Any],
    at_work: Callable[[str], tuple[Any, Any]],
    wait_until: Callable[..., None],
    command: str,
) -> None:
    _, process = at_work(command)
    wait_until(lambda: _poses_of(workshop.folder) >= 16 or not process.running)
    killed_ns = time.time_ns()
    process.send(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL

    (path,) = workshop.folder.glob("*.mcap")
    triaxcal("fit", path).failed(2, str(path), "log recover")
    recovery = triaxcal("log", "recover", path, "--json").json
    mended = Path(recovery["output"])
    poses, last_ns = _state(mended)
    assert poses >= 16
    assert killed_ns - last_ns < SECOND_NS + BUSY_NS
    assert recovery["cut_short"] is True
    assert (recovery["raw_missing"], recovery["raw_dropped"], recovery["chunks_failed"]) == (0, 0, 0)
    info = triaxcal("log", "info", mended, "--json").json
    assert info["metadata"]["recovery"]["raw_records"] == str(recovery["raw_records"])
    assert recovery["raw_records"] == info["raw"]["calibration"]["records"]

    fitted = triaxcal("fit", mended, "--json")
    assert fitted.code == 0
    assert fitted.json["residual"]["rms_g"] < 1e-4
    told = [text.partition(" of ")[0] for text in fitted.json["data_quality"]]
    exported = triaxcal("log", "export", mended, "-o", workshop.folder / "a.csv").err
    if overflowed := _overflowed(mended):  # what is lost before the bus is told, and all that is told
        assert told == [f"missing_samples: {overflowed}"]
        assert exported.endswith(f"; {overflowed} missing\n")
    else:
        assert told == []
        assert exported.endswith("none lost\n")
    triaxcal("audit", mended).failed(2, "holds no result to audit")


@pytest.mark.slow
@pytest.mark.parametrize("command", ["record", "run"])
def test_an_interrupt_finishes_the_recording_and_leaves_the_unit_alone(
    workshop: Any,
    triaxcal: Callable[..., Any],
    at_work: Callable[[str], tuple[Any, Any]],
    wait_until: Callable[..., None],
    command: str,
) -> None:
    sim, process = at_work(command)
    wait_until(lambda: _poses_of(workshop.folder) >= 3 or not process.running)
    process.send(signal.SIGINT)
    assert process.wait() == 130
    if command == "run":
        (unit,) = json.loads(process.out)["units"]
        assert (unit["exit_code"], unit["device_state"], unit["registers_written"]) == (130, None, [])
    assert "interrupted" in process.err.splitlines()[-1]
    assert "Traceback" not in process.err

    (path,) = workshop.folder.glob("*.mcap")
    info = triaxcal("log", "info", path, "--json").json
    assert info["finished"] is True
    assert info["losses"] == []
    assert int(info["metadata"]["raw"]["records"]) == info["raw"]["calibration"]["records"]
    assert len(triaxcal("poses", path, "--json").json["poses"]) >= 3
    assert not list(workshop.folder.glob("*.certificate.json"))
    sim.send(signal.SIGTERM)
    assert sim.wait() == 0
    assert (workshop.folder / "eeprom.bin").read_bytes() == Stored(factory_calibration()).image()


@pytest.mark.slow
def test_a_unit_whose_process_dies_in_mid_recording_is_an_error(
    workshop: Any,
    triaxcal: Callable[..., Any],
    at_work: Callable[[str], tuple[Any, Any]],
    wait_until: Callable[..., None],
) -> None:
    sim, process = at_work("run")
    wait_until(lambda: _poses_of(workshop.folder) >= 3 or not process.running)
    sim.send(signal.SIGKILL)
    assert process.wait() == 4
    (unit,) = json.loads(process.out)["units"]
    assert unit["exit_code"] == 4
    assert "unit rec: " in unit["error"]
    assert process.err.splitlines()[-1] == f"triaxcal: {VERDICTS[unit['outcome']['verdict']]} {unit['error']}"
    assert triaxcal("log", "info", unit["recording"], "--json").json["finished"] is True
    assert triaxcal("audit", unit["recording"]).code == 0
