"""Two simulated hours of trays at a station: `python -m benchmarks.station_hours [--hours 2] [--speed 20] [--slots 4]`.

`triaxcal serve` runs as a process; the simulated units of each tray are in another, turned by an operator who follows
the service. A line scans, starts, waits for the end and goes on to the next tray, most of them whole, some with a wrong
unit, an empty slot, a unit that is stopped or one too noisy to pass. Two readers follow the events, one of them slowly,
and a receiver takes the results. The hours are those of the units' clock, which a busy machine stretches.

Each second the service is measured from outside: memory, descriptors, threads, the lateness of its event loop. In the
end outcomes, rows of the database, events and results must be the same. The exit code is 1 where a target is missed.
"""

from __future__ import annotations

import argparse
import asyncio
import http.client
import itertools
import json
import multiprocessing
import os
import re
import signal
import socket
import sqlite3
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import urllib.error
import urllib.request
import uuid
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.loop_lateness import MOST_S, free_ports
from benchmarks.table import Table
from tests.simulated_tray import DEVICE, UNIT

GROWTH_MOST = 5.0
"""MiB of the service's memory per 100 runs, once it is warm."""
WARM = 0.25
"""Share of the runs after which it is."""
PATIENCE_S = 60.0
SLOW_BYTES, SLOW_S = 1024, 0.25
"""The slow reader takes so much, then pauses for so long."""
SLOTS = "abcdefgh"
STATION = """\
format = "triaxcal.station/1"
name = "hours"
folder = "runs"
[plan]
poses = 12
hold_s = 1.4
check_poses = 2
comes_back_s = 0.5
patience_s = 60.0
repeat = false
[limits]
rms_g = 5e-4
verification_rms_g = 5e-4
[rules]
open_loopback = true
[fixture]
together = true
[[deliver]]
name = "mes"
url = "http://127.0.0.1:{receiver}/results"
"""
WRONG, EMPTY, STOPPED, NOISY = "wrong unit", "empty slot", "stopped", "noisy"
KINDS = ("", WRONG, "", EMPTY, "", STOPPED, "", NOISY)
"""What is wrong with a tray, one after the other."""
CODES = {
    WRONG: {"wrong_unit"}, EMPTY: {"absent"}, STOPPED: {"stopped"}, NOISY: {"fit_outside", "verification_outside"},
}  # fmt: skip


# What stands around the service.


def simulate(files: Sequence[Path], url: str, clock: Any, ready: Any) -> None:
    """As `triaxcal sim FILES --follow URL`; ``clock`` shows the units' time."""
    from triaxcald.cli.stations import simulated
    from triaxcald.simulation.follow import ServiceEvents
    from triaxcald.simulation.tray import load_tray

    sys.stderr = open(os.devnull, "w")  # noqa: SIM115 - says of each unit where it is
    tray = load_tray(files, followed=True)

    async def both() -> None:
        serving = asyncio.ensure_future(simulated(tray, ServiceEvents(url)))
        ready.set()
        while not serving.done():
            clock.value = tray.time_base.now_s()
            await asyncio.sleep(0.05)
        serving.result()

    asyncio.run(both())


class Receiver:
    """A factory's own system."""

    def __init__(self, port: int) -> None:
        self.taken: Counter[str] = Counter()
        receiver = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                result = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
                receiver.taken[result["outcome"]["run"]] += 1
                self.send_response(201)
                self.send_header("Content-Length", "0")
                self.end_headers()

            def log_message(self, format: str, *args: object) -> None: ...

        self._server = ThreadingHTTPServer(("127.0.0.1", port), Handler)
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()


