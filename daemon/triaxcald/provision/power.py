"""Detects a power cycle of a device."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

import triaxcal_drivers as td
from triaxcald.provision.access import NO_CONTACT, RegisterLink
from triaxcald.provision.sequence import contact_register, reconnect

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
    again. A busy or refusing device has its supply. ``off`` is called once it is
    silent.
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
