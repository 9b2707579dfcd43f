"""Reasons of work that ended early: one line for people, a traceback for developers."""

from __future__ import annotations

import asyncio
import traceback

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald import errors as exit_codes
from triaxcald.errors import (
    DaemonError,
    DeviceInUse,
    DiskError,
    Implausible,
    NoPoses,
    SerialTwice,
    StationError,
    TwoAnswer,
    exit_code_of,
)
from triaxcald.memory import out_of_memory, ran_out_of_memory
from triaxcald.provision.identity import WrongUnit
from triaxcald.schema.codes import Code


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


def code_of(e: BaseException) -> Code | None:
    """Code of an error: that of its first cause with a code of its own. None for bad
    input."""
    if ran_out_of_memory(e):
        return Code.MEMORY
    causes = [e]
    while (cause := causes[-1].__cause__) is not None:
        causes.append(cause)
    for cause in causes:
        for kind, code in _CODES:
            if isinstance(cause, kind):
                return code
    if is_internal(e):
        return Code.INTERNAL
    match exit_code_of(e):
        case exit_codes.REFUSED:
            return Code.REFUSED
        case exit_codes.DEVICE:
            return Code.NOT_SETTLED if isinstance(e, StationError) else Code.LOST
    return None


_CODES: tuple[tuple[type[BaseException], Code], ...] = (
    (asyncio.CancelledError, Code.STOPPED),
    (KeyboardInterrupt, Code.STOPPED),
    (DiskError, Code.DISK),
    (TwoAnswer, Code.TWO_ANSWER),
    (td.SecondAnswer, Code.TWO_ANSWER),
    (WrongUnit, Code.WRONG_UNIT),
    (SerialTwice, Code.SERIAL_TWICE),
    (DeviceInUse, Code.IN_USE),
    (Implausible, Code.IMPLAUSIBLE),
    (NoPoses, Code.NO_POSES),
    (td.DeviceAbsent, Code.ABSENT),
    (td.DeviceSilent, Code.LOST),
    (td.BusError, Code.LOST),
)
"""Error classes with their codes, in the order of the search."""
