"""Finishes what an earlier provisioning has begun, or takes it back: by its journal, or by a snapshot."""

from __future__ import annotations

import asyncio
from pathlib import Path

from triaxcal_drivers.profile import Bundle
from triaxcald.errors import InputError, ProvisionError
from triaxcald.provision.access import RegisterLink
from triaxcald.provision.identity import check_identity
from triaxcald.provision.image import RegisterImage, image_of
from triaxcald.provision.journal import Journal
from triaxcald.provision.procedure import Provisioning
from triaxcald.provision.snapshot import Snapshot
from triaxcald.provision.state import DeviceState, Evidence


async def journaled_image(
    link: RegisterLink, bundle: Bundle, *, folder: Path, unit: str, expected_serial: str | None, where: str
) -> tuple[RegisterImage, str | None]:
    """What the provisioning of this device that was cut short was to write, and the device's serial number.

    Raises InputError where there is none, or where it was begun with another profile; WrongUnit, DriverError.
    """
    identity = await check_identity(link, bundle, expected_serial, where=where)
    journal = Journal.of(folder, unit, identity.serial)
    entry = journal.read()
    if entry is None:
        raise InputError(f"{journal.path}: no such file: no provisioning of this unit was cut short")
    if entry.profile_sha256 != bundle.digest():
        raise InputError(f"{journal.path}: was begun with another version of the profile {bundle.profile.name}")
    return image_of(bundle.profile, entry.wanted), identity.serial


async def put_back(p: Provisioning, snapshot: Snapshot) -> None:
    """The registers of ``snapshot`` back into the device of ``p``, whose image is the snapshot's.

    Raises ProvisionError that says why they are not; what the device holds then is in ``p.held``. WrongUnit,
    DriverError, DiskError.
    """
    p.held.now(DeviceState.UNKNOWN, Evidence.NO_ANSWER)
    await p.examine()
    if p.found.differing(snapshot.raw):
        p.begin()
    p.before, p.carried = snapshot, True
    await p.undo()
    if (task := asyncio.current_task()) and task.cancelling():
        raise asyncio.CancelledError
    if p.held.state is DeviceState.OLD:
        await p.prove_old()
    if p.held.state is not DeviceState.OLD:
        raise ProvisionError(p.undoing_failed or "the old calibration is not back")
    p.finish()
