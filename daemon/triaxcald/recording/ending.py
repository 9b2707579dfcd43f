"""Why a recording came to its end, as its last event says it."""

from __future__ import annotations

import asyncio
from typing import Literal

from triaxcal_drivers.errors import DriverError
from triaxcald.errors import DiskError, ProvisionError

ENDED = "ended"
EndedBecause = Literal["asked", "signal", "disk", "unit gave up", "failed"]


def ended_because(error: BaseException | None) -> EndedBecause:
    """``error`` is what the recording was left with, None where it was to end."""
    match error:
        case None:
            return "asked"
        case DiskError():
            return "disk"
        case asyncio.CancelledError() | KeyboardInterrupt():
            return "signal"
        case DriverError() | ProvisionError():
            return "unit gave up"
        case _:
            return "failed"
