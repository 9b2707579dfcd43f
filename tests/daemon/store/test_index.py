"""What the index says is what the outcomes in the folder say: after any change, damage, or a second process."""

from __future__ import annotations

import gc
import json
import os
import random
import resource
import shutil
import sqlite3
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from benchmarks.results_index import fill
from triaxcald.outcome import digest_of
from triaxcald.schema.columns import COLUMNS, NAMES
from triaxcald.store import History, Runs, Store, database, index

Write = Callable[..., Path]
MANY = 2_000
FILE = "triaxcal.sqlite"


@pytest.fixture(scope="module")
def many(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[dict[str, Any]]]:
    """A folder of synthetic outcomes, and their documents in the order of time."""
    folder = tmp_path_factory.mktemp("many")
    documents = fill(folder, MANY, seed=20260131)
    for path in folder.iterdir():
        os.utime(path, (0, 0))  # long ago: the index trusts its stamp
    return folder, documents


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the outcomes that are read."""
    names: list[str] = []
    true = index.cells_of
    monkeypatch.setattr(index, "cells_of", lambda data, name: (names.append(name), true(data, name))[1])
    return names


def ask(folder: Path, **wanted: Any) -> Runs:
    with Store(folder) as store:
        return store.runs(**wanted)


def column(runs: Runs, name: str) -> list[Any]:
    return [row[NAMES.index(name)] for row in runs.rows]


def at(document: Any, key: tuple[str | int, ...]) -> Any:
    for step in key:
        document = None if document is None else document[step]
    return document


# Truth.


@pytest.mark.slow
def test_each_cell_of_many_runs_is_that_of_its_document(many: tuple[Path, list[dict[str, Any]]]) -> None:
    folder, documents = many
    runs = ask(folder)
    assert runs.skipped == []
    for of in COLUMNS:
        if of.key and of.name != "recording":  # there is no recording in the folder
            expected = [at(document, of.key) for document in documents]
            assert [row[of.name] for row in runs.documents()] == expected, of.name


@pytest.mark.slow
def test_the_latest_outcome_and_the_attempts_are_those_of_the_serial_number(
    many: tuple[Path, list[dict[str, Any]]],
) -> None:
    folder, documents = many
    digests = {row["run"]: row["outcome_sha256"] for row in ask(folder).documents()}
    choice = random.Random(4)
    with Store(folder) as store:
        for document in choice.sample(documents, 20):
            serial = document["work"]["serial"]
            tried = [d for d in documents if d["work"]["serial"] == serial]
            reported = [d for d in documents if d["serial"] == serial]
            last = max(reported, key=lambda d: d["ended"])["run"] if reported else None
            assert store.latest(serial) == digests.get(last)
            assert store.attempts(serial) == len(tried)
            assert store.has_passed(serial) == any(d["verdict"] == "pass" for d in tried)
        assert (store.latest("unknown"), store.attempts("unknown"), store.has_passed("unknown")) == (None, 0, False)
        assert (store.latest(None), store.attempts(None), store.has_passed(None)) == (None, 0, False)


def test_the_latest_is_by_the_end_and_not_by_the_name(write: Write, tmp_path: Path) -> None:
    write("b", ended="2026-01-31T12:00:00.000+00:00")
    late = write("a", ended="2026-01-31T12:30:00.000+00:00")
    write("c", ended="2026-01-31T13:00:00.000+01:00")  # the same moment as b
    assert History.of(tmp_path, "1042").latest == digest_of(late.read_bytes())


@pytest.mark.parametrize("asked", ["42", "042", "0042", " 42"])
def test_leading_zeros_of_a_serial_number_do_not_count(write: Write, tmp_path: Path, asked: str) -> None:
    path = write("a", serial="0042", work={"serial": "42", "attempt": 1})
    assert History.of(tmp_path, asked) == History(digest_of(path.read_bytes()), 1, passed=True)


@pytest.mark.parametrize(
    ("outcomes", "attempts", "passed"),
    [
        ([{"work": {"serial": "1042", "attempt": 3}}], 3, True),
        ([{"contents": None}], 0, False),  # a provisioning
        ([{"work": {"serial": "1042", "attempt": 1}, "verdict": "aborted", "serial": None}], 1, False),
        ([{"work": {"serial": "7777", "attempt": 1}}], 0, False),  # a wrong unit
        ([{"ended": "2026-01-30T12:00:00Z"}, {"verdict": "fail"}], 2, True),
        ([{"work": {"serial": "1042", "attempt": 1}}, {"contents": None, "ended": "2026-02-01", "verdict": "fail"}],
         1, True),
        ([{"serial": "0042", "work": {"serial": "42", "attempt": 1}}, {"serial": "1042"}], 1, True),
    ],
)  # fmt: skip
def test_attempts_count_runs_by_the_expected_serial_number_first(
    write: Write, tmp_path: Path, outcomes: list[dict[str, Any]], attempts: int, passed: bool
) -> None:
    for i, of in enumerate(outcomes):
        write(f"run-{i}", **of)
    with Store(tmp_path) as store:
        assert (store.attempts("1042"), store.has_passed("1042")) == (attempts, passed)


def test_runs_are_chosen_by_time_serial_number_and_code(write: Write, tmp_path: Path) -> None:
    write("a", ended="2026-01-31T12:00:00Z", code="within_limits")
    write("b", ended="2026-01-31T13:00:00Z", started="2026-01-31T11:00:00Z", code="fit_outside")
    write("c", ended="2026-01-31T11:30:00Z", serial=None, work={"serial": "1042"}, code="absent")
    write("d", ended="2026-01-31T11:45:00Z", serial="1043", work={"serial": "1044"}, code="wrong_unit")
    noon = 1769860800_000000
    half = 1800_000000

    def chosen(**wanted: Any) -> list[str]:
        return [name[0] for name in column(ask(tmp_path, **wanted), "outcome")]

    assert chosen() == ["b", "c", "d", "a"]
    assert chosen(since_us=noon) == ["a"]
    assert chosen(until_us=noon) == ["b", "c", "d"]
    assert chosen(since_us=noon - half, until_us=noon) == ["c", "d"]
    assert chosen(serial="1042") == ["b", "c", "a"]
    assert (chosen(serial="1043"), chosen(serial="1044")) == (["d"], ["d"])
    assert chosen(code="absent") == ["c"]


def test_a_copy_of_an_outcome_is_no_other_attempt(write: Write, tmp_path: Path) -> None:
    path = write("a", run="0197-1")
    shutil.copy2(path, tmp_path / "a (copy).outcome.json")
    with Store(tmp_path) as store:
        assert store.attempts("1042") == 1


def test_files_are_named_if_they_are_there(write: Write, tmp_path: Path) -> None:
    write("left-1042-x")
    write("other", recording="named.mcap")
    for name in ("left-1042-x.mcap", "left-1042-x.report.html", "named.mcap"):
        (tmp_path / name).touch()
    with Store(tmp_path) as store:
        runs = store.runs()
        assert column(runs, "recording") == ["left-1042-x.mcap", "named.mcap"]
        assert column(runs, "report") == ["left-1042-x.report.html", None]
        assert column(runs, "certificate") == [None, None]
        (tmp_path / "named.mcap").unlink()
        assert column(store.runs(), "recording") == ["left-1042-x.mcap", None]


# Keeping up.


def test_only_files_that_changed_are_read(write: Write, tmp_path: Path, reads: list[str]) -> None:
    for name in ("a", "b", "c"):
        write(name)

    def read_since() -> list[str]:
        reads.clear()
        found = ask(tmp_path)
        assert sorted(column(found, "outcome")) == sorted(p.name for p in tmp_path.glob("*.outcome.json"))
        return sorted(reads)

    assert read_since() == ["a.outcome.json", "b.outcome.json", "c.outcome.json"]
    assert read_since() == []
    write("b", reason="another")
    write("d", unit="right")
    assert read_since() == ["b.outcome.json", "d.outcome.json"]
    (tmp_path / "a.outcome.json").unlink()
    assert read_since() == []
    assert sorted(column(ask(tmp_path), "reason"))[0] == "another"


def test_a_file_that_changed_just_now_is_read_again(write: Write, tmp_path: Path) -> None:
    """It may have changed twice within a tick of the file system's clock."""
    path = write("a", reason="first")
    stamp = os.stat(path).st_mtime_ns + 3600 * 10**9  # now
    os.utime(path, ns=(stamp, stamp))
    assert column(ask(tmp_path), "reason") == ["first"]
    write("a", reason="other")
    os.utime(path, ns=(stamp, stamp))
    assert column(ask(tmp_path), "reason") == ["other"]


