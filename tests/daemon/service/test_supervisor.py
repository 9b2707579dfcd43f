"""What systemd hears, on a socket of the test's own."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.drivers.virtual_time import run, virtual
from triaxcald.service.supervisor import Supervisor


@pytest.fixture
def heard(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as bound:
        bound.bind(str(tmp_path / "notify"))
        bound.setblocking(False)
        yield bound


def all_of(heard: socket.socket) -> list[str]:
    found = []
    while True:
        try:
            found.append(heard.recv(4096).decode())
        except BlockingIOError:
            return found


def environment(heard: socket.socket, **more: str) -> dict[str, str]:
    return {"NOTIFY_SOCKET": heard.getsockname(), **more}


async def lives(supervisor: Supervisor, seconds: float) -> None:
    import asyncio

    async with supervisor.kept_informed(lambda: "2 of 2 units\nrecorded"):
        await asyncio.sleep(seconds)


def test_it_hears_that_the_service_is_up_that_it_lives_and_that_it_stops(heard: socket.socket) -> None:
    supervisor = Supervisor(environment(heard, WATCHDOG_USEC="30000000", WATCHDOG_PID=str(os.getpid())))
    run(lives(supervisor, 25.0))
    said = all_of(heard)
    assert said[0] == "READY=1"
    assert said[1:-1] == ["WATCHDOG=1\nSTATUS=2 of 2 units recorded"] * 3, "at 0, 10 and 20 s"
    assert said[-1] == "STOPPING=1"


def test_a_loop_that_hangs_gives_no_sign_of_life(heard: socket.socket) -> None:
    async def work(late_s: float) -> int:
        virtual().late_s = late_s
        await lives(Supervisor(environment(heard, WATCHDOG_USEC="3000000")), 7.5)
        return sum("WATCHDOG" in said for said in all_of(heard))

    assert run(work(0.0)) == 8
    assert run(work(100.0)) <= 2, "none of its own thread, which would not notice"


def test_a_watchdog_that_is_meant_for_another_process_is_not_this_ones(heard: socket.socket) -> None:
    assert Supervisor(environment(heard, WATCHDOG_USEC="3000000", WATCHDOG_PID="1")).watchdog_s is None
    assert Supervisor(environment(heard, WATCHDOG_USEC="3000000")).watchdog_s == 3.0


def test_a_supervisor_that_does_not_read_holds_nothing_up(heard: socket.socket) -> None:
    supervisor = Supervisor(environment(heard))
    for _ in range(10_000):  # more than any queue holds
        supervisor.tell(WATCHDOG="1")
    assert all_of(heard)


@pytest.mark.parametrize("address", ["", "/no/such/socket"])
def test_where_nobody_listens_nothing_fails(address: str) -> None:
    Supervisor({"NOTIFY_SOCKET": address}).tell(READY="1")


def test_an_abstract_address_is_one() -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as bound:
        bound.bind(f"\0triaxcal-test-{os.getpid()}")
        bound.settimeout(2.0)
        Supervisor({"NOTIFY_SOCKET": f"@triaxcal-test-{os.getpid()}"}).tell(READY="1")
        assert bound.recv(100) == b"READY=1"
