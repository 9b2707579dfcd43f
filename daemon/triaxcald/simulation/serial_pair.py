"""A serial line without hardware: two pseudo-terminals, each the other's far
end."""

from __future__ import annotations

import asyncio
import os
from collections.abc import AsyncIterator
from contextlib import ExitStack, asynccontextmanager, suppress
from pathlib import Path

from triaxcal_drivers.errors import BusError


@asynccontextmanager
async def pty_pair(link: Path | None = None) -> AsyncIterator[tuple[str, str]]:
    """Paths of the two ends. Both open as serial ports, in this process or
    another; parity and baud rate are taken and mean nothing. ``link`` becomes a
    symbolic link to the second end while the pair is open.

    What an end does not read in time is lost, as on a line. Raises BusError
    where ``link`` is in the way or cannot be made.
    """
    import tty  # which Windows has not

    loop = asyncio.get_running_loop()
    with ExitStack() as stack:
        masters, paths = [], []
        for _ in range(2):
            master, slave = os.openpty()
            # The slave stays open here: a master whose slave nobody holds reads
            # as an error.
            stack.callback(os.close, master)
            stack.callback(os.close, slave)
            tty.setraw(slave)
            os.set_blocking(master, False)
            masters.append(master)
            paths.append(os.ttyname(slave))
        for near, far in (masters, masters[::-1]):
            loop.add_reader(near, _pump, near, far)
            stack.callback(loop.remove_reader, near)
        if link is not None:
            try:
                if link.is_symlink():  # left behind by a process that was killed
                    link.unlink()
                link.symlink_to(paths[1])
            except OSError as e:
                raise BusError(f"cannot link a serial line to {link}: {e.strerror}") from e
            stack.callback(link.unlink, missing_ok=True)
        yield paths[0], paths[1]


def _pump(near: int, far: int) -> None:
    with suppress(BlockingIOError):  # the far end's buffer is full: nobody reads there
        os.write(far, os.read(near, 4096))
