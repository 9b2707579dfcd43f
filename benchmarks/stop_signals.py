"""Stop signals at random moments: one, two or three to a command that is at work on a simulated unit.

Each shot has a unit, a folder and a process of its own. What the process says and what it exits with is held against
what the unit holds and what lies in the folder. Prints a table, and every shot that went wrong.

    python -m benchmarks.stop_signals --count 1000 --seed 1 --python .venv/bin/python --python other/bin/python
"""

from __future__ import annotations

import argparse
import asyncio
import dataclasses
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import AsyncExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.table import Table
from triaxcal.errors import Refused
from triaxcald.errors import RecordingError
from triaxcald.recording.reader import Recording
from triaxcald.recording.recover import recover
from triaxcald.simulation.bench import SimulatedUnit, load_device, simulate
from triaxcald.simulation.unit import CALIBRATION, ReferenceUnit, Stored, UnitSilent, factory_calibration

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
ON_A_BUS = ("record", "provision", "run", "provision", "sim")
"""In turn; where registers are written there is most to go wrong."""
ON_FILES = ("diagnose", "recover")
COMMANDS = (*ON_A_BUS, *ON_FILES)
SPEED = {"tcp": 20.0, "can": 8.0, "rtu": 20.0}
"""Of the units, by transport; frames one by one cost more than windows of a FIFO."""
DEADLINE_S = 5.0
HUNG_S = 30.0
PROGRESS = ("unit: ", "warning: ", "advice: ")
PATIENCE = "triaxcal: putting things in order"
GAPS_S = (0.0, 0.003, 0.05, 0.5)
"""Scales of the time from one signal to the next."""
START_S = 1.0
"""Until a command is at work, about, on a machine that has little else to do."""
FILES_S = 2.0
"""What the commands on files take."""
STEPS = {
    ("record", "can"): 6, ("provision", "can"): 95, ("run", "can"): 98,
    ("record", "modbus"): 8, ("provision", "modbus"): 160, ("run", "modbus"): 166,
}  # fmt: skip
"""A command's steps that show from outside: its accesses to the unit's registers. `sim` has one: it says it serves."""
DELAYS_S = (0.001, 0.03, 1.0)
"""Scales of the time from a step to the first signal: from one message on the bus to a phase of the work."""
OLD = factory_calibration()
RECORDING = Path(__file__).parents[1] / "recordings" / "can-second-order.mcap"
ENDED_EARLY = {-number for number in SIGNALS} | {1, 130}
"""Before the program's first line signals are the interpreter's: it dies of them, or of a KeyboardInterrupt."""
CALIBRATION_FILE = {
    "format": "triaxcal.calibration/1",
    "scale_factor": [-2.41, -2.405, -2.37],
    "misalignment": [0.006, 0.004, -0.001],
    "bias": [0.005, -0.003, 0.004],
}
DEVICE = """\
format = "triaxcal.device/1"
profile = "{profile}"
serial = 4711
speed = {speed}
seed = 3
eeprom = "eeprom.bin"
bus = {bus}
fixture = {{ poses = 12, hold_s = 1.5, move_s = 0.6 }}
"""
STATION = """\
format = "triaxcal.station/1"
name = "bench"
plan = {{ poses = 12, hold_s = 0.8, check_poses = 6 }}

[[units]]
name = "unit"
profile = "{profile}"
bus = {bus}
"""


@dataclass(frozen=True)
class Shot:
    """The first signal ``at_s`` after the process's start (``step`` 0) or a step of its work, each next one after its
    gap."""

    number: int
    python: str
    command: str
    transport: str
    signals: tuple[signal.Signals, ...]
    step: int
    at_s: float
    gaps_s: tuple[float, ...]

    def __str__(self) -> str:
        sent = [f"{n.name} +{gap:.3f} s" for n, gap in zip(self.signals, (self.at_s, *self.gaps_s), strict=True)]
        return f"shot {self.number}: {self.command} over {self.transport}, step {self.step}, {', '.join(sent)}"


