"""Follows the events of a run, from a file that grows, a pipe or standard input."""

from __future__ import annotations

import asyncio
import os
import stat
import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from http.client import HTTPException
from pathlib import Path
from urllib.request import urlopen

from triaxcald.errors import InputError
from triaxcald.printable import printable
from triaxcald.simulation.operating import Operator
from triaxcald.simulation.time_base import TimeBase
from triaxcald.simulation.unit import ReferenceUnit

STDIN = "-"
CHUNK, LINE_MOST = 1 << 16, 1 << 22
"""Bytes. The longest event is that of an outcome; no document has more than 4 MiB."""
LOOK_S = 0.02
"""By the wall clock, from one look at a file to the next."""
TICK_S = 0.1
"""Of the units' time: how exactly the operator keeps the reaction time of a switch."""
EVENTS = "/api/1/events"
DEAD_S, AGAIN_S = 10.0, 0.5
"""A service that says nothing for so long is gone: it gives a sign of life every two
seconds. Then the pause before the next connection."""
TOLD_EACH = 10
"""Ignored lines that are told one by one; then at each power of ten."""


class Lines:
    """Splits bytes into lines without their ends. A line of more than `LINE_MOST`
    bytes is cut there."""

    def __init__(self) -> None:
        self._held = b""

    def feed(self, data: bytes) -> list[bytes]:
        *whole, self._held = (self._held + data).split(b"\n")
        if len(self._held) > LINE_MOST:
            whole.append(self._held)
            self._held = b""
        return whole

    def rest(self) -> list[bytes]:
        """The last line, where it has no end."""
        held, self._held = self._held, b""
        return [held] if held else []


class Source:
    """The bytes of ``name``: of a file that grows, also one that is written anew or
    replaced; of a FIFO, whose writers may come and go; of anything else, such as
    standard input, to its end.

    Raises InputError if it cannot be read.
    """

    def __init__(self, name: str) -> None:
        self.name = "standard input" if name == STDIN else name
        self._path = None if name == STDIN else Path(name)
        try:
            self._descriptor = sys.stdin.fileno() if self._path is None else _opened(self._path)
            kind = os.fstat(self._descriptor).st_mode
        except (OSError, ValueError, AttributeError) as e:  # standard input may be closed
            raise InputError(f"{self.name}: {getattr(e, 'strerror', None) or 'cannot be read'}") from e
        if stat.S_ISDIR(kind):
            raise InputError(f"{self.name}: Is a directory")
        self._grows = self._path is not None and stat.S_ISREG(kind)
        self._returns = self._path is not None and stat.S_ISFIFO(kind)

    def read(self, tell: Callable[[bytes | None], None]) -> None:
        """Tell the bytes as they come, and None at an end; returns where nothing more
        can come. Blocks."""
        told = False
        while True:
            try:
                data = os.read(self._descriptor, CHUNK)
            except OSError:
                data = b""
            if data:
                tell(data)
                told = True
            elif self._grows:
                time.sleep(LOOK_S)
                self._look()
            elif self._returns:
                if told:
                    tell(None)
                    told = False
                time.sleep(LOOK_S)
            else:
                tell(None)
                return

    def _look(self) -> None:
        """Begin anew where the file is another one, or shorter than what was read."""
        assert self._path is not None
        with suppress(OSError):
            here, there = os.fstat(self._descriptor), os.stat(self._path)
            if not os.path.samestat(here, there):
                descriptor = _opened(self._path)
                os.close(self._descriptor)
                self._descriptor = descriptor
            elif here.st_size < os.lseek(self._descriptor, 0, os.SEEK_CUR):
                os.lseek(self._descriptor, 0, os.SEEK_SET)


class ServiceEvents:
    """The events of a station's service at ``address``, to which it connects again and
    again; as lines, like a `Source`. ``address`` is that of the service or of its
    `/events`."""

    def __init__(self, address: str) -> None:
        self.name = address
        self._address = address if address.rstrip("/").endswith("/events") else f"{address.rstrip('/')}{EVENTS}"
        self._after: str | None = None

    def read(self, tell: Callable[[bytes | None], None]) -> None:
        """Tell each event as a line, for ever. Blocks."""
        while True:
            with suppress(OSError, ValueError, HTTPException):
                self._listen(tell)
            time.sleep(AGAIN_S)

    def _listen(self, tell: Callable[[bytes | None], None]) -> None:
        """Raises OSError, HTTPException at the end of the connection; ValueError of an
        answer that is none."""
        query = "" if self._after is None else f"?after={self._after}"
        with urlopen(self._address + query, timeout=DEAD_S) as answer:
            kind, number = b"", b""
            for line in iter(lambda: answer.readline(LINE_MOST), b""):
                field, _, value = line.rstrip(b"\r\n").partition(b":")
                value = value.removeprefix(b" ")
                if field == b"event":
                    kind = value
                elif field == b"id":
                    number = value
                elif field == b"data" and kind == b"state" and self._after is None:
                    self._after = str(int(number))
                elif field == b"data" and kind == b"event":
                    tell(value + b"\n")
                    self._after = str(int(number))
                elif not field:
                    kind = b""


def _opened(path: Path) -> int:
    """A FIFO without a writer opens too."""
    nonblocking = getattr(os, "O_NONBLOCK", 0)
    descriptor = os.open(path, os.O_RDONLY | nonblocking)
    if nonblocking:
        os.set_blocking(descriptor, True)
    return descriptor


async def follow(
    source: Source | ServiceEvents,
    operator: Operator,
    units: Mapping[str, ReferenceUnit],
    time_base: TimeBase,
    say: Callable[[str], None],
) -> None:
    """Let the operator do what the events say, for ever. ``say`` is told of ignored
    lines, of slots that are not here, and of the end of the events."""
    loop, lines = asyncio.get_running_loop(), Lines()

    def take(whole: list[bytes]) -> None:
        known = len(operator.strangers)
        for line in whole:
            if line.strip() and not operator.read(line, time_base.now_s()) and _is_told(operator.ignored):
                say(f"{source.name}: a line that is no event of a run is ignored, {operator.ignored} so far")
        for slot in map(printable, operator.strangers[known:]):
            say(f"{source.name}: no unit here has the slot {slot}; the slots are {', '.join(operator.mounted)}")

    def come(data: bytes | None) -> None:
        if data is not None:
            take(lines.feed(data))
            return
        take(lines.rest())
        operator.ended(time_base.now_s())
        say(f"{source.name}: the events have ended, {operator.ignored} lines were ignored; the units are served on")

    def tell(data: bytes | None) -> None:
        with suppress(RuntimeError):  # the loop has ended
            loop.call_soon_threadsafe(come, data)

    # Not a thread of the executor: nothing ends a read that waits for a writer.
    threading.Thread(target=source.read, args=(tell,), daemon=True).start()
    while True:
        now_s = time_base.now_s()
        for switch in operator.due(now_s):
            unit = units[switch.slot]
            (unit.switch_on if switch.on else unit.switch_off)(now_s)
        await time_base.wait_until(now_s + TICK_S)


def _is_told(ignored: int) -> bool:
    return ignored <= TOLD_EACH or str(ignored).strip("0") == "1"
