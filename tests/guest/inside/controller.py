"""A CAN controller of which the test is the bus: the kernel's slcan driver, whose adapter is a pseudo-terminal."""

from __future__ import annotations

import fcntl
import os
import pty
import select
import socket
import struct
import subprocess
import threading
import tty
from contextlib import suppress

from tests.guest.inside.witness import wait_until

SET_DISCIPLINE, SLCAN = 0x5423, 17  # TIOCSETD, N_SLCAN


def interfaces() -> set[str]:
    return {name for _, name in socket.if_nameindex()}


class Controller:
    """At 500 kbit/s, up. ``says`` is what the adapter writes, in the words of the serial protocol."""

    def __init__(self, adapter: int, line: int, name: str) -> None:
        self._adapter, self._line, self.name = adapter, line, name
        self._reading = threading.Thread(target=self._take)
        self._jam = os.eventfd(0)
        self._reading.start()

    def _take(self) -> None:
        """What the driver sends; it goes on when that has been read."""
        while self._jam not in select.select([self._adapter, self._jam], [], [])[0]:
            os.read(self._adapter, 4096)

    @classmethod
    def attached(cls) -> Controller:
        before = interfaces()
        adapter, line = pty.openpty()
        tty.setraw(line)
        tty.setraw(adapter)
        fcntl.ioctl(line, SET_DISCIPLINE, struct.pack("i", SLCAN))
        (name,) = interfaces() - before
        made = cls(adapter, line, name)
        made.ip("type", "can", "bitrate", "500000")
        made.ip("up")
        return made

    def ip(self, *words: str) -> None:
        subprocess.run(["ip", "link", "set", self.name, *words], check=True, capture_output=True, text=True)

    def says(self, line: str) -> None:
        os.write(self._adapter, line.encode() + b"\r")

    def jam(self) -> None:
        """The adapter takes no more, but for what is on its way."""
        os.eventfd_write(self._jam, 1)
        self._reading.join()

    def end(self) -> None:
        """In order: a link that is up sends one more command, and waits a second for it to be read."""
        with suppress(subprocess.CalledProcessError):  # unplugged before
            self.ip("down")
        self.unplug()

    def unplug(self) -> None:
        self.jam()
        for end in (self._adapter, self._line):
            with suppress(OSError):  # unplugged before
                os.close(end)
        wait_until(lambda: self.name not in interfaces())
