"""Restarts a device so that the restart shows."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass

from triaxcal_drivers.errors import RegisterRefused
from triaxcal_drivers.profile import Bundle, Profile, WriteStep
from triaxcald.errors import ProvisionError, StationError
from triaxcald.provision.access import NO_CONTACT, RegisterLink
from triaxcald.provision.identity import WrongUnit, check_identity
from triaxcald.provision.sequence import lock_quietly, reconnect, run_sequence

ATTEMPTS = 2
"""The request of a restart is lost at times, and is not repeated by itself."""


@dataclass(frozen=True)
class _Mark:
    """A register that ``held`` a value and is to hold another one, ``put``.
    ``taken``: whether it does; None where nobody answered."""

    name: str
    held: bytes
    put: bytes
    taken: bool | None


async def proven_restart(link: RegisterLink, bundle: Bundle, serial: str | None, *known: Mapping[str, bytes]) -> bool:
    """Restart the unit of that serial number; whether it shows that it did.

    An acknowledgement does not show it: the command may go to a wrong register,
    be ignored by a device that is locked, or be carried out later. So before it
    a register in use is given a value that is stored nowhere, off by one bit
    from the one that it holds: only a restart takes it away. The value is put
    back where the restart did not.

    ``known`` are the values by register of which one is stored. Where writes
    last without a store, or the device refuses the value, its acknowledgement
    has to do; where nobody answers to the value, nothing is shown. Raises
    ProvisionError where the register does not take its value again; WrongUnit;
    RegisterRefused, other DriverError, SequenceStalled of the restart.
    """
    mark = await _marked(link, bundle, serial, known)
    if mark is None:
        return await run_sequence(link, bundle, "reset")
    for _ in range(ATTEMPTS):
        try:
            acknowledged = await run_sequence(link, bundle, "reset")
        except RegisterRefused:
            if mark.taken is not False:
                await _put_back(link, bundle, serial, mark)
            raise
        if mark.taken is False:
            return acknowledged
        if await _read_again(link, bundle.profile, mark.name) != mark.put:
            return bool(mark.taken)
    await _put_back(link, bundle, serial, mark)
    return False


async def _marked(
    link: RegisterLink, bundle: Bundle, serial: str | None, known: Collection[Mapping[str, bytes]]
) -> _Mark | None:
    """None where no register may have another value."""
    profile = bundle.profile
    if not profile.sequences.store or not any(isinstance(step, WriteStep) for step in profile.sequences.reset):
        return None
    checksum = profile.crc.register_name if profile.crc else None
    names = dict.fromkeys(name for registers in known for name in registers if name != checksum)
    # Better one that was written anyhow.
    for name in sorted(names, key=lambda name: len({registers.get(name) for registers in known}) == 1):
        held = await link.read(name)
        for put in _beside(profile, name, held):
            if put not in [registers.get(name) for registers in known]:
                return _Mark(name, held, put, await _put(link, bundle, serial, name, put))
    return None


def _beside(profile: Profile, name: str, raw: bytes) -> list[bytes]:
    """Values within the register's limits that differ from ``raw`` by one bit,
    the nearest first: that of the last byte, or of the first where the least
    significant one comes first."""
    register, value = profile.registers[name], profile.decode(name, raw)
    low = -math.inf if register.minimum is None else register.minimum
    high = math.inf if register.maximum is None else register.maximum
    near = [bytes([*raw[:-1], raw[-1] ^ bit]) for bit in (1, 2)] + [bytes([raw[0] ^ bit, *raw[1:]]) for bit in (1, 2)]
    allowed = [other for other in near if low <= profile.decode(name, other) <= high]
    found = {abs(profile.decode(name, other) - value): other for other in allowed}
    return [found[off] for off in sorted(off for off in found if off > 0)]


async def _put(link: RegisterLink, bundle: Bundle, serial: str | None, name: str, raw: bytes) -> bool | None:
    """Whether the device took it; None where nobody answered. Raises
    WrongUnit."""
    try:
        await run_sequence(link, bundle, "unlock")
        await check_identity(link, bundle, serial)  # right before the one write that could reach another unit
        await link.write(name, raw)
        taken: bool | None = await link.read(name) == raw
    except WrongUnit:
        raise
    except NO_CONTACT:
        link.refresh()
        taken = None
    except (RegisterRefused, StationError):
        taken = False
    await lock_quietly(link, bundle)
    return taken


async def _put_back(link: RegisterLink, bundle: Bundle, serial: str | None, mark: _Mark) -> None:
    if not await _put(link, bundle, serial, mark.name, mark.held):
        raise ProvisionError(f"register {mark.name} does not take its value again")


async def _read_again(link: RegisterLink, profile: Profile, name: str) -> bytes:
    """A device that has just started may need a new connection."""
    try:
        return await link.read(name)
    except NO_CONTACT:
        link.refresh()
        await reconnect(link, profile)
        return await link.read(name)
