"""What `triaxcal record` costs beside `can_logger`: `python -m benchmarks.record_command`.

Both run as whole processes on one bus at the same time, and so receive the same frames: those of a simulated CANopen
unit, at several rates. Processor time is user and system time of the whole process, from its start to its exit. The
marginal cost leaves the start and the end out. The bus is python-can's `udp_multicast`; `--bus vcan0` takes a SocketCAN
interface, which has to be up.
"""

from __future__ import annotations

import argparse
import os
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path

import can

from benchmarks.table import Table
from triaxcal_drivers.catalogue import BUILT_IN
from triaxcald.recording.reader import Recording
from triaxcald.station.lock import FOLDER_VARIABLE

BIN = Path(sys.executable).parent
GROUP = "239.74.163.2"
NODE = 5
FRAMES_A_SAMPLE = 4  # of the simulated unit
PROFILE_HZ = 100.0  # its rate in the built-in profile
RATES = (200, 1000, 4000)  # frames a second: a slow unit, ten units of 25 Hz, a bus half full
SETTLED_S = 3.0  # after the start, before the marginal cost is counted
TICKS = os.sysconf("SC_CLK_TCK")
LEAN = "import sys; sys.modules['asammdf'] = None; from can.logger import main; sys.exit(main())"
"""python-can imports asammdf where that is installed, as with the extra `logs`: 0.6 s, which no log of BLF needs."""


@dataclass(frozen=True)
class Cost:
    """Processor seconds of the whole process and of the time between, and the frames in its file."""

    whole_s: float
    between_s: float
    frames: int


