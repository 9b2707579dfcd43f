"""Errors of the profile, the bus and the device.

The leaf class names the party at fault; the message is one line with the fault, its
place and the expected value.
"""


class DriverError(Exception):
    """Root of everything this package raises on purpose."""


class ProfileError(DriverError):
    """The profile, or a file it names (DBC, EDS), is wrong."""


class AddressError(ProfileError):
    """The settings of a unit's bus lack its address, or have one that its profile has
    no use for."""


class DriverMissing(DriverError):
    """No driver of that name is installed, or it cannot be imported."""


class BusError(DriverError):
    """The bus cannot be opened or has failed."""


class DeviceAbsent(DriverError):
    """Nothing answers at the device's address."""


class DeviceSilent(DriverError):
    """The device answered before and does not any more, or its stream has
    stopped.

    ``stream`` is the one that has been silent for ``silent_s`` while another
    goes on, and ``source`` that of its records; None where nothing comes.
    """

    def __init__(
        self, message: str, *, stream: str | None = None, source: int | None = None, silent_s: float = 0.0
    ) -> None:
        super().__init__(message)
        self.stream = stream
        self.source = source
        self.silent_s = silent_s


class SecondAnswer(DriverError):
    """Two units answer at one address."""


class DeviceRestarted(DeviceSilent):
    """The device has started anew, and is to be opened again."""


class RegisterRefused(DriverError):
    """The device refused to read or write a register.

    ``register`` is the profile's name of it, ``code`` the device's own code
    (SDO abort, Modbus exception).
    """

    def __init__(self, message: str, *, register: str, code: int) -> None:
        super().__init__(message)
        self.register = register
        self.code = code


class DeviceBusy(RegisterRefused):
    """The device refuses for now: it is at work, and the same request may be
    taken later."""


class RegisterValueError(DriverError):
    """A value does not fit the register's type or limits; nothing was sent."""


class LogError(DriverError):
    """A log that others recorded cannot be read."""
