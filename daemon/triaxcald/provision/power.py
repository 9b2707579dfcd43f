"""Sees a device lose its supply and come back."""

from __future__ import annotations

from contextlib import suppress

from triaxcal_drivers.errors import DriverError, RegisterRefused
from triaxcal_drivers.profile import Profile
from triaxcald.provision.access import NO_CONTACT, RegisterLink
from triaxcald.provision.sequence import contact_register, reconnect

LOOK_S = 0.2
"""So often the device is asked; a supply is off for longer when a person
switches it."""
MISSED = 3
"""So many requests in a row go unanswered by chance once in a million times
where a link loses one in a hundred."""


def least_off_s(profile: Profile) -> float:
    """The supply has to be off for so long to be seen off."""
    return MISSED * (profile.sampling.reply_timeout_s + LOOK_S)


async def power_cycled(link: RegisterLink, profile: Profile, patience_s: float) -> bool:
    """Waits until the device, which answered, has gone silent and answers
    again; whether it has within ``patience_s``.

    One that is busy, or refuses, has its supply.
    """
    register = contact_register(profile) or next(iter(profile.registers))
    deadline_s, missed, answered = link.clock.now_s() + patience_s, 0, False
    while missed < MISSED:
        if link.clock.now_s() >= deadline_s:
            return False
        try:
            await link.read_once(register)
            missed, answered = 0, True
        except RegisterRefused:
            missed, answered = 0, True
        except NO_CONTACT:
            missed += answered
            await link.renew()
        await link.clock.sleep(LOOK_S)
    with suppress(DriverError):
        await reconnect(link, profile, max(deadline_s - link.clock.now_s(), LOOK_S))
        return True
    return False
