"""Opening and closing a CAN bus, both of which block."""

from __future__ import annotations

import asyncio
import threading
from typing import Any

import can

from triaxcal_drivers.can.model import CanBus
from triaxcal_drivers.errors import BusError


def open_bus(settings: CanBus) -> can.BusABC:
    """Blocking. Raises BusError."""
    options: dict[str, Any] = dict(settings.options)
    if settings.bitrate is not None:
        options["bitrate"] = settings.bitrate
    try:
        return can.Bus(settings.channel, settings.interface, ignore_config=True, **options)
    except (can.CanError, OSError, ValueError, TypeError, ImportError, NotImplementedError) as e:
        reason = " ".join(str(e).split()) or type(e).__name__
        raise BusError(f"cannot open {settings.interface} {settings.channel}: {reason}") from e


async def opened_bus(settings: CanBus) -> can.BusABC:
    """In a thread, which shuts the bus down again where nobody waits for it any
    more. Raises BusError."""
    given_up = threading.Event()

    def open_unless_given_up() -> can.BusABC:
        bus = open_bus(settings)
        if given_up.is_set():
            bus.shutdown()
        return bus

    try:
        return await asyncio.to_thread(open_unless_given_up)
    except asyncio.CancelledError:
        given_up.set()
        raise


async def close_bus(bus: can.BusABC, notifier: can.Notifier) -> None:
    """In a thread, which does both also where nobody waits for it any more."""

    def close() -> None:
        notifier.stop()
        bus.shutdown()

    await asyncio.to_thread(close)