def shot_of(seed: int, number: int, python: str, pace: float = 1.0, transports: Sequence[str] = tuple(SPEED)) -> Shot:
    """``pace`` stretches the times, for a machine that is slow or busy."""
    rng = np.random.default_rng([seed, number])
    command = COMMANDS[number % len(COMMANDS)]
    transport = str(rng.choice(transports))
    count = int(rng.integers(1, 4))
    steps = STEPS.get((command, "can" if transport == "can" else "modbus"), 1)
    step = 0 if command in ON_FILES or rng.random() < 0.25 else int(rng.integers(1, steps + 1))
    until_s = FILES_S if command in ON_FILES else START_S
    at_s = rng.exponential(rng.choice(DELAYS_S)) if step else rng.uniform(0, until_s)
    return Shot(
        number,
        python,
        command,
        transport,
        tuple(SIGNALS[i] for i in rng.integers(0, 3, count)),
        step,
        float(pace * at_s),
        tuple(float(rng.exponential(rng.choice(GAPS_S))) for _ in range(count - 1)),
    )


@dataclass(frozen=True)
class Ended:
    """How a shot ended: ``faults`` are empty where all was as it has to be."""

    shot: Shot
    code: int
    took_s: float
    err: str
    early: bool
    """The first signal came before the program's first line."""
    late: bool
    """The process had ended before the first signal."""
    faults: tuple[str, ...]


async def fire(shot: Shot, deadline_s: float = DEADLINE_S) -> Ended:
    with tempfile.TemporaryDirectory(prefix="stop-signals-") as name:
        folder = Path(name)
        async with AsyncExitStack() as stack:
            steps = _Steps()
            unit = await _workplace(shot, folder, stack, steps)
            process = await asyncio.create_subprocess_exec(
                shot.python, "-m", "triaxcald.cli", *_arguments(shot.command, folder),
                stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                preexec_fn=_heed_signals,
            )  # fmt: skip
            said = asyncio.gather(_read(process.stdout, steps.said), _read(process.stderr, steps.said))
            exited = asyncio.ensure_future(process.wait())
            early, struck_s = await _strike(process, exited, shot, steps)
            _, overdue = await asyncio.wait([exited], timeout=deadline_s + HUNG_S)
            took_s = 0.0 if struck_s is None else time.monotonic() - struck_s
            if overdue:
                process.kill()
            code, (out, err) = await exited, await said
            held = None if unit is None else await _held(unit)
        ended = Ended(shot, code, took_s, err, early, struck_s is None, ())
        faults = [f"took {took_s:.1f} s"] if took_s > deadline_s else []
        return dataclasses.replace(ended, faults=(*faults, *judge(ended, out, folder, held)))


class _Steps:
    """Counts the steps of a command's work."""

    def __init__(self) -> None:
        self._count = 0
        self._more = asyncio.Event()

    def one(self) -> None:
        self._count += 1
        self._more.set()

    def said(self, line: str) -> None:
        if line.startswith("serving "):
            self.one()

    def watch(self, unit: ReferenceUnit) -> None:
        for name in ("read", "write"):
            setattr(unit, name, self._counted(getattr(unit, name)))

    def _counted(self, access: Callable[..., Any]) -> Callable[..., Any]:
        def counted(*arguments: Any) -> Any:
            self.one()
            return access(*arguments)

        return counted

    async def reached(self, step: int) -> None:
        while self._count < step:
            self._more.clear()
            await self._more.wait()


async def _read(stream: asyncio.StreamReader | None, said: Callable[[str], None]) -> str:
    assert stream is not None
    lines = []
    async for line in stream:
        lines.append(line.decode())
        said(lines[-1])
    return "".join(lines)


