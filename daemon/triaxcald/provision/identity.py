"""Is this the unit that is meant?"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from triaxcal_drivers.interface import Device
from triaxcal_drivers.profile import Bundle
from triaxcald.errors import ProvisionError


class WrongUnit(ProvisionError):
    """Another product or another serial number answers than was expected."""


@dataclass(frozen=True)
class IdentityRead:
    """``serial``: the integer in the serial register as text of at least four
    characters, None where the profile has none.

    ``values``: the raw numbers of the registers that the profile's identity
    expects, by name.
    """

    serial: str | None
    values: Mapping[str, int]


async def check_identity(
    device: Device, bundle: Bundle, expected_serial: str | None, *, where: str | None = None
) -> IdentityRead:
    """Read who answers and compare. ``where`` names the place in messages; by
    default the profile.

    Raises WrongUnit; RegisterRefused, DeviceSilent of the driver.
    """
    profile, where = bundle.profile, where or bundle.profile.name
    values = {}
    for name, expected in profile.identity.expect.items():
        values[name] = await _read_raw_number(device, bundle, name)
        if values[name] != expected:
            raise WrongUnit(
                f"the unit on {where} is no {profile.identity.product}: "
                f"register {name} holds {values[name]:#x}, expected {expected:#x}"
            )
    serial = await read_serial(device, bundle)
    if expected_serial is not None and not same_serial(serial, expected_serial):
        answers = f"is serial {serial}" if serial else "tells no serial (its profile has no serial_register)"
        raise WrongUnit(f"the unit on {where} {answers}, expected {expected_serial}")
    return IdentityRead(serial, values)


async def read_serial(device: Device, bundle: Bundle) -> str | None:
    """The serial number as `IdentityRead` has it. Raises RegisterRefused,
    DeviceSilent; WrongUnit where the register holds no number."""
    name = bundle.profile.identity.serial_register
    return serial_text(await _read_raw_number(device, bundle, name)) if name else None


async def _read_raw_number(device: Device, bundle: Bundle, name: str) -> int:
    raw = await device.read(name)
    number = bundle.profile.raw_number(name, raw)
    if number is None:
        kind = bundle.profile.registers[name].type
        raise WrongUnit(f"register {name} holds {raw.hex()}, which is no {kind} number")
    return number


def serial_text(number: int) -> str:
    """A serial number as every document has it."""
    return f"{number:04d}"


def same_serial(serial: str | None, expected: str) -> bool:
    """Leading zeros do not count, also after a minus sign: the device holds a
    number."""
    return serial is not None and _without_zeros(serial) == _without_zeros(expected)


def _without_zeros(serial: str) -> str:
    return re.sub("^(-?)0+", r"\1", serial.strip())
