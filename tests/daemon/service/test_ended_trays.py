"""What a tray leaves in memory, and where it waits for the disk."""

from __future__ import annotations

import asyncio
import gc
import threading
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest

from triaxcald.files import synchronise
from triaxcald.run import attempts
from triaxcald.run.unit_run import TrayRun
from triaxcald.service.floor import Floor
from triaxcald.service.ledger import Ledger
from triaxcald.service.stream import Stream
from triaxcald.station.config import Station


@pytest.fixture
def no_automatic_garbage_collection() -> Iterator[None]:
    """As between two of its passes, which are far apart in a service."""
    gc.collect()
    gc.disable()
    yield
    gc.enable()


async def absent(station: Station, ledger: Ledger) -> int:
    """Two trays in which nobody answers; how many are in memory afterwards."""
    floor = Floor(station, ledger, partial(Stream, ledger), load=lambda: station, log=print)
    await floor.stream.begin()
    streaming = asyncio.ensure_future(floor.stream.run())
    try:
        await floor.begin()
        for serial in ("1001", "1002"):
            await floor.scan(serial)
            await floor.start(None)
            while floor._task is not None:
                await asyncio.wait([floor._task])
            assert floor.state(0)["slots"][0]["code"] == "absent"
        await asyncio.sleep(0)
        return sum(type(o) is TrayRun for o in gc.get_objects())
    finally:
        await floor.end()
        await floor.stream.drained()
        streaming.cancel()


@pytest.fixture
def kept(make_station: Callable[..., Station]) -> Iterator[Callable[[], int]]:
    station = make_station("[plan]\ncomes_back_s = 0.0\n")
    ledger = Ledger.open(station)
    yield lambda: asyncio.run(absent(station, ledger))
    ledger.close()


@pytest.mark.usefixtures("no_automatic_garbage_collection")
def test_of_a_tray_that_has_ended_nothing_stays_in_memory(kept: Callable[[], int]) -> None:
    assert kept() == 0


def test_the_event_loop_waits_for_no_disk(kept: Callable[[], int], monkeypatch: pytest.MonkeyPatch) -> None:
    on: list[threading.Thread] = []

    def noted(folder: Path) -> None:
        on.append(threading.current_thread())
        synchronise(folder)

    monkeypatch.setattr(attempts, "synchronise", noted)
    kept()
    assert on
    assert threading.main_thread() not in on