class Reader:
    """Follows the events from the first on, and comes again where it is let go. A slow one takes a little at a time,
    until it is told to ``hurry``."""

    def __init__(self, port: int, *, slow: bool) -> None:
        self.ended: Counter[str] = Counter()
        self.seqs: list[int] = []
        self.connections = 0
        self.hurry = threading.Event()
        if not slow:
            self.hurry.set()
        self._port, self._over = port, threading.Event()
        threading.Thread(target=self._run, daemon=True).start()

    def close(self) -> None:
        self._over.set()
        self.hurry.set()

    def _run(self) -> None:
        while not self._over.is_set():
            with suppress(OSError, http.client.HTTPException):
                self._listen()
            self._over.wait(0.2)

    def _listen(self) -> None:
        with socket.socket() as connected:
            if not self.hurry.is_set():
                connected.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)  # before it connects
            connected.settimeout(10)
            connected.connect(("127.0.0.1", self._port))
            connection = http.client.HTTPConnection("127.0.0.1", self._port)
            connection.sock = connected
            connection.request("GET", f"/api/1/events?after={self.seqs[-1] if self.seqs else 0}")
            answer = connection.getresponse()
            self.connections += 1
            taken, kind = 0, b""
            for line in iter(lambda: answer.readline(1 << 22), b""):
                if self._over.is_set():
                    return
                name, _, value = line.rstrip(b"\r\n").partition(b": ")
                if name == b"event":
                    kind = value
                elif name == b"data" and kind == b"event":
                    self._take(json.loads(value))
                taken += len(line)
                if taken >= SLOW_BYTES and not self.hurry.is_set():
                    self.hurry.wait(SLOW_S * taken / SLOW_BYTES)
                    taken = 0

    def _take(self, event: Mapping[str, Any]) -> None:
        self.seqs.append(event["seq"])
        if event["event"] == "ended":
            self.ended[event["run"]] += 1

    @property
    def in_order(self) -> bool:
        """Whether each event came once, in its place."""
        return self.seqs == list(range(1, len(self.seqs) + 1))


# What is measured from outside.


@dataclass(frozen=True)
class Look:
    """The service at a time; memory in MiB."""

    at_s: float
    runs: int
    tray: int
    memory: float
    own: float
    simulated_s: float
    children: float
    files: int
    threads: int
    late_s: float
    answer_s: float
    load: float
    counts: tuple[int, ...]


def memory_of(pid: int) -> tuple[float, float, int]:
    """Resident memory and the part of it that is no file, both in MiB; threads."""
    status = Path(f"/proc/{pid}/status").read_text()
    found = {name: int(value) for name, value in re.findall(r"^(\w+):\s+(\d+)", status, re.MULTILINE)}
    return found["VmRSS"] / 1024, found["RssAnon"] / 1024, found["Threads"]


def children_of(pid: int) -> list[int]:
    found: list[int] = []
    for task in Path(f"/proc/{pid}/task").iterdir():
        with suppress(OSError):  # a thread has ended
            found += map(int, (task / "children").read_text().split())
    return found


