"""`results FOLDER --rebuild` gives the same rows as before, with and without a service."""

from __future__ import annotations

import sqlite3
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import delete, select, text, update

from tests.daemon.service.conftest import put_outcome
from triaxcald.cli.commands import main
from triaxcald.schema.codes import Code
from triaxcald.service import tables
from triaxcald.service.ledger import Ledger, RunFilter
from triaxcald.station.config import Station
from triaxcald.store import FILE_NAME, Store

MakeStation = Callable[..., Station]
DELIVER = '[[deliver]]\nname = "mes"\nurl = "http://127.0.0.1:1/"\n'
MADE = (tables.unit, tables.measurement)


def rows(ledger: Ledger, table: Any) -> list[dict[str, Any]]:
    with ledger.reading() as db:
        return sorted((dict(row) for row in db.execute(select(table)).mappings()), key=repr)


def contents(ledger: Ledger) -> tuple[Any, ...]:
    return ledger.every(RunFilter()), *(rows(ledger, table) for table in MADE)


def rebuild(folder: Path, database: str | None = None) -> int:
    options = [] if database is None else ["--database", database]
    return main(["results", str(folder), "--rebuild", *options])


def test_the_index_alone_is_made_anew(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for number, code in enumerate(Code):
        put_outcome(tmp_path, number, code)
    with Store(tmp_path) as store:
        before = store.runs()
    db = sqlite3.connect(tmp_path / FILE_NAME)
    db.execute("DELETE FROM run WHERE code = 'lost'")
    db.commit()
    assert rebuild(tmp_path) == 0
    assert f"{len(Code)} runs" in capsys.readouterr().out
    with Store(tmp_path) as store:
        assert store.runs() == before
    names = {name for (name,) in db.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    db.close()
    assert names == {"file", "run"}


def test_a_folder_without_an_outcome_stays_empty(tmp_path: Path) -> None:
    assert rebuild(tmp_path) == 0
    assert list(tmp_path.iterdir()) == []


def test_rows_of_a_service_come_back_and_other_tables_stay(
    make_station: MakeStation, open_ledger: Callable[[Station], Ledger], database: str | None, tmp_path: Path
) -> None:
    ledger = open_ledger(make_station(DELIVER))
    ledger.begin_deliveries()
    for number, code in enumerate(Code):
        put_outcome(tmp_path, number, code)
    ledger.take()
    ledger.put_setting("desk", 1)
    before, sent = contents(ledger), rows(ledger, tables.outbox)
    with ledger.writing() as db:
        db.execute(delete(tables.unit).where(tables.unit.c.code == "lost"))
        db.execute(update(tables.measurement).values(value=1.0))
        db.execute(text("DELETE FROM run WHERE code = 'stopped'"))
    assert contents(ledger) != before
    assert rebuild(tmp_path, database) == 0
    assert contents(ledger) == before
    assert rows(ledger, tables.outbox) == sent
    assert ledger.setting("desk") == 1
    assert ledger.take() == []
    # A run that the rebuild sees first is delivered nevertheless.
    document = put_outcome(tmp_path, 50)
    assert rebuild(tmp_path, database) == 0
    assert document["run"] in {row["run"] for row in rows(ledger, tables.outbox)}


def test_without_the_extra_the_index_is_made_anew_and_it_is_said(
    make_station: MakeStation, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    ledger = Ledger.open(make_station())
    put_outcome(tmp_path, 1)
    ledger.take()
    before = contents(ledger)
    monkeypatch.setitem(sys.modules, "sqlalchemy", None)
    assert rebuild(tmp_path) == 0
    assert "pip install 'triaxcal[serve]'" in capsys.readouterr().err
    assert rebuild(tmp_path, "postgresql://127.0.0.1:1/x") == 2
    monkeypatch.undo()
    assert contents(ledger) == before
    ledger.close()


@pytest.mark.parametrize(
    ("options", "exit_code", "said"),
    [
        (["--database", "postgresql://127.0.0.1:1/x"], 2, "--rebuild"),
        (["--rebuild", "--database", "mysql://h/x"], 2, "postgresql://"),
        (["--rebuild", "--database", "postgresql://u:s3cret@127.0.0.1:1/x"], 4, "database"),
    ],
)
def test_a_database_that_cannot_be_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], exit_code: int, said: str
) -> None:
    put_outcome(tmp_path, 1)
    assert main(["results", str(tmp_path), *options]) == exit_code
    told = capsys.readouterr().err
    assert said in told
    assert "s3cret" not in told
    assert len(told.splitlines()) == 1
