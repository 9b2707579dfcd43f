"""Odd outcomes, damage, a kill or another process at a bad moment: the ledger goes on, and nothing is lost or sent
twice."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import insert, select

from tests.daemon.service.conftest import put_outcome
from triaxcald.errors import InputError, StationError
from triaxcald.service import tables
from triaxcald.service.database import DatabaseError
from triaxcald.service.ledger import Ledger, RunFilter
from triaxcald.station.config import Station
from triaxcald.store import FILE_NAME, Store

MakeStation = Callable[..., Station]
OpenLedger = Callable[[Station], Ledger]
DELIVER = '[[deliver]]\nname = "mes"\nurl = "http://127.0.0.1:1/"\n'
PERSON = {"name": "A", "role": "operator", "pin": "hash", "disabled": False, "created": "2030-01-01"}
NOON = "2026-01-31T12:00:00.000+00:00"


def rows(ledger: Ledger, table: Any) -> list[dict[str, Any]]:
    with ledger.reading() as db:
        return sorted((dict(row) for row in db.execute(select(table)).mappings()), key=repr)


def people(ledger: Ledger) -> list[str]:
    """As the access of the service asks: by the engine alone."""
    with ledger.engine.connect() as db:
        return list(db.execute(select(tables.person.c.name)).scalars())


def enter(ledger: Ledger, name: str) -> None:
    with ledger.engine.begin() as db:
        db.execute(insert(tables.person).values({**PERSON, "name": name}))


# Outcomes that are odd.


def test_a_copy_of_an_outcome_is_delivered_once(
    make_station: MakeStation, open_ledger: OpenLedger, tmp_path: Path
) -> None:
    ledger = open_ledger(make_station(DELIVER))
    document = put_outcome(tmp_path, 1)
    (path,) = tmp_path.glob("*.outcome.json")
    shutil.copy(path, tmp_path / "a copy.outcome.json")
    ledger.take()
    assert [row["run"] for row in rows(ledger, tables.outbox)] == [document["run"]]
    assert len(ledger.every(RunFilter())) == 2
    path.unlink()
    assert ledger.take() == []
    assert len(ledger.measurements_of(document["run"])) == len({m["name"] for m in rows(ledger, tables.measurement)})
    assert [row["run"] for row in rows(ledger, tables.outbox)] == [document["run"]]


@pytest.mark.parametrize("odd", ["a\0b", "\ud800", "\U0001f527 µ\u202e", "'; DROP TABLE run; --"])
def test_odd_texts_keep_no_run_out(
    make_station: MakeStation, open_ledger: OpenLedger, tmp_path: Path, odd: str
) -> None:
    """PostgreSQL has no text with a zero byte, and no database one with half a pair."""
    ledger = open_ledger(make_station(DELIVER))
    document = put_outcome(tmp_path, 1)
    (path,) = tmp_path.glob("*.outcome.json")
    path.write_text(json.dumps({**document, "reason": odd}))
    other = put_outcome(tmp_path, 2)
    ledger.take()
    assert {row["run"] for row in ledger.every(RunFilter())} >= {other["run"]}
    if odd != "\ud800":
        assert {row["run"] for row in rows(ledger, tables.outbox)} == {document["run"], other["run"]}
    ledger.trail(NOON, odd, "operator", "scan", {"text": odd}, False, "invalid")
    ledger.append([{"seq": 1, "event": "lost", "reason": odd}])
    assert ledger.events_after(0, 1)[0]["reason"] == odd
    ledger.put_setting("odd", odd)
    assert ledger.setting("odd") == odd


def test_a_wrong_unit_is_found_by_both_of_its_serial_numbers(
    make_station: MakeStation, open_ledger: OpenLedger, tmp_path: Path
) -> None:
    ledger = open_ledger(make_station())
    document = put_outcome(tmp_path, 1)
    (path,) = tmp_path.glob("*.outcome.json")
    document["work"]["serial"], document["serial"] = "0700", "800"
    path.write_text(json.dumps(document))
    ledger.take()
    for serial in ("700", "0800"):
        assert [row["run"] for row in ledger.unit(serial)] == [document["run"]]
    with Store(tmp_path) as store:  # the attempt is one at the expected unit
        counted = {serial: store.attempts(serial) for serial in ("700", "800")}
    assert {row["plain_serial"]: row["attempts"] for row in rows(ledger, tables.unit)} | {"800": 0} == counted


# A file that is damaged or replaced.


def test_people_and_the_trail_outlive_damaged_rows_of_the_index(make_station: MakeStation, tmp_path: Path) -> None:
    ledger = Ledger.open(make_station())
    put_outcome(tmp_path, 1)
    ledger.take()
    enter(ledger, "A")
    before = ledger.every(RunFilter())
    for statement in (
        "DROP TABLE run", "DROP TABLE file", "UPDATE run SET reason = 'other'", "UPDATE run SET terms = x'00'",
        "PRAGMA user_version = 0", "ALTER TABLE run ADD COLUMN more", "ALTER TABLE run DROP COLUMN terms",
    ):  # fmt: skip
        db = sqlite3.connect(tmp_path / FILE_NAME)
        db.execute(statement)
        db.commit()
        db.close()
        with Store(tmp_path) as store:
            assert len(store.runs().rows) == 1, statement
        assert people(ledger) == ["A"], statement
        ledger.take()
        assert ledger.every(RunFilter()) == before, statement
    assert not list(tmp_path.glob("*damaged*"))
    db = sqlite3.connect(tmp_path / FILE_NAME)
    assert db.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    assert db.execute("PRAGMA user_version").fetchone() == (1,)
    db.close()
    ledger.close()


def test_a_new_file_is_used_by_all_who_have_the_engine(make_station: MakeStation, tmp_path: Path) -> None:
    """Another process sets a damaged file aside while this one has it open."""
    ledger = Ledger.open(make_station())
    put_outcome(tmp_path, 1)
    ledger.take()
    ledger.trail(NOON, "A", "engineer", "people_add", {"name": "A"}, True, None)
    enter(ledger, "A")
    assert people(ledger) == ["A"]
    assert ledger.lost is None
    path = tmp_path / FILE_NAME
    for end in ("-wal", "-shm", ""):
        if os.path.exists(f"{path}{end}"):
            os.replace(f"{path}{end}", f"{path}.damaged{end}")
    assert people(ledger) == []
    assert ledger.lost is not None
    assert "people" in ledger.lost
    enter(ledger, "B")
    with Store(tmp_path) as store:
        assert len(store.runs().rows) == 1
    ledger.take()
    assert people(ledger) == ["B"]
    assert [row["who"] for row in rows(ledger, tables.trail)] == ["A"]
    ledger.close()
    again = Ledger.open(make_station())
    assert people(again) == ["B"]
    again.close()


def test_damage_that_the_service_finds_first_is_set_aside(make_station: MakeStation, tmp_path: Path) -> None:
    ledger = Ledger.open(make_station())
    for n in range(40):
        put_outcome(tmp_path, n)
    ledger.take()
    ledger.append([{"seq": n, "event": "stage", "text": "x" * 500} for n in range(1, 200)])
    ledger.trail(NOON, "A", "operator", "scan", {}, True, None)
    ledger.close()
    path = tmp_path / FILE_NAME
    data = bytearray(path.read_bytes())
    data[8192:] = os.urandom(len(data) - 8192)
    path.write_bytes(data)
    ledger = Ledger.open(make_station())
    assert ledger.lost is not None
    assert len(ledger.take()) == 40
    assert [row["who"] for row in rows(ledger, tables.trail)] == ["A"]
    assert len(list(tmp_path.glob("*damaged*"))) >= 1
    ledger.close()


def test_damage_under_an_open_service_ends_by_itself(make_station: MakeStation, tmp_path: Path) -> None:
    """The first call says so, the next works with a new file."""
    ledger = Ledger.open(make_station())
    ledger.append([{"seq": n, "event": "stage", "text": "x" * 500} for n in range(1, 2000)])
    with ledger.engine.connect() as db:
        db.exec_driver_sql("SELECT 1")
    ledger.engine.dispose()  # what is in the log is in the file
    path = tmp_path / FILE_NAME
    with path.open("r+b") as file:
        file.seek(4096)
        file.write(os.urandom(path.stat().st_size - 4096))
    with pytest.raises(DatabaseError):
        ledger.events_after(0, 2000)
    ledger.append([{"seq": 2000, "event": "stage"}])
    assert [e["seq"] for e in ledger.events_after(0, 10)] == [2000]
    assert ledger.lost is not None
    ledger.close()


def test_what_waits_is_delivered_after_the_database_was_lost(make_station: MakeStation, tmp_path: Path) -> None:
    station = make_station(DELIVER)
    ledger = Ledger.open(station)
    ledger.begin_deliveries()
    document = put_outcome(tmp_path, 1)
    ledger.take()
    ledger.close()
    for end in ("", "-wal", "-shm"):
        (tmp_path / f"{FILE_NAME}{end}").unlink(missing_ok=True)
    ledger = Ledger.open(station)
    ledger.begin_deliveries()
    ledger.take()
    assert [row["run"] for row in rows(ledger, tables.outbox)] == [document["run"]]
    ledger.close()


def test_a_station_with_another_name_keeps_what_its_folder_has(make_station: MakeStation, tmp_path: Path) -> None:
    ledger = Ledger.open(make_station(DELIVER))
    ledger.begin_deliveries()
    document = put_outcome(tmp_path, 1)
    assert ledger.take() == [document["run"]]
    ledger.append([{"seq": 7, "event": "stage"}])
    ledger.put_setting("desk", 1)
    ledger.close()
    ledger = Ledger.open(make_station(DELIVER, name="line 7"))
    ledger.begin_deliveries()
    assert ledger.take() == []
    assert (ledger.last_seq(), ledger.setting("desk")) == (7, 1)
    assert [row["run"] for row in rows(ledger, tables.outbox)] == [document["run"]]
    waiting = ledger.next_delivery("mes")
    assert waiting is not None
    assert len(rows(ledger, tables.unit)) == 1
    ledger.close()


def test_a_database_that_is_no_file_of_its_own_is_refused(make_station: MakeStation, tmp_path: Path) -> None:
    station = make_station()
    (tmp_path / FILE_NAME).symlink_to(tmp_path / "elsewhere")
    with pytest.raises((InputError, DatabaseError)) as caught:
        Ledger.open(station)
    assert FILE_NAME in str(caught.value)
    assert not (tmp_path / "elsewhere").exists()


def test_an_index_of_a_later_version_is_refused(make_station: MakeStation, tmp_path: Path) -> None:
    Ledger.open(make_station()).close()
    db = sqlite3.connect(tmp_path / FILE_NAME)
    db.execute("PRAGMA user_version = 99")
    db.close()
    with pytest.raises(InputError, match="later version"):
        Ledger.open(make_station())


@pytest.mark.parametrize("to", [FILE_NAME, "other", "folder"])
def test_a_backup_replaces_an_earlier_copy_alone(make_station: MakeStation, tmp_path: Path, to: str) -> None:
    ledger = Ledger.open(make_station())
    for name in "BC":
        enter(ledger, name)
        ledger.backup(tmp_path / "copy")
    db = sqlite3.connect(tmp_path / "copy")
    assert db.execute("SELECT count(*) FROM person").fetchone() == (2,)
    db.close()
    (tmp_path / "other").write_text("of somebody")
    (tmp_path / "folder").mkdir()
    enter(ledger, "A")
    with pytest.raises(InputError):
        ledger.backup(tmp_path / to)
    assert (tmp_path / "other").read_text() == "of somebody"
    assert sorted(people(ledger)) == ["A", "B", "C"]
    assert {p.name for p in tmp_path.iterdir() if p.name.startswith(".")} == set()
    ledger.close()


# The trail and its other copy.


def test_a_line_without_its_row_is_entered_at_the_next_start(
    make_station: MakeStation, open_ledger: OpenLedger, tmp_path: Path
) -> None:
    """As after a kill between the two; the last line was cut short."""
    ledger = open_ledger(make_station())
    ledger.trail(NOON, "A", "operator", "scan", {"text": "1"}, True, None)
    path = tmp_path / "trail.jsonl"
    (line,) = map(json.loads, path.read_text().splitlines())
    more = {**line, "who": "B", "uid": "0" * 32}
    with path.open("a") as file:
        file.write(json.dumps(more) + "\n" + json.dumps(more)[:30])
    ledger.close()
    ledger = open_ledger(make_station())
    assert sorted(row["who"] for row in rows(ledger, tables.trail)) == ["A", "B"]
    ledger.trail(NOON, "C", "operator", "scan", {"text": "1"}, True, None)
    for _ in range(2):
        ledger.close()
        ledger = open_ledger(make_station())
        assert sorted(row["who"] for row in rows(ledger, tables.trail)) == ["A", "B", "C"]


def test_a_trail_that_cannot_be_written_is_an_error_and_leaves_no_row(
    make_station: MakeStation, open_ledger: OpenLedger, tmp_path: Path
) -> None:
    ledger = open_ledger(make_station())
    (tmp_path / "trail.jsonl").unlink(missing_ok=True)
    (tmp_path / "trail.jsonl").mkdir()
    with pytest.raises(DatabaseError, match=r"trail\.jsonl"):
        ledger.trail(NOON, "A", "operator", "scan", {}, True, None)
    assert rows(ledger, tables.trail) == []


# Kills, and other processes.

TAKE = """
import os, signal, sys
from pathlib import Path
from triaxcald.service import ledger as module
from triaxcald.service.ledger import Ledger
from triaxcald.station.config import load_station
ledger = Ledger.open(load_station(Path(sys.argv[1])), sys.argv[2] or None)
at = sys.argv[3]
if at == "before":
    module.Ledger._enter = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
