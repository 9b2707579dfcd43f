"""Opening a CAN bus, which blocks."""

from __future__ import annotations

import asyncio
import sys
import threading
from collections.abc import Callable
from importlib.util import find_spec
from typing import TypeVar

from triaxcal_drivers.can.adapter import Adapter
from triaxcal_drivers.can.model import BusSettings

T = TypeVar("T")


def open_bus(settings: BusSettings) -> Adapter:
    """Blocking; SocketCAN and multicast by sockets of our own, all else by
    python-can.
    Raises BusError."""
    if settings.interface == "socketcan" and sys.platform == "linux":
        from triaxcal_drivers.can.socketcan import open_socketcan  # what it imports is Linux' own

        return open_socketcan(str(settings.channel), settings.options, settings.bitrate)
    if settings.interface == "udp_multicast" and sys.platform == "linux" and find_spec("msgpack"):
        from triaxcal_drivers.can.udp_multicast import OPTIONS, UdpMulticast

        if OPTIONS.issuperset(settings.options):
            return UdpMulticast(settings)
    from triaxcal_drivers.can.python_can import PythonCan  # python-can takes a tenth of a second to load

    return PythonCan(settings)


async def opened(opening: Callable[[], T], closing: Callable[[T], object]) -> T:
    """What ``opening`` gives, called in a thread, which closes it again where
    nobody waits for it any more. Raises what ``opening`` does."""
    given_up = threading.Event()

    def open_unless_given_up() -> T:
        made = opening()
        if given_up.is_set():
            closing(made)
        return made

    try:
        return await asyncio.to_thread(open_unless_given_up)
    except asyncio.CancelledError:
        given_up.set()
        raise
