"""What the service keeps, in SQLite and in PostgreSQL: rows made from the outcomes, events, trail and settings."""

from __future__ import annotations

import json
import sqlite3
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import delete, select, text, update

from tests.daemon.service.conftest import put_outcome
from triaxcald.errors import InputError
from triaxcald.schema.codes import Code
from triaxcald.service import tables
from triaxcald.service.database import DatabaseError
from triaxcald.service.ledger import EVENTS_KEPT, Ledger, RunFilter
from triaxcald.station.config import Station
from triaxcald.store import FILE_NAME, Store

MakeStation = Callable[..., Station]
OpenLedger = Callable[[Station], Ledger]
DELIVER = '[[deliver]]\nname = "mes"\nurl = "http://127.0.0.1:1/"\n[[deliver]]\nname = "files"\nfolder = "out"\n'


def rows(ledger: Ledger, table: Any) -> list[dict[str, Any]]:
    with ledger.reading() as db:
        found = [dict(row) for row in db.execute(select(table)).mappings()]
    return sorted(found, key=repr)


def test_runs_units_and_measurements_are_those_of_the_folder(
    make_station: MakeStation, open_ledger: OpenLedger, tmp_path: Path
) -> None:
    ledger = open_ledger(make_station())
    made = [
        put_outcome(tmp_path, 1), put_outcome(tmp_path, 2, Code.FIT_OUTSIDE), put_outcome(tmp_path, 3, Code.ABSENT),
        put_outcome(tmp_path, 4, serial="001001", attempt=2),
    ]  # fmt: skip
    assert sorted(ledger.take()) == sorted(d["run"] for d in made)
    assert ledger.take() == []
    with Store(tmp_path) as store:
        assert ledger.every(RunFilter()) == list(store.runs().documents())
    units = {row["plain_serial"]: row for row in rows(ledger, tables.unit)}
    assert set(units) == {"1001", "1002", "1003"}
    assert (units["1001"]["attempts"], units["1001"]["passed"], units["1001"]["run"]) == (2, True, made[3]["run"])
    assert (units["1003"]["passed"], units["1003"]["code"]) == (False, "absent")
    figures = ledger.measurements_of(made[0]["run"])
    assert figures[0] == {"name": "rms_g", "value": 1e-5, "unit": "g", "low": None, "high": 1e-4, "passed": True}
    assert [f["name"] for f in figures][-3:] == ["bias_x", "bias_y", "bias_z"]
    assert ledger.measurements_of(made[2]["run"]) == []
    assert ledger.run_of(made[1]["run"])["code"] == "fit_outside"  # type: ignore[index]
    assert ledger.run_of("nobody") is None
    assert [row["run"] for row in ledger.unit("1001")] == [made[0]["run"], made[3]["run"]]


def test_what_leaves_the_folder_or_changes_is_followed(
    make_station: MakeStation, open_ledger: OpenLedger, tmp_path: Path
) -> None:
    ledger = open_ledger(make_station())
    first, second = put_outcome(tmp_path, 1), put_outcome(tmp_path, 2)
    ledger.take()
    next(tmp_path.glob("*000001.outcome.json")).unlink()
    changed = next(tmp_path.glob("*000002.outcome.json"))
    changed.write_text(changed.read_text().replace('"WO 1"', '"WO 22"'))
    assert ledger.take() == []
    assert [(row["run"], row["order"]) for row in ledger.every(RunFilter())] == [(second["run"], "WO 22")]
    assert [row["serial"] for row in rows(ledger, tables.unit)] == [second["serial"]]
    assert ledger.measurements_of(first["run"]) == []


@pytest.mark.parametrize(
    ("wanted", "numbers"),
    [
        (RunFilter(serial="01003"), [3]),
        (RunFilter(order="WO 2"), [4]),
        (RunFilter(verdict="aborted"), [2]),
        (RunFilter(code="within_limits", slot="b"), [1, 3]),
        (RunFilter(operator="B"), []),
        (RunFilter(since_us=1893456000_000000 + 3 * 60_000_000), [3, 4]),
        (RunFilter(until_us=1893456000_000000 + 3 * 60_000_000), [1, 2]),
    ],
)
def test_runs_are_chosen(
    make_station: MakeStation, open_ledger: OpenLedger, tmp_path: Path, wanted: RunFilter, numbers: list[int]
) -> None:
    ledger = open_ledger(make_station())
    for number in (1, 3):
        put_outcome(tmp_path, number)
    put_outcome(tmp_path, 2, Code.LOST)
    put_outcome(tmp_path, 4, order="WO 2")
    ledger.take()
    expected = [str(1000 + n) for n in numbers]
    assert [row["serial"] for row in ledger.every(wanted)] == expected
    latest_first, after = ledger.runs(wanted, 10)
    assert ([row["serial"] for row in latest_first], after) == (expected[::-1], None)


