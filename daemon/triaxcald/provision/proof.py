"""Restarts a device and shows whether it restarted."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass

from triaxcal_drivers.errors import DriverError, RegisterRefused
from triaxcal_drivers.profile import Bundle, Profile, WriteStep
from triaxcald.errors import ProvisionError, StationError, TwoAnswer
from triaxcald.provision.access import NO_CONTACT, RegisterLink
from triaxcald.provision.identity import WrongUnit, check_identity
from triaxcald.provision.sequence import Label, lock_quietly, reconnect, run_sequence

ATTEMPTS = 2
"""A restart command is lost at times, and is not repeated by the link. The
second attempt uses another mark."""
SEQUENCES: tuple[Label, ...] = ("unlock", "store", "lock", "reset")
BITS = (1, 2, 4)
"""Bits that a mark may differ by: one for each attempt, and one in reserve for
a value that equals a stored one."""
REGISTERS_TRIED = 3
"""A register may refuse a value beyond limits that its profile does not state."""


@dataclass(frozen=True)
class Restart:
    """What a restart command showed. ``acknowledged`` alone proves nothing:
    `proven_restart` says why. ``mark_gone``: a value that was in use, and
    stored nowhere, was gone afterwards."""

    acknowledged: bool
    mark_gone: bool


@dataclass(frozen=True)
class _Mark:
    """A register that ``held`` a value and was given another one, ``put``.
    ``taken``: the register read back ``put``."""

    name: str
    held: bytes
    put: bytes
    taken: bool


async def proven_restart(
    link: RegisterLink, bundle: Bundle, serial: str | None, *known: Mapping[str, bytes]
) -> Restart:
    """Restart the unit of that serial number, and show whether it restarted.

    An acknowledgement is no proof: the command may reach a wrong register, a
    locked device may ignore it, or the device may carry it out later. So one
    register in use first gets a mark: a value that is stored nowhere, one bit
    off from the value that it holds. Only a restart takes the mark away. The
    register gets its value back if the restart fails or does not show; while two
    units answer, a restart is sent in its place.

    ``known`` are register images, one of which is stored: no mark equals them.
    No register gets a mark where writes last without a store, or where the
    device refuses the values. Raises ProvisionError if the register does not
    take its value again; WrongUnit; RegisterRefused, other DriverError,
    SequenceStalled of the restart.
    """
    touched = set(link.touched)
    mark: _Mark | None = None
    try:
        mark = await _marked(link, bundle, serial, known)
        if mark is None:
            return Restart(await run_sequence(link, bundle, "reset"), mark_gone=False)
        restart, mark = await _restarted(link, bundle, serial, mark, known)
    except TwoAnswer:  # the mark may be in use in both units, and only a restart takes it away from either
        link.tolerate()
        with suppress(DriverError, StationError):
            await lock_quietly(link, bundle)
            await run_sequence(link, bundle, "reset")
        raise
    except BaseException as e:
        if mark is None:
            raise
        try:
            await _put_back(link, bundle, serial, mark)
        except (DriverError, StationError):
            if isinstance(e, RegisterRefused):  # it answers, and keeps a value that nobody wants
                raise
        raise
    if not restart.mark_gone and await _read_again(link, bundle.profile, mark.name) == mark.put:
        await _put_back(link, bundle, serial, mark)
    if mark.name not in touched:  # the register holds what it would hold without the mark
        link.touched.discard(mark.name)
    return restart


async def _restarted(
    link: RegisterLink, bundle: Bundle, serial: str | None, mark: _Mark, known: Collection[Mapping[str, bytes]]
) -> tuple[Restart, _Mark]:
    """Send the restart command until the mark is gone; the mark that was used
    last."""
    used = [mark.put]
    while True:
        # A device may drop what is not stored when it is locked. Then the mark
        # is gone before the restart, and shows nothing.
        standing = mark.taken and await _is(link, mark.name, mark.put)
        link.refresh()
        acknowledged = await run_sequence(link, bundle, "reset")
        if await _read_again(link, bundle.profile, mark.name) != mark.put:
            return Restart(acknowledged, mark_gone=standing), mark
        # Either the device did not restart, or its store spoiled just this bit.
        # Another mark tells these apart.
        other = next(_others(bundle.profile, mark.name, mark.held, known, used), None)
        if len(used) == ATTEMPTS or other is None:
            return Restart(acknowledged, mark_gone=False), mark
        used.append(other)
        try:
            mark = _Mark(mark.name, mark.held, other, await _put(link, bundle, serial, mark.name, other))
        except RegisterRefused:
            return Restart(acknowledged, mark_gone=False), mark


async def _marked(
    link: RegisterLink, bundle: Bundle, serial: str | None, known: Collection[Mapping[str, bytes]]
) -> _Mark | None:
    """None where no register may get another value, or the device refuses all
    that are offered."""
    if not may_mark(bundle.profile):
        return None
    for name in list(_names(bundle.profile, known))[:REGISTERS_TRIED]:
        held = await link.read(name)
        put = next(_others(bundle.profile, name, held, known), None)
        if put is not None:
            with suppress(RegisterRefused):
                return _Mark(name, held, put, await _put(link, bundle, serial, name, put))
    return None


def _others(
    profile: Profile, name: str, held: bytes, known: Collection[Mapping[str, bytes]], used: Collection[bytes] = ()
) -> Iterator[bytes]:
    """Values for a mark: none that is stored, or was used before."""
    taken = [*used, *(registers.get(name) for registers in known)]
    return (other for other in beside(profile, name, held) if other not in taken)


def _names(profile: Profile, known: Collection[Mapping[str, bytes]]) -> Iterator[str]:
    """Registers for a mark: first those that are written anyhow, never the
    checksum."""
    checksum = profile.crc.register_name if profile.crc else None
    names = dict.fromkeys(name for registers in known for name in registers if name != checksum)
    yield from sorted(names, key=lambda name: len({registers.get(name) for registers in known}) == 1)


def may_mark(profile: Profile) -> bool:
    """Whether a register may get a mark: no write lasts without the store, and
    no other sequence stores."""
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
    """Values within the register's limits that differ from ``raw`` by one of
    the three lowest bits, the nearest first. The lowest bits lie in the last
    byte, or in the first one if the least significant byte comes first."""
    register, value = profile.registers[name], profile.decode(name, raw)
    low = -math.inf if register.minimum is None else register.minimum
    high = math.inf if register.maximum is None else register.maximum
    last = [bytes([*raw[:-1], raw[-1] ^ bit]) for bit in BITS]
    first = [bytes([raw[0] ^ bit, *raw[1:]]) for bit in BITS]
    near = dict.fromkeys([*last, *first])  # the same values in a register of one byte
    off = [(abs(profile.decode(name, other) - value), other) for other in near]
    allowed = sorted((far, other) for far, other in off if far > 0 and low <= profile.decode(name, other) <= high)
    return [other for _, other in allowed[: len(BITS)]]


async def _put(link: RegisterLink, bundle: Bundle, serial: str | None, name: str, raw: bytes) -> bool:
    """Whether the register read back the value. Raises WrongUnit, with nothing
    written; RegisterRefused of the write."""
    try:
        await check_identity(link, bundle, serial)
        await run_sequence(link, bundle, "unlock")
        await check_identity(link, bundle, serial)  # right before the one write that could reach another unit
    except (WrongUnit, TwoAnswer):
        raise
    except (*NO_CONTACT, RegisterRefused, StationError):
        link.refresh()
        return False
    link.marked.append(name)
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
