"""What a service owes to systemd: that it is up, that it lives, that it
stops (sd_notify(3))."""

from __future__ import annotations

import asyncio
import os
import socket
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager, suppress

_SHARE = 3.0
"""Of the watchdog's time a sign of life comes so many times: one that is late
is followed by another."""
_QUIET_S = 10.0
"""Without a watchdog the status is told so often."""


class Supervisor:
    """Who started this process, where it wants to hear of it; else nobody."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        self._address = environment.get("NOTIFY_SOCKET", "")
        meant_for = environment.get("WATCHDOG_PID", str(os.getpid()))
        watchdog_us = environment.get("WATCHDOG_USEC", "") if meant_for == str(os.getpid()) else ""
        self.watchdog_s = int(watchdog_us) / 1e6 if watchdog_us.isdigit() and int(watchdog_us) else None

    def tell(self, **said: str) -> None:
        """Each as a variable of its own; nowhere where nobody wants to hear, or
        nobody reads: nothing waits for it."""
        if not self._address:
            return
        address = "\0" + self._address[1:] if self._address.startswith("@") else self._address
        text = "\n".join(f"{name}={' '.join(value.split())}" for name, value in said.items())
        with (
            suppress(OSError),
            socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK) as out,
        ):
            out.sendto(text.encode(), address)

    @asynccontextmanager
    async def kept_informed(self, status: Callable[[], str]) -> AsyncIterator[None]:
        """That the service is up, then again and again that it lives: from the
        event loop, so that a loop that hangs is found out."""

        async def live() -> None:
            while True:
                self.tell(WATCHDOG="1", STATUS=status())
                await asyncio.sleep(_QUIET_S if self.watchdog_s is None else self.watchdog_s / _SHARE)

        self.tell(READY="1")
        living = asyncio.ensure_future(live())
        try:
            yield
        finally:
            living.cancel()
            self.tell(STOPPING="1")
