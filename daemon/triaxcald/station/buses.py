"""Buses of a station that are listened to: all their frames, of no unit."""

from __future__ import annotations

import re
from collections.abc import AsyncIterator, Callable, Collection, Iterable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from itertools import combinations
from typing import Annotated, Any

from pydantic import Field

import triaxcal_drivers as td
from triaxcald.errors import InputError
from triaxcald.station.reconnect import RetryPolicy, claimed, until_open

BUSES_MOST = 32  # more adapters than a machine has ports for
NAME = r"^[A-Za-z0-9][A-Za-z0-9._-]*$"  # of files too


class Bus(td.Strict):
    name: Annotated[str, Field(pattern=NAME)]
    bus: Annotated[dict[str, Any], Field(description="as that of a unit on CAN, without a node")]


@dataclass(frozen=True)
class BusPlace:
    """A bus with everything it takes to listen to it. ``given`` are the
    settings as the station file has them."""

    name: str
    settings: td.can.BusSettings
    given: Mapping[str, Any]

    @property
    def address(self) -> str:
        """Where the bus is, for messages."""
        return ", ".join(f"{k}={v}" for k, v in self.given.items())

    def listener(self) -> td.can.BusListener:

        return td.can.BusListener(self.settings)

    @asynccontextmanager
    async def opened(self, policy: RetryPolicy, tell: Callable[[Exception], None]) -> AsyncIterator[td.can.BusListener]:
        """The bus, listened to until the context ends. Raises DeviceInUse where
        another process has its serial port, BusError once the policy gives up
        (``tell`` is told meanwhile)."""
        listener, claim = self.listener(), self.settings.claim_to_listen()
        if claim is None:
            async with _open(listener, policy, tell):
                yield listener
        else:
            async with claimed(claim, policy, tell), _open(listener, policy, tell):
                yield listener


@asynccontextmanager
async def _open(
    listener: td.can.BusListener, policy: RetryPolicy, tell: Callable[[Exception], None]
) -> AsyncIterator[None]:
    try:
        await until_open(listener.open, policy, tell)
        yield
    finally:
        await listener.close()


def bus_places(
    buses: Sequence[Bus], units: Collection[td.can.BusSettings], text: bytes, *, where: str
) -> list[BusPlace]:
    """``units`` are the buses that the station's units are on: to any other
    bus its adapter is asked to listen only. Opens none. Raises ProfileError,
    InputError with the field."""
    driven = {unit.name for unit in units}
    places = []
    for i, bus in enumerate(buses):
        given = td.toml_text.validate(td.can.BusSettings, bus.bus, text, where=f"{where}: buses.{i}.bus")
        places.append(BusPlace(bus.name, given if given.name in driven else given.listening(), bus.bus))
        places[-1].listener()  # so that a package that is not there comes out before any bus is opened
    for (_, a), (i, b) in combinations(enumerate(places), 2):
        if a.settings.name == b.settings.name:
            raise InputError(f"{where}: buses.{i}.bus: {b.name} is the bus that {a.name} is already ({a.address})")
    return places


def taken_for(bus: str, units: Iterable[str]) -> str | None:
    """The unit whose recordings those of a bus of this name would be taken
    for."""
    return next((unit for unit in units if re.fullmatch(rf"{re.escape(unit)}-([0-9]+|unknown)", bus)), None)
