"""The simulated unit's time: the wall clock times a speed, or a clock that a
test moves by hand."""

from __future__ import annotations

import asyncio
import heapq
import itertools
import time
from collections.abc import Callable
from typing import Protocol


class TimeBase(Protocol):
    def wait_for_reader(self, behind: Callable[[], bool]) -> None:
        """``behind`` says from now on whether much of what a unit has sent is not
        fetched yet. Units that share the clock each say so."""

    def now_s(self) -> float:
        """Unit time in seconds; never goes back."""

    def later_s(self, unit_s: float, period_s: float) -> float:
        """A period later; where the unit is so fast that the machine would do
        little but wake up, some periods."""

    async def wait_until(self, unit_s: float) -> None:
        """Returns once ``now_s()`` has reached ``unit_s``; at once where it has
        already."""


WAKE_S = 0.004
"""By the wall clock. A unit twenty times as fast as life then sends eight
samples at a time, and still as often as an adapter delivers its frames."""


class RealTimeBase:
    """Starts at 0 when made and runs ``speed`` times as fast as the wall clock,
    whatever a reader does."""

    def __init__(self, speed: float = 1.0) -> None:
        if not speed > 0:
            raise ValueError(f"speed must be above 0, not {speed}")
        self.speed = speed
        self._origin_s = time.monotonic()

    def wait_for_reader(self, behind: Callable[[], bool]) -> None:
        pass

    def now_s(self) -> float:
        return (time.monotonic() - self._origin_s) * self.speed

    def later_s(self, unit_s: float, period_s: float) -> float:
        return unit_s + max(period_s, WAKE_S * self.speed)

    async def wait_until(self, unit_s: float) -> None:
        while (left := unit_s - self.now_s()) > 0:
            await asyncio.sleep(left / self.speed)


class ElasticTimeBase:
    """At most ``speed`` times as fast as the wall clock, and stretched where
    machine or reader do not keep up.

    It goes on by no more than ``step_s`` from one look to the next, so that a
    process that was kept from looking has nothing to make up for; and while a
    reader is behind no faster than the wall clock, so that nothing overflows
    that would not in real time. It does not stand still then: a unit that
    nobody reads still stores and restarts.
    """

    def __init__(self, speed: float = 1.0, step_s: float = 0.05) -> None:
        if not (speed > 0 and step_s > 0):
            raise ValueError(f"speed and step must be above 0, not {speed} and {step_s}")
        self.speed, self.step_s = speed, step_s
        self._now_s = 0.0
        self._looked_s = time.monotonic()
        self._behind: list[Callable[[], bool]] = []

    def wait_for_reader(self, behind: Callable[[], bool]) -> None:
        self._behind.append(behind)

    def now_s(self) -> float:
        looked_s = time.monotonic()
        self._now_s += min((looked_s - self._looked_s) * self._rate(), self.step_s)
        self._looked_s = looked_s
        return self._now_s

    def later_s(self, unit_s: float, period_s: float) -> float:
        return unit_s + max(period_s, min(WAKE_S * self.speed, self.step_s))

    async def wait_until(self, unit_s: float) -> None:
        while (left := unit_s - self.now_s()) > 0:  # half a step: to wake a little late costs no time then
            await asyncio.sleep(min(left, self.step_s / 2) / self._rate())

    def _rate(self) -> float:
        return min(self.speed, 1.0) if any(behind() for behind in self._behind) else self.speed


class SteppedTimeBase:
    """Stands still until a test moves it; whoever waits is woken in the order
    of the times waited for."""

    def __init__(self, start_s: float = 0.0) -> None:
        self._now_s = start_s
        self._waiting: list[tuple[float, int, asyncio.Future[None]]] = []
        self._order = itertools.count()

    def wait_for_reader(self, behind: Callable[[], bool]) -> None:
        pass

    def now_s(self) -> float:
        return self._now_s

    def later_s(self, unit_s: float, period_s: float) -> float:
        return unit_s + period_s

    async def wait_until(self, unit_s: float) -> None:
        if unit_s <= self._now_s:
            return
        woken = asyncio.get_running_loop().create_future()
        heapq.heappush(self._waiting, (unit_s, next(self._order), woken))
        await woken

    async def advance_to(self, unit_s: float) -> None:
        """Move to ``unit_s``, stopping at every time somebody waits for, so
        that loops keep their period."""
        await self._let_others_run()
        while self._waiting and self._waiting[0][0] <= unit_s:
            due_s, _, woken = heapq.heappop(self._waiting)
            if not woken.done():  # a waiter that was cancelled is done
                self._now_s = max(self._now_s, due_s)
                woken.set_result(None)
                await self._let_others_run()
        self._now_s = max(self._now_s, unit_s)
        await self._let_others_run()

    async def advance(self, by_s: float) -> None:
        await self.advance_to(self._now_s + by_s)

    @staticmethod
    async def _let_others_run() -> None:
        for _ in range(5):  # the woken task, and those that it wakes in turn
            await asyncio.sleep(0)