elif at == "within":
    true = module.Ledger._count_units
    def count(self, db, serials):
        true(self, db, serials)
        os.kill(os.getpid(), signal.SIGKILL)
    module.Ledger._count_units = count
ledger.take()
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.slow
@pytest.mark.parametrize("at", ["before", "within", "after"])
def test_a_kill_between_the_outcome_and_its_rows_costs_no_run(
    make_station: MakeStation, open_ledger: OpenLedger, tmp_path: Path, database: str | None, at: str
) -> None:
    station = make_station(DELIVER)
    ledger = open_ledger(station)
    ledger.begin_deliveries()
    ledger.close()
    made = [put_outcome(tmp_path, n)["run"] for n in range(3)]
    killed = subprocess.run(
        [sys.executable, "-c", TAKE, station.path, database or "", at], capture_output=True, text=True, check=False
    )
    assert (killed.returncode, killed.stderr) == (-signal.SIGKILL, "")
    ledger = open_ledger(station)
    there = [row["run"] for row in ledger.every(RunFilter())]
    assert there == ([] if at == "within" and database else there)
    ledger.take()
    assert sorted(row["run"] for row in ledger.every(RunFilter())) == sorted(made)
    assert sorted(row["run"] for row in rows(ledger, tables.outbox)) == sorted(made)
    assert len(rows(ledger, tables.filed)) == 3
    assert ledger.take() == []


