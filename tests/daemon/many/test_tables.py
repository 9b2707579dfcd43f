"""Rows are stored as they come, outlive a kill, and are taken over only where nothing has changed."""

from __future__ import annotations

import os
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.daemon.many.conftest import environment
from triaxcald.errors import DeviceInUse, InputError
from triaxcald.many import COMMON_AFTER, COMMON_BEFORE, Column, Settings, Source, is_current, open_table
from triaxcald.schema.columns import Kind

COLUMNS: tuple[Column[Any], ...] = (
    *COMMON_BEFORE,
    Column("word", Kind.TEXT, "a text", lambda of: None),
    Column("count", Kind.WHOLE, "a number", lambda of: None),
    Column("value", Kind.NUMBER, "another", lambda of: None),
    *COMMON_AFTER,
)
SETTINGS = Settings("abc", "1.0")
SOURCE = Source('r/a, "b".mcap', 12, "99")
KINDS = ["t.csv", "t.csv.gz", "t.parquet", "t.sqlite"]


def row_of(name: str, **cells: Any) -> dict[str, Any]:
    common = {"exit_code": 0, "error": None, "seconds": 1.5, "size": 12, "stamp": "99", "sha256": "ff"}
    own = {"word": 'µ; "x",\ny', "count": 3, "value": 1e-300}
    return {"recording": name, **common, **own, "software": "1.0", "settings": "abc", **cells}


def opened(path: Path, *, resume: bool = False, command: str = "audit") -> Any:
    return open_table(path, command, COLUMNS, resume=resume)


