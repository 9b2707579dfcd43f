"""Interfaces to test on, and what judges them."""

from __future__ import annotations

import itertools
import os
import socket
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.guest.inside.controller import Controller
from tests.guest.inside.witness import PATIENCE_S, Candump, Seen, Sender, listeners, seen, wait_until
from triaxcal_drivers.can.socketcan import SocketCan, open_socketcan

STAMPED, STAMP_NS = 1, 35  # SO_TIMESTAMPNS
numbers = itertools.count()


@pytest.fixture(scope="session", autouse=True)
def _stamping() -> Iterator[None]:
    """The kernel begins to stamp what comes some time after the first socket that wants it, and until then stamps what
    is read: with this one it never has to begin."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.setsockopt(socket.SOL_SOCKET, STAMP_NS, STAMPED)
        yield


def ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True, text=True)


@pytest.fixture
def vcan() -> Iterator[str]:
    """A virtual interface with CAN FD, up."""
    name = f"vcan{next(numbers)}"
    ip("link", "add", "dev", name, "mtu", "72", "up", "type", "vcan")
    yield name
    subprocess.run(["ip", "link", "del", name], capture_output=True)


@pytest.fixture
def opened() -> Iterator[Callable[..., SocketCan]]:
    """Our receiver on an interface, closed when the test ends."""
    made: list[SocketCan] = []

    def open_(name: str, bitrate: int | None = None, **options: Any) -> SocketCan:
        made.append(open_socketcan(name, options, bitrate))
        return made[-1]

    yield open_
    for adapter in made:
        adapter.close()


@pytest.fixture
def sender(vcan: str) -> Iterator[Sender]:
    made = Sender(vcan)
    yield made
    made.close()


@pytest.fixture
def candump() -> Callable[[str, int], Candump]:
    return Candump


@pytest.fixture
def witness(tmp_path: Path) -> Iterator[Callable[[str], Callable[[], list[Seen]]]]:
    """Lets candump log an interface from now on, also when that goes down; what it gives stops it, and has all that it
    saw."""
    running: list[subprocess.Popen[bytes]] = []

    def watch(name: str) -> Callable[[], list[Seen]]:
        log, before = tmp_path / "candump.log", listeners(name)
        with open(log, "w") as out:
            process = subprocess.Popen(["candump", "-D", "-L", "-r", "8000000", name], stdout=out)
        running.append(process)
        wait_until(lambda: listeners(name) > before)

        def stopped() -> list[Seen]:
            process.terminate()
            process.wait(PATIENCE_S)
            return [seen(line) for line in log.read_text().splitlines()]

        return stopped

    yield watch
    for process in running:
        process.kill()
        process.wait()


@pytest.fixture
def controller() -> Iterator[Controller]:
    """An interface with a controller: the kernel's slcan on a pseudo-terminal. It appears in the machine's own network,
    whoever makes it, and so not on a host."""
    if os.environ.get("TRIAXCAL_GUEST") != "inside":
        pytest.skip("slcan is tested in a guest alone")
    made = Controller.attached()
    yield made
    made.end()