def test_pages_of_runs_hold_each_once(make_station: MakeStation, open_ledger: OpenLedger, tmp_path: Path) -> None:
    ledger = open_ledger(make_station())
    for number in range(7):
        put_outcome(tmp_path, number)
    ledger.take()
    seen, after = [], None
    while True:
        page, after = ledger.runs(RunFilter(), 3, after)
        seen += [row["serial"] for row in page]
        if after is None:
            break
    assert seen == [str(1000 + n) for n in range(6, -1, -1)]
    for cursor in ("", "x", "eA==", "12", "é"):
        with pytest.raises(InputError):
            ledger.runs(RunFilter(), 3, cursor)


def test_each_receiver_gets_each_later_run_once(
    make_station: MakeStation, open_ledger: OpenLedger, tmp_path: Path
) -> None:
    """Runs of 2030 ended after the receiver was named, an old one before."""
    old = put_outcome(tmp_path, -30 * 365 * 24 * 60)
    ledger = open_ledger(make_station(DELIVER))
    ledger.begin_deliveries()
    made = [put_outcome(tmp_path, 2), put_outcome(tmp_path, 1)]
    ledger.take()
    for receiver in ("mes", "files"):
        waiting = ledger.next_delivery(receiver)
        assert waiting is not None
        assert waiting.run == made[1]["run"]  # the order of their ends
        ledger.note_try(waiting, "not now")
        ledger.end_delivery(waiting, None)
    ledger.rebuild()
    ledger.take()
    waiting = ledger.next_delivery("mes")
    assert waiting is not None
    assert waiting.run == made[0]["run"]
    ledger.end_delivery(waiting, "never")
    assert ledger.next_delivery("mes") is None
    assert [(d.receiver, d.waiting, d.refused) for d in ledger.deliveries()] == [("mes", 0, 1), ("files", 1, 0)]
    out = rows(ledger, tables.outbox)
    assert len(out) == 4
    assert old["run"] not in {row["run"] for row in out}
    assert {row["tries"] for row in out if row["state"] == "delivered"} == {2}


def test_a_rebuild_gives_the_same_rows(make_station: MakeStation, open_ledger: OpenLedger, tmp_path: Path) -> None:
    ledger = open_ledger(make_station(DELIVER))
    for number, code in enumerate(Code):
        put_outcome(tmp_path, number, code)
    ledger.take()
    made = (tables.filed, tables.unit, tables.measurement, tables.outbox)
    before = [rows(ledger, table) for table in made], ledger.every(RunFilter())
    ledger.rebuild()
    assert ([rows(ledger, table) for table in made], ledger.every(RunFilter())) == before


def test_two_stations_share_a_server_and_keep_apart(
    postgresql: str, make_station: MakeStation, open_ledger: OpenLedger, database: str | None, tmp_path: Path
) -> None:
    if database is None:
        pytest.skip("a file belongs to one folder")
    first = open_ledger(make_station())
    run = put_outcome(tmp_path, 1)
    first.take()
    second = open_ledger(make_station(name="line 2", folder="other"))
    second.take()
    assert second.every(RunFilter()) == []
    second.append([{"seq": 1, "event": "tray"}])
    assert (first.last_seq(), second.last_seq()) == (0, 1)
    assert [row["run"] for row in first.every(RunFilter())] == [run["run"]]


def test_events_are_numbered_kept_and_dropped(make_station: MakeStation, open_ledger: OpenLedger) -> None:
    ledger = open_ledger(make_station())
    assert (ledger.last_seq(), ledger.events_after(0, 10)) == (0, [])
    events = [{"seq": n, "run": "r" if n % 2 else None, "event": "stage", "text": "µ"} for n in range(1, 8)]
    ledger.append(events[:3])
    ledger.append(events[3:])
    assert ledger.last_seq() == 7
    assert ledger.events_after(2, 3) == events[2:5]
    assert ledger.events_of("r") == events[::2]
    with pytest.raises(DatabaseError):
        ledger.append([events[0] | {"text": "another event of that number"}])
    ledger.append([{"seq": EVENTS_KEPT + 5, "event": "stage"}])
    assert [e["seq"] for e in ledger.events_after(0, 100)] == [6, 7, EVENTS_KEPT + 5]


def test_settings_are_values(make_station: MakeStation, open_ledger: OpenLedger) -> None:
    ledger = open_ledger(make_station())
    assert ledger.setting("desk") is None
    for value in ({"a": [1, None, "µ"]}, 7, None, "x"):
        ledger.put_setting("desk", value)
        assert ledger.setting("desk") == value


def test_the_trail_only_grows(make_station: MakeStation, open_ledger: OpenLedger, tmp_path: Path) -> None:
    ledger = open_ledger(make_station())
    ledger.trail("2026-01-31T12:00:00.000+00:00", "A", "operator", "scan", {"text": "1001"}, True, None)
    ledger.trail("2026-01-31T12:00:01.000+00:00", None, None, "request", {"path": "/é"}, False, "role")
    for statement in (update(tables.trail).values(ok=True), delete(tables.trail)):
        with pytest.raises(DatabaseError), ledger.writing() as db:
            db.execute(statement)
    if ledger.path is None:
        with pytest.raises(DatabaseError), ledger.writing() as db:
            db.execute(text("TRUNCATE trail"))
    kept = rows(ledger, tables.trail)
    assert [(row["who"], row["action"], bool(row["ok"])) for row in kept] == [
        ("A", "scan", True), (None, "request", False),
    ]  # fmt: skip
    lines = [json.loads(line) for line in (tmp_path / "trail.jsonl").read_text().splitlines()]
    assert [(line["who"], line["what"]) for line in lines] == [("A", {"text": "1001"}), (None, {"path": "/é"})]


