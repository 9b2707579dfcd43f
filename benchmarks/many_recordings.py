"""Many recordings on one process, on two, and on two separate `dask worker`s; and what each costs who asks.

    python -m benchmarks.many_recordings [--recordings 2000] [--rows 20000] [--work audit|fit]

The recordings are copies of a golden one, a run of 27 poses. Workers are warm: each has done one before the clock
starts. Efficiency is the wall time of one worker over that of n workers, times n; on a machine that others use, take
the processor time of each recording, which the first column after it is.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.table import Table
from triaxcald.audit.many import COLUMNS, audited
from triaxcald.cli.batch import Task
from triaxcald.many import Finding, Settings, Source, open_table, sources_of
from triaxcald.many.cluster import Cluster, cluster_at, local_cluster, results

GOLDEN = Path(__file__).parents[1] / "recordings" / "can-second-order.mcap"
MEMORY = 300 * 2**20
DEADLINE_S = 120.0
FIT = Task(
    "fit",
    dict.fromkeys(
        (
            "sign", "output_unit", "reference", "reference_unit", "turning", "attitudes", "datasheet",
            "attitude_error", "datasheet_error", "latitude", "height", "reference_uncertainty",
            "thermometer_uncertainty", "thermal_sensitivity", "limit", "columns", "time_unit", "rate", "where",
        )
    )
    | {"skip_bad": False, "pose_means": False},
    {},
)  # fmt: skip
WORKS = {"audit": audited, "fit": FIT}


def usage() -> tuple[int, float, int]:
    """Process, its seconds of processor time, and its peak memory in KiB."""
    with open("/proc/self/status", encoding="ascii") as file:
        peak = next(int(line.split()[1]) for line in file if line.startswith("VmHWM"))
    times = os.times()
    return os.getpid(), times.user + times.system, peak


def measured(cluster: Cluster, work: Any, sources: Sequence[Source]) -> tuple[float, float, list[float]]:
    """Wall seconds of all, processor seconds of each, and peak MiB of the workers."""
    settings = Settings("benchmark", memory=MEMORY)
    workers = len(cluster.client.scheduler_info(n_workers=-1)["workers"])
    for done in results(cluster, work, sources[: 2 * workers], settings):
        assert done.error is None, done.error
    before = {pid: seconds for pid, seconds, _ in cluster.client.run(usage).values()}
    began_s = time.perf_counter()
    count = 0
    for done in results(cluster, work, sources, settings):
        assert done.error is None, done.error
        count += 1
    wall_s = time.perf_counter() - began_s
    after = list(cluster.client.run(usage).values())
    assert {pid for pid, *_ in after} == set(before), "a worker was lost"
    processor_s = sum(seconds - before[pid] for pid, seconds, _ in after) / count
    return wall_s, processor_s, [peak / 1024 for *_, peak in after]


@contextmanager
def separate_workers(count: int) -> Iterator[Cluster]:
    """A `dask scheduler` and so many `dask worker`s, as anybody starts them."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "scheduler.json"
        environment = {
            **os.environ,
            "DASK_LOGGING__DISTRIBUTED": "critical",
            "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "false",
        }
        dask = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0"]
        started = [subprocess.Popen([*dask, "--no-dashboard", "--scheduler-file", str(file)], env=environment)]
        try:
            until_s = time.monotonic() + DEADLINE_S
            while not (file.exists() and file.read_text().endswith("}")):
                assert time.monotonic() < until_s
                time.sleep(0.1)
            dask = [sys.executable, "-m", "distributed.cli.dask_worker", "--scheduler-file", str(file)]
            options = ["--nthreads", "1", "--memory-limit", "400MiB", "--no-dashboard", "--local-directory", folder]
            started += [subprocess.Popen([*dask, *options], env=environment) for _ in range(count)]
            with cluster_at(json.loads(file.read_text())["address"]) as cluster:
                cluster.client.wait_for_workers(count, timeout=DEADLINE_S)
                yield cluster
        finally:
            for process in reversed(started):
                process.terminate()
                process.wait()


