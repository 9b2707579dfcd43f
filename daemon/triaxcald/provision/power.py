"""Sees a device lose its supply and come back."""

from __future__ import annotations

from contextlib import suppress

from triaxcal_drivers.errors import DeviceBusy, DriverError
from triaxcal_drivers.profile import Profile
from triaxcald.provision.access import NO_CONTACT, RegisterLink
from triaxcald.provision.sequence import probe, reconnect

LOOK_S = 0.2
"""So often the device is asked; a supply is off for longer when a person switches it."""
MISSED = 3
"""So many requests in a row go unanswered by chance once in a million times where a link loses one in a hundred."""


def least_off_s(profile: Profile) -> float:
    """The supply has to be off for so long to be seen off."""
    return MISSED * (profile.sampling.reply_timeout_s + LOOK_S)


async def power_cycled(link: RegisterLink, profile: Profile, patience_s: float) -> bool:
    """Waits until the device has gone silent and answers again; whether it has within ``patience_s``."""
    register = probe(profile) or next(iter(profile.registers))
    deadline_s, missed = link.pace.clock_s() + patience_s, 0
    while missed < MISSED:
        if link.pace.clock_s() >= deadline_s:
            return False
        try:
            await link.read_once(register)
            missed = 0
        except (*NO_CONTACT, DeviceBusy):
            missed += 1
            await link.renew()
        await link.pace.sleep(LOOK_S)
    with suppress(DriverError):
        await reconnect(link, profile, max(deadline_s - link.pace.clock_s(), LOOK_S))
        return True
    return False
