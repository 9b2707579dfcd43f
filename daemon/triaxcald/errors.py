"""The daemon's errors. Each knows the exit code that the command line owes it."""

from __future__ import annotations

from typing import ClassVar


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


class StationError(DaemonError):
    """The station or a device on it failed while at work."""

    exit_code = 4


class TwoAnswer(StationError):
    """Two units answer, or send, where there is to be one; the message says
    where."""


class DeviceInUse(StationError):
    """Another command works with the device, or with the serial port that it is
    on; the message says which."""


class DeviceInUseElsewhere(DeviceInUse):
    """The command is another process, which comes to its end."""


class ProvisionError(StationError):
    """Writing to the device failed."""


class Implausible(DaemonError):
    """What the device holds is no calibration under its profile; nothing was
    written."""

    exit_code = 3
