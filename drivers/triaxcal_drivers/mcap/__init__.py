"""Messages of other people's MCAP files: what ROS 2 recorded, JSON and
protobuf."""

from __future__ import annotations

from typing import TYPE_CHECKING

from triaxcal_drivers.lazy import lazily

if TYPE_CHECKING:
    from triaxcal_drivers.mcap.container import Channel, LoggedMessage, McapFile
    from triaxcal_drivers.mcap.driver import McapProfile, MessageSchema, schema_file, stream_reader

_NAMES = {
    "container": (
        "Channel",
        "LoggedMessage",
        "McapFile",
    ),
    "driver": (
        "McapProfile",
        "MessageSchema",
        "schema_file",
        "stream_reader",
    ),
}

__all__ = [
    "Channel",
    "LoggedMessage",
    "McapFile",
    "McapProfile",
    "MessageSchema",
    "schema_file",
    "stream_reader",
]

if not TYPE_CHECKING:  # a checker would take any name for one that is here
    __getattr__ = lazily(__name__, _NAMES)
