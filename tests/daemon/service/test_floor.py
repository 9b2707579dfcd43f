"""The floor while its database fails: runs enter it and the desk is kept as soon as it answers again."""

from __future__ import annotations

import asyncio
import sqlite3
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path

import pytest

from tests.daemon.service.conftest import put_outcome
from triaxcald.service import database as database_module
from triaxcald.service import floor as floor_module
from triaxcald.service.floor import DESK, Floor
from triaxcald.service.ledger import Ledger, RunFilter
from triaxcald.service.stream import Stream
from triaxcald.station.config import Station
from triaxcald.store import FILE_NAME
from triaxcald.store import database as store_module


async def test_a_locked_database_gets_the_runs_and_the_desk_once_it_is_free(
    make_station: Callable[..., Station], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(floor_module, "RETRY_S", 0.05)
    for module in (database_module, store_module):
        monkeypatch.setattr(module, "BUSY_S", 0.05)
    station = make_station()
    ledger = Ledger.open(station)
    lines: list[str] = []
    entered = asyncio.Event()
    floor = Floor(
        station, ledger, partial(Stream, ledger), load=lambda: station, log=lines.append, recorded=entered.set
    )
    try:
        document = put_outcome(tmp_path, 1)
        with closing(sqlite3.connect(tmp_path / FILE_NAME, isolation_level=None)) as other:
            other.execute("BEGIN IMMEDIATE")
            await floor.begin()
            await floor.put({"a": "4711"}, {})
            async with asyncio.timeout(20):
                while floor._retry is None or not lines:
                    await asyncio.sleep(0.01)
            assert ledger.every(RunFilter()) == []
            other.execute("ROLLBACK")
        async with asyncio.timeout(20):
            await entered.wait()
            while (ledger.setting(DESK) or {}) != floor.desk.kept():
                await asyncio.sleep(0.01)
        assert [row["run"] for row in ledger.every(RunFilter())] == [document["run"]]
        assert len(lines) == len(set(lines))  # not one with each attempt
    finally:
        await floor.end()
        ledger.close()
