"""Restarts a device so that the restart shows."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice

from triaxcal_drivers.errors import DriverError, RegisterRefused
from triaxcal_drivers.profile import Bundle, Profile, WriteStep
from triaxcald.errors import ProvisionError, StationError
from triaxcald.provision.access import NO_CONTACT, RegisterLink
from triaxcald.provision.identity import WrongUnit, check_identity
from triaxcald.provision.sequence import Label, lock_quietly, reconnect, run_sequence

ATTEMPTS = 2
"""The request of a restart is lost at times, and is not repeated by itself."""
SEQUENCES: tuple[Label, ...] = ("unlock", "store", "lock", "reset")
TRIED = 3
"""Values that a device is offered; one may lie beyond limits that its profile
does not tell."""


@dataclass(frozen=True)
class _Mark:
    """A register that ``held`` a value and is to hold another one, ``put``.
    ``taken``: whether it is known to."""

    name: str
    held: bytes
    put: bytes
    taken: bool


async def proven_restart(link: RegisterLink, bundle: Bundle, serial: str | None, *known: Mapping[str, bytes]) -> bool:
    """Restart the unit of that serial number; whether it shows that it did.

    An acknowledgement does not show it: the command may go to a wrong register,
    be ignored by a device that is locked, or be carried out later. So before it
    a register in use is given a value that is stored nowhere, off by one bit
    from the one that it holds: only a restart takes it away. The value is put
    back where the restart did not, or failed.

    ``known`` are the values by register of which one is stored. Where writes
    last without a store, or the device refuses such values, its acknowledgement
    has to do; where the value is not known to be in use, nothing is shown.
    Raises ProvisionError where the register does not take its value again;
    WrongUnit; RegisterRefused, other DriverError, SequenceStalled of the
    restart.
    """
    touched = set(link.touched)
    mark = await _marked(link, bundle, serial, known)
    if mark is None:
        return await run_sequence(link, bundle, "reset")
    try:
        gone = await _taken_away(link, bundle, mark)
    except BaseException as e:
        try:
            await _put_back(link, bundle, serial, mark)
        except (DriverError, StationError):
            if isinstance(e, RegisterRefused):  # it answers, and keeps a value that nobody wants
                raise
        raise
    if not gone:
        await _put_back(link, bundle, serial, mark)
    if mark.name not in touched:  # it holds what it would without the proof
        link.touched.discard(mark.name)
    return gone and mark.taken


async def _taken_away(link: RegisterLink, bundle: Bundle, mark: _Mark) -> bool:
    for _ in range(ATTEMPTS):
        await run_sequence(link, bundle, "reset")
        if await _read_again(link, bundle.profile, mark.name) != mark.put:
            return True
    return False


async def _marked(
    link: RegisterLink, bundle: Bundle, serial: str | None, known: Collection[Mapping[str, bytes]]
) -> _Mark | None:
    """None where no register may have another value, or the device refuses
    each."""
    if not may_mark(bundle.profile):
        return None
    for name in islice(_names(bundle.profile, known), TRIED):
        held = await link.read(name)
        taken = [registers.get(name) for registers in known]
        put = next((other for other in beside(bundle.profile, name, held) if other not in taken), None)
        if put is not None:
            with suppress(RegisterRefused):
                return _Mark(name, held, put, await _put(link, bundle, serial, name, put))
    return None


def _names(profile: Profile, known: Collection[Mapping[str, bytes]]) -> Iterator[str]:
    """Better one that was written anyhow, and never the checksum."""
    checksum = profile.crc.register_name if profile.crc else None
    names = dict.fromkeys(name for registers in known for name in registers if name != checksum)
    yield from sorted(names, key=lambda name: len({registers.get(name) for registers in known}) == 1)


def may_mark(profile: Profile) -> bool:
    """Whether a value may be written that is not to stay: nothing lasts without
    the store, and no other sequence stores."""
    elsewhere = writes_of(profile, "lock") | writes_of(profile, "reset")
    store = writes_of(profile, "store") - writes_of(profile, "unlock")
    return bool(store) and not store & elsewhere


def own_steps(profile: Profile, label: Label) -> set[tuple[str, bytes]]:
    """The writes of a sequence that are in no other one, as a key is; all of
    them where there are none."""
    mine = writes_of(profile, label)
    return mine - {step for other in SEQUENCES if other != label for step in writes_of(profile, other)} or mine


def writes_of(profile: Profile, label: Label) -> set[tuple[str, bytes]]:
    """Of a sequence, as registers and values."""
    steps = getattr(profile.sequences, label)
    return {(s.write, profile.encode(s.write, s.value)) for s in steps if isinstance(s, WriteStep)}


def beside(profile: Profile, name: str, raw: bytes) -> list[bytes]:
    """Values within the register's limits that differ from ``raw`` by one bit,
    the nearest first: of the last byte, or of the first where the least
    significant one comes first."""
    register, value = profile.registers[name], profile.decode(name, raw)
    low = -math.inf if register.minimum is None else register.minimum
    high = math.inf if register.maximum is None else register.maximum
    near = [bytes([*raw[:-1], raw[-1] ^ bit]) for bit in (1, 2)] + [bytes([raw[0] ^ bit, *raw[1:]]) for bit in (1, 2)]
    off = [(abs(profile.decode(name, other) - value), other) for other in near]
    allowed = sorted((far, other) for far, other in off if far > 0 and low <= profile.decode(name, other) <= high)
    return [other for _, other in allowed[:2]]


async def _put(link: RegisterLink, bundle: Bundle, serial: str | None, name: str, raw: bytes) -> bool:
    """Whether the register is known to hold the value now. Raises WrongUnit,
    with nothing written; RegisterRefused of the write."""
    try:
        await check_identity(link, bundle, serial)
        await run_sequence(link, bundle, "unlock")
        await check_identity(link, bundle, serial)  # right before the one write that could reach another unit
    except WrongUnit:
        raise
    except (*NO_CONTACT, RegisterRefused, StationError):
        link.refresh()
        return False
    try:
        await link.write(name, raw)
        taken = await _is(link, name, raw)
    except NO_CONTACT:
        taken = False
    finally:
        link.refresh()
        await lock_quietly(link, bundle)
    return taken


async def _is(link: RegisterLink, name: str, raw: bytes) -> bool:
    try:
        return await link.read(name) == raw
    except (*NO_CONTACT, RegisterRefused):
        return False


async def _put_back(link: RegisterLink, bundle: Bundle, serial: str | None, mark: _Mark) -> None:
    with suppress(RegisterRefused):
        if await _put(link, bundle, serial, mark.name, mark.held):
            return
    raise ProvisionError(f"register {mark.name} does not take its value again")


async def _read_again(link: RegisterLink, profile: Profile, name: str) -> bytes:
    """A device that has just started may need a new connection."""
    try:
        return await link.read(name)
    except NO_CONTACT:
        link.refresh()
        await reconnect(link, profile)
        return await link.read(name)
