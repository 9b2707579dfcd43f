"""Is this the unit that is meant?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import triaxcal_drivers as td
from triaxcald.errors import ProvisionError, TwoAnswer
from triaxcald.provision.access import RegisterLink, contact_register
from triaxcald.work import plain_serial


class WrongUnit(ProvisionError):
    """Another product or another serial number answers than was expected."""


class BlankIdentity(WrongUnit):
    """A register of the identity holds zeros, ones, or no number, as one may of
    a unit that is starting."""


@dataclass(frozen=True)
class IdentityRead:
    """``serial``: the text in the serial register, or the integer as text of at
    least four characters; None where the profile has none.

    ``values``: the raw numbers of the registers that the profile's identity
    expects, by name.
    """

    serial: str | None
    values: Mapping[str, int]


async def check_identity(
    device: td.Device, bundle: td.Bundle, expected_serial: str | None, *, where: str | None = None
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
            raise _wrong(profile, name, values[name])(
                f"the unit on {where} is no {profile.identity.product}: "
                f"register {name} holds {values[name]:#x}, expected {expected:#x}"
            )
    register = profile.identity.serial_register
    raw = await device.read(register) if register else b""
    serial = _serial_of(profile, register, raw) if register else None
    if expected_serial is not None and not same_serial(serial, expected_serial):
        if isinstance(device, RegisterLink) and device.tolerant and await _also(device, bundle, expected_serial):
            return IdentityRead(expected_serial, values)
        answers = f"is serial {serial}" if serial else "tells no serial (its profile has no serial_register)"
        kind = WrongUnit if register is None else _wrong_serial(profile, register, raw)
        raise kind(f"the unit on {where} {answers}, expected {expected_serial}")
    return IdentityRead(serial, values)


async def identified(
    link: RegisterLink, bundle: td.Bundle, expected_serial: str | None, *, where: str, device: td.Device | None = None
) -> IdentityRead:
    """`check_identity` of the ``device`` (default: the link), and a check that no
    other unit answers at the address. Raises TwoAnswer too."""
    try:
        identity = await check_identity(device or link, bundle, expected_serial, where=where)
    except WrongUnit:
        with suppress(td.DriverError):  # the answer may be that of a second unit
            await require_alone(link, bundle)
        raise
    await require_alone(link, bundle)
    return identity


def _wrong_serial(profile: td.Profile, name: str, raw: bytes) -> type[WrongUnit]:
    return _wrong(profile, name, profile.raw_number(name, raw)) if _is_number(profile, name) else WrongUnit


def _wrong(profile: td.Profile, name: str, number: int | None) -> type[WrongUnit]:
    """Diagnosis of an unexpected number in a register of the identity."""
    ones = 256 ** td.registers.TYPES[profile.registers[name].type].size - 1
    return BlankIdentity if number in (0, -1, ones) else WrongUnit


async def _also(link: RegisterLink, bundle: td.Bundle, serial: str) -> bool:
    """Whether the unit of that serial number answers behind another one."""
    name = bundle.profile.identity.serial_register
    late = [e.answer for e in await link.listen(LISTEN_S) if e.register == name]
    return name is not None and any(same_serial(serial_in(bundle.profile, name, raw), serial) for raw in late)


ABORT_BYTES = 8
"""Length of a CANopen abort."""
LISTEN_S = 0.2
"""By the host's clock: longer than the answer of a slow node, and short compared with
the time in which an operator mounts a unit."""
ASKED = 3
"""Requests that must all be answered twice before two units are reported. A line that
doubles one answer in twenty does so by chance once in ten thousand times."""


async def require_alone(link: RegisterLink, bundle: td.Bundle) -> None:
    """Ask the unit for its serial number, and listen whether another unit
    answers too.

    Raises TwoAnswer if two serial numbers come, or if each of `ASKED` requests
    is answered twice; RegisterRefused, DeviceSilent. A device whose driver
    cannot tell passes.
    """
    profile = bundle.profile
    readable = (name for name, register in profile.registers.items() if register.access != "wo")
    name = contact_register(profile) or next(readable, None)
    if name is None:
        return
    for _ in range(ASKED):
        link.doubled = 0
        answers, found = await _answers(link, name)
        if found:
            link.two_answered = True
            with suppress(td.DriverError, TwoAnswer):  # late answers to earlier requests have come by now
                answers, _ = await _answers(link, name)
            raise TwoAnswer(f"two units answer at {link.name}: {_who(bundle, name, answers)}")
        if not link.doubled:
            return
    link.two_answered = True
    raise TwoAnswer(f"two units answer at {link.name}: each request was answered twice, byte for byte")


async def _answers(link: RegisterLink, name: str) -> tuple[list[bytes], list[td.two_senders.ExtraAnswer]]:
    """Value of a register, and the contradicting answers."""
    answers = [await link.read(name)]
    most = max(td.registers.size_of(link.profile.registers[name]), ABORT_BYTES)
    # Another program may ask the unit for something else, and a stream may be
    # polled meanwhile, whose replies are longer than a register.
    extra = await link.listen(LISTEN_S)
    found = [e for e in extra if e.register == name and e.first is not None and len(e.answer) <= most]
    return answers + [e.answer for e in found], found


def _who(bundle: td.Bundle, name: str, answers: Sequence[bytes]) -> str:
    """The serial numbers, as far as they are any."""
    if name != bundle.profile.identity.serial_register:
        return ", ".join(f"register {name} holds {raw.hex()}" for raw in dict.fromkeys(answers))
    serials = [serial_in(bundle.profile, name, raw) for raw in answers]
    told = dict.fromkeys(serial for serial in serials if serial is not None)
    return ", ".join(told) if len(told) > 1 else ", ".join([*told, "and one that answers otherwise"])


async def read_serial(device: td.Device, bundle: td.Bundle) -> str | None:
    """The serial number as `IdentityRead` has it. Raises RegisterRefused,
    DeviceSilent; BlankIdentity where the register holds no number, or no text."""
    name = bundle.profile.identity.serial_register
    return _serial_of(bundle.profile, name, await device.read(name)) if name else None


def serial_in(profile: td.Profile, name: str, raw: bytes) -> str | None:
    """The serial number in the bytes of register ``name``; None where they are
    none."""
    try:
        return _serial_of(profile, name, raw)
    except (BlankIdentity, td.RegisterValueError):
        return None


def _is_number(profile: td.Profile, name: str) -> bool:
    return str(profile.registers[name].type) != td.registers.ASCII


def _serial_of(profile: td.Profile, name: str, raw: bytes) -> str:
    """Raises BlankIdentity; RegisterValueError on a wrong length of a number."""
    if _is_number(profile, name):
        return serial_text(_number_in(profile, name, raw))
    try:
        serial = profile.text(name, raw)
    except td.RegisterValueError as e:
        raise BlankIdentity(str(e)) from e
    if not serial:
        raise BlankIdentity(f"register {name} holds {raw.hex()}, which is no serial number")
    return serial


async def _read_raw_number(device: td.Device, bundle: td.Bundle, name: str) -> int:
    return _number_in(bundle.profile, name, await device.read(name))


def _number_in(profile: td.Profile, name: str, raw: bytes) -> int:
    number = profile.raw_number(name, raw)
    if number is None:
        kind = profile.registers[name].type
        raise BlankIdentity(f"register {name} holds {raw.hex()}, which is no {kind} number")
    return number


def serial_text(number: int) -> str:
    """A serial number as every document has it."""
    return f"{number:04d}"


def same_serial(serial: str | None, expected: str) -> bool:
    """Leading zeros do not count, also after a minus sign: the device holds a
    number."""
    return serial is not None and plain_serial(serial) == plain_serial(expected)