class Program:
    def __init__(self, command: Sequence[object], folder: Path, name: str) -> None:
        self._said = open(folder / f"{name}.said", "wb")  # noqa: SIM115 -- closed by finish
        self._process = subprocess.Popen(
            [*map(str, command)], stdin=subprocess.DEVNULL, stdout=self._said, stderr=self._said,
            env={**os.environ, FOLDER_VARIABLE: str(folder)},
        )  # fmt: skip
        self.said = folder / f"{name}.said"
        self._ended = False

    def spent_s(self) -> float:
        """So far."""
        fields = Path(f"/proc/{self._process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / TICKS

    def finish(self) -> float:
        """Asks it to end; processor seconds of its whole life."""
        ended, _, usage = os.wait4(self._process.pid, os.WNOHANG)
        if not ended:
            os.kill(self._process.pid, signal.SIGINT)
            _, _, usage = os.wait4(self._process.pid, 0)
        self._ended = True
        self._said.close()
        if ended:
            raise SystemExit(f"record_command: a program ended by itself: {self.said.read_text()[-1000:]}")
        return usage.ru_utime + usage.ru_stime

    def kill(self) -> None:
        if not self._ended:
            with suppress(ProcessLookupError, ChildProcessError):
                os.kill(self._process.pid, signal.SIGKILL)
                os.wait4(self._process.pid, 0)
            self._said.close()


def measured(bus: str, rate: int, seconds: float, whole_bus: bool, lean: bool, folder: Path) -> tuple[Cost, Cost]:
    """Of `record` and of `can_logger`."""
    port = _free_port()
    settings = (
        f'{{ interface = "udp_multicast", channel = "{GROUP}", options = {{ port = {port} }}, node_id = {NODE} }}'
        if bus == "udp_multicast"
        else f'{{ interface = "socketcan", channel = "{bus}", node_id = {NODE} }}'
    )
    speed = rate / FRAMES_A_SAMPLE / PROFILE_HZ
    device, station = folder / "device.toml", folder / "station.toml"
    device.write_text(
        f'format = "triaxcal.device/1"\nprofile = "triax-ref-can"\nspeed = {speed}\nbus = {settings}\n'
        f"[fixture]\nhold_s = {4 * speed}\nmove_s = {1.5 * speed}\n"
    )
    _write_profile(folder, rate / FRAMES_A_SAMPLE)
    _write_station(station, settings, whole_bus)
    ours, theirs = folder / "ours.mcap", folder / "theirs.blf"
    listen = [*([sys.executable, "-c", LEAN] if lean else [BIN / "can_logger"]), "-f", theirs]
    listen += ["-i", "udp_multicast", "-c", GROUP, "--bus-kwargs", f"port={port}"] if bus == "udp_multicast" else []
    listen += ["-i", "socketcan", "-c", bus] if bus != "udp_multicast" else []
    with ExitStack() as stack:

        def begin(name: str, command: Sequence[object]) -> Program:
            program = Program(command, folder, name)
            stack.callback(program.kill)
            return program

        sim = begin("sim", [BIN / "triaxcal", "sim", device])
        _until(lambda: "serving" in sim.said.read_text(), "the simulated unit serves")
        logger = begin("can_logger", listen)
        recorder = begin("record", [BIN / "triaxcal", "record", station, "-o", ours])
        programs = (recorder, logger)
        if whole_bus:  # nobody else tells the unit to send
            options = {"interface": "udp_multicast", "channel": GROUP, "port": port}
            if bus != "udp_multicast":
                options = {"interface": "socketcan", "channel": bus}
            with can.Bus(**options) as starter:
                starter.send(can.Message(arbitration_id=0, is_extended_id=False, data=[1, NODE]))
        begun_s = time.monotonic()
        time.sleep(min(SETTLED_S, seconds / 2))
        before = [p.spent_s() for p in programs]
        time.sleep(max(0.0, begun_s + seconds - time.monotonic()))
        between = [p.spent_s() - b for p, b in zip(programs, before, strict=True)]
        whole = [p.finish() for p in programs]
    with Recording.open(ours) as recording:
        got = sum(len(batch) for _, batch in recording.raw_batches())
    with can.LogReader(theirs) as log:
        logged = sum(1 for _ in log)
    return Cost(whole[0], between[0], got), Cost(whole[1], between[1], logged)


def _write_profile(folder: Path, rate_hz: float) -> None:
    """The built-in one at another rate."""
    text = (BUILT_IN / "triax-ref-can.toml").read_text()
    assert f"rate_hz = {PROFILE_HZ}" in text
    (folder / "unit.toml").write_text(text.replace(f"rate_hz = {PROFILE_HZ}", f"rate_hz = {rate_hz}"))
    for name in ("triax-ref-can.dbc", "triax-ref-can.eds"):
        (folder / name).write_bytes((BUILT_IN / name).read_bytes())


def _write_station(path: Path, settings: str, whole_bus: bool) -> None:
    bus = f'[[buses]]\nname = "bus"\nbus = {settings.replace(f", node_id = {NODE}", "")}\n'
    unit = f'[[units]]\nname = "unit"\nprofile = "unit.toml"\nbus = {settings}\n'
    head = 'format = "triaxcal.station/1"\nname = "bench"\nfolder = "."\n'
    path.write_text(head + (bus if whole_bus else unit))


def _until(condition: Callable[[], object], what: str) -> None:
    until_s = time.monotonic() + 60.0
    while not condition():
        if time.monotonic() > until_s:
            raise SystemExit(f"record_command: not within a minute: {what}")
        time.sleep(0.02)


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        s.bind(("", 0))
        return int(s.getsockname()[1])


def row(bus: str, rate: int, seconds: float, runs: int, whole_bus: bool, lean: bool) -> list[str]:
    """Medians of the runs."""
    found = []
    for _ in range(runs):
        with tempfile.TemporaryDirectory() as name:
            found.append(measured(bus, rate, seconds, whole_bus, lean, Path(name)))

    def median(of: Callable[[tuple[Cost, Cost]], float]) -> float:
        return statistics.median(of(one) for one in found)

    between_s = seconds - min(SETTLED_S, seconds / 2)
    return [
        str(rate),
        f"{median(lambda c: c[0].whole_s):.2f}",
        f"{median(lambda c: c[1].whole_s):.2f}",
        f"{median(lambda c: c[0].whole_s / c[1].whole_s):.2f}",
        f"{median(lambda c: 1e6 * c[0].between_s / between_s / rate):.1f}",
        f"{median(lambda c: 1e6 * c[1].between_s / between_s / rate):.1f}",
        f"{median(lambda c: c[0].between_s / max(c[1].between_s, 1e-3)):.2f}",
        f"{min(c[0].frames for c in found)}",
        f"{min(c[1].frames for c in found)}",
    ]


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--quick", action="store_true", help="one run of 10 s a rate")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--rates", type=int, nargs="+", default=list(RATES), help="frames a second")
    parser.add_argument("--bus", default="udp_multicast", help="udp_multicast, or a SocketCAN interface")
    parser.add_argument("--lean", action="store_true", help="can_logger as where asammdf is not installed")
    parser.add_argument("--whole-bus", action="store_true", help="record all frames of the bus, of no unit")
    told = parser.parse_args(arguments)
    seconds, runs = (10.0, 1) if told.quick else (told.seconds, told.runs)
    rows = [row(told.bus, rate, seconds, runs, told.whole_bus, told.lean) for rate in told.rates]
    head = [
        "frames/s", "record [s]", "can_logger [s]", "ratio",
        "record, marginal [µs a frame]", "can_logger", "ratio", "frames of record", "of can_logger",
    ]  # fmt: skip
    what = "a bus" if told.whole_bus else "a unit"
    print(Table(f"{what} on {told.bus} for {seconds:g} s, median of {runs}", head, rows))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