def test_a_store_that_stays_open_sees_what_comes(write: Write, tmp_path: Path) -> None:
    with Store(tmp_path) as store:
        assert store.attempts("1042") == 0
        assert list(tmp_path.iterdir()) == []  # no index in a folder without an outcome
        write("a")
        assert store.attempts("1042") == 1
        write("b", ended="2026-02-01T00:00:00Z", verdict="fail")
        assert store.attempts("1042") == 2


def test_what_is_no_outcome_is_named_and_read_once(write: Write, tmp_path: Path, reads: list[str]) -> None:
    write("good")
    for name, text in (("deep", "[" * 200_000), ("empty", ""), ("huge", " " * 5_000_000), ("list", "[]")):
        write(name, text=text)
    (tmp_path / "folder.outcome.json").mkdir()
    (tmp_path / "link.outcome.json").symlink_to("nowhere")
    os.mkfifo(tmp_path / "pipe.outcome.json")
    skipped = [f"{name}.outcome.json" for name in ("deep", "empty", "folder", "huge", "link", "list", "pipe")]
    first = ask(tmp_path)
    assert (first.skipped, column(first, "outcome")) == (skipped, ["good.outcome.json"])
    reads.clear()
    assert ask(tmp_path) == first
    assert reads == []


def test_a_name_that_is_no_text_is_left_out(write: Write, tmp_path: Path) -> None:
    write("a")
    try:
        Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xff.outcome.json")).write_text("{}")
    except OSError:
        pytest.skip("this file system has names of text alone")
    found = ask(tmp_path)
    assert (len(found.rows), len(found.skipped)) == (1, 1)


