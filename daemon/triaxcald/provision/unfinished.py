"""What an earlier provisioning that was cut short had begun, by its journal."""

from __future__ import annotations

from pathlib import Path

from triaxcal_drivers.profile import Bundle, Profile
from triaxcald.errors import InputError
from triaxcald.provision.access import RegisterLink
from triaxcald.provision.identity import check_identity
from triaxcald.provision.image import RegisterImage, image_of
from triaxcald.provision.journal import Entry, Journal, Owner, journals_of
from triaxcald.provision.plausible import fits_its_checksum
from triaxcald.provision.snapshot import Snapshot, take_snapshot


async def journaled_image(
    link: RegisterLink, bundle: Bundle, *, folder: Path, unit: str, expected_serial: str | None, where: str
) -> tuple[RegisterImage, str | None]:
    """What the provisioning of this device that was cut short was to write, and
    the device's serial number.

    Raises InputError where there is none, or where it was begun with another
    profile; WrongUnit, DriverError.
    """
    identity = await check_identity(link, bundle, expected_serial, where=where)
    owner = Owner.of(bundle.profile, unit, identity.serial)
    found = journals_of(folder, owner, bundle.profile)
    if not found:
        path = Journal.of(folder, owner, "RUN").path
        raise InputError(f"{path}: no such file: no provisioning of this unit was cut short")
    journal, entry = found[0]
    if len(found) > 1:  # of several units, one after the other in this slot
        held = await take_snapshot(link, bundle)
        journal, entry = next(((j, e) for j, e in found if _fits(e, held)), found[0])
    if entry.profile_sha256 != bundle.digest():
        raise InputError(f"{journal.path}: was begun with another version of the profile {bundle.profile.name}")
    return image_of(bundle.profile, entry.wanted), identity.serial


def _fits(entry: Entry, held: Snapshot) -> bool:
    """Whether each register holds its old value or its new one."""
    return all(raw in (entry.before.get(name), entry.wanted.get(name)) for name, raw in held.raw.items())


def was_cut_short(entry: Entry, profile: Profile, found: Snapshot, image: RegisterImage, restarted: bool) -> bool:
    """Whether a device with a journal still is as that provisioning left it,
    and not as somebody has made it since.

    ``found`` was read after a restart, where ``restarted`` says so; ``image``
    is what is to be written now.
    """
    if not found.differing(entry.before):  # which is in use, and may not be what is stored
        return bool(profile.sequences.store) and not restarted
    if not found.differing(entry.wanted):
        return entry.step != "unverified" or not found.differing(image.raw)
    torn = [n for n, raw in found.raw.items() if raw not in (entry.before[n], entry.wanted.get(n))]
    if profile.crc is None:
        return len(torn) <= 1  # a supply that fails in a write leaves one register half written
    # Without a serial number, a blank unit at the same place is not to be taken
    # for one that was cut short.
    known = profile.identity.serial_register is not None or len(torn) <= 1
    return known and not fits_its_checksum(profile, found)
