"""Requests of registers over a line that is lost: what is said of them."""

from __future__ import annotations

from typing import Any

import pytest

from triaxcal_drivers.errors import BusError, DeviceAbsent, RegisterRefused
from triaxcald.provision.access import RegisterAccess, RegisterLink, run_sequence

NOT_OPEN = "the device is not open"


class Lost:
    """Answers nothing once it is closed, and cannot be opened again: ``why`` of each attempt."""

    def __init__(self, *why: Exception | None) -> None:
        self.why, self.is_open, self.opened = list(why), True, 0

    async def open(self) -> None:
        self.opened += 1
        if (e := self.why.pop(0)) is not None:
            raise e
        self.is_open = True

    async def close(self) -> None:
        self.is_open = False

    async def read(self, register: str) -> bytes:
        raise BusError("the connection was lost" if self.is_open else NOT_OPEN)

    async def write(self, register: str, raw: bytes) -> None:
        raise BusError("the connection was lost" if self.is_open else NOT_OPEN)


def _link(bench: Any, device: Any, told: list[RegisterAccess]) -> RegisterLink:
    return RegisterLink(device, bench.profile, told.append)


@pytest.mark.parametrize("refused", [BusError("no route"), DeviceAbsent("nothing answers")])
async def test_what_keeps_a_device_from_being_opened_again_is_what_is_said(bench: Any, refused: Exception) -> None:
    told: list[RegisterAccess] = []
    with pytest.raises(BusError, match=f"^{refused}$"):
        await _link(bench, Lost(refused, refused), told).write("bias_x", bytes(4))
    assert [access.error for access in told] == ["the connection was lost", str(refused), str(refused)]
    assert all(access.unanswered for access in told)


async def test_it_is_said_at_an_unlock_too(bench: Any) -> None:
    with pytest.raises(BusError, match=r"^no route$"):
        await run_sequence(_link(bench, Lost(*[BusError("no route")] * 2), []), bench.bundle, "unlock")


async def test_once_the_device_is_open_again_the_next_cause_is_its_own(bench: Any) -> None:
    with pytest.raises(BusError, match=r"^the connection was lost$"):
        await _link(bench, Lost(BusError("no route"), None), []).read("bias_x")


async def test_a_refusal_is_said_as_it_is(bench: Any) -> None:
    class Refusing(Lost):
        async def read(self, register: str) -> bytes:
            raise RegisterRefused("no", register=register, code=2)

    link = _link(bench, Refusing(BusError("no route")), [])
    await link.renew()
    with pytest.raises(RegisterRefused, match=r"^no$"):
        await link.read("bias_x")
