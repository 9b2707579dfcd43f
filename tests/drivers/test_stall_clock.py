"""A time-out runs out where this process looked and found nothing, and not where it was kept from looking."""

from __future__ import annotations

import asyncio
import math
import socket
from collections.abc import Callable

import pytest

from tests.drivers.virtual_time import VirtualLoop, run, virtual
from triaxcal_drivers.stall_clock import IDLE_TICK_S, MOST_S, TICK_S, StallTolerantClock, StallTolerantTimer

HELD_UP_S = 30.0


def test_time_between_looks_counts_as_it_passes_up_to_the_most() -> None:
    timer = StallTolerantTimer(100.0, most_s=0.5)
    assert timer.update(100.2) == pytest.approx(0.2)
    assert timer.update(100.6) == pytest.approx(0.6)
    assert timer.update(200.0) == pytest.approx(1.1)
    assert timer.at(200.1) == pytest.approx(1.2)
    assert timer.at(999.0) == pytest.approx(1.6)
    assert timer.update(200.1) == pytest.approx(1.2), "what was only asked for is not counted"
    assert timer.update(200.0) == pytest.approx(1.2), "a clock that goes back takes nothing away"


def test_on_an_idle_machine_a_silence_is_told_when_the_time_is_up() -> None:
    async def work() -> float:
        loop, clock = virtual(), StallTolerantClock(asyncio.get_running_loop())
        begun_s = loop.time()
        with pytest.raises(TimeoutError):
            async with clock.timeout(1.0):
                await asyncio.Event().wait()
        return loop.time() - begun_s

    assert 1.0 <= run(work()) <= 1.0 + 2 * TICK_S


@pytest.mark.parametrize("late_s", [0.1, 1.0, 10.0])
def test_a_loop_that_is_late_each_time_tells_a_silence_after_so_many_turns(late_s: float) -> None:
    async def work() -> float:
        loop, clock = virtual(), StallTolerantClock(asyncio.get_running_loop())
        loop.late_s, begun_s = late_s, loop.time()
        with pytest.raises(TimeoutError):
            async with clock.timeout(1.0):
                await asyncio.Event().wait()
        return (loop.time() - begun_s) / (late_s + TICK_S)

    turns = 1.0 / MOST_S
    assert turns - 1 <= run(work()) <= turns + 2


@pytest.mark.parametrize("at_s", [0.0, 0.5, 0.99, 1.0])
def test_what_waits_unread_when_a_loop_comes_back_late_is_in_time(at_s: float) -> None:
    async def work() -> bytes:
        loop, clock = virtual(), StallTolerantClock(asyncio.get_running_loop())
        here, there = socket.socketpair()
        with here, there:
            here.setblocking(False)
            loop.call_later(at_s, _held_up, loop, lambda: there.send(b"reply"))
            async with clock.timeout(1.0):
                return await loop.sock_recv(here, 16)

    assert run(work()) == b"reply"


def _held_up(loop: VirtualLoop, meanwhile: Callable[[], object]) -> None:
    loop.now_s += HELD_UP_S
    meanwhile()


def test_a_cancellation_goes_through_a_time_out() -> None:
    async def work() -> None:
        clock = StallTolerantClock(asyncio.get_running_loop())

        async def wait() -> None:
            async with clock.timeout(1.0):
                await asyncio.Event().wait()

        waiting = asyncio.create_task(wait())
        await asyncio.sleep(0.5)
        waiting.cancel()
        with pytest.raises(asyncio.CancelledError):
            await waiting

    run(work())


def test_where_nobody_looks_any_more_every_time_out_has_run_out() -> None:
    async def work() -> None:
        loop, clock = virtual(), StallTolerantClock(asyncio.get_running_loop())
        loop.call_later(0.5, clock.close)
        for _ in range(2):
            with pytest.raises(TimeoutError):
                async with clock.timeout(3600.0):
                    await asyncio.Event().wait()
        assert clock.now_s() == math.inf
        assert loop.time() < 1001.0

    run(work())
    loop = asyncio.new_event_loop()
    clock = StallTolerantClock(loop)
    assert clock.now_s() < math.inf
    loop.close()
    assert clock.now_s() == math.inf


def test_while_nobody_waits_the_loop_wakes_up_seldom_and_the_clock_goes_on_all_the_same() -> None:
    async def work() -> tuple[int, float]:
        loop, clock, turns = virtual(), StallTolerantClock(asyncio.get_running_loop()), [0]
        tick = clock._tick

        def counted() -> None:
            turns[0] += 1
            tick()

        clock._tick = counted  # type: ignore[method-assign]
        begun_s, shown_s = loop.time(), clock.now_s()
        await asyncio.sleep(10.0)
        assert clock.now_s() - shown_s == pytest.approx(loop.time() - begun_s, abs=IDLE_TICK_S)
        idle = turns[0]
        with clock.thread_waiting():
            await asyncio.sleep(10.0)
        return idle, turns[0] - idle

    idle, waiting = run(work())
    assert idle == pytest.approx(10.0 / IDLE_TICK_S, abs=3)
    assert waiting == pytest.approx(10.0 / TICK_S, abs=3)


def test_a_time_out_that_begins_while_the_loop_wakes_up_seldom_is_as_exact_as_any() -> None:
    async def work() -> float:
        loop, clock = virtual(), StallTolerantClock(asyncio.get_running_loop())
        await asyncio.sleep(10.03)
        begun_s = loop.time()
        with pytest.raises(TimeoutError):
            async with clock.timeout(0.2):
                await asyncio.Event().wait()
        return loop.time() - begun_s

    assert 0.2 <= run(work()) <= 0.2 + 2 * TICK_S