def test_threads_write_side_by_side(make_station: MakeStation, open_ledger: OpenLedger) -> None:
    ledger = open_ledger(make_station())
    failed: list[Exception] = []

    def work(first: int) -> None:
        try:
            for n in range(first, first + 25):
                ledger.append([{"seq": n, "event": "stage"}])
                ledger.put_setting(f"k{first}", n)
                ledger.last_seq()
        except Exception as e:  # noqa: BLE001 - told by the test
            failed.append(e)

    threads = [threading.Thread(target=work, args=(100 * k + 1,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failed == []
    assert len(ledger.events_after(0, 1000)) == 100


# SQLite alone.


@pytest.fixture
def ledger(make_station: MakeStation) -> Any:
    with_file = Ledger.open(make_station())
    yield with_file
    with_file.close()


def test_the_index_goes_on_in_the_same_file(ledger: Ledger, tmp_path: Path) -> None:
    put_outcome(tmp_path, 1)
    with Store(tmp_path) as store:
        assert len(store.runs().rows) == 1
    ledger.take()
    put_outcome(tmp_path, 2)
    with Store(tmp_path) as store:
        assert len(store.runs().rows) == 2
    assert len(ledger.take()) == 1
    assert not list(tmp_path.glob("*damaged*"))


def test_a_damaged_row_of_the_index_costs_no_other_table(ledger: Ledger, tmp_path: Path) -> None:
    put_outcome(tmp_path, 1)
    ledger.take()
    ledger.put_setting("desk", 1)
    with sqlite3.connect(tmp_path / FILE_NAME) as db:
        db.execute("UPDATE run SET operator = 'somebody else'")
    db.close()
    with Store(tmp_path) as store:
        (row,) = store.runs().documents()
    assert row["operator"] == "A"
    assert ledger.setting("desk") == 1
    ledger.take()
    assert [row["operator"] for row in ledger.every(RunFilter())] == ["A"]
    assert not list(tmp_path.glob("*damaged*"))


def test_a_file_that_is_no_database_is_set_aside_and_the_trail_comes_back(ledger: Ledger, tmp_path: Path) -> None:
    put_outcome(tmp_path, 1)
    ledger.take()
    ledger.trail("2026-01-31T12:00:00.000+00:00", "A", "operator", "scan", {"text": "1001"}, True, None)
    ledger.close()
    (tmp_path / FILE_NAME).write_bytes(b"no database" * 1000)
    assert ledger.take() != []
    assert [row["who"] for row in rows(ledger, tables.trail)] == ["A"]
    assert len(list(tmp_path.glob("*damaged*"))) >= 1


def test_a_copy_is_whole_while_others_write(ledger: Ledger, tmp_path: Path) -> None:
    stop = threading.Event()

    def write() -> None:
        n = 0
        while not stop.is_set():
            n += 1
            ledger.append([{"seq": n, "event": "stage"}])
            ledger.put_setting("n", n)

    thread = threading.Thread(target=write)
    thread.start()
    try:
        while ledger.last_seq() < 20:
            pass
        ledger.backup(tmp_path / "copy.sqlite")
    finally:
        stop.set()
        thread.join()
    with sqlite3.connect(tmp_path / "copy.sqlite") as db:
        assert db.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        (seq,) = db.execute("SELECT max(seq) FROM event").fetchone()
        (n,) = db.execute("SELECT value FROM setting WHERE key = 'n'").fetchone()
    db.close()
    assert seq - int(n) in (0, 1)  # the transaction between the two


def test_it_waits_for_the_disk(ledger: Ledger) -> None:
    with ledger.reading() as db:
        assert db.execute(text("PRAGMA journal_mode")).scalar() == "wal"
        assert db.execute(text("PRAGMA synchronous")).scalar() == 2


@pytest.mark.parametrize(
    "url", ["nonsense", "mysql://h/d", "sqlite:///x", "postgresql://", "postgresql://127.0.0.1:1/x"]
)
def test_a_database_that_cannot_be_is_one_line(make_station: MakeStation, url: str) -> None:
    with pytest.raises((InputError, DatabaseError)) as caught:
        Ledger.open(make_station(), url).last_seq()
    assert "\n" not in str(caught.value)


def test_tables_of_a_later_version_are_left_alone(make_station: MakeStation, open_ledger: OpenLedger) -> None:
    ledger = open_ledger(make_station())
    with ledger.writing() as db:
        db.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    with pytest.raises(InputError, match="later version"):
        open_ledger(make_station())
