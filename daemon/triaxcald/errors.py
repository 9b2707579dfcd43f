"""The daemon's errors. Each knows the exit code that the command line owes it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import ClassVar

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald.memory import ran_out_of_memory


class DaemonError(Exception):
    """Root of what this package raises on purpose; the message is one line."""

    exit_code: ClassVar[int] = 2


class InputError(DaemonError):
    """A file or an option given by the user is wrong: file, line, field, what
    was expected."""

    exit_code = 2


class RecordingError(InputError):
    """A recording cannot be read or does not hold what is asked of it."""


class DiskError(RecordingError):
    """The disk failed at work; what was recorded is sound up to the time
    stated."""

    exit_code = 5


class NotSigned(DiskError):
    """A recording could not be signed, and so was not closed; the next start closes
    it."""


class StationError(DaemonError):
    """The station or a device on it failed while at work."""

    exit_code = 4


class DeviceInUse(StationError):
    """Another command works with the device, or with the serial port that it is
    on; the message says which."""


class DeviceInUseElsewhere(DeviceInUse):
    """The command is another process, which comes to its end."""


class TwoAnswer(StationError):
    """Two units answer at one address."""


class SerialTwice(StationError):
    """Two places of a station report one serial number."""


class ProvisionError(StationError):
    """Writing to the device failed."""


class NoPoses(tc.Refused):
    """No new still pose came within `plan.patience_s`."""


class Implausible(DaemonError):
    """What the device holds is no calibration under its profile; nothing was
    written."""

    exit_code = 3


# Which exit code an error owes, wherever it comes to light.

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
    import asyncio  # 30 ms, which the start of a command does without

    match e:
        case tc.Refused() | td.RegisterValueError():
            return REFUSED
        case tc.InvalidData() | td.ProfileError() | td.DriverMissing() | td.LogError():
            return BAD_INPUT
        case DaemonError():
            return e.exit_code
        case tc.TriaxcalError():
            return REFUSED
        case asyncio.CancelledError() | KeyboardInterrupt():
            return INTERRUPTED
        case td.DriverError() | _:
            return DEVICE
