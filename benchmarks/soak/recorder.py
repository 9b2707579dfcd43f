"""`triaxcal record` as a process of its own: started, watched, stopped, killed and started again."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.soak.bench import Bench
from triaxcald.station.lock import FOLDER_VARIABLE

ASK_S = 2.0
ENDS_IN_S = 60.0
_PAGE = os.sysconf("SC_PAGE_SIZE")
_TICKS = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True)
class Look:
    """At the process that was the ``start``-th: bytes of resident memory, processor seconds, open files, threads."""

    time_s: float
    start: int
    memory: int
    cpu_s: float
    files: int
    threads: int


@dataclass
class Recorder:
    """``killed_ns`` are the times at which it was killed; ``looks`` what it took."""

    bench: Bench
    metrics_port: int
    segment_s: float
    starts: int = 0
    killed_ns: list[int] = field(default_factory=list)
    looks: list[Look] = field(default_factory=list)
    cpu_of_killed_s: float = 0.0
    died: list[int] = field(default_factory=list)
    _process: subprocess.Popen[bytes] | None = None

    @property
    def log(self) -> Path:
        return self.bench.folder / "record.log"

    def start(self) -> None:
        b = self.bench
        arguments = ["record", b.station, "-o", b.recordings, "--segment-time", f"{self.segment_s:g}s"]
        arguments += ["--metrics", self.metrics_port, "--log-format", "json"]
        self.starts += 1
        with open(self.log, "ab") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "triaxcald.cli", *map(str, arguments)],
                stdin=subprocess.DEVNULL, stdout=log, stderr=log,
                env={**os.environ, FOLDER_VARIABLE: str(b.locks)},
            )  # fmt: skip

    def send(self, number: signal.Signals) -> None:
        if self._process is not None:
            self._process.send_signal(number)

    def kill(self) -> None:
        self.look()
        if self.looks:
            self.cpu_of_killed_s += self.looks[-1].cpu_s
        self.killed_ns.append(time.time_ns())
        self.send(signal.SIGKILL)
        assert self._process is not None
        self._process.wait()
        self._process = None

    def look(self) -> None:
        """Notes what the process takes; that it has died, where it has."""
        process = self._process
        if process is None:
            return
        if (code := process.poll()) is not None:
            self.died.append(code)
            self._process = None
            return
        proc = Path(f"/proc/{process.pid}")
        fields = (proc / "stat").read_text().rpartition(")")[2].split()
        memory = int((proc / "statm").read_text().split()[1]) * _PAGE
        files = len(os.listdir(proc / "fd"))
        cpu_s = (int(fields[11]) + int(fields[12])) / _TICKS
        self.looks.append(look := Look(time.monotonic(), self.starts, memory, cpu_s, files, int(fields[17])))
        with open(self.bench.folder / "looks.csv", "a", encoding="utf-8") as told:
            told.write(",".join(map(str, vars(look).values())) + "\n")

    def health(self) -> dict[str, Any] | None:
        """None where it does not answer."""
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{self.metrics_port}/health", timeout=ASK_S) as answer:
                return dict(json.load(answer))
        except urllib.error.HTTPError as e:  # 503: a unit is lost
            return dict(json.load(e))
        except (OSError, ValueError):
            return None

    def metrics(self) -> str:
        """Nothing where it does not answer."""
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{self.metrics_port}/metrics", timeout=ASK_S) as answer:
                return str(answer.read().decode())
        except OSError:
            return ""

    def stop(self) -> int | None:
        """As a service is stopped; the exit code, None where it had to be killed."""
        if self._process is None:
            return None
        self.send(signal.SIGTERM)
        try:
            return self._process.wait(ENDS_IN_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
            return None

    def end(self) -> None:
        if self._process is not None and self._process.poll() is None:
            self._process.kill()
            self._process.wait()
