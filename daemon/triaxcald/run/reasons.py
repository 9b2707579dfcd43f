"""Why work ended before its time: in one line, and where in this program."""

from __future__ import annotations

import asyncio
import traceback

from triaxcal.errors import TriaxcalError
from triaxcal_drivers.errors import DriverError
from triaxcald.errors import DaemonError


def reason_of(e: BaseException) -> str:
    """Of an end before its time, in one line."""
    if isinstance(e, asyncio.CancelledError):
        return "interrupted"
    return f"internal error: {e!r}" if _internal(e) else str(e) or type(e).__name__


def trace_of(e: BaseException) -> str | None:
    """Where an internal error came from, for who mends it; None of any other."""
    return "".join(traceback.format_exception(e)) if _internal(e) else None


def _internal(e: BaseException) -> bool:
    return not isinstance(e, (TriaxcalError, DriverError, DaemonError, asyncio.CancelledError))
