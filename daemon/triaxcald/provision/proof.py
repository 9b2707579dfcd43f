"""Restarts a device so that the restart shows."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping

from triaxcal_drivers.errors import RegisterRefused
from triaxcal_drivers.profile import Bundle, Profile
from triaxcald.errors import ProvisionError, StationError
from triaxcald.provision.access import NO_CONTACT, RegisterLink
from triaxcald.provision.sequence import lock_quietly, reconnect, run_sequence

ATTEMPTS = 2
"""The request of a restart is lost at times, and is not repeated by itself."""


async def proven_restart(link: RegisterLink, bundle: Bundle, *known: Mapping[str, bytes]) -> bool:
    """Restart; whether it shows that the device did.

    An acknowledgement does not show it: the command may go to a wrong register,
    be ignored by a device that is locked, or be carried out later. So before it
    a register in use is given a value that is stored nowhere, off by its last
    bit from the one that it holds: only a restart takes it away. The value is
    put back where the restart did not.

    ``known`` are the values by register of which one is stored. Where writes
    last without a store, or the device refuses the value, its acknowledgement
    has to do. Raises ProvisionError where the register does not take its value
    again; RegisterRefused, other DriverError, SequenceStalled of the restart.
    """
    mark = await _marked(link, bundle, known)
    if mark is None:
        return await run_sequence(link, bundle, "reset")
    name, held, put = mark
    for _ in range(ATTEMPTS):
        try:
            await run_sequence(link, bundle, "reset")
        except RegisterRefused:
            await _put_back(link, bundle, name, held)
            raise
        if await _read_again(link, bundle.profile, name) != put:
            return True
    await _put_back(link, bundle, name, held)
    return False


async def _marked(
    link: RegisterLink, bundle: Bundle, known: Collection[Mapping[str, bytes]]
) -> tuple[str, bytes, bytes] | None:
    """The register, what it held and what it holds now; None where none has
    another value."""
    profile = bundle.profile
    if not profile.sequences.store:
        return None
    checksum = profile.crc.register_name if profile.crc else None
    names = dict.fromkeys(name for registers in known for name in registers if name != checksum)
    # Better one that was written anyhow.
    for name in sorted(names, key=lambda name: len({registers.get(name) for registers in known}) == 1):
        held = await link.read(name)
        for put in _beside(profile, name, held):
            if put not in [registers.get(name) for registers in known]:
                return (name, held, put) if await _put(link, bundle, name, put) else None
    return None


def _beside(profile: Profile, name: str, raw: bytes) -> list[bytes]:
    """Values within the register's limits that differ from ``raw`` by one bit,
    the nearest first: that of the last byte, or of the first where the least
    significant one comes first."""
    register, value = profile.registers[name], profile.decode(name, raw)
    low = -math.inf if register.minimum is None else register.minimum
    high = math.inf if register.maximum is None else register.maximum
    near = [bytes([*raw[:-1], raw[-1] ^ bit]) for bit in (1, 2)] + [bytes([raw[0] ^ bit, *raw[1:]]) for bit in (1, 2)]
    found = {
        abs(profile.decode(name, other) - value): other for other in near if low <= profile.decode(name, other) <= high
    }
    return [found[off] for off in sorted(off for off in found if off > 0)]


async def _put(link: RegisterLink, bundle: Bundle, name: str, raw: bytes) -> bool:
    """Whether the device took it."""
    try:
        await run_sequence(link, bundle, "unlock")
        await link.write(name, raw)
        taken = await link.read(name) == raw
    except (RegisterRefused, StationError):
        taken = False
    await lock_quietly(link, bundle)
    return taken


async def _put_back(link: RegisterLink, bundle: Bundle, name: str, held: bytes) -> None:
    if not await _put(link, bundle, name, held):
        raise ProvisionError(f"register {name} does not take its value again")


async def _read_again(link: RegisterLink, profile: Profile, name: str) -> bytes:
    """A device that has just started may need a new connection."""
    try:
        return await link.read(name)
    except NO_CONTACT:
        link.refresh()
        await reconnect(link, profile)
        return await link.read(name)
