"""Stall-tolerant time-outs: time in which this process was kept from running does
not count.

A process that gets no processor, or computes for long, returns to an event loop
with unread replies. By the wall clock they are late, but the device was in time.
This clock therefore advances by `MOST_S` at most between two turns of the event
loop, so a time-out expires only after many turns that found nothing. On an idle
machine it equals the wall clock.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress

TICK_S = 0.02
"""Period of the ticks: some ten in the shortest time-out of a bus."""
MOST_S = 0.05
"""Longest time that one turn of the loop counts. The ticks of an idle machine are
never so late, so the clock loses no time there."""


IDLE_TICK_S, IDLE_MOST_S = 0.1, 0.13
"""The same while nobody waits: no time-out can expire then, and a busy recorder
wakes up for its batches alone."""


class StallTolerantTimer:
    """Sums the time between updates, each interval capped at ``most_s``. Pure: time
    is an argument [s]."""

    def __init__(self, now_s: float, most_s: float) -> None:
        self.most_s = most_s
        self._updated = now_s, 0.0  # one tuple: another thread sees both values or neither

    def at(self, now_s: float) -> float:
        """Time counted by ``now_s`` [s]; does not update the timer."""
        updated_s, counted_s = self._updated
        return counted_s + min(max(now_s - updated_s, 0.0), self.most_s)

    def update(self, now_s: float) -> float:
        """Time counted by ``now_s`` [s], from which the next interval begins."""
        counted_s = self.at(now_s)
        self._updated = now_s, counted_s
        return counted_s


class StallTolerantClock:
    """The clock of one event loop, from its construction until `close`.

    Every time-out expires once the clock or its loop is closed.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self.loop = loop
        self._timer = StallTolerantTimer(loop.time(), MOST_S)
        self._closed = False
        self._running: dict[asyncio.Timeout, float] = {}
        self._threads = 0  # threads that wait by this clock
        self._idle = False
        self._next = loop.call_later(TICK_S, self._tick)

    def now_s(self) -> float:
        """Time of this clock [s]; callable from any thread."""
        if self._closed or self.loop.is_closed():
            return math.inf
        return self._timer.at(self.loop.time())

    def close(self) -> None:
        self._closed = True
        self._next.cancel()
        self._expire(math.inf)

    @asynccontextmanager
    async def timeout(self, seconds: float) -> AsyncIterator[None]:
        """As `asyncio.timeout`; data that is there when the time expires is still in
        time."""
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
    def thread_waiting(self) -> Iterator[None]:
        """Keeps the short ticks while another thread waits by `now_s`."""
        self._threads += 1
        with suppress(RuntimeError):  # the loop has ended
            self.loop.call_soon_threadsafe(self._wake)
        try:
            yield
        finally:
            self._threads -= 1

    def _tick(self) -> None:
        self._expire(self._timer.update(self.loop.time()))
        self._idle = not self._running and not self._threads
        self._timer.most_s = IDLE_MOST_S if self._idle else MOST_S
        self._next = self.loop.call_later(IDLE_TICK_S if self._idle else TICK_S, self._tick)

    def _wake(self) -> None:
        """Return to the short ticks, since somebody waits."""
        if self._idle and not self._closed:
            self._next.cancel()
            self._tick()

    def _expire(self, now_s: float) -> None:
        for timeout in [t for t, due_s in self._running.items() if not due_s > now_s]:
            del self._running[timeout]
            # Expire in the next turn: data that this turn has read from the bus
            # reaches its waiter first.
            timeout.reschedule(self.loop.time())
