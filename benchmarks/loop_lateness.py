"""How late the event loop of a run is in a folder with many outcomes: `python -m benchmarks.loop_lateness`.

Two simulated units on Modbus TCP, served by a process of their own, are recorded, calibrated, written and checked. A
task in the loop of the run wakes up every 10 ms and notes how late it is. The same tray runs in an empty folder too,
for the share that the machine and the work itself have. A folder whose outcomes nobody has indexed is measured as well.
"""

from __future__ import annotations

import argparse
import asyncio
import multiprocessing
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.results_index import OUTCOMES, fill
from benchmarks.table import Table
from triaxcald.run.orders import works
from triaxcald.run.unit_run import TrayRun
from triaxcald.schema.codes import Stage
from triaxcald.station.config import Station, load_station
from triaxcald.store import History
from triaxcald.work import Work

MOST_S = 0.5
"""A run may be so late at most."""
TICK_S = 0.01
SPEED = 15.0
DEVICE = """\
format = "triaxcal.device/1"
profile = "triax-ref-modbus"
serial = {serial}
seed = {serial}
bus = {{ host = "127.0.0.1", port = {port} }}
speed = {speed}
[fixture]
poses = 12
hold_s = 1.4
move_s = 0.6
"""


@dataclass
class Lateness:
    """The largest lateness of a loop [s] by the phase in which it fell: the last stage that any unit has entered."""

    phase: str = "begin"
    largest: dict[str, float] = field(default_factory=dict)

    async def watch(self) -> None:
        due_s = time.monotonic()
        while True:
            due_s = max(due_s + TICK_S, time.monotonic())
            began_in = self.phase
            await asyncio.sleep(max(0.0, due_s - time.monotonic()))
            late_s = time.monotonic() - due_s
            for phase in {began_in, self.phase}:
                self.largest[phase] = max(self.largest.get(phase, 0.0), late_s)

    @property
    def worst(self) -> tuple[float, str]:
        return max((late_s, phase) for phase, late_s in self.largest.items())

    def stage(self, unit: str, stage: Stage) -> None:
        self.phase = stage

    def poses(self, unit: str, phase: str, guide: Any) -> None: ...
    def note(self, unit: str, text: str) -> None: ...
    def lost(self, unit: str, code: object, reason: str) -> None: ...
    def back(self, unit: str) -> None: ...


def free_ports(number: int) -> list[int]:
    sockets = [socket.create_server(("127.0.0.1", 0)) for _ in range(number)]
    ports = [s.getsockname()[1] for s in sockets]
    for s in sockets:
        s.close()
    return ports


@contextmanager
def served(within: Path, ports: Mapping[str, int]) -> Iterator[None]:
    """The units by serial number, in a process for each: their work delays no loop but their own."""
    processes = []
    try:
        for serial, port in ports.items():
            device = within / f"{serial}.toml"
            device.write_text(DEVICE.format(serial=serial, port=port, speed=SPEED))
            command = [sys.executable, "-m", "triaxcald.cli", "sim", str(device)]
            processes.append(subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT))
        for process in processes:
            assert process.stdout is not None
            said = process.stdout.readline()
            if not said.startswith(b"serving "):
                raise SystemExit(said.decode())
        yield
    finally:
        for process in processes:
            process.send_signal(signal.SIGTERM)
            process.communicate()


def station_in(within: Path, folder: Path, ports: Mapping[str, int]) -> Path:
    units = "".join(
        f'[[units]]\nname = "s{serial}"\nprofile = "triax-ref-modbus"\nserial = "{serial}"\n'
        f'bus = {{ host = "127.0.0.1", port = {port} }}\n'
        for serial, port in ports.items()
    )
    path = within / "station.toml"
    path.write_text(
        f'format = "triaxcal.station/1"\nname = "bench"\nfolder = "{folder}"\n'
        f"[plan]\nposes = 12\nhold_s = 0.6\ncheck_poses = 2\n{units}"
    )
    return path


async def watched(station: Station, work: Mapping[str, Work]) -> tuple[Lateness, list[str]]:
    late = Lateness()
    watch = asyncio.ensure_future(late.watch())
    await asyncio.sleep(0.1)
    outcomes = await TrayRun(station, late, work=work)
    watch.cancel()
    return late, [str(outcome.document["code"]) for outcome in outcomes]


def measured(outcomes: int, *, indexed: bool) -> tuple[Lateness, list[str]]:
    with tempfile.TemporaryDirectory() as name:
        within, folder = Path(name), Path(name) / "line"
        folder.mkdir()
        if outcomes:
            fill(folder, outcomes)
        if indexed and outcomes:
            time.sleep(2.5)  # what was written just now is read again, as it may still change
            History.of(folder, "000001")
        ports = dict(zip(("1001", "1002"), free_ports(2), strict=True))
        with served(within, ports):
            station = load_station(station_in(within, folder, ports))
            return asyncio.run(watched(station, works(station, {})))  # as the command does, before its loop


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--quick", action="store_true", help="a tenth of the outcomes")
    many = OUTCOMES // 10 if parser.parse_args(arguments).quick else OUTCOMES
    runs = (("empty", 0, True), (f"{many} outcomes", many, True), (f"{many} outcomes, no index", many, False))
    found = {}
    for what, outcomes, indexed in runs:  # each in a process of its own, which loads its modules itself
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            found[what] = pool.submit(measured, outcomes, indexed=indexed).result()
    empty_s, _ = found["empty"][0].worst
    rows = []
    for what, (late, codes) in found.items():
        worst_s, phase = late.worst
        phases = ", ".join(f"{name} {1e3 * late_s:.0f}" for name, late_s in late.largest.items())
        rows.append([what, f"{1e3 * worst_s:.0f}", phase, f"{worst_s / empty_s:.1f}", phases, " ".join(codes)])
    heads = ["folder", "largest lateness [ms]", "phase", "to the empty one", "by phase [ms]", "codes"]
    print(Table("Lateness of the event loop of a tray of two", heads, rows))
    worst_s = max(late.worst[0] for late, _ in found.values())
    print(f"largest lateness {worst_s:.3f} s, {'within' if worst_s < MOST_S else 'over'} {MOST_S} s")
    return int(worst_s >= MOST_S)


if __name__ == "__main__":
    raise SystemExit(main())