@dataclass
class Hours:
    """The station, its service and its line."""

    folder: Path
    speed: float
    slots: str
    stack: ExitStack
    kept: Path | None = None
    looks: list[Look] = field(default_factory=list)
    codes: Counter[str] = field(default_factory=Counter)
    faults: list[str] = field(default_factory=list)
    simulated_s: float = 0.0
    trays: int = 0

    def __post_init__(self) -> None:
        self.port, receiver, *ports = free_ports(2 + len(self.slots))
        self.ports = dict(zip(self.slots, ports, strict=True))
        station = self.folder / "station.toml"
        units = "".join(UNIT.format(slot=slot, port=port) for slot, port in self.ports.items())
        station.write_text(STATION.format(receiver=receiver) + units)
        self.receiver = Receiver(receiver)
        self.stack.callback(self.receiver.close)
        command = [sys.executable, "-m", "triaxcald.cli", "serve", str(station), "--port", str(self.port)]
        log = self.stack.enter_context((self.folder / "log").open("w"))
        self.service = subprocess.Popen(command, stdout=log, stderr=log)
        self.stack.callback(self._end)
        self._until(self._answers)
        self.readers = [Reader(self.port, slow=slow) for slow in (False, True)]
        for reader in self.readers:
            self.stack.callback(reader.close)
        self._until(lambda: self._listeners() == len(self.readers))
        self._context = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload(["triaxcald.cli.stations", "triaxcald.simulation.tray"])
        self._began_s = time.monotonic()
        self._over = threading.Event()
        self._looking = threading.Thread(target=self._look_on, daemon=True)
        self._looking.start()

    @property
    def log(self) -> str:
        return (self.folder / "log").read_text()

    def _end(self) -> None:
        if self.service.poll() is None:
            self.service.send_signal(signal.SIGTERM)
            try:
                self.service.wait(60)
            except subprocess.TimeoutExpired:
                self.service.kill()
                self.service.wait()

    def _answers(self) -> bool:
        if self.service.poll() is not None:
            raise SystemExit(self.log)
        with suppress(urllib.error.URLError):
            return self.call("GET", "/health")["healthy"] is True
        return False

    def _until(self, condition: Callable[[], bool]) -> None:
        deadline_s = time.monotonic() + PATIENCE_S
        while not condition():
            if time.monotonic() > deadline_s:
                state = json.dumps(self._states(), indent=1)
                health = self.call("GET", "/health")
                raise SystemExit(f"tray {self.trays}: the station does not go on\n{state}\n{health}\n{self.log}")
            time.sleep(0.05)

    def call(self, method: str, path: str, body: Any = None) -> Any:
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(f"http://127.0.0.1:{self.port}{path}", data, method=method)
        request.add_header("Content-Type", "application/json")
        with urllib.request.urlopen(request, timeout=30) as answer:
            return json.loads(answer.read())

    # The line.

    def _listeners(self) -> int:
        return int(self.call("GET", "/health")["listeners"])

    def _states(self) -> dict[str, dict[str, Any]]:
        return {slot["slot"]: slot for slot in self.call("GET", "/api/1/station")["slots"]}

    def tray(self) -> None:
        kind, number = KINDS[self.trays % len(KINDS)], self.trays
        self.trays += 1
        scanned = {slot: 1001 + 10 * number + i for i, slot in enumerate(self.slots)}
        odd = self.slots[number % len(self.slots)]
        files = []
        for slot, serial in scanned.items():
            if slot == odd and kind == EMPTY:
                continue
            there = 900_000 + number if slot == odd and kind == WRONG else serial
            noise_g = 0.06 if slot == odd and kind == NOISY else 2e-4
            path = self.folder / f"{slot}.toml"
            path.write_text(
                DEVICE.format(slot=slot, serial=there, port=self.ports[slot], speed=self.speed, noise_g=noise_g)
            )
            files.append(path)
        clock, ready = self._context.Value("d", 0.0), self._context.Event()
        sim = self._context.Process(target=simulate, args=(files, f"http://127.0.0.1:{self.port}", clock, ready))
        sim.start()
        try:
            if not ready.wait(PATIENCE_S):
                raise SystemExit("the simulated tray does not come up")
            self._until(lambda: self._listeners() > len(self.readers))
            for serial in scanned.values():
                self.call("POST", "/api/1/scan", {"text": str(serial)})
            self.call("POST", "/api/1/tray/start", {"request": str(uuid.uuid4())})
            if kind == STOPPED:
                self._until(lambda: (s := self._states()[odd])["stage"] == "poses" and s["found"] >= 3)
                self.call("POST", f"/api/1/slots/{odd}/stop", {"reason": "dropped"})
            self._until(lambda: all(s["state"] not in ("running", "lost") for s in self._states().values()))
            found = {slot: state["code"] for slot, state in self._states().items()}
            self.call("POST", "/api/1/tray/clear")
        finally:
            sim.terminate()
            sim.join()
        self.simulated_s += clock.value
        self.codes.update(found.values())
        for slot, code in found.items():
            if code not in (CODES[kind] if kind and slot == odd else {"within_limits"}):
                self.faults.append(f"tray {number + 1}, slot {slot}: {code}")
        self._until(lambda: self._listeners() == len(self.readers))

    # Looks from outside.

    def _look_on(self) -> None:
        due_s = time.monotonic()
        while not self._over.wait(max(0.0, due_s - time.monotonic())):
            due_s = max(due_s + 1.0, time.monotonic())
            try:
                self.looks.append(self._look())
                if self.kept is not None:
                    with self.kept.open("a") as file:
                        file.write(json.dumps(vars(self.looks[-1])) + "\n")
            except (OSError, sqlite3.Error, http.client.HTTPException) as e:
                self.faults.append(f"a look failed: {e}")

    def _look(self) -> Look:
        pid = self.service.pid
        memory, own, threads = memory_of(pid)
        children = 0.0
        for child in children_of(pid):
            with suppress(OSError, KeyError):
                children += memory_of(child)[0]
        files = len(os.listdir(f"/proc/{pid}/fd"))
        asked_s = time.monotonic()
        with urllib.request.urlopen(f"http://127.0.0.1:{self.port}/metrics", timeout=30) as answer:
            metrics = answer.read().decode()
        answer_s = time.monotonic() - asked_s
        (late,) = re.findall(r"^triaxcal_loop_late_seconds (\S+)$", metrics, re.MULTILINE)
        counts = tuple(len(runs) for runs in self.found().values())
        return Look(
            time.monotonic() - self._began_s, counts[0], self.trays, memory, own,
            self.simulated_s, children, files, threads, float(late),
            answer_s, os.getloadavg()[0], counts,
        )  # fmt: skip

    def found(self) -> dict[str, Counter[str]]:
        """The runs that each place knows."""
        runs = self.folder / "runs"
        outcomes = [json.loads(path.read_text())["run"] for path in runs.glob("*.outcome.json")]
        db = sqlite3.connect(f"file:{runs / 'triaxcal.sqlite'}?mode=ro", uri=True, timeout=10)
        try:
            rows = [run for (run,) in db.execute("SELECT run FROM run")]
        finally:
            db.close()
        quick, slow = self.readers
        return {
            "outcomes": Counter(outcomes),
            "rows": Counter(rows),
            "events, quick reader": quick.ended.copy(),
            "events, slow reader": slow.ended.copy(),
            "results": self.receiver.taken.copy(),
        }

    def settle(self) -> dict[str, Counter[str]]:
        """The slow reader catches up; what each place knows in the end."""
        for reader in self.readers:
            reader.hurry.set()
        deadline_s = time.monotonic() + 30
        while len({frozenset(runs) for runs in self.found().values()}) > 1 and time.monotonic() < deadline_s:
            time.sleep(0.2)
        self._over.set()
        self._looking.join()
        return self.found()


