"""Why work ended before its time: in one line, and where in this program."""

from __future__ import annotations

import asyncio
import traceback

import triaxcal as tc
from triaxcal_drivers.errors import DriverError
from triaxcald.errors import DaemonError
from triaxcald.memory import out_of_memory, ran_out_of_memory


def reason_of(e: BaseException) -> str:
    """Of an end before its time, in one line."""
    if isinstance(e, asyncio.CancelledError):
        return "interrupted"
    if is_internal(e) and ran_out_of_memory(e):
        return out_of_memory(e)
    return f"internal error: {e!r}" if is_internal(e) else str(e) or type(e).__name__


def trace_of(e: BaseException) -> str | None:
    """Where an internal error came from, for who mends it; None of any other."""
    internal = is_internal(e) and not ran_out_of_memory(e)
    return "".join(traceback.format_exception(e)) if internal else None


def is_internal(e: BaseException) -> bool:
    """Whether nobody raises such an error on purpose."""
    return not isinstance(e, (tc.TriaxcalError, DriverError, DaemonError, asyncio.CancelledError))
