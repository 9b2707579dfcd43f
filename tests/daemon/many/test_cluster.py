"""Many recordings on processes that die, run out of memory, or lose who asked them."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sqlite3
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from tests.daemon.many import works
from tests.daemon.many.conftest import CAN, TABLE, rows_of
from triaxcald.errors import InputError, StationError
from triaxcald.many import Done, Settings, Source
from triaxcald.many.cluster import cluster_at, local_cluster, results
from triaxcald.many.work import WrongVersion

pytestmark = pytest.mark.slow
MEMORY = 300 * 2**20
Run = Callable[..., Any]


@pytest.fixture
def sources(tmp_path: Path) -> Callable[..., list[Source]]:
    folder = tmp_path / "sources"
    folder.mkdir()
    os.mkfifo(folder / works.FIFO)

    def make(*names: str) -> list[Source]:
        for name in names:
            (folder / name).write_bytes(b"x")
        return [Source(str(folder / name), 1, "1") for name in names]

    return make


def by_name(found: Iterator[Done]) -> dict[str, Done]:
    done = list(found)
    assert len({d.name for d in done}) == len(done), "a recording counts once"
    return {Path(d.name).name: d for d in done}


# Two separate `dask worker`s.


def test_a_worker_killed_in_the_midst_of_work_loses_nothing(
    cluster: Callable[..., str], sources: Callable[..., list[Source]], until: Callable[..., Any]
) -> None:
    names = ["a", "victim", "b", "c", "d", "e"]
    given = sources(*names)
    mark = Path(given[1].name).with_suffix(".pid")
    with cluster_at(cluster()) as connected:
        found = results(connected, works.holds_once, given, Settings("x", memory=MEMORY))
        early = [next(found) for _ in range(3)]  # the other worker goes on meanwhile
        victim = int(until(lambda: mark.exists() and mark.read_text().endswith("\n") and mark.read_text()))
        os.kill(victim, signal.SIGKILL)
        done = by_name(iter([*early, *found]))
    assert set(done) == set(names)
    assert {d.exit_code for d in done.values()} == {0}
    assert done["victim"].row["pid"] != victim


def test_a_recording_at_which_workers_die_is_named_and_hides_no_other(
    cluster: Callable[..., str], sources: Callable[..., list[Source]]
) -> None:
    names = [*"abc", "deadly", *"defg"]
    with cluster_at(cluster()) as connected:
        done = by_name(results(connected, works.dies, sources(*names), Settings("x", memory=MEMORY)))
    assert set(done) == set(names)
    assert {name: d.exit_code for name, d in done.items() if d.exit_code} == {"deadly": 5}
    assert "workers died at it" in str(done["deadly"].error)
    assert done["deadly"].row["stamp"] == "1"


def test_a_whole_batch_on_two_workers_with_one_corrupt_file(
    cluster: Callable[..., str], recordings: Callable[..., Path], triaxcal: Run
) -> None:
    folder = recordings(6, CAN)
    data = bytearray(CAN.read_bytes())
    data[len(data) // 2] ^= 1
    (folder / "corrupt.mcap").write_bytes(data)
    address = cluster()
    done = triaxcal("batch", "fit", folder, "-o", folder / "t.csv", "--scheduler", address)
    assert done.code == 2
    assert "corrupt.mcap" in done.err
    rows = rows_of(folder / "t.csv")
    assert [Path(r["recording"]).name for r in rows] == ["corrupt.mcap", *(f"r{i:02}.mcap" for i in range(6))]
    assert "CRC" in rows[0]["error"]
    alone = triaxcal("fit", CAN, "--json").json
    assert {r["bias_x"] for r in rows[1:]} == {str(alone["bias"][0])}


def test_a_scheduler_that_goes_is_4_and_the_rest_resumes(
    cluster: Callable[..., str], sources: Callable[..., list[Source]], tmp_path: Path
) -> None:
    address = cluster()
    scheduler = json.loads((tmp_path / "scheduler.json").read_text())
    port = int(scheduler["address"].rpartition(":")[2])
    [pid] = {c.pid for c in psutil.net_connections() if c.status == "LISTEN" and c.laddr and c.laddr.port == port}
    assert pid is not None
    with cluster_at(address) as connected:
        found = results(connected, works.holds_once, sources("a", "victim"), Settings("x"))
        assert next(found).exit_code == 0
        os.kill(pid, signal.SIGKILL)
        with pytest.raises(StationError, match=r"the scheduler is gone; --resume goes on"):
            next(found)


def test_no_scheduler_and_workers_of_another_version(
    cluster: Callable[..., str], sources: Callable[..., list[Source]]
) -> None:
    with (
        pytest.raises(InputError, match=r"--scheduler tcp://127\.0\.0\.1:1: no Dask scheduler answers"),
        cluster_at("tcp://127.0.0.1:1"),
    ):
        pass
    with cluster_at(cluster()) as connected, pytest.raises(WrongVersion, match="a worker has triaxcal"):
        list(results(connected, works.tells, sources("a"), Settings("x", "99")))


def test_a_scheduler_without_triaxcal_is_named(
    cluster: Callable[..., str], sources: Callable[..., list[Source]], tmp_path: Path
) -> None:
    modules = tmp_path / "modules"
    for name in ("triaxcald", "tests"):  # they hide those that are installed
        (modules / name).mkdir(parents=True)
        (modules / name / "__init__.py").write_text("raise ImportError('there is none')\n")
    with (
        cluster_at(cluster(modules_of_scheduler=modules)) as connected,
        pytest.raises(InputError, match="the scheduler cannot load triaxcal"),
    ):
        list(results(connected, works.tells, sources("a"), Settings("x")))


def test_paths_and_trust_reach_workers_that_start_elsewhere(
    cluster: Callable[..., str], recordings: Callable[..., Path], triaxcal: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = recordings(1, CAN)
    (folder / "keys.toml").write_text('format = "triaxcal.trust/1"\nsince = "2020-01-01T00:00:00+00:00"\n')
    address = cluster()
    monkeypatch.chdir(folder)
    triaxcal("audit", "r00.mcap", "--trust", "keys.toml", "-o", "t.csv", "--scheduler", address)
    [row] = rows_of(folder / "t.csv")
    assert row["recording"] == str(folder / "r00.mcap")
    assert (row["error"], row["signature"], row["exit_code"]) == ("", "unsigned", "1")


# Processes of our own.


def test_a_worker_out_of_memory_is_named_and_hides_no_other(sources: Callable[..., list[Source]]) -> None:
    names = ["a", "large", "b", "c"]
    with local_cluster(2, MEMORY) as own:
        done = by_name(results(own, works.grows, sources(*names), Settings("x", memory=MEMORY)))
        assert {name: d.exit_code for name, d in done.items() if d.exit_code} == {"large": 5}
        assert "memory ran out" in str(done["large"].error)
        assert len({d.row["pid"] for d in done.values() if d.row.get("pid")}) <= 2  # no worker was lost


def test_what_no_limit_of_the_process_catches_is_caught_by_its_nanny(sources: Callable[..., list[Source]]) -> None:
    names = ["a", "large", "b", "c"]
    with local_cluster(2, MEMORY) as own:
        done = by_name(results(own, works.maps, sources(*names), Settings("x", memory=MEMORY)))
    assert {name: d.exit_code for name, d in done.items() if d.exit_code} == {"large": 5}
    assert "workers died at it, as they do where memory runs out" in str(done["large"].error)


def test_an_error_that_nobody_foresaw_is_a_row(sources: Callable[..., list[Source]]) -> None:
    with local_cluster(1, MEMORY) as own:
        done = by_name(results(own, works.breaks, sources("a", "odd", "b"), Settings("x", memory=MEMORY)))
    assert {name: d.exit_code for name, d in done.items()} == {"a": 0, "odd": 4, "b": 0}


# Whoever asked is stopped.


def _stored(table: Path) -> list[str]:
    """Recordings with a row in an unfinished table."""
    if table.suffix == ".sqlite":
        if not table.exists():
            return []
        with sqlite3.connect(table) as db:
            try:
                return [name for (name,) in db.execute("SELECT recording FROM recordings ORDER BY rowid")]
            except sqlite3.OperationalError:
                return []
    journal = table.with_name(table.name + ".journal")
    lines = journal.read_bytes().split(b"\n")[1:-1] if journal.exists() else []
    return [json.loads(line)["recording"] for line in lines]


def _started(process: Callable[..., Any], folder: Path, table: Path, *more: str) -> subprocess.Popen[str]:
    started: subprocess.Popen[str] = process("triaxcald.cli", "batch", "fit", folder, "-o", table, "--jobs", 2, *more)
    return started


@pytest.mark.parametrize(
    ("number", "name"),
    [
        (signal.SIGINT, "t.csv"),
        (signal.SIGINT, "t.sqlite"),
        (signal.SIGKILL, "t.parquet"),
        (signal.SIGKILL, "t.sqlite"),
    ],
)
def test_an_interrupted_run_resumes(
    recordings: Callable[..., Path], process: Callable[..., Any], until: Callable[..., Any], number: int, name: str
) -> None:
    folder = recordings(24)
    for attempt in range(10):  # on a busy machine all may be done before the signal is sent
        table = folder.parent / f"{attempt}-{name}"
        client = _started(process, folder, table)
        until(lambda: client.poll() is not None or len(_stored(table)) >= 3)  # noqa: B023 - it waits here
        with contextlib.suppress(psutil.NoSuchProcess, ProcessLookupError):
            workers = psutil.Process(client.pid).children(recursive=True)
            # A terminal tells the whole group.
            os.killpg(client.pid, number) if number == signal.SIGINT else client.kill()
        _, err = client.communicate(timeout=180)
        if client.returncode != 0:
            break
    before = _stored(table)
    assert 3 <= len(before) < 24
    if number == signal.SIGINT:
        assert client.returncode == 130
        said = err.splitlines()[-1]
        assert said.startswith("triaxcal: interrupted; ")
        assert said.endswith(f"--resume goes on with {table}")
        assert "Traceback" not in err
    until(lambda: not any(worker.is_running() and worker.status() != "zombie" for worker in workers))
    again = _started(process, folder, table, "--resume")
    out, err = again.communicate(timeout=200)
    assert (again.returncode, out) == (0, "24 recordings: 24 done\n"), err
    after = _stored(table) if table.suffix == ".sqlite" else []
    if table.suffix == ".csv":
        after = [row["recording"] for row in rows_of(table)]
    elif table.suffix == ".parquet":
        import pandas as pd

        after = list(pd.read_parquet(table)["recording"])
    assert len(after) == len(set(after)) == 24
    if table.suffix == ".sqlite":
        assert after[: len(before)] == before  # these rows were not written again


def test_resumed_on_a_finished_table_only_what_has_changed_is_done_again(
    recordings: Callable[..., Path], triaxcal: Run
) -> None:
    """A row that was not written again keeps what a program put into it."""
    folder = recordings(3, TABLE)
    table = folder / "t.sqlite"
    assert triaxcal("batch", "poses", folder, "-o", table).code == 0
    with sqlite3.connect(table) as db:
        db.execute("UPDATE recordings SET poses = -1")
    os.utime(folder / "r01.csv.gz", ns=(1, 1))
    assert triaxcal("batch", "poses", folder, "-o", table, "--resume").code == 0
    with sqlite3.connect(table) as db:
        found = list(db.execute("SELECT poses, stamp = '1' FROM recordings ORDER BY recording"))
    assert found == [(-1, 0), (14, 1), (-1, 0)]
