"""Opening a bus in a thread, and giving it up meanwhile."""

from __future__ import annotations

import asyncio
import threading

import can
import pytest
from can.interfaces.virtual import VirtualBus

from triaxcal_drivers.can import bus as can_bus
from triaxcal_drivers.can.bus import opened_bus
from triaxcal_drivers.can.model import CanBus


async def test_a_bus_that_was_given_up_while_it_opened_is_shut_down(monkeypatch: pytest.MonkeyPatch) -> None:
    asked, answered, shut = threading.Event(), threading.Event(), threading.Event()

    class Slow(VirtualBus):
        def shutdown(self) -> None:
            super().shutdown()
            shut.set()

    def slow(_: CanBus) -> can.BusABC:
        asked.set()
        answered.wait(10)
        return Slow("given-up")

    monkeypatch.setattr(can_bus, "open_bus", slow)
    opening = asyncio.create_task(opened_bus(CanBus(interface="virtual", channel="given-up", node_id=5)))
    await asyncio.to_thread(asked.wait, 10)
    opening.cancel()
    with pytest.raises(asyncio.CancelledError):
        await opening
    answered.set()
    assert await asyncio.to_thread(shut.wait, 10)
