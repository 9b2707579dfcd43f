"""The floor while its database fails, and what comes in the middle of something else: a station file that is read
again, an end of the service, a scan."""

from __future__ import annotations

import asyncio
import json
import sqlite3
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, closing
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from tests.daemon.service.conftest import put_outcome
from triaxcald.service import database as database_module
from triaxcald.service import floor as floor_module
from triaxcald.service.errors import ApiError, Problem
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


async def test_a_start_that_a_restart_would_not_know_touches_no_device(
    make_station: Callable[..., Station], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else the same request would start again after a kill."""
    monkeypatch.setattr(database_module, "BUSY_S", 0.05)
    request = "01890000-0000-7000-8000-000000000000"
    async with at_work(make_station()) as (floor, lines):
        await floor.scan("1001")
        with closing(sqlite3.connect(tmp_path / FILE_NAME, isolation_level=None)) as other:
            other.execute("BEGIN IMMEDIATE")
            with pytest.raises(ApiError) as caught:
                await floor.start(request)
            assert caught.value.problem is Problem.DATABASE
            assert lines  # why
            other.execute("ROLLBACK")
        slot = floor.state(0)["slots"][0]
        assert (slot["state"], slot["serial"]) == ("scanned", "1001")
        answer = await floor.start(request)
        assert await floor.start(request) == answer
        assert floor.desk.slots["a"].run == answer["runs"]["a"]


# Two things at once, at a station whose units are absent.


class Gate:
    """Holds a thread that passes it until it is opened."""

    def __init__(self) -> None:
        self.reached, self.opened = threading.Event(), threading.Event()

    def __call__(self) -> None:
        self.reached.set()
        assert self.opened.wait(20)


@asynccontextmanager
async def at_work(
    station: Station, load: Callable[[], Station] | None = None
) -> AsyncIterator[tuple[Floor, list[str]]]:
    ledger = Ledger.open(station)
    lines: list[str] = []
    floor = Floor(station, ledger, partial(Stream, ledger), load=load or (lambda: station), log=lines.append)
    streaming = asyncio.ensure_future(floor.stream.run())
    try:
        await floor.begin()
        async with asyncio.timeout(60):
            yield floor, lines
    finally:
        await floor.end()
        await floor.stream.drained()
        streaming.cancel()
        ledger.close()


async def over(floor: Floor) -> None:
    """The end of the tray."""
    if floor._task is not None:
        await floor._task


@pytest.fixture
def works(monkeypatch: pytest.MonkeyPatch) -> Gate:
    """The rules are held that a start asks in a thread."""
    gate, ask = Gate(), floor_module.works

    def held(*arguments: Any) -> Any:
        gate()
        return ask(*arguments)

    monkeypatch.setattr(floor_module, "works", held)
    return gate


async def test_a_station_file_that_is_read_while_a_tray_starts_waits_for_its_end(
    make_station: Callable[..., Station],
) -> None:
    load, station = Gate(), make_station()

    def loaded() -> Station:
        load()
        return station

    async with at_work(station, loaded) as (floor, lines):
        reloading = asyncio.ensure_future(floor.reload())
        await asyncio.to_thread(load.reached.wait, 20)
        await floor.scan("1001")
        starting = asyncio.ensure_future(floor.start(None))
        await asyncio.wait([starting], timeout=0.2)
        load.opened.set()
        await reloading
        await starting
        assert floor.desk.slots["a"].at_work
        assert floor.desk.slots["a"].reason is None
        await floor.reload()
        assert len(lines) == 1
        await floor.stop("enough")
        await over(floor)
        assert [line.endswith(": loaded again") for line in lines] == [True, True]


async def test_a_stop_at_the_very_start_ends_its_slot_with_an_outcome_and_no_other(
    make_station: Callable[..., Station],
) -> None:
    async with at_work(make_station()) as (floor, _):
        await floor.put({"a": "1001", "b": "1002"}, {})
        await floor.start(None)
        await asyncio.sleep(0)  # the tray has begun, and its units not yet
        assert await floor.stop_slot("a", "a wrong unit") == {"stopped": ["a"]}
        while floor.desk.slots["a"].at_work:
            await asyncio.sleep(0.01)
        assert floor.desk.slots["a"].reason == "stopped: a wrong unit"
        await floor.stop_slot("b", "enough")
        await over(floor)
        assert {slot.code for slot in floor.desk.slots.values()} <= {"stopped", "absent"}


async def test_a_stop_while_the_start_is_noted_stops_the_tray(make_station: Callable[..., Station]) -> None:
    async with at_work(make_station()) as (floor, _):
        await floor.scan("1001")
        async with floor._saving:  # as a slow database does
            starting = asyncio.ensure_future(floor.start(None))
            while not floor.desk.running:
                await asyncio.sleep(0)
            assert await floor.stop("not yet") == {"stopped": ["a"]}
        await starting
        await over(floor)
        assert floor.desk.slots["a"].reason == "stopped: not yet"


@pytest.mark.parametrize("change", ["name", "folder"])
async def test_a_station_file_of_another_folder_or_name_is_not_taken_without_a_restart(
    make_station: Callable[..., Station], change: str
) -> None:
    station = make_station()
    async with at_work(station, lambda: make_station(**{change: "elsewhere"})) as (floor, lines):
        await floor.reload()
        assert floor.station is station
    assert f"{change} changes with a restart" in lines[0]


async def test_a_scan_while_a_tray_starts_is_refused_and_not_lost(
    make_station: Callable[..., Station], works: Gate
) -> None:
    async with at_work(make_station()) as (floor, _):
        await floor.scan("1001")
        starting = asyncio.ensure_future(floor.start(None))
        await asyncio.to_thread(works.reached.wait, 20)
        for change in (lambda: floor.scan("1002"), floor.clear, lambda: floor.put({"a": "1003"}, {"order": "9"})):
            with pytest.raises(ApiError) as caught:
                await change()
            assert caught.value.problem is Problem.RUNNING
        works.opened.set()
        assert set((await starting)["runs"]) == {"a"}
        assert floor.desk.slots["a"].serial == "1001"


async def test_a_start_that_is_refused_leaves_the_scans(make_station: Callable[..., Station]) -> None:
    async with at_work(make_station("[rules]\noperator = true\n")) as (floor, _):
        await floor.scan("1001")
        with pytest.raises(ApiError):
            await floor.start(None)
        assert (await floor.scan("1002"))["slot"] == "b"


async def test_no_tray_starts_once_the_service_ends(make_station: Callable[..., Station], works: Gate) -> None:
    async with at_work(make_station()) as (floor, _):
        await floor.scan("1001")
        starting = asyncio.ensure_future(floor.start(None))
        await asyncio.to_thread(works.reached.wait, 20)
        ending = asyncio.ensure_future(floor.end())
        await asyncio.sleep(0)
        ending.cancel()  # a second signal
        works.opened.set()
        await asyncio.wait([ending])
        with pytest.raises(ApiError) as caught:
            await starting
        assert caught.value.message == "the service is about to end"
        assert floor._task is None
        assert floor.desk.slots["a"].serial == "1001"


# Who the operator is.


@pytest.mark.parametrize(
    ("work", "badge", "expected"),
    [("", None, "Ada"), ("", "Ben", "Ben"), ('[work]\noperator = "Cyd"\n', None, "Cyd")],
)
async def test_who_has_signed_in_is_the_operator_unless_another_is_named(
    make_station: Callable[..., Station], tmp_path: Path, work: str, badge: str | None, expected: str
) -> None:
    async with at_work(make_station("[plan]\ncomes_back_s = 0.0\n" + work)) as (floor, _):
        if badge:
            await floor.scan(f"OP:{badge}")
        await floor.scan("1001")
        await floor.scan("CMD:START", "Ada")
        await over(floor)
    (path,) = tmp_path.glob("*.outcome.json")
    assert json.loads(path.read_text())["work"]["operator"] == expected


async def test_a_tray_that_cannot_be_signed_does_not_start_and_leaves_the_scans(
    make_station: Callable[..., Station], tmp_path: Path
) -> None:
    async with at_work(make_station()) as (floor, _):
        await floor.scan("1001")
        (tmp_path / "keys").mkdir()
        (tmp_path / "keys" / "line-1.key").write_text("no key")  # since the service began
        with pytest.raises(ApiError) as e:
            await floor.start(None)
        assert e.value.problem is Problem.INVALID
        assert (await floor.scan("1002"))["slot"] == "b"
