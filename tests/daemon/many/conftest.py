"""Recordings in folders and stores, and commands at them as processes."""

from __future__ import annotations

import csv
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[3]
RECORDINGS = ROOT / "recordings"
CAN, TABLE = RECORDINGS / "can-second-order.mcap", RECORDINGS / "paper-unit.csv.gz"
DEADLINE_S = 240.0


def environment(**more: str) -> dict[str, str]:
    path = os.pathsep.join(str(ROOT / part) for part in ("", "daemon", "drivers"))
    one_thread = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    return {**os.environ, **one_thread, "PYTHONPATH": path, **more}


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture
def recordings(tmp_path: Path) -> Callable[..., Path]:
    """A folder with so many copies of a recording."""

    def make(count: int, of: Path = TABLE, name: str = "recordings") -> Path:
        folder = tmp_path / name
        folder.mkdir()
        ending = "".join(of.suffixes)
        for i in range(count):
            shutil.copy(of, folder / f"r{i:02}{ending}")
        return folder

    return make


@pytest.fixture
def until() -> Callable[[Callable[[], Any]], Any]:
    """Waits for something that is no longer empty."""

    def wait(condition: Callable[[], Any]) -> Any:
        deadline = time.monotonic() + DEADLINE_S
        while not (found := condition()):
            assert time.monotonic() < deadline, "the condition has not come about"
            time.sleep(0.05)
        return found

    return wait


@pytest.fixture
def process() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Starts a module as a program in a process group of its own; what still runs at the end is killed."""
    with ExitStack() as stack:

        def start(*arguments: Any, **more: str) -> subprocess.Popen[str]:
            popen = subprocess.Popen(
                [sys.executable, "-m", *map(str, arguments)],
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                env=environment(**more),
                start_new_session=True,
            )
            stack.callback(_ended, popen)
            return popen

        yield start


def _ended(popen: subprocess.Popen[str]) -> None:
    popen.kill()
    popen.communicate()


@pytest.fixture
def cluster(tmp_path: Path, until: Callable[..., Any], process: Callable[..., Any]) -> Callable[..., str]:
    """A `dask scheduler` and two separate `dask worker`s; gives the scheduler's address. It may find its modules
    elsewhere."""

    def start(memory: str = "500MB", modules_of_scheduler: Path | None = None, **more: str) -> str:
        file = tmp_path / "scheduler.json"
        quiet = {"DASK_LOGGING__DISTRIBUTED": "error", **more}
        own = quiet if modules_of_scheduler is None else {**quiet, "PYTHONPATH": str(modules_of_scheduler)}
        process("distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", 0, "--no-dashboard",
                "--scheduler-file", file, **own)  # fmt: skip
        until(lambda: file.exists() and file.read_text().endswith("}"))
        for i in range(2):
            process(
                "distributed.cli.dask_worker", "--scheduler-file", file, "--nthreads", 1, "--memory-limit", memory,
                "--no-dashboard", "--local-directory", tmp_path / f"worker{i}", **quiet,
            )  # fmt: skip
        return str(json.loads(file.read_text())["address"])

    return start