@pytest.mark.parametrize("name", KINDS)
def test_a_finished_table_gives_the_same_rows_back(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    rows = [row_of(n) for n in ("c", SOURCE.name, "a")] + [row_of("empty", word=None, count=None, value=None)]
    with opened(path) as table:
        for row in rows:
            table.store(row)
        table.finish(["a", "c", SOURCE.name, "empty"])
    assert [p.name for p in tmp_path.iterdir()] == [name]
    with opened(path, resume=True) as table:
        for row in rows:
            assert table.stored(row["recording"]) == row


@pytest.mark.parametrize("name", ["t.csv", "t.parquet"])
def test_rows_of_a_file_are_in_the_order_given(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    with opened(path) as table:
        for n in ("c", "b", "a"):
            table.store(row_of(n))
        table.finish(["a", "b", "c"])
    import pandas as pd

    found = pd.read_csv(path) if name == "t.csv" else pd.read_parquet(path)
    assert list(found["recording"]) == ["a", "b", "c"]


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_a_kill_loses_no_stored_row(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    code = f"""
import os, signal
from pathlib import Path
from tests.daemon.many.test_tables import opened, row_of
table = opened(Path({str(path)!r}))
table.store(row_of("a"))
table.store(row_of("b"))
os.kill(os.getpid(), signal.SIGKILL)
"""
    done = subprocess.run([sys.executable, "-c", code], env=environment(), check=False, timeout=180)
    assert done.returncode == -signal.SIGKILL
    with pytest.raises(InputError, match="an interrupted run has left it; --resume goes on"):
        opened(path)
    with opened(path, resume=True) as table:
        assert table.stored("a") == row_of("a")
        assert table.stored("b") == row_of("b")
        assert table.stored("c") is None


def test_what_a_kill_leaves_of_a_last_line_is_cut_off(tmp_path: Path) -> None:
    path, journal = tmp_path / "t.csv", tmp_path / "t.csv.journal"
    with opened(path) as table:
        table.store(row_of("a"))
        table.store(row_of("b"))
    whole = journal.read_bytes()
    for cut in range(1, len(whole) - whole[:-1].rfind(b"\n") - 1, 37):
        journal.write_bytes(whole[:-cut])
        with opened(path, resume=True) as table:
            assert table.stored("a") == row_of("a")
            assert table.stored("b") is None
            table.store(row_of("b"))
        assert journal.read_bytes() == whole


def test_a_journal_cut_within_its_first_line_begins_anew(tmp_path: Path) -> None:
    path, journal = tmp_path / "t.csv", tmp_path / "t.csv.journal"
    journal.write_bytes(b'{"format": "tri')
    with opened(path, resume=True) as table:
        table.store(row_of("a"))
        table.finish(["a"])
    assert path.read_text().count("\n") == 3  # one cell has a line end
    assert not journal.exists()


@pytest.mark.parametrize(
    ("change", "current"),
    [
        ({}, True),
        ({"size": 13}, False),
        ({"stamp": "100"}, False),
        ({"software": "1.1"}, False),
        ({"settings": "abd"}, False),
        ({"exit_code": 1}, True),
        ({"exit_code": 2, "error": "broken"}, True),
        ({"exit_code": 3, "error": "refused"}, True),
        ({"exit_code": 2, "error": "the store refuses", "sha256": None}, False),
        ({"exit_code": 3, "error": "refused", "sha256": ""}, False),
        ({"exit_code": 4, "error": "internal"}, False),
        ({"exit_code": 5, "error": "memory ran out"}, False),
    ],
    ids=str,
)
def test_a_row_counts_where_nothing_has_changed(change: dict[str, Any], current: bool) -> None:
    assert is_current(row_of(SOURCE.name, **change), SOURCE, SETTINGS) is current


def test_a_stamp_that_is_empty_reads_back_as_such() -> None:
    unstamped = replace(SOURCE, stamp="")
    for stored in ("", None):
        assert is_current(row_of(SOURCE.name, stamp=stored), unstamped, SETTINGS)


def test_a_recording_of_which_nothing_is_known_is_never_taken_over() -> None:
    unknown = replace(SOURCE, size=None, stamp="")
    assert not is_current(row_of(SOURCE.name, size=None, stamp=""), unknown, SETTINGS)


@pytest.mark.parametrize("name", KINDS)
def test_two_processes_do_not_write_one_table(tmp_path: Path, name: str) -> None:
    with opened(tmp_path / name) as table:
        table.store(row_of("a"))
        with pytest.raises(DeviceInUse, match="another process writes this table"):
            opened(tmp_path / name, resume=True)
    with opened(tmp_path / name, resume=True) as table:
        assert table.stored("a") == row_of("a")


@pytest.mark.parametrize("name", KINDS)
def test_a_table_of_another_command_is_not_gone_on_with(tmp_path: Path, name: str) -> None:
    with opened(tmp_path / name) as table:
        table.store(row_of("a"))
    with pytest.raises(InputError, match="`triaxcal audit`, expected that of `triaxcal batch fit`"):
        opened(tmp_path / name, resume=True, command="batch fit")


def test_a_database_with_other_tables_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "t.sqlite"
    with sqlite3.connect(path) as db:
        db.execute("CREATE TABLE run (a)")
    for resume in (False, True):
        with pytest.raises(InputError, match=r"a database with other tables \(run\)"):
            opened(path, resume=resume)
    with sqlite3.connect(path) as db:
        assert [name for (name,) in db.execute("SELECT name FROM sqlite_master")] == ["run"]


@pytest.mark.parametrize(
    ("name", "make"),
    [
        ("t.sqlite", lambda path: path.write_bytes(b"no database " * 100)),
        ("t.csv", lambda path: path.mkdir()),
        ("t.csv", lambda path: os.symlink("elsewhere", path)),
        ("t.xlsx", lambda path: None),
        ("none/t.csv", lambda path: None),
    ],
)
def test_what_cannot_be_a_table_is_refused(tmp_path: Path, name: str, make: Callable[[Path], Any]) -> None:
    make(tmp_path / name)
    with pytest.raises(InputError, match=name):
        opened(tmp_path / name)


@pytest.mark.parametrize("resume", [False, True])
@pytest.mark.parametrize("name", ["t.csv", "t.csv.gz", "t.parquet"])
def test_a_file_that_is_no_table_of_results_is_left_alone(tmp_path: Path, name: str, resume: bool) -> None:
    """However often it is tried: a recording may have such a name, too."""
    import pandas as pd

    path = tmp_path / name
    frame = pd.DataFrame({"recording": ["a"], "x": [1]})
    frame.to_parquet(path) if name == "t.parquet" else frame.to_csv(path)
    before = path.read_bytes()
    for _ in range(3):
        with pytest.raises(InputError, match="no column"):
            opened(path, resume=resume)
        assert [p.name for p in tmp_path.iterdir()] == [name]
    assert path.read_bytes() == before


@pytest.mark.parametrize("cut", [0.3, 0.9])
@pytest.mark.parametrize("name", ["t.csv.gz", "t.parquet"])
def test_a_damaged_table_is_not_gone_on_with(tmp_path: Path, name: str, cut: float) -> None:
    path = tmp_path / name
    with opened(path) as table:
        for i in range(50):
            table.store(row_of(f"r{i}"))
        table.finish([])
    path.write_bytes(data := path.read_bytes()[: int(cut * path.stat().st_size)])
    with pytest.raises(InputError, match=name):
        opened(path, resume=True)
    assert [p.name for p in tmp_path.iterdir()] == [name]
    assert path.read_bytes() == data


@pytest.mark.parametrize("name", KINDS)
def test_a_table_of_other_columns_is_not_gone_on_with(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    with opened(path) as table:
        table.store(row_of("a"))
        table.finish(["a"])
    before = path.read_bytes()
    more = (*COLUMNS, Column("new", Kind.TEXT, "", str))
    for _ in range(2):
        with pytest.raises(InputError, match=r"of `triaxcal audit`.* column"):
            open_table(path, "audit", more, resume=True)
        assert path.read_bytes() == before
    with open_table(path, "audit", more, resume=False) as table:  # it is ours, and is replaced
        table.store(row_of("b", new="x"))
        table.finish(["b"])
    with open_table(path, "audit", more, resume=True) as table:
        assert table.stored("a") is None
        assert table.stored("b") == row_of("b", new="x")


@pytest.mark.parametrize("resume", [False, True])
@pytest.mark.parametrize("name", KINDS)
def test_a_start_of_which_nothing_comes_leaves_the_finished_table(tmp_path: Path, name: str, resume: bool) -> None:
    path = tmp_path / name
    with opened(path, resume=resume):
        pass
    assert not list(tmp_path.iterdir())
    with opened(path) as table:
        table.store(row_of("a"))
        table.finish(["a"])
    before = path.read_bytes()
    with opened(path, resume=resume):
        pass
    assert [p.name for p in tmp_path.iterdir()] == [name]
    assert path.read_bytes() == before
    with opened(path, resume=True) as table:
        assert table.stored("a") == row_of("a")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["t.csv", "t.parquet"])
def test_a_kill_at_the_start_of_resume_loses_no_row_of_the_finished_table(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    with opened(path) as table:
        for i in range(200):
            table.store(row_of(f"r{i}"))
        table.finish([])
    code = f"""
import os, signal, sys
from pathlib import Path
from tests.daemon.many.test_tables import opened
from triaxcald.many import tables
true, count = tables._line, 0
def line(value):
    global count
    count += 1
    if count == 150:
        os.kill(os.getpid(), signal.SIGKILL)
    return true(value)
tables._line = line
opened(Path({str(path)!r}), resume=True)
"""
    done = subprocess.run([sys.executable, "-c", code], env=environment(), check=False, timeout=180)
    assert done.returncode == -signal.SIGKILL
    with opened(path, resume=True) as table:
        assert all(table.stored(f"r{i}") == row_of(f"r{i}") for i in range(200))


@pytest.mark.parametrize("resume", [False, True])
@pytest.mark.parametrize("name", KINDS)
def test_a_table_that_is_being_written_is_named_as_such(tmp_path: Path, name: str, resume: bool) -> None:
    with opened(tmp_path / name) as table:
        table.store(row_of("a"))
        with pytest.raises(DeviceInUse, match="another process writes this table"):
            opened(tmp_path / name, resume=resume)
        table.store(row_of("b"))
        table.finish(["a", "b"])
    assert [p.name for p in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("name", KINDS)
def test_the_error_of_an_argument_goes_once_the_argument_is_mended(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    nothing = {"exit_code": 2, "error": "no recording", "size": None, "stamp": None, "sha256": None}
    with opened(path) as table:
        for argument in ("day", "day/below", "days", "other"):
            table.store(row_of(argument, **nothing))
        table.store(row_of("day/broken.mcap", exit_code=2, error="broken", sha256=None))
        table.finish(["day"], ["day"])
    with opened(path, resume=True) as table:
        table.store(row_of("day/a.mcap"))
        table.finish(["day/a.mcap"], ["day"])
    with opened(path, resume=True) as table:
        left = [n for n in ("day", "day/below", "days", "other", "day/broken.mcap", "day/a.mcap") if table.stored(n)]
    assert left == ["days", "other", "day/broken.mcap", "day/a.mcap"]


@pytest.mark.parametrize("name", KINDS)
def test_a_name_that_is_no_text_and_a_figure_that_is_no_number(tmp_path: Path, name: str) -> None:
    odd = "r/\udcff\r.mcap"
    with opened(tmp_path / name) as table:
        table.store(row_of(odd, value=float("nan"), error="half \ud800"))
        table.finish([odd])
    with opened(tmp_path / name, resume=True) as table:
        found = table.stored(odd)
    assert found == row_of("r/\\udcff\r.mcap", value=None, error="half \\ud800")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["t.csv", "t.sqlite"])
def test_a_disk_that_takes_no_more_is_5_and_the_rest_resumes(tmp_path: Path, name: str) -> None:
    """A file of 40 KiB at most stands for the full disk."""
    path = tmp_path / name
    code = f"""
import resource, signal
from pathlib import Path
from tests.daemon.many.test_tables import opened, row_of
from triaxcald.errors import DiskError
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (40 * 1024, 40 * 1024))
with opened(Path({str(path)!r})) as table:
    for count in range(10_000):
        try:
            table.store(row_of(f"r{{count}}"))
        except DiskError as e:
            print(count, e.exit_code, e)
            break
"""
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment(), capture_output=True, text=True, check=True, timeout=120
    )
    count, code_, words = done.stdout.split(" ", 2)
    assert code_ == "5"
    assert "--resume goes on" in words
    with opened(path, resume=True) as table:
        for i in range(int(count)):
            assert table.stored(f"r{i}") == row_of(f"r{i}")
