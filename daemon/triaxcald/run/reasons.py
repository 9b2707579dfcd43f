"""Reasons of work that ended early: one line for people, a traceback for developers."""

from __future__ import annotations

import asyncio
import traceback

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald.errors import DaemonError
from triaxcald.memory import out_of_memory, ran_out_of_memory


def reason_of(e: BaseException) -> str:
    """Reason of an early end, in one line."""
    if isinstance(e, asyncio.CancelledError):
        return "interrupted"
    if is_internal(e) and ran_out_of_memory(e):
        return out_of_memory(e)
    return f"internal error: {e!r}" if is_internal(e) else str(e) or type(e).__name__


def trace_of(e: BaseException) -> str | None:
    """Traceback of an internal error; None of any other error."""
    internal = is_internal(e) and not ran_out_of_memory(e)
    return "".join(traceback.format_exception(e)) if internal else None


def is_internal(e: BaseException) -> bool:
    """Whether the error is none of the packages' own: a defect of this program."""
    return not isinstance(e, (tc.TriaxcalError, td.DriverError, DaemonError, asyncio.CancelledError))