def _heed_signals() -> None:
    """Also where this is run in the background of a shell, or by `nohup`."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_DFL)


async def _workplace(shot: Shot, folder: Path, stack: AsyncExitStack, steps: _Steps) -> SimulatedUnit | None:
    """Writes the files of a shot; serves the unit where the command wants one served."""
    if shot.command in ON_FILES:
        (folder / "damaged").write_bytes(RECORDING.read_bytes()[:-1000])
        return None
    profile, bus = "triax-ref-modbus", {"host": "127.0.0.1", "port": 0}
    if shot.transport == "can":
        profile = "triax-ref-can"
        bus = {"interface": "udp_multicast", "channel": "239.74.163.2", "node_id": 5, "options": {"port": _free_port()}}
    elif shot.transport == "rtu":
        bus = {"serial_port": f"pty:{folder / 'line'}"}
    device = folder / "device.toml"
    device.write_text(DEVICE.format(profile=profile, bus=_toml(bus), speed=SPEED[shot.transport]))
    (folder / "cal.json").write_text(json.dumps(CALIBRATION_FILE))
    if shot.command == "sim":
        return None
    unit = simulate(load_device(device), where=str(device))
    steps.watch(unit.unit)
    server = await stack.enter_async_context(unit.serve())
    if shot.transport == "tcp":
        bus = {**bus, "port": server.bus.port}
    elif shot.transport == "rtu":
        bus = {"serial_port": str(folder / "line"), "parity": "N"}
    (folder / "station.toml").write_text(STATION.format(profile=profile, bus=_toml(bus)))
    return unit


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bound:
        bound.bind(("127.0.0.1", 0))
        return int(bound.getsockname()[1])


def _toml(table: dict[str, Any]) -> str:
    inner = (f"{k} = {_toml(v) if isinstance(v, dict) else json.dumps(v)}" for k, v in table.items())
    return f"{{ {', '.join(inner)} }}"


def _arguments(command: str, folder: Path) -> list[str]:
    station = str(folder / "station.toml")
    return {
        "record": ["record", station, "-o", str(folder / "rec.mcap"), "--seconds", "120"],
        "run": ["run", station, "--json"],
        "provision": ["provision", str(folder / "cal.json"), station, "--json"],
        "sim": ["sim", str(folder / "device.toml")],
        "diagnose": ["diagnose", str(RECORDING), "-o", str(folder / "a.json"), "--report", str(folder / "a.html")],
        "recover": ["log", "recover", str(folder / "damaged"), "-o", str(folder / "rec.mcap"), "--json"],
    }[command]


async def _strike(
    process: asyncio.subprocess.Process, exited: asyncio.Future[int], shot: Shot, steps: _Steps
) -> tuple[bool, float | None]:
    """Whether the first signal came before the program's first line, and when it was sent; None where it never was."""
    early, struck_s = False, None
    reached = asyncio.ensure_future(steps.reached(shot.step))
    await asyncio.wait([exited, reached], return_when=asyncio.FIRST_COMPLETED)
    reached.cancel()
    for number, gap_s in zip(shot.signals, (shot.at_s, *shot.gaps_s), strict=True):
        await asyncio.sleep(gap_s)
        if process.returncode is not None:
            break
        if struck_s is None:
            early = not _catches(process.pid, signal.SIGTERM)
            struck_s = time.monotonic()
        try:
            os.kill(process.pid, number)  # `send_signal` would ask for the exit code, which asyncio is waiting for
        except ProcessLookupError:
            break
    return early, struck_s


