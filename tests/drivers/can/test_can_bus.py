"""Opening a bus in a thread, and giving it up meanwhile."""

from __future__ import annotations

import asyncio
import threading

import pytest

from triaxcal_drivers.can.line import opened


async def test_a_bus_that_was_given_up_while_it_opened_is_closed() -> None:
    asked, answered, closed = threading.Event(), threading.Event(), threading.Event()

    def slow() -> str:
        asked.set()
        answered.wait(10)
        return "a bus"

    def close(bus: str) -> None:
        assert bus == "a bus"
        closed.set()

    opening = asyncio.create_task(opened(slow, close))
    await asyncio.to_thread(asked.wait, 10)
    opening.cancel()
    with pytest.raises(asyncio.CancelledError):
        await opening
    answered.set()
    assert await asyncio.to_thread(closed.wait, 10)


async def test_a_bus_that_is_waited_for_stays_open() -> None:
    closed = threading.Event()
    assert await opened(lambda: "a bus", lambda _: closed.set()) == "a bus"
    assert not closed.is_set()
