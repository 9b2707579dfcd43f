"""Which exit code an error owes, wherever it comes to light."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable

from triaxcal.errors import InvalidData, Refused, TriaxcalError
from triaxcal_drivers.errors import DriverError, DriverMissing, LogError, ProfileError, RegisterValueError
from triaxcald.errors import DaemonError
from triaxcald.memory import ran_out_of_memory

DONE, OUTSIDE, BAD_INPUT, REFUSED, DEVICE, DISK, INTERRUPTED = 0, 1, 2, 3, 4, 5, 130
SEVEREST = (DEVICE, INTERRUPTED, DISK, REFUSED, BAD_INPUT, OUTSIDE, DONE)
"""Of several units the worst counts, in this order."""


def severest(codes: Iterable[int]) -> int:
    found = set(codes)
    return next(code for code in SEVEREST if code in found)


def exit_code_of(e: BaseException) -> int:
    """An error that nobody raises on purpose is a failure of the station; that
    memory ran out is one like a full disk."""
    if ran_out_of_memory(e):
        return DISK
    match e:
        case Refused() | RegisterValueError():
            return REFUSED
        case InvalidData() | ProfileError() | DriverMissing() | LogError():
            return BAD_INPUT
        case DaemonError():
            return e.exit_code
        case TriaxcalError():
            return REFUSED
        case asyncio.CancelledError() | KeyboardInterrupt():
            return INTERRUPTED
        case DriverError() | _:
            return DEVICE