# Damage.


def _damaged(path: Path, seed: int) -> None:
    choice, data = random.Random(seed), bytearray(path.read_bytes())
    if seed % 3 == 0:
        path.write_bytes(data[: choice.randrange(len(data))])
    elif seed % 3 == 1:
        path.write_bytes(choice.randbytes(choice.randrange(1, 9000)))
    else:
        for _ in range(20):
            start = choice.randrange(0, len(data) - 512, 512)
            data[start : start + 512] = choice.randbytes(512)
        path.write_bytes(data)


@pytest.mark.parametrize("seed", range(30))
def test_a_damaged_index_is_made_anew(write: Write, tmp_path: Path, seed: int) -> None:
    for i in range(40):
        write(f"run-{i:02d}", reason=f"reason {i}", ended=f"2026-01-31T12:{i:02d}:00Z", work={"attempt": i + 1})
    before = ask(tmp_path)
    assert len(before.rows) == 40
    _damaged(tmp_path / FILE, seed)
    with Store(tmp_path) as store:
        assert store.attempts("1042") == 40
        assert store.runs() == before
    assert ask(tmp_path) == before
    db = sqlite3.connect(tmp_path / FILE)
    assert db.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    db.close()


@pytest.mark.parametrize(
    "statement",
    [
        "DROP TABLE run", "DROP TABLE file", "ALTER TABLE run DROP COLUMN terms", "UPDATE run SET rms_g = 'wide'",
        "UPDATE run SET terms = x'00'", "UPDATE run SET reason = 'other'", "UPDATE run SET at_us = 0",
        "PRAGMA user_version = 0", "ALTER TABLE run ADD COLUMN more",
    ],
)  # fmt: skip
def test_tables_that_are_not_ours_are_set_aside(write: Write, tmp_path: Path, statement: str) -> None:
    write("a", ended="2026-01-31T12:00:00Z")
    write("b", ended="2026-01-31T13:00:00Z")
    before = ask(tmp_path)
    db = sqlite3.connect(tmp_path / FILE)
    db.execute(statement)
    db.commit()
    db.close()
    write("c", ended="2026-01-31T14:00:00Z")
    after = ask(tmp_path)
    assert (after.rows[:2], len(after.rows)) == (before.rows, 3)
    assert (tmp_path / f"{FILE}.damaged").exists()
    assert ask(tmp_path) == after


