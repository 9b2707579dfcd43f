"""A time since the epoch as text in UTC."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from typing import Literal


def iso_time(time_ns: int, timespec: Literal["seconds", "milliseconds"] = "milliseconds") -> str:
    """The time in ISO 8601, as documents have it."""
    return datetime.fromtimestamp(time_ns / 1e9, UTC).isoformat(timespec=timespec)


def file_stamp(time_ns: int) -> str:
    """The time in whole seconds, for the name of a file."""
    return time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(time_ns // 1_000_000_000))
