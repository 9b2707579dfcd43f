"""Commands of ours on a CAN interface, each in a process of its own."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path
from typing import Any

import numpy as np

from tests.guest.inside.witness import wait_until
from triaxcald.cli.commands import main
from triaxcald.cli.signals import heed_stop_signals
from triaxcald.recording.reader import Recording
from triaxcald.run import record_only  # noqa: F401 - these take long, and so are imported once for all processes
from triaxcald.simulation import bench, can_unit  # noqa: F401
from triaxcald.station.lock import FOLDER_VARIABLE

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


class Command:
    """``said`` is the file to which it writes what it says."""

    def __init__(self, folder: Path, *arguments: object) -> None:
        self.said = folder / f"{arguments[0]}.txt"
        self.said.touch()
        self._process = os.fork()
        if self._process == 0:
            code = 70
            try:
                os.environ[FOLDER_VARIABLE] = str(folder)
                sys.stdout = sys.stderr = open(self.said, "w", buffering=1)  # noqa: SIM115
                heed_stop_signals()
                code = main([str(argument) for argument in arguments])
            finally:
                os._exit(code)

    def says(self, words: str) -> None:
        """Waits for it."""
        wait_until(lambda: words in self.said.read_text())

    def ends(self) -> int:
        """Waits for it; the exit code."""
        return os.waitstatus_to_exitcode(os.waitpid(self._process, 0)[1])

    def signal(self, number: signal.Signals) -> None:
        os.kill(self._process, number)

    def stop(self) -> None:
        self.signal(signal.SIGINT)
        self.ends()


def simulated_unit(folder: Path, name: str) -> Command:
    """At work on an interface."""
    device = folder / "device.toml"
    device.write_text(DEVICE.format(name))
    unit = Command(folder, "sim", device)
    unit.says("serving triax-ref-can, serial 4711")
    return unit


def recorder(folder: Path, name: str, path: Path, *options: object) -> Command:
    """``record`` of that unit, seen on an interface."""
    station = folder / "station.toml"
    station.write_text(STATION.format(name))
    return Command(folder, "record", station, "-o", path, *options)


def records(path: Path) -> list[tuple[int, int, int, bytes]]:
    """Of a recording: time in µs, identifier, flags and data of each frame."""
    found = []
    with Recording.open(path) as held:
        for _, batch in held.raw_batches():
            ends = np.cumsum(batch.length)
            starts = ends - batch.length
            columns = zip(batch.time_ns, batch.source, batch.flags, starts, ends, strict=True)
            for time_ns, source, flags, start, end in columns:
                found.append((int(time_ns) // 1000, int(source), int(flags), batch.payload[start:end]))
    return found


def events(path: Path) -> list[tuple[str, Any]]:
    """Of a recording: kind and detail of each."""
    with Recording.open(path) as held:
        return [(event.kind, event.detail) for event in held.events()]
