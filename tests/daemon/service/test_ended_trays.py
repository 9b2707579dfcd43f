"""What the floor keeps of a tray that has ended."""

from __future__ import annotations

import asyncio
import gc
from collections.abc import Callable, Iterator
from functools import partial

import pytest

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


@pytest.mark.usefixtures("no_automatic_garbage_collection")
def test_of_a_tray_that_has_ended_nothing_stays_in_memory(make_station: Callable[..., Station]) -> None:
    async def trays(station: Station, ledger: Ledger) -> int:
        floor = Floor(station, ledger, partial(Stream, ledger), load=lambda: station, log=print)
        await floor.stream.begin()
        streaming = asyncio.ensure_future(floor.stream.run())
        try:
            await floor.begin()
            for serial in ("1001", "1002", "1003", "1004"):
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

    station = make_station("[plan]\ncomes_back_s = 0.0\n")
    ledger = Ledger.open(station)
    try:
        # The last one may be held by what still enters it into the database.
        assert asyncio.run(trays(station, ledger)) <= 1
    finally:
        ledger.close()
