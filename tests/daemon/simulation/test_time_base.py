import asyncio

import pytest

from triaxcald.simulation.time_base import RealTimeBase, SteppedTimeBase


async def test_nobody_is_woken_before_the_time_they_wait_for() -> None:
    base = SteppedTimeBase()
    waiting = asyncio.create_task(base.wait_until(1.0))
    await base.advance_to(0.999)
    assert not waiting.done()
    await base.advance_to(1.0)
    assert waiting.done()


async def test_a_loop_keeps_its_period_through_one_large_step() -> None:
    base, seen = SteppedTimeBase(), []

    async def tick() -> None:
        while True:
            await base.wait_until(base.now_s() + 0.25)
            seen.append(base.now_s())

    task = asyncio.create_task(tick())
    await base.advance_to(1.0)
    task.cancel()
    assert seen == [0.25, 0.5, 0.75, 1.0]


async def test_waiters_wake_in_the_order_of_their_times_and_not_of_their_asking() -> None:
    base, woken = SteppedTimeBase(), []

    async def wait(unit_s: float) -> None:
        await base.wait_until(unit_s)
        woken.append(unit_s)

    async with asyncio.TaskGroup() as group:
        for unit_s in (3.0, 1.0, 2.0):
            group.create_task(wait(unit_s))
        await base.advance(3.0)
    assert woken == [1.0, 2.0, 3.0]


async def test_a_cancelled_waiter_does_not_hold_up_the_others() -> None:
    base = SteppedTimeBase()
    first, second = (asyncio.create_task(base.wait_until(1.0)) for _ in range(2))
    await base.advance_to(0.5)
    first.cancel()
    await base.advance_to(2.0)
    assert second.done()
    assert not second.cancelled()
    assert base.now_s() == 2.0


async def test_waiting_for_the_past_returns_at_once() -> None:
    base = SteppedTimeBase(start_s=5.0)
    await base.wait_until(4.0)
    assert base.now_s() == 5.0


async def test_real_time_runs_at_its_speed_and_is_reached_when_waited_for() -> None:
    base = RealTimeBase(speed=1000.0)
    await base.wait_until(5.0)
    assert base.now_s() >= 5.0


def test_a_speed_of_zero_is_refused() -> None:
    with pytest.raises(ValueError, match="above 0"):
        RealTimeBase(speed=0.0)
