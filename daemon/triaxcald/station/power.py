"""Asks the operator to switch a unit's supply."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from triaxcald import text
from triaxcald.provision.access import RegisterLink
from triaxcald.provision.restart_check import least_off_s, power_cycled
from triaxcald.schema.codes import Stage
from triaxcald.station.config import Place, Station


def power_cycle_asked(
    ask: Callable[[Stage, str], None], link: RegisterLink, place: Place, station: Station
) -> Callable[[], Awaitable[bool]]:
    """The function for `Provisioning.power_cycle`: asks the operator to switch the
    supply off, and then on; returns whether a power cycle was seen within
    ``plan.patience_s``. ``ask`` gets the stage, and it in words."""

    async def asked() -> bool:
        ask(Stage.POWER_OFF, text.switch_supply(least_off_s(place.bundle.profile)))

        def off() -> None:
            ask(Stage.POWER_ON, text.SWITCH_ON)

        return await power_cycled(link, place.bundle.profile, station.file.plan.patience_s, off)

    return asked