@pytest.fixture
def held(make_station: MakeStation, tmp_path: Path) -> Iterator[tuple[Ledger, sqlite3.Connection]]:
    """Another process has the file and does not let go."""
    ledger = Ledger.open(make_station())
    other = sqlite3.connect(tmp_path / FILE_NAME, isolation_level=None, check_same_thread=False)
    other.execute("BEGIN IMMEDIATE")
    yield ledger, other
    other.close()
    ledger.close()


@pytest.mark.slow
def test_a_file_that_another_process_holds_is_an_error_and_later_none(
    held: tuple[Ledger, sqlite3.Connection], tmp_path: Path
) -> None:
    ledger, other = held
    document = put_outcome(tmp_path, 1)
    with pytest.raises(DatabaseError):
        ledger.take()
    assert ledger.last_seq() == 0  # readers need not wait
    other.execute("ROLLBACK")
    assert ledger.take() == [document["run"]]
    assert [row["run"] for row in ledger.every(RunFilter())] == [document["run"]]


def test_two_services_that_take_one_folder_agree(
    make_station: MakeStation, open_ledger: OpenLedger, tmp_path: Path
) -> None:
    station = make_station(DELIVER)
    ledgers = [open_ledger(station) for _ in range(3)]
    ledgers[0].begin_deliveries()
    made = [put_outcome(tmp_path, n)["run"] for n in range(30)]
    failed: list[BaseException] = []

    def take(ledger: Ledger) -> None:
        try:
            ledger.take()
        except (DatabaseError, InputError) as e:
            failed.append(e)

    threads = [threading.Thread(target=take, args=(ledger,)) for ledger in ledgers]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failed == []
    assert sorted(row["run"] for row in ledgers[0].every(RunFilter())) == sorted(made)
    assert sorted(row["run"] for row in rows(ledgers[0], tables.outbox)) == sorted(made)


@pytest.mark.parametrize("database", ["postgresql"], indirect=True)
def test_two_services_do_not_work_for_one_station_in_a_shared_database(
    make_station: MakeStation, open_ledger: Callable[[Station], Ledger]
) -> None:
    first, second, other = open_ledger(make_station()), open_ledger(make_station()), open_ledger(make_station(name="b"))
    with first.alone(), other.alone():
        with pytest.raises(StationError, match="another service works for a station named line 1"), second.alone():
            pass
        with first.reading() as db:
            db.execute(select(tables.setting)).all()
        first.take()
    with second.alone():
        pass
