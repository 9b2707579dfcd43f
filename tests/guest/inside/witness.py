"""What judges the receiver: candump, and sockets of the tests' own."""

from __future__ import annotations

import re
import socket
import struct
import subprocess
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

from triaxcal_drivers.can.adapter import Frame
from triaxcal_drivers.can.socketcan import SocketCan
from triaxcal_drivers.interface import RawFlag

PATIENCE_S = 120.0  # of a busy machine, whose processor the guest shares
EXTENDED, REMOTE, ERROR = 0x8000_0000, 0x4000_0000, 0x2000_0000
LINE = re.compile(r"\((\d+)\.(\d{6})\) (\S+) ([0-9A-F]+)#(#([0-9A-F]))?(R?)([0-9A-F]*)")


class Seen(NamedTuple):
    """A frame in candump's words; ``word`` the identifier with the kernel's three flags, ``fd`` the flags of a CAN FD
    frame or None, a remote frame's data the zeros that it asks for."""

    time_us: int
    word: int
    fd: int | None
    data: bytes


def seen(line: str) -> Seen:
    """A line of candump's log format."""
    matched = LINE.match(line)
    assert matched is not None, line
    seconds, microseconds, _, identifier, _, fd, remote, rest = matched.groups()
    word = int(identifier, 16)
    if len(identifier) == 8 and not word & ERROR:
        word |= EXTENDED
    data = bytes(int(rest or "0", 16)) if remote else bytes.fromhex(rest)
    return Seen(
        int(seconds) * 1_000_000 + int(microseconds),
        word | (REMOTE if remote else 0),
        None if fd is None else int(fd, 16) & 3,
        data,
    )


def wait_until(true: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not true():
        assert time.monotonic() < deadline_s, "it did not happen"
        time.sleep(0.005)


def listeners(name: str) -> int:
    """Raw sockets that take the data frames of an interface."""
    lists = Path("/proc/net/can").glob("rcvlist_*")
    return sum(line.split()[:1] == [name] for path in lists if path.name != "rcvlist_err" for line in _lines(path))


def _lines(path: Path) -> list[str]:
    return path.read_text().splitlines()


class Candump:
    """Takes all frames of an interface, error frames too, from when it is made until it has ``count``."""

    def __init__(self, name: str, count: int) -> None:
        before = listeners(name)
        command = ["candump", "-L", "-r", "8000000", "-n", str(count), f"{name},0:0,#FFFFFFFF"]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        wait_until(lambda: listeners(name) > before)

    def frames(self) -> list[Seen]:
        out, err = self._process.communicate(timeout=PATIENCE_S)
        assert self._process.returncode == 0, err
        return [seen(line) for line in out.splitlines()]


class Sender:
    """A raw socket of the test's own."""

    def __init__(self, name: str) -> None:
        self._socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        self._socket.bind((name,))

    def send(self, word: int, data: bytes = b"") -> None:
        self._socket.send(struct.pack("=IB3x8s", word, len(data), data))

    def count(self, word: int, numbers: Iterable[int]) -> None:
        for number in numbers:
            self.send(word, struct.pack("<Q", number))

    def close(self) -> None:
        self._socket.close()


def words_of(frame: Frame) -> Seen:
    """A received frame as candump would have it."""
    flags = RawFlag(frame.flags)
    word = frame.source | EXTENDED * (RawFlag.EXTENDED_ID in flags) | ERROR * (RawFlag.ERROR in flags)
    if RawFlag.FD not in flags:
        return Seen(frame.time_ns // 1000, word | REMOTE * (RawFlag.REMOTE in flags), None, frame.data)
    fd = (RawFlag.BIT_RATE_SWITCH in flags) | 2 * (RawFlag.REMOTE in flags)
    return Seen(frame.time_ns // 1000, word, fd, frame.data)


def received(adapter: SocketCan, count: int) -> list[Frame]:
    """As many frames, or those that there are."""
    frames: list[Frame] = []
    while len(frames) < count and (more := adapter.receive(5.0)):
        frames += more
    return frames


def number(frame: Frame) -> int:
    """That `Sender.count` gave it."""
    return int.from_bytes(frame.data, "little")
