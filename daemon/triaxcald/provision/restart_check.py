"""Restarts a device and checks that it restarted; detects a power cycle."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass

import triaxcal_drivers as td
from triaxcald.errors import ProvisionError, StationError, TwoAnswer
from triaxcald.provision.access import (
    NO_CONTACT,
    Label,
    RegisterLink,
    contact_register,
    lock_quietly,
    reconnect,
    run_sequence,
)
from triaxcald.provision.identity import WrongUnit, check_identity

ATTEMPTS = 2
"""A restart command may get lost, and the link does not repeat it. The second
attempt uses another probe."""
SEQUENCES: tuple[Label, ...] = ("start", "unlock", "store", "lock", "reset")
BITS = (1, 2, 4)
"""Bits by which a probe may differ from the register's value: one for each attempt,
and one in reserve for a value that equals a stored one."""
REGISTERS_TRIED = 3
"""A register may refuse a value beyond limits that its profile does not state."""


@dataclass(frozen=True)
class Restart:
    """Result of a restart command.

    ``acknowledged`` alone proves nothing (see `checked_restart`). ``probe_gone``: a
    value in use that was stored nowhere was gone afterwards.
    """

    acknowledged: bool
    probe_gone: bool


@dataclass(frozen=True)
class _Probe:
    """A register whose ``original`` value was replaced by ``value``. ``taken``: the
    register read back ``value``."""

    name: str
    original: bytes
    value: bytes
    taken: bool


async def checked_restart(
    link: RegisterLink, bundle: td.Bundle, serial: str | None, *known: Mapping[str, bytes]
) -> Restart:
    """Restart the unit of that serial number, and check that it restarted.

    An acknowledgement is no proof: the command may reach a wrong register, a
    locked device may ignore it, or the device may execute it later. So one register
    in use first gets a probe: a value that is stored nowhere and differs by one bit
    from the register's own. Only a restart removes the probe. The register gets its
    value back if the restart fails or the probe stays. While two units answer, the
    function restarts them instead of writing.

    ``known`` are register images, one of which is stored: no probe equals them. No
    register gets a probe if writes last without a store, or if the device refuses
    the values. Raises ProvisionError if the register does not take its value back;
    WrongUnit; DiskError of the journal; RegisterRefused, other DriverError or
    SequenceStalled of the restart.
    """
    touched = set(link.touched)
    probe: _Probe | None = None
    try:
        probe = await _with_probe(link, bundle, serial, known)
        if probe is None:
            return Restart(await run_sequence(link, bundle, "reset"), probe_gone=False)
        restart, probe = await _restarted(link, bundle, serial, probe, known)
    except TwoAnswer:  # both units may hold the probe, and only a restart removes it from both
        link.tolerate()
        with suppress(td.DriverError, StationError):
            await lock_quietly(link, bundle)
            await run_sequence(link, bundle, "reset")
        raise
    except BaseException as e:
        if probe is None:
            raise
        try:
            await _put_back(link, bundle, serial, probe)
        except (td.DriverError, StationError):
            if isinstance(e, td.RegisterRefused):  # the device answers, but keeps the probe
                raise
        raise
    if not restart.probe_gone and await _read_again(link, bundle.profile, probe.name) == probe.value:
        await _put_back(link, bundle, serial, probe)
    if probe.name not in touched:  # the register holds its own value again
        link.touched.discard(probe.name)
    return restart


async def _restarted(
    link: RegisterLink, bundle: td.Bundle, serial: str | None, probe: _Probe, known: Collection[Mapping[str, bytes]]
) -> tuple[Restart, _Probe]:
    """Send the restart command until the probe is gone, `ATTEMPTS` times at most;
    the result and the last probe."""
    used = [probe.value]
    while True:
        # A device may discard unstored values when it is locked. Then the probe is
        # gone before the restart and proves nothing.
        in_use = probe.taken and await _is(link, probe.name, probe.value)
        link.refresh()
        acknowledged = await run_sequence(link, bundle, "reset")
        if await _read_again(link, bundle.profile, probe.name) != probe.value:
            return Restart(acknowledged, probe_gone=in_use), probe
        # The probe is still there: the device did not restart, or its store flipped
        # exactly this bit. Another probe distinguishes the two.
        other = next(_others(bundle.profile, probe.name, probe.original, known, used), None)
        if len(used) == ATTEMPTS or other is None:
            return Restart(acknowledged, probe_gone=False), probe
        used.append(other)
        try:
            probe = _Probe(probe.name, probe.original, other, await _put(link, bundle, serial, probe.name, other))
        except td.RegisterRefused:
            return Restart(acknowledged, probe_gone=False), probe


async def _with_probe(
    link: RegisterLink, bundle: td.Bundle, serial: str | None, known: Collection[Mapping[str, bytes]]
) -> _Probe | None:
    """Write a probe. None if no register may get another value, or if the device
    refuses all values offered."""
    if not may_probe(bundle.profile):
        return None
    for name in list(_names(bundle.profile, known))[:REGISTERS_TRIED]:
        original = await link.read(name)
        value = next(_others(bundle.profile, name, original, known), None)
        if value is not None:
            with suppress(td.RegisterRefused):
                return _Probe(name, original, value, await _put(link, bundle, serial, name, value))
    return None


def _others(
    profile: td.Profile, name: str, held: bytes, known: Collection[Mapping[str, bytes]], used: Collection[bytes] = ()
) -> Iterator[bytes]:
    """Candidate values of a probe: neither stored nor used before."""
    taken = [*used, *(registers.get(name) for registers in known)]
    return (other for other in neighbouring_values(profile, name, held) if other not in taken)


def _names(profile: td.Profile, known: Collection[Mapping[str, bytes]]) -> Iterator[str]:
    """Candidate registers of a probe: first those that differ between the images and
    are written anyway, never the checksum."""
    checksum = profile.crc.register_name if profile.crc else None
    names = dict.fromkeys(name for registers in known for name in registers if name != checksum)
    yield from sorted(names, key=lambda name: len({registers.get(name) for registers in known}) == 1)


def may_probe(profile: td.Profile) -> bool:
    """Whether a register may get a probe: no write lasts without the store, and no
    other sequence stores."""
    elsewhere = writes_of(profile, "lock") | writes_of(profile, "reset") | writes_of(profile, "start")
    store = writes_of(profile, "store") - writes_of(profile, "unlock")
    return bool(store) and not store & elsewhere


def own_steps(profile: td.Profile, label: Label) -> set[tuple[str, bytes]]:
    """The writes of a sequence that no other sequence has; all of its writes if
    there are none. A key is such a shared write."""
    mine = writes_of(profile, label)
    return mine - {step for other in SEQUENCES if other != label for step in writes_of(profile, other)} or mine


def writes_of(profile: td.Profile, label: Label) -> set[tuple[str, bytes]]:
    """The writes of a sequence: registers and raw values."""
    steps = getattr(profile.sequences, label)
    return {(s.write, profile.encode(s.write, s.value)) for s in steps if isinstance(s, td.WriteStep)}


def neighbouring_values(profile: td.Profile, name: str, raw: bytes) -> list[bytes]:
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


async def _put(link: RegisterLink, bundle: td.Bundle, serial: str | None, name: str, raw: bytes) -> bool:
    """Write a value in use; whether the register read it back.

    Raises WrongUnit, DiskError, with nothing written; RegisterRefused of the write.
    """
    link.before_probe()
    try:
        await check_identity(link, bundle, serial)
        await run_sequence(link, bundle, "unlock")
        await check_identity(link, bundle, serial)  # right before the one write that could reach another unit
    except (WrongUnit, TwoAnswer):
        raise
    except (*NO_CONTACT, td.RegisterRefused, StationError):
        link.refresh()
        return False
    link.probed.append(name)
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
    except (*NO_CONTACT, td.RegisterRefused):
        return False


async def _put_back(link: RegisterLink, bundle: td.Bundle, serial: str | None, probe: _Probe) -> None:
    with suppress(td.RegisterRefused):
        if await _put(link, bundle, serial, probe.name, probe.original):
            return
    raise ProvisionError(f"register {probe.name} does not take its value again")


async def _read_again(link: RegisterLink, profile: td.Profile, name: str) -> bytes:
    """Read after a restart; a device that has just started may need a new
    connection."""
    try:
        return await link.read(name)
    except NO_CONTACT:
        link.refresh()
        await reconnect(link, profile)
        return await link.read(name)


# Detects a power cycle of a device.

LOOK_S = 0.2
"""Period of the requests; a person switches a supply off for longer."""
MISSED = 3
"""Unanswered requests in a row that count as no supply: by chance once in a million
on a link that loses one in a hundred."""


def least_off_s(profile: td.Profile) -> float:
    """Shortest time without supply that is detected [s]."""
    return MISSED * (profile.sampling.reply_timeout_s + LOOK_S)


async def power_cycled(
    link: RegisterLink, profile: td.Profile, patience_s: float, off: Callable[[], None] = lambda: None
) -> bool:
    """Whether the device, within ``patience_s``, answers, goes silent and answers
    again. A busy or refusing device has its supply. ``off`` is called once the device
    is silent.
    """
    register = contact_register(profile) or next(iter(profile.registers))
    deadline_s, missed, answered = link.clock.now_s() + patience_s, 0, False
    while missed < MISSED:
        if link.clock.now_s() >= deadline_s:
            return False
        try:
            await link.read_once(register)
            missed, answered = 0, True
        except td.RegisterRefused:
            missed, answered = 0, True
        except NO_CONTACT:
            missed += answered
            await link.renew()
        await link.clock.sleep(LOOK_S)
    off()
    with suppress(td.DriverError):
        await reconnect(link, profile, max(deadline_s - link.clock.now_s(), LOOK_S))
        return True
    return False
