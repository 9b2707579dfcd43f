"""Puts an old calibration back and shows that it is back, whatever state the device is in."""

from __future__ import annotations

from triaxcal_drivers.errors import DriverError, RegisterRefused
from triaxcal_drivers.interface import Device
from triaxcal_drivers.profile import Bundle, PollStep, WaitStep
from triaxcald.errors import ProvisionError, StationError
from triaxcald.provision.identity import check_identity
from triaxcald.provision.sequence import NO_CONTACT, REAL_PACE, Pace, reconnect, run_sequence, run_steps
from triaxcald.provision.snapshot import Snapshot, take_snapshot

RECONNECT_S = 5.0
FAILURES = (DriverError, StationError)


async def restore(
    device: Device, bundle: Bundle, snapshot: Snapshot, *, stored: bool = True, pace: Pace = REAL_PACE
) -> None:
    """Make the device hold ``snapshot``, also permanently where ``stored`` says that it may be overwritten.

    First a restart, since that brings back whatever is stored without writing; then, only where it is not the
    snapshot, the registers that differ. Returns once every register reads back as the snapshot's raw bytes
    (with ``stored``: after a restart). Raises ProvisionError that says why not; WrongUnit, with nothing
    written, where another unit answers.
    """
    try:
        await _contact(device, bundle, snapshot, pace)
        if stored:
            await _let_a_store_end(device, bundle, pace)
        await _restart(device, bundle, pace)
        if await _differing(device, bundle, snapshot):
            await _write_back(device, bundle, snapshot, stored, pace)
    except DriverError as e:
        raise ProvisionError(str(e)) from e


async def lock_quietly(device: Device, bundle: Bundle, pace: Pace) -> None:
    """Lock if the device will. A restart locks it too; what it holds does not depend on it."""
    try:
        await run_sequence(device, bundle, "lock", pace)
    except FAILURES:
        return


async def _contact(device: Device, bundle: Bundle, snapshot: Snapshot, pace: Pace) -> None:
    """A device that had its power cut is back after a moment, on a new connection."""
    try:
        await check_identity(device, bundle, snapshot.serial)
    except NO_CONTACT:
        await reconnect(device, bundle.profile, RECONNECT_S, pace)


async def _let_a_store_end(device: Device, bundle: Bundle, pace: Pace) -> None:
    """A restart in the middle of a store could spoil the stored copy."""
    waits = [step for step in bundle.profile.sequences.store if isinstance(step, (WaitStep, PollStep))]
    try:
        await run_steps(device, bundle, "store", waits, pace)
    except FAILURES:
        return  # what came of the store shows after the restart


async def _restart(device: Device, bundle: Bundle, pace: Pace) -> None:
    await lock_quietly(device, bundle, pace)
    try:
        await run_sequence(device, bundle, "reset", pace)
    except RegisterRefused:
        return  # writing back may still do


async def _differing(device: Device, bundle: Bundle, snapshot: Snapshot) -> tuple[str, ...]:
    await check_identity(device, bundle, snapshot.serial)
    return snapshot.differing((await take_snapshot(device, bundle, snapshot.raw)).raw)


async def _write_back(device: Device, bundle: Bundle, snapshot: Snapshot, stored: bool, pace: Pace) -> None:
    try:
        await run_sequence(device, bundle, "unlock", pace)
        for name in await _differing(device, bundle, snapshot):
            await device.write(name, snapshot.raw[name])
        await _require_equal(device, bundle, snapshot)  # before anything wrong is made permanent
        if stored:
            await run_sequence(device, bundle, "store", pace)
    finally:
        await lock_quietly(device, bundle, pace)
    if stored:
        await run_sequence(device, bundle, "reset", pace)
        await _require_equal(device, bundle, snapshot)


async def _require_equal(device: Device, bundle: Bundle, snapshot: Snapshot) -> None:
    if wrong := await _differing(device, bundle, snapshot):
        raise ProvisionError(f"of the old calibration, {', '.join(wrong)} will not come back")