def test_the_file_of_a_later_version_is_left_alone(write: Write, tmp_path: Path) -> None:
    write("a")
    expected = ask(tmp_path)
    db = sqlite3.connect(tmp_path / FILE)
    db.execute("DROP TABLE run")
    db.execute("PRAGMA user_version = 99")
    db.close()
    data = (tmp_path / FILE).read_bytes()
    assert ask(tmp_path) == expected
    assert (tmp_path / FILE).read_bytes() == data


def test_the_file_of_an_earlier_version_gets_the_later_tables(
    write: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write("a")
    expected = ask(tmp_path)
    monkeypatch.setattr(database, "MIGRATIONS", (*database.MIGRATIONS, ("CREATE TABLE person (name TEXT)",)))
    assert ask(tmp_path) == expected
    db = sqlite3.connect(tmp_path / FILE)
    assert db.execute("PRAGMA user_version").fetchone() == (2,)
    assert db.execute("SELECT count(*) FROM person").fetchone() == (0,)
    db.close()


@pytest.mark.parametrize(
    "changed",
    [
        {"reason": "a\0b"}, {"reason": ""}, {"serial": "\U0001f527 µ\u202e"}, {"exit_code": -(2**62)},
        {"verification": {"after_rms_g": -0.0}}, {"verification": {"after_rms_g": 5e-324}},
        {"verification": {"after_rms_g": 1.7e308}}, {"verification": {"after_rms_g": 2**70}},
        {"measured": {"terms": []}}, {"measured": {"terms": ['"', "; "]}},
    ],
    ids=str,
)  # fmt: skip
def test_a_cell_comes_back_as_it_was(write: Write, tmp_path: Path, changed: dict[str, Any]) -> None:
    write("a", **changed)
    first = ask(tmp_path)
    assert ask(tmp_path) == first
    assert len(first.rows) == 1
    assert not (tmp_path / f"{FILE}.damaged").exists()


@pytest.mark.parametrize("how", ["deleted", "replaced"])
def test_an_index_that_is_removed_while_it_is_open_is_made_anew(write: Write, tmp_path: Path, how: str) -> None:
    write("a")
    with Store(tmp_path) as store:
        before = store.runs()
        if how == "deleted":
            (tmp_path / FILE).unlink()
        else:
            (tmp_path / "other").write_bytes(b"no database")
            (tmp_path / "other").replace(tmp_path / FILE)
        assert store.runs() == before
    assert (tmp_path / FILE).exists()
    assert ask(tmp_path) == before


# Where there can be no file.


@pytest.mark.parametrize("kind", ["folder", "link", "pipe"])
def test_without_a_file_the_index_is_in_memory(write: Write, tmp_path: Path, kind: str) -> None:
    path, elsewhere = tmp_path / FILE, tmp_path / "elsewhere"
    if kind == "folder":
        path.mkdir()
    elif kind == "link":
        path.symlink_to(elsewhere)
    else:
        os.mkfifo(path)
    write("a")
    with Store(tmp_path) as store:
        assert len(store.runs().rows) == 1
        write("b")
        assert store.attempts("1042") == 2
    assert not elsewhere.exists()


@pytest.mark.slow
def test_a_full_disk_leaves_the_index_in_memory(write: Write, tmp_path: Path) -> None:
    """A process that may write no file beyond 20 KB stands for it."""
    for i in range(200):
        write(f"run-{i:03d}", reason=f"{i} " * 50)
    code = """
import resource, signal, sys
from pathlib import Path
from triaxcald.store import Store
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
with Store(Path(sys.argv[1])) as store:
    print(len(store.runs().rows), store.attempts("1042"))
"""
    done = subprocess.run([sys.executable, "-c", code, tmp_path], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "200 200\n", "")
    assert len(ask(tmp_path).rows) == 200


def test_an_index_that_another_process_holds_is_left_to_it(
    write: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(database, "BUSY_S", 0.05)
    write("a")
    ask(tmp_path)
    write("b")
    held = sqlite3.connect(tmp_path / FILE, isolation_level=None)
    held.execute("BEGIN EXCLUSIVE")
    assert len(ask(tmp_path).rows) == 2
    held.execute("ROLLBACK")
    held.close()
    assert not (tmp_path / f"{FILE}.damaged").exists()


def test_what_was_indexed_is_not_read_again_in_memory(
    write: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reads: list[str]
) -> None:
    for name in ("a", "b"):
        write(name)
    ask(tmp_path)
    write("c")
    reads.clear()
    connect = database._connected

    def read_only(path: Path | str) -> sqlite3.Connection:
        db = connect(path)
        if path != ":memory:":
            db.execute("PRAGMA query_only = 1")
        return db

    monkeypatch.setattr(database, "_connected", read_only)
    assert len(ask(tmp_path).rows) == 3
    assert set(reads) == {"c.outcome.json"}


def test_a_folder_that_is_not_there_has_no_runs(tmp_path: Path) -> None:
    assert History.of(tmp_path / "none", "1042").latest is None
    assert ask(tmp_path / "none") == Runs([], [])
    assert list(tmp_path.iterdir()) == []


# Several at once.


def test_any_thread_may_ask(write: Write, tmp_path: Path) -> None:
    for i in range(20):
        write(f"run-{i}", serial=str(i))
    found: list[int] = []
    with Store(tmp_path) as store:
        threads = [threading.Thread(target=lambda i=i: found.append(store.attempts(str(i)))) for i in range(20)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert found == [1] * 20


@pytest.mark.slow
def test_processes_that_index_one_folder_at_once_agree(tmp_path: Path) -> None:
    """They begin together, one of them after damage, while outcomes come and go."""
    documents = fill(tmp_path, 600)
    (tmp_path / FILE).write_bytes(b"no database" * 1000)
    code = """
import json, sys
from pathlib import Path
from triaxcald.store import Store
print("ready", flush=True)
sys.stdin.readline()
for _ in range(5):
    with Store(Path(sys.argv[1])) as store:
        runs = store.runs()
        print(json.dumps([len(runs.rows), store.attempts(sys.argv[2])]), flush=True)
"""
    serial = Counter(d["work"]["serial"] for d in documents).most_common(1)[0][0]
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", code, tmp_path, serial],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )
        for _ in range(3)
    ]  # fmt: skip
    for process in processes:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
    for process in processes:
        assert process.stdin is not None
        process.stdin.write("go\n")
        process.stdin.flush()
    expected = [600, sum(d["work"]["serial"] == serial for d in documents)]
    for process in processes:
        out, err = process.communicate(timeout=180)
        assert (process.returncode, err) == (0, "")
        assert [json.loads(line) for line in out.splitlines()] == [expected] * 5
    assert len(ask(tmp_path).rows) == 600


# Cost.


PEER = """
import hashlib, json, sys
from pathlib import Path
for path in sorted(Path(sys.argv[1]).glob("*.outcome.json")):
    read = path.read_bytes()
    hashlib.sha256(read).digest()
    json.loads(read)
"""
"""Reads each outcome once and keeps nothing: the least that a first reading costs."""


def cost(*command: object) -> tuple[float, float]:
    """Processor time [s] and largest memory [MiB] of a process."""
    code = (
        "import resource, subprocess, sys\n"
        "subprocess.run(sys.argv[1:], check=True, stdout=subprocess.DEVNULL)\n"
        "used = resource.getrusage(resource.RUSAGE_CHILDREN)\n"
        "print(used.ru_utime + used.ru_stime, used.ru_maxrss / 1024)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, *map(str, command)], check=True, capture_output=True, text=True)
    processor_s, mib = map(float, done.stdout.split())
    return processor_s, mib


@pytest.mark.slow
def test_the_index_of_twenty_thousand_outcomes_is_cheap(tmp_path: Path) -> None:
    """Costs are multiples of the peer's in the same test, which hold on a slow machine; `benchmarks.results_index` has
    seconds."""
    fill(tmp_path, 20_000)
    peer_s, _ = cost(sys.executable, "-c", PEER, tmp_path)
    for most in (8.0, 1.6):  # measured: 4.7 from nothing, 0.8 again
        processor_s, mib = cost(sys.executable, "-m", "triaxcald.cli", "results", tmp_path)
        assert processor_s < most * peer_s
        assert mib < 300
    gc.collect()
    gc.freeze()  # what other tests left in this process
    begun = resource.getrusage(resource.RUSAGE_SELF)
    assert History.of(tmp_path, "unknown").latest is None
    gc.unfreeze()
    ended = resource.getrusage(resource.RUSAGE_SELF)
    assert ended.ru_utime + ended.ru_stime - begun.ru_utime - begun.ru_stime < 1.0 * peer_s  # measured: 0.53
