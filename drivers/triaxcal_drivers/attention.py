"""Time-outs that count attention: time in which this process looked, and not
that in which it was kept from it.

A process that gets no processor, or computes for long, comes back to an event
loop with replies waiting unread. By the wall clock they are late; the device
was not. So a silence is measured by a clock that goes on no further than
`MOST_S` from one turn of the event loop to the next: it runs out only where the
loop has gone round often, and found nothing each time. On a machine with time
to spare it keeps to the wall clock.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress

TICK_S = 0.02
"""The loop is looked at so often: some ten times in the shortest time-out that
a bus is given."""
MOST_S = 0.05
"""A turn of the loop counts no more than this: an idle machine is never so
late, so that nothing is lost there."""


IDLE_TICK_S, IDLE_MOST_S = 0.1, 0.13
"""The same while nobody waits for anything: nothing can run out then, and a
recorder that is given one batch after the other wakes up for them alone."""


class Looks:
    """Sums the time between looks, each interval no more than ``most_s``. Pure:
    time is an argument [s]."""

    def __init__(self, now_s: float, most_s: float) -> None:
        self.most_s = most_s
        self._looked = now_s, 0.0  # one value, so that another thread sees both or neither

    def at(self, now_s: float) -> float:
        """What has been counted by now, without a look."""
        looked_s, counted_s = self._looked
        return counted_s + min(max(now_s - looked_s, 0.0), self.most_s)

    def look(self, now_s: float) -> float:
        counted_s = self.at(now_s)
        self._looked = now_s, counted_s
        return counted_s


class Attention:
    """The attention of one event loop as a clock, from when it is made until
    `close`.

    Once it is closed, or its loop is, every time-out has run out: nobody looks
    any more.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self.loop = loop
        self._looks = Looks(loop.time(), MOST_S)
        self._closed = False
        self._running: dict[asyncio.Timeout, float] = {}
        self._threads = 0  # that wait
        self._idle = False
        self._next = loop.call_later(TICK_S, self._tick)

    def now_s(self) -> float:
        """From any thread."""
        if self._closed or self.loop.is_closed():
            return math.inf
        return self._looks.at(self.loop.time())

    def close(self) -> None:
        self._closed = True
        self._next.cancel()
        self._expire(math.inf)

    @asynccontextmanager
    async def timeout(self, seconds: float) -> AsyncIterator[None]:
        """As `asyncio.timeout`. What is there when the time runs out still
        counts as in time."""
        async with asyncio.timeout(None) as inner:
            self._running[inner] = self.now_s() + seconds
            self._wake()
            if self._closed:
                self._expire(math.inf)
            try:
                yield
            finally:
                self._running.pop(inner, None)

    @contextmanager
    def watched(self) -> Iterator[None]:
        """While another thread waits by `now_s`."""
        self._threads += 1
        with suppress(RuntimeError):  # the loop has ended
            self.loop.call_soon_threadsafe(self._wake)
        try:
            yield
        finally:
            self._threads -= 1

    def _tick(self) -> None:
        self._expire(self._looks.look(self.loop.time()))
        self._idle = not self._running and not self._threads
        self._looks.most_s = IDLE_MOST_S if self._idle else MOST_S
        self._next = self.loop.call_later(IDLE_TICK_S if self._idle else TICK_S, self._tick)

    def _wake(self) -> None:
        """Somebody waits: the loop is looked at often again."""
        if self._idle and not self._closed:
            self._next.cancel()
            self._tick()

    def _expire(self, now_s: float) -> None:
        for timeout in [t for t, due_s in self._running.items() if not due_s > now_s]:
            del self._running[timeout]
            # In the next turn: what this one has read from the bus reaches
            # first who waits for it.
            timeout.reschedule(self.loop.time())
