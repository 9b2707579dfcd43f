"""The whole way: a simulated unit on a CAN interface, recorded, with candump beside it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.guest.inside.witness import PATIENCE_S, listeners, seen, wait_until
from triaxcald.cli.commands import main
from triaxcald.cli.signals import heed_stop_signals
from triaxcald.recording.reader import Recording
from triaxcald.simulation import bench, can_unit  # noqa: F401 - which take long: once for both processes
from triaxcald.station import collection  # noqa: F401
from triaxcald.station.lock import FOLDER_VARIABLE

SECONDS = 2
DEVICE = """\
format = "triaxcal.device/1"
profile = "triax-ref-can"
serial = 4711
speed = 1.0
fixture = {{ poses = 9 }}
bus = {{ interface = "socketcan", channel = "{0}", node_id = 5 }}
"""
STATION = """\
format = "triaxcal.station/1"
name = "bench"
[[units]]
name = "unit"
profile = "triax-ref-can"
serial = "4711"
bus = {{ interface = "socketcan", channel = "{0}", node_id = 5 }}
"""


def started(said: Path, *arguments: object) -> int:
    """A command of ours in a process of its own, with what is imported here already; the process's number."""
    said.touch()
    process = os.fork()
    if process == 0:
        code = 70
        try:
            sys.stdout = sys.stderr = open(said, "w", buffering=1)  # noqa: SIM115
            heed_stop_signals()
            code = main([str(argument) for argument in arguments])
        finally:
            os._exit(code)
    return process


def test_a_recording_holds_every_frame_that_candump_saw(
    vcan: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "device.toml").write_text(DEVICE.format(vcan))
    (tmp_path / "station.toml").write_text(STATION.format(vcan))
    recording, log = tmp_path / "recording.mcap", tmp_path / "candump.log"
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))
    before = listeners(vcan)
    with open(log, "w") as out:
        witness = subprocess.Popen(["candump", "-L", "-r", "8000000", vcan], stdout=out)
    wait_until(lambda: listeners(vcan) > before)
    unit = started(tmp_path / "unit", "sim", tmp_path / "device.toml")
    wait_until(lambda: "serving triax-ref-can, serial 4711" in (tmp_path / "unit").read_text())
    station = started(
        tmp_path / "station", "record", tmp_path / "station.toml", "-o", recording, "--seconds", str(SECONDS)
    )
    code = os.waitstatus_to_exitcode(os.waitpid(station, 0)[1])
    os.kill(unit, signal.SIGINT)
    os.waitpid(unit, 0)
    witness.send_signal(signal.SIGINT)
    witness.wait(PATIENCE_S)
    assert code == 0, (tmp_path / "station").read_text()

    recorded = _records(recording)
    identifiers = {identifier for _, identifier, _ in recorded}
    dumped = [(f.time_us, f.word, f.data) for f in map(seen, log.read_text().splitlines()) if f.word in identifiers]
    first = next(i for i, (_, *frame) in enumerate(dumped) if frame == list(recorded[0][1:]))
    witnessed = dumped[first : first + len(recorded)]
    assert [frame[1:] for frame in recorded] == [frame[1:] for frame in witnessed]
    apart_us = np.array([frame[0] for frame in recorded]) - np.array([frame[0] for frame in witnessed])
    assert np.abs(apart_us).max() <= 1
    assert len(recorded) >= SECONDS * 100 * len(identifiers) - 10  # 100 Hz


def _records(path: Path) -> list[tuple[int, int, bytes]]:
    records = []
    with Recording.open(path) as recording:
        for _, batch in recording.raw_batches():
            ends = np.cumsum(batch.length)
            for time_ns, source, begin, end in zip(batch.time_ns, batch.source, ends - batch.length, ends, strict=True):
                records.append((int(time_ns) // 1000, int(source), batch.payload[begin:end]))
    return records