# What it comes to.


def growth(looks: Sequence[Look], of: Callable[[Look], float]) -> tuple[float, float]:
    """MiB per 100 runs with its standard error, by a line through the median of each tray once it is warm."""
    warm = [look for look in looks if look.runs >= WARM * looks[-1].runs]
    trays = sorted({look.tray for look in warm})
    of_trays = [[look for look in warm if look.tray == tray] for tray in trays]
    x = np.array([statistics.fmean(look.runs for look in some) for some in of_trays]) / 100
    y = np.array([statistics.median(map(of, some)) for some in of_trays])
    if len(x) < 4:
        return float("nan"), float("nan")
    (slope, _), covariance = np.polyfit(x, y, 1, cov=True)
    return float(slope), float(np.sqrt(covariance[0, 0]))


def quarters(looks: Sequence[Look], of: Callable[[Look], float]) -> list[float]:
    """The median of each quarter of the time."""
    last_s = looks[-1].at_s
    parts: list[list[float]] = [[], [], [], []]
    for look in looks:
        parts[min(3, int(4 * look.at_s / last_s))].append(of(look))
    return [statistics.median(part) if part else float("nan") for part in parts]


def report(hours: Hours, found: Mapping[str, Counter[str]], wall_s: float) -> int:
    looks = hours.looks
    loads = [look.load for look in looks]
    about = (
        f"{hours.simulated_s / 3600:.2f} simulated hours of {hours.trays} trays in {len(hours.slots)} slots, "
        f"{wall_s:.0f} s: {hours.simulated_s / wall_s:.1f} times as fast as life, {hours.speed:g} wanted; "
        f"load {statistics.median(loads):.1f}, at most {max(loads):.1f}, of {os.cpu_count()} processors"
    )
    rows = []
    measured: list[tuple[str, Callable[[Look], float]]] = [
        ("resident memory [MiB]", lambda look: look.memory), ("of it no file [MiB]", lambda look: look.own),
        ("children [MiB]", lambda look: look.children), ("open files", lambda look: look.files),
        ("threads", lambda look: look.threads), ("answer of /metrics [ms]", lambda look: 1e3 * look.answer_s),
    ]  # fmt: skip
    for what, of in measured:
        slope, error = growth(looks, of)
        figures = [f"{v:.1f}" for v in quarters(looks, of)]
        rows.append([what, *figures, f"{max(map(of, looks)):.1f}", f"{slope:+.2f} ± {error:.2f}"])
    print(Table(about, ["median of a quarter", "1", "2", "3", "4", "most", "per 100 runs"], rows))
    counts = [[what, str(runs.total()), str(len(runs))] for what, runs in found.items()]
    print(Table("Runs", ["place", "runs", "different"], counts))
    for name, reader in zip(("quick", "slow"), hours.readers, strict=True):
        order = "each once, in order" if reader.in_order else "NOT each once in order"
        behind = max(look.counts[2] - look.counts[3] for look in looks) if name == "slow" else 0
        print(
            f"{name} reader: {len(reader.seqs)} events, {order}; {reader.connections} connections"
            + (f"; at most {behind} ended runs behind the quick one" if behind else "")
        )
    print("codes:", ", ".join(f"{code} {n}" for code, n in hours.codes.most_common()))
    rises = [f"{b.at_s:.0f} s: {b.late_s:.2f}" for a, b in itertools.pairwise(looks) if b.late_s > a.late_s]
    print(f"lateness [s] by time of a new greatest: {', '.join(rises)}")

    outcomes = found["outcomes"]
    missed = [what for what, runs in found.items() if runs != outcomes]
    missed += [f"runs there twice: {what}" for what, runs in found.items() if runs.total() != len(runs)]
    if outcomes.total() != hours.trays * len(hours.slots):
        missed.append(f"{outcomes.total()} outcomes of {hours.trays * len(hours.slots)} runs")
    missed += [f"events of the {n} reader" for n, r in zip(("quick", "slow"), hours.readers, strict=True)
               if not r.in_order]  # fmt: skip
    slope, _ = growth(looks, lambda look: look.memory)
    if not slope < GROWTH_MOST:
        missed.append(f"memory grows by {slope:.1f} MiB per 100 runs")
    if looks[-1].late_s >= MOST_S:
        missed.append(f"the event loop was late by {looks[-1].late_s:.2f} s")
    missed += hours.faults
    print("; ".join(f"MISSED: {what}" for what in missed) or "all targets are met")
    return int(bool(missed))


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--hours", type=float, default=2.0, help="of the units' time")
    parser.add_argument("--speed", type=float, default=20.0, help="of the units' time to that of the host")
    parser.add_argument("--slots", type=int, default=4, choices=range(1, len(SLOTS) + 1))
    parser.add_argument("--looks", type=Path, help="append what is measured each second there, as JSON lines")
    a = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        hours = Hours(Path(name), a.speed, SLOTS[: a.slots], stack, a.looks)
        began_s = time.monotonic()
        while hours.simulated_s < 3600 * a.hours:
            hours.tray()
        wall_s = time.monotonic() - began_s
        found = hours.settle()
        if log := [line for line in hours.log.splitlines() if not line.startswith("serving ")]:
            print("the service says:", *log[:20], sep="\n")
        return report(hours, found, wall_s)


if __name__ == "__main__":
    raise SystemExit(main())
