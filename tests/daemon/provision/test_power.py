"""A supply was switched where the device answered, fell silent, and answers again; nothing else counts."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import pytest

from tests.devices.habits import Habits
from tests.devices.in_memory import VirtualClock
from tests.devices.profiles import profile_text
from triaxcal_drivers.catalogue import parse_bundle
from triaxcal_drivers.errors import DeviceBusy, DeviceSilent, RegisterRefused
from triaxcald.provision.access import Clock
from triaxcald.provision.restart_check import least_off_s, power_cycled

PROFILE = parse_bundle(profile_text("modbus", Habits()).encode(), {}, where="a profile").profile


class Link:
    """``answers`` says what becomes of a read at a time: None for an answer."""

    def __init__(self, answers: Callable[[float], Exception | None]) -> None:
        self._clock, self._answers = VirtualClock(), answers
        self.clock = Clock(self._clock.sleep, self._clock.now)

    async def read_once(self, _: str) -> bytes:
        failure = self._answers(self._clock.now())
        if failure is not None:
            await self._clock.sleep(0.1)
            raise failure
        return b"\x00"

    async def open(self) -> None: ...
    async def close(self) -> None: ...
    async def renew(self) -> None: ...


def seen(answers: Callable[[float], Exception | None], patience_s: float = 20.0) -> bool:
    link: Any = Link(answers)
    return asyncio.run(power_cycled(link, PROFILE, patience_s))


SILENT = DeviceSilent("no reply")


def test_a_supply_that_is_off_for_as_long_as_is_asked_for_is_seen() -> None:
    assert seen(lambda t: SILENT if 2.0 <= t < 2.0 + least_off_s(PROFILE) + 0.3 else None)


def test_one_that_does_not_come_back_is_not() -> None:
    assert not seen(lambda t: SILENT if t >= 2.0 else None)


def test_a_lost_reply_now_and_then_is_not() -> None:
    assert not seen(lambda t: SILENT if int(t * 10) % 7 == 0 else None)


@pytest.mark.parametrize(
    "failure", [DeviceBusy("busy", register="a", code=6), RegisterRefused("no", register="a", code=2)]
)
def test_a_device_that_is_busy_or_refuses_has_its_supply(failure: Exception) -> None:
    assert not seen(lambda t: failure if 2.0 <= t < 8.0 else None)


def test_a_device_that_was_silent_from_the_first_is_not_taken_for_one_that_was_switched_off() -> None:
    assert not seen(lambda t: SILENT if t < 5.0 else None)
