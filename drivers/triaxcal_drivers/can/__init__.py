"""CAN: frames, profiles, adapters and the driver of devices on a bus."""

from __future__ import annotations

from typing import TYPE_CHECKING

from triaxcal_drivers.lazy import lazily

if TYPE_CHECKING:
    from triaxcal_drivers.can.eds import object_dictionary
    from triaxcal_drivers.can.layout import NODES, Layout, stream_layout
    from triaxcal_drivers.can.line import BusListener, opened
    from triaxcal_drivers.can.message import Message
    from triaxcal_drivers.can.model import BusSettings, CanBus, CanProfile, object_address
    from triaxcal_drivers.can.python_can import open_python_can

_NAMES = {
    "eds": ("object_dictionary",),
    "layout": (
        "Layout",
        "NODES",
        "stream_layout",
    ),
    "line": (
        "BusListener",
        "opened",
    ),
    "message": ("Message",),
    "model": (
        "BusSettings",
        "CanBus",
        "CanProfile",
        "object_address",
    ),
    "python_can": ("open_python_can",),
}

__all__ = [
    "NODES",
    "BusListener",
    "BusSettings",
    "CanBus",
    "CanProfile",
    "Layout",
    "Message",
    "object_address",
    "object_dictionary",
    "open_python_can",
    "opened",
    "stream_layout",
]

if not TYPE_CHECKING:  # a checker would take any name for one that is here
    __getattr__ = lazily(__name__, _NAMES)