def workers_table(work: Any, sources: Sequence[Source], name: str) -> None:
    lines = list[Sequence[str]]()
    one_s = None
    for title, count, start in (
        ("1 process", 1, partial(local_cluster, 1, MEMORY)),
        ("2 processes", 2, partial(local_cluster, 2, MEMORY)),
        ("2 separate `dask worker`s", 2, partial(separate_workers, 2)),
    ):
        with start() as cluster:
            wall_s, processor_s, peaks = measured(cluster, work, sources)
        one_s = one_s or wall_s
        figures = len(sources) / wall_s, processor_s, one_s / (count * wall_s)
        lines.append([title, *(f"{v:.2f}" for v in figures), f"{max(peaks):.0f}"])
    head = ["", "recordings a second", "processor s a recording", "efficiency", "peak MiB of a worker"]
    print(Table(f"{len(sources)} recordings through `{name}`", head, lines), flush=True)


def nothing(path: object) -> Finding:
    return Finding({})


def handing_out_us(count: int) -> float:
    """Processor time of this process, and of the scheduler in it, for each recording at which nothing is done."""
    with tempfile.NamedTemporaryFile() as empty, local_cluster(1, MEMORY) as cluster:
        for _ in results(cluster, nothing, [Source(empty.name)] * 20, Settings("benchmark")):
            pass
        began_s = sum(os.times()[:2])
        for _ in results(cluster, nothing, [Source(empty.name)] * count, Settings("benchmark")):
            pass
        return (sum(os.times()[:2]) - began_s) / count * 1e6


def asking_table(rows: int, folder: Path) -> None:
    """What lists, rows and tables of many recordings cost the process that asks."""
    lines = list[Sequence[str]]()
    many = folder / "many"
    many.mkdir()
    for i in range(rows):
        (many / f"{i:07}.mcap").touch()
    before = usage()[2]
    began_s = time.perf_counter()
    found = sources_of([str(many)], (".mcap",))
    lines.append(["list of a folder, in memory", *_each(began_s, rows, (usage()[2] - before) * 1024)])
    lines.append(["hand out and take back", f"{handing_out_us(min(rows, 1000)):.0f}", ""])
    row = {column.name: None for column in COLUMNS} | {
        "exit_code": 0, "result": "same_bytes", "verdict": "pass", "serial": "1001", "differences": 0, "seconds": 4.123,
        "run": "01a21f9f-759b-729d-b68e-7585ebf351b1", "size": 948162, "stamp": "1795953071899956811",
        "sha256": "0e1e0d31d9f4743742ebf887dfa827d186845c59ac0ab18e99ec656d03c445be", "software": "0.2.0",
        "settings": "8818d016bf6ad295",
    }  # fmt: skip
    for name in ("t.sqlite", "t.csv", "t.parquet"):
        path = folder / name
        began_s = time.perf_counter()
        with open_table(path, "audit", COLUMNS, resume=False) as opened:
            for of in found:
                opened.store({**row, "recording": of.name})
            stored_s = time.perf_counter()
            opened.finish(of.name for of in found)
        size = path.stat().st_size
        lines.append([f"rows of {name}", f"{(stored_s - began_s) / rows * 1e6:.0f}", f"{size / rows:.0f}"])
        lines.append([f"end of {name}", *_each(stored_s, rows, 0)])
    print(Table(f"{rows} rows", ["", "µs a recording", "bytes a recording"], lines), flush=True)


def _each(began_s: float, count: int, size: int) -> tuple[str, str]:
    return f"{(time.perf_counter() - began_s) / count * 1e6:.0f}", f"{size / count:.0f}"


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=int, default=2000)
    parser.add_argument("--rows", type=int, default=20_000)
    parser.add_argument("--work", choices=WORKS, default="audit")
    parser.add_argument("--quick", action="store_true", help="24 recordings, 2000 rows")
    a = parser.parse_args(arguments)
    count, rows = (24, 2000) if a.quick else (a.recordings, a.rows)
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        recordings = folder / "recordings"
        recordings.mkdir()
        for i in range(count):
            shutil.copy(GOLDEN, recordings / f"{i:05}.mcap")
        sources = [of for of in sources_of([str(recordings)], (".mcap",)) if isinstance(of, Source)]
        workers_table(WORKS[a.work], sources, a.work)
        asking_table(rows, folder)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
