"""The program as processes of their own."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

PROGRAM = Path(sys.executable).with_name("triaxcal")
DEADLINE_S = 180.0
MULTICAST = "239.74.163.2"


def _heed_interrupts() -> None:
    """Also where the tests themselves run in the background of a shell, or under nohup; without its terminal."""
    os.setsid()
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


class Process:
    """A running command; what it says on standard error is gathered as it comes."""

    def __init__(self, *arguments: Any) -> None:
        self._popen = subprocess.Popen(
            [PROGRAM, *map(str, arguments)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=_heed_interrupts,
        )
        self._said: dict[str, list[str]] = {"out": [], "err": []}
        streams = (("out", self._popen.stdout), ("err", self._popen.stderr))
        self._readers = [threading.Thread(target=self._read, args=of, daemon=True) for of in streams]
        for reader in self._readers:
            reader.start()

    def _read(self, name: str, stream: Any) -> None:
        for line in stream:
            self._said[name].append(line)

    @property
    def pid(self) -> int:
        return self._popen.pid

    @property
    def out(self) -> str:
        return "".join(self._said["out"])

    @property
    def err(self) -> str:
        return "".join(self._said["err"])

    @property
    def running(self) -> bool:
        return self._popen.poll() is None

    def send(self, number: signal.Signals) -> None:
        self._popen.send_signal(number)

    def wait(self) -> int:
        """The exit code, once all that was said has been read."""
        code = self._popen.wait(DEADLINE_S)
        for reader in self._readers:
            reader.join(DEADLINE_S)
        return code

    def says(self, words: str) -> None:
        """Waits until ``words`` are on standard error."""
        until(lambda: words in self.err or not self.running)
        assert words in self.err

    def end(self) -> None:
        if self.running:
            self._popen.kill()
        self._popen.wait()


def until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline, "the condition has not come about"
        time.sleep(0.02)


@pytest.fixture
def wait_until() -> Callable[[Callable[[], bool]], None]:
    return until


@pytest.fixture
def start() -> Iterator[Callable[..., Process]]:
    """Starts a command; whatever still runs at the end of the test is killed."""
    with contextlib.ExitStack() as stack:

        def run(*arguments: Any) -> Process:
            process = Process(*arguments)
            stack.callback(process.end)
            return process

        yield run


@pytest.fixture
def free_port() -> int:
    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))
        return int(bound.getsockname()[1])


@pytest.fixture(scope="session")
def multicast_fault() -> str | None:
    """Why multicast does not work on this machine; None where it does."""
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as there, socket.socket(type=socket.SOCK_DGRAM) as here:
            there.bind(("", 0))
            member = struct.pack("4s4s", socket.inet_aton(MULTICAST), socket.inet_aton("0.0.0.0"))
            there.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
            there.settimeout(2.0)
            here.sendto(b"hello", (MULTICAST, there.getsockname()[1]))
            return None if there.recv(16) == b"hello" else "something else came"
    except OSError as e:
        return str(e)
