"""`python -m benchmarks.soak [--time 20m] [--seed N] [--folder F]`; `make soak SOAK=20m SEED=N`."""

from __future__ import annotations

import argparse
import heapq
import itertools
import json
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from benchmarks.soak.bench import Bench
from benchmarks.soak.faults import Fault, schedule
from benchmarks.soak.recorder import Recorder
from benchmarks.soak.verdict import verdict
from triaxcald.cli.syntax import duration

LOOK_S = 2.0
BEGINS_IN_S = 60.0
HEARD_S = 5.0
"""A unit that is recorded was heard within this time."""
SEGMENTS = 12
"""Of each unit in the time of the soak: enough to have faults at their borders."""
_LAST_RECORD = re.compile(r'^triaxcal_last_record_timestamp_seconds{unit="(\w+)"} (\S+)$', re.MULTILINE)


class Process:
    """The simulated units of one bus, in a process of their own."""

    def __init__(self, bench: Bench, bus: str, seed: int) -> None:
        self.bus = bus
        self._popen = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.soak.units", str(bench.folder.resolve()), bus, str(seed)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parents[2],
        )  # fmt: skip

    def ready(self) -> None:
        assert self._popen.stdout is not None
        if self._popen.stdout.readline() != "ready\n":
            raise SystemExit(f"soak: the simulated units of {self.bus} do not come up")

    @property
    def running(self) -> bool:
        return self._popen.poll() is None

    def command(self, fault: Fault) -> None:
        assert self._popen.stdin is not None
        said = {"place": fault.place, "what": fault.what, "seconds": fault.seconds, "share": fault.share}
        self._popen.stdin.write(json.dumps(said) + "\n")
        self._popen.stdin.flush()

    def send(self, number: signal.Signals) -> None:
        self._popen.send_signal(number)

    def end(self) -> None:
        """In order, so that all it has written down is there."""
        self.send(signal.SIGCONT)
        assert self._popen.stdin is not None
        self._popen.stdin.close()
        try:
            self._popen.wait(30)
        except subprocess.TimeoutExpired:
            self._popen.kill()
            self._popen.wait()


