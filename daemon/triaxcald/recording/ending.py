"""Why a recording came to its end, as its last event says it."""

from __future__ import annotations

import asyncio
from typing import Literal

from triaxcal_drivers.errors import DriverError
from triaxcald.errors import DiskError, ProvisionError, TwoAnswer

ENDED = "ended"
EndedBecause = Literal["asked", "signal", "disk", "unit gave up", "bus gave up", "failed"]
Kind = Literal["unit", "bus"]


def ended_because(error: BaseException | None, of: Kind = "unit") -> EndedBecause:
    """``error`` is what the recording was left with, None where it was to end;
    ``of`` what was recorded."""
    match error:
        case None:
            return "asked"
        case DiskError():
            return "disk"
        case asyncio.CancelledError() | KeyboardInterrupt():
            return "signal"
        case DriverError() | ProvisionError() | TwoAnswer():
            return "unit gave up" if of == "unit" else "bus gave up"
        case _:
            return "failed"
