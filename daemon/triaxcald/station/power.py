"""Asks the operator to switch a unit's supply."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from triaxcald import text
from triaxcald.provision.access import RegisterLink
from triaxcald.provision.restart_check import least_off_s, power_cycled
from triaxcald.station.config import Place, Station


def power_cycle_asked(
    ask: Callable[[str], None], link: RegisterLink, place: Place, station: Station
) -> Callable[[], Awaitable[bool]]:
    """The function for `Provisioning.power_cycle`: asks the operator, and returns
    whether a power cycle was seen within ``plan.patience_s``."""

    async def asked() -> bool:
        ask(text.switch_supply(least_off_s(place.bundle.profile)))
        return await power_cycled(link, place.bundle.profile, station.file.plan.patience_s)

    return asked