class Soak:
    """``faults`` are filled with what is wrong while it runs."""

    def __init__(self, bench: Bench, seed: int, seconds: float, stack: ExitStack) -> None:
        self.bench, self.seconds = bench, seconds
        self.schedule = schedule(seed, seconds, bench.units)
        self.faults: list[str] = []
        self._buses = {unit.name: unit.bus for unit in bench.units}
        self._processes: dict[str, Process] = {}
        for bus in (*dict.fromkeys(self._buses.values()), "stranger"):
            self._processes[bus] = process = Process(bench, bus, seed)
            stack.callback(process.end)
        for process in self._processes.values():
            process.ready()
        self.recorder = Recorder(bench, bench.metrics_port, max(5.0, seconds / SEGMENTS))
        stack.callback(self.recorder.end)

    def run(self) -> int:
        """When the recorder was asked to stop, by the host's clock in ns."""
        self.recorder.start()
        self._until_recording()
        begin = time.monotonic()
        order = itertools.count()
        due: list[tuple[float, int, Callable[[], Any]]] = [(0.0, next(order), self._look)]
        for fault in self.schedule:
            for at_s, act in self._acts(fault):
                heapq.heappush(due, (at_s, next(order), act))
        heapq.heappush(due, (self.seconds, next(order), lambda: None))
        while due:
            at_s, _, act = heapq.heappop(due)
            time.sleep(max(0.0, begin + at_s - time.monotonic()))
            act()
            if act == self._look and at_s < self.seconds:
                heapq.heappush(due, (at_s + LOOK_S, next(order), act))
        self._judge_end()
        return self._stop()

    def _until_recording(self) -> None:
        deadline = time.monotonic() + BEGINS_IN_S
        while not (self.recorder.health() or {}).get("healthy"):
            if time.monotonic() > deadline:
                raise SystemExit(f"soak: not all units are recorded after {BEGINS_IN_S:g} s; see {self.recorder.log}")
            self.recorder.look()
            if self.recorder.died:
                raise SystemExit(f"soak: the recorder ends with {self.recorder.died[0]}; see {self.recorder.log}")
            time.sleep(0.2)

    def _acts(self, fault: Fault) -> list[tuple[float, Callable[[], Any]]]:
        begin, end = fault.at_s, fault.at_s + fault.seconds
        recorder = self.recorder

        def said(act: Callable[[], Any]) -> Callable[[], Any]:
            def begun() -> None:
                print(f"{datetime.now(UTC):%H:%M:%S} {fault}", flush=True)
                act()

            return begun

        if fault.what == "recorder killed":
            return [(begin, said(recorder.kill)), (end, recorder.start)]
        if fault.what == "recorder stopped":
            return [(begin, said(lambda: recorder.send(signal.SIGSTOP))), (end, lambda: recorder.send(signal.SIGCONT))]
        bus = "stranger" if fault.what == "flood" else self._buses.get(fault.place, fault.place)
        process = self._processes[bus]
        if fault.what == "bus stopped":
            return [(begin, said(lambda: process.send(signal.SIGSTOP))), (end, lambda: process.send(signal.SIGCONT))]
        return [(begin, said(lambda: process.command(fault)))]

    def _look(self) -> None:
        died = len(self.recorder.died)
        self.recorder.look()
        if len(self.recorder.died) > died:
            self.faults.append(f"the recorder died by itself, with {self.recorder.died[-1]}; see {self.recorder.log}")
            self.recorder.start()
        for process in self._processes.values():
            if not process.running:
                raise SystemExit(f"soak: the simulated units of {process.bus} have died")

    def _judge_end(self) -> None:
        """All units are recorded, some time after the last fault."""
        health = self.recorder.health()
        if health is None:
            self.faults.append("the recorder does not answer")
            return
        for unit in health["units"]:
            if unit["state"] != "recording":
                self.faults.append(f"{unit['unit']} has not come back: {unit['state']}, {unit['trouble']}")
        heard_s = dict(_LAST_RECORD.findall(self.recorder.metrics()))
        for unit in self.bench.units:
            if (ago_s := time.time() - float(heard_s.get(unit.name, 0.0))) > HEARD_S:
                self.faults.append(f"{unit.name} is said to be recorded, and was last heard {ago_s:.1f} s ago")

    def _stop(self) -> int:
        stopped_ns = time.time_ns()
        code = self.recorder.stop()
        if code != 130:
            self.faults.append(f"the recorder ended with {code} when it was stopped, expected 130")
        return stopped_ns


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="benchmarks.soak", description=__doc__)
    parser.add_argument("--time", type=duration, default=1200.0, metavar="TIME", help="as 90s or 20m, the default")
    parser.add_argument("--seed", type=int, help="of the faults; default: of the time of day, and printed")
    parser.add_argument("--can", type=int, default=4, metavar="N", help="units on the CAN bus")
    parser.add_argument("--folder", type=Path, help="where files are left; default: removed where all is well")
    a = parser.parse_args(arguments)
    seed = time.time_ns() // 10**9 % 100_000 if a.seed is None else a.seed
    folder = a.folder or Path(tempfile.mkdtemp(prefix="soak-"))
    folder.mkdir(parents=True, exist_ok=True)
    bench = Bench.made(folder, a.can)
    print(f"soak: seed {seed}, {a.time:g} s, {len(bench.units)} units, in {folder}", flush=True)
    with ExitStack() as stack:
        soak = Soak(bench, seed, a.time, stack)
        stopped_ns = soak.run()
    found = verdict(bench, soak.recorder, soak.schedule, stopped_ns, a.time)
    for table in found.tables:
        print(table)
    for fault in (faults := soak.faults + found.faults):
        print(f"\nsoak: {fault}")
    end = f"{len(faults)} faults; {folder} has the files" if faults else "no sample was lost in silence"
    print(f"\nsoak: seed {seed}: {end}")
    if not faults and a.folder is None:
        shutil.rmtree(folder, ignore_errors=True)
    return 1 if faults else 0


if __name__ == "__main__":
    raise SystemExit(main())
