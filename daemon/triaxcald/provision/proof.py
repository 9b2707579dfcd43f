"""Shows that a restart took place which the device did not acknowledge."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from triaxcal_drivers.errors import RegisterRefused
from triaxcal_drivers.profile import Bundle
from triaxcald.errors import ProvisionError, StationError
from triaxcald.provision.access import RegisterLink
from triaxcald.provision.sequence import lock_quietly, run_sequence


async def show_restart(
    link: RegisterLink,
    bundle: Bundle,
    image: Mapping[str, bytes],
    old: Mapping[str, bytes],
    differing: Sequence[str],
) -> bool:
    """Restart once more with an old value in one register in use: only a
    restart brings the stored one back.

    For devices whose writes do not last without a store. The value is put back
    where the restart did not. Raises ProvisionError where that fails;
    DriverError, SequenceStalled where the device does not come back.
    """
    checksum = bundle.profile.crc.register_name if bundle.profile.crc else None
    name = next((n for n in differing if n != checksum), None)
    if name is None or not await _put(link, bundle, name, old[name]):
        return False
    await run_sequence(link, bundle, "reset")
    if await link.read(name) == image[name]:
        return True
    if not await _put(link, bundle, name, image[name]):
        raise ProvisionError(f"register {name} does not take the new value again")
    return False


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