def _catches(pid: int, number: int) -> bool:
    """Where the system does not tell, it is taken for granted."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return True
    mask = next(int(line.split()[1], 16) for line in lines if line.startswith("SigCgt"))
    return bool(mask >> (number - 1) & 1)


async def _held(unit: SimulatedUnit) -> str:
    """Which calibration the unit holds, in use and stored."""
    while True:
        try:
            now_s = unit.time_base.now_s()
            ram = {name: unit.unit.read(name, now_s) for name in CALIBRATION}
        except UnitSilent:  # it restarts
            await asyncio.sleep(0.01)
            continue
        stored = Stored.from_image(unit.unit.eeprom).calibration
        if ram == stored:
            return "old" if stored == OLD else "new"
        return "mixed"


def judge(ended: Ended, out: str, folder: Path, held: str | None) -> list[str]:
    """What is wrong with the exit code, the words and the files, given what the unit holds: ``old``, ``new``, ``mixed``
    or, of `sim`, None."""
    if ended.late:
        return []
    if ended.early:
        return [] if ended.code in ENDED_EARLY | {0} else [f"exit code {ended.code} before the first line"]
    lines = [line for line in ended.err.splitlines() if not line.startswith(PROGRESS)]
    faults = [f"said: {line}" for line in lines if not line.startswith(("triaxcal: ", "serving ", f"{folder}/"))]
    # A signal may come when the unit has ended and the bus is being closed.
    last = next((line for line in reversed(lines) if not line.startswith(PATIENCE)), "")
    faults += _judge_code(ended, last, held)
    faults += _judge_files(folder, ended.code, last)
    if ended.shot.command in ("run", "provision") and ended.code in (0, 1) and not out.endswith("}\n"):
        faults.append("no whole document")
    return faults


def _judge_code(ended: Ended, last: str, held: str | None) -> list[str]:
    code, command = ended.code, ended.shot.command
    if command == "sim":
        # Of two that come at once, the system may hand over the later one first.
        stopped = code == 0 and set(ended.shot.signals) != {signal.SIGINT}
        return [] if stopped or code == 130 else [f"exit code {code}"]
    if command in ON_FILES:
        return [] if code == 0 or (code, last) == (130, "triaxcal: interrupted") else [f"exit code {code}: {last}"]
    if code == 130:
        if "interrupted" not in last:
            return ["130 without a word"]
        said_new = "holds the new calibration" in last
        if held == ("new" if said_new else "old"):
            return []
        return [f"130 while the unit holds {held}: {last}"]
    if code == 4:
        return [] if "'triaxcal provision --resume " in last else [f"exit code 4: {last}"]  # and so how to settle it
    if code in (0, 1) and command == "run":  # 1: an output that was not better than before, and so the old one is back
        return [] if held == ("new" if code == 0 else "old") else [f"exit code {code} while the unit holds {held}"]
    if code == 0 and held == ("new" if command == "provision" else "old"):
        return []
    return [f"exit code {code} while the unit holds {held}: {last}"]


def _judge_files(folder: Path, code: int, last: str) -> list[str]:
    faults = [f"left behind: {p.name}" for p in folder.glob("**/.*")]
    for path in folder.glob("**/*.json"):
        json.loads(path.read_text())
    faults += [f"{p.name} is half written" for p in folder.glob("**/*.html") if "</html>" not in p.read_text()]
    for path in folder.glob("**/eeprom.bin"):
        if not Stored.from_image(path.read_bytes()).valid:
            faults.append("the EEPROM's file is damaged")
    for path in folder.glob("**/*.mcap"):
        faults += _judge_recording(path, given_up=code != 0 and f"{path.name} is not finished" in last)
    return faults


def _judge_recording(path: Path, *, given_up: bool) -> list[str]:
    try:
        if given_up:
            recover(path, path.with_suffix(".recovered"))
            return []
        with Recording.open(path):
            return []
    except (RecordingError, Refused) as e:
        return [str(e)]


async def fire_all(shots: Sequence[Shot], jobs: int, deadline_s: float) -> list[Ended]:
    waiting, ended = iter(shots), []

    async def work() -> None:
        for shot in waiting:
            ended.append(end := await fire(shot, deadline_s))
            if end.faults:
                print(f"{shot}: exit code {end.code} after {end.took_s:.2f} s: {'; '.join(end.faults)}\n{end.err}")
                sys.stdout.flush()

    await asyncio.gather(*(work() for _ in range(jobs)))
    return ended


def table(ended: Sequence[Ended]) -> Table:
    """A row for each Python and command."""
    rows = []
    groups = dict.fromkeys((e.shot.python, e.shot.command) for e in sorted(ended, key=lambda e: e.shot.number))
    for python, command in sorted(groups):
        mine = [e for e in ended if (e.shot.python, e.shot.command) == (python, command)]
        struck = [e for e in mine if not (e.early or e.late)]
        codes = Counter(e.code for e in struck)
        rows.append(
            [
                _version(python),
                command,
                str(sum(len(e.shot.signals) for e in mine)),
                str(len(mine)),
                str(sum(e.early for e in mine)),
                str(sum(e.late for e in mine)),
                ", ".join(f"{code}: {n}" for code, n in sorted(codes.items())),
                f"{max((e.took_s for e in struck), default=0.0):.2f}",
                str(sum(bool(e.faults) for e in mine)),
            ]
        )
    head = ["Python", "command", "signals", "processes", "too early", "too late", "exit codes", "longest s", "wrong"]
    return Table("Stop signals at random moments", head, rows)


def _version(python: str) -> str:
    code = "import platform; print(platform.python_version())"
    return subprocess.run([python, "-c", code], capture_output=True, text=True, check=True).stdout.strip()


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=1000, help="processes, spread over the Pythons")
    parser.add_argument("--first", type=int, default=0, help="number of the first shot, to see one again")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2, help="processes at a time")
    parser.add_argument("--pace", type=float, default=1.0, help="stretches all times, for a busy machine")
    parser.add_argument("--python", action="append", metavar="PATH", help="with the project installed; default: this")
    a = parser.parse_args(arguments)
    pythons = a.python or [sys.executable]
    numbers = range(a.first, a.first + a.count)
    shots = [shot_of(a.seed, n, pythons[n // len(COMMANDS) % len(pythons)], a.pace) for n in numbers]
    ended = asyncio.run(fire_all(shots, a.jobs, a.pace * DEADLINE_S))
    print(table(ended))
    return 1 if any(e.faults for e in ended) else 0


if __name__ == "__main__":
    raise SystemExit(main())
