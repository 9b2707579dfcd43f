"""Puts an old calibration back and shows that it is back, whatever state the
device is in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress

from triaxcal_drivers.errors import DriverError, RegisterRefused
from triaxcal_drivers.profile import Bundle, PollStep, WaitStep
from triaxcald.errors import ProvisionError, StationError, TwoAnswer
from triaxcald.provision.access import NO_CONTACT, RegisterLink
from triaxcald.provision.identity import WrongUnit, check_identity, require_alone
from triaxcald.provision.proof import proven_restart
from triaxcald.provision.sequence import lock_quietly, reconnect, run_sequence, run_steps
from triaxcald.provision.snapshot import Snapshot, take_snapshot
from triaxcald.provision.state import Evidence

Images = Sequence[Mapping[str, bytes]]


async def restore(
    link: RegisterLink,
    bundle: Bundle,
    snapshot: Snapshot,
    *,
    stored: bool = True,
    wanted: Mapping[str, bytes] | None = None,
) -> Evidence:
    """Make the device hold ``snapshot``, also permanently where ``stored`` says
    that it may have been overwritten; ``wanted`` is what may have been stored
    in its place.

    First a restart: it brings back what is stored, and writes nothing. Then the
    registers that differ are written, and stored if ``stored``. The store is
    also sent if no restart has shown what is stored: the registers in use may
    differ from it. Returns once every register reads back as the snapshot's raw
    bytes; the evidence is a restart only if a mark was gone after it. Raises
    ProvisionError that says why not; WrongUnit, with nothing written, if another
    unit answers.
    """
    known = [snapshot.raw, wanted or {}]
    try:
        await _contact(link, bundle, snapshot)
        if stored:
            await let_a_store_end(link, bundle)
        restarted = await _restart(link, bundle, snapshot, known)
        doubtful = stored and not restarted and bool(bundle.profile.sequences.store)
        if await differing(link, bundle, snapshot) or doubtful:
            restarted = await _write_back(link, bundle, snapshot, known, stored)
    except DriverError as e:
        raise ProvisionError(str(e)) from e
    if not stored:
        return Evidence.NOTHING_STORED
    return Evidence.RESTART if restarted else Evidence.READ_BACK


async def let_a_store_end(link: RegisterLink, bundle: Bundle) -> None:
    """A restart in the middle of a store could spoil the stored copy. What came
    of it shows after the restart."""
    waits = [step for step in bundle.profile.sequences.store if isinstance(step, (WaitStep, PollStep))]
    with suppress(DriverError, StationError):
        await run_steps(link, bundle, "store", waits)


async def differing(link: RegisterLink, bundle: Bundle, snapshot: Snapshot) -> tuple[str, ...]:
    """The registers in which the snapshot's own unit differs from it. Raises
    WrongUnit, DriverError."""
    await check_identity(link, bundle, snapshot.serial)
    return snapshot.differing((await take_snapshot(link, bundle, snapshot.raw)).raw)


async def _contact(link: RegisterLink, bundle: Bundle, snapshot: Snapshot) -> None:
    """A device that had its power cut is back after a moment, on a new
    connection."""
    try:
        await check_identity(link, bundle, snapshot.serial)
    except NO_CONTACT:
        await reconnect(link, bundle.profile)
        await check_identity(link, bundle, snapshot.serial)


async def _restart(link: RegisterLink, bundle: Bundle, snapshot: Snapshot, known: Images) -> bool:
    """Whether a mark shows that the device restarted."""
    if not bundle.profile.sequences.reset:
        return False
    await lock_quietly(link, bundle)
    try:
        return (await proven_restart(link, bundle, snapshot.serial, *known)).mark_gone
    except WrongUnit:  # one of ProvisionError
        raise
    except (RegisterRefused, ProvisionError):
        return False  # writing back may still do


async def _write_back(link: RegisterLink, bundle: Bundle, snapshot: Snapshot, known: Images, stored: bool) -> bool:
    acknowledged, theirs = True, False
    try:
        await run_sequence(link, bundle, "unlock")
        for name in await differing(link, bundle, snapshot):
            await link.write(name, snapshot.raw[name])
        await _require_equal(link, bundle, snapshot)  # before anything wrong is made permanent
        if stored:
            await require_alone(link, bundle)  # a store reaches whoever hears it
            acknowledged = await run_sequence(link, bundle, "store")
            await _require_equal(link, bundle, snapshot)  # the supply may have failed in the store
    except (WrongUnit, TwoAnswer):
        theirs = True
        raise
    finally:
        if not theirs:
            await lock_quietly(link, bundle)
    if not stored:
        return False
    restarted = False
    if bundle.profile.sequences.reset:
        restarted = (await proven_restart(link, bundle, snapshot.serial, *known)).mark_gone
    await _require_equal(link, bundle, snapshot)
    if not acknowledged and not restarted:
        raise ProvisionError("the store of the old calibration went unanswered, and no read decides what it did")
    return restarted


async def _require_equal(link: RegisterLink, bundle: Bundle, snapshot: Snapshot) -> None:
    if wrong := await differing(link, bundle, snapshot):
        raise ProvisionError(f"of the old calibration, {', '.join(wrong)} will not come back")
