import asyncio

import pytest

from triaxcald.simulation import time_base
from triaxcald.simulation.time_base import ElasticTimeBase, RealTimeBase, SteppedTimeBase


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


class WallClock:
    """Moves by what is slept, and by hand."""

    def __init__(self) -> None:
        self.now_s = 1000.0
        self.slept: list[float] = []

    def monotonic(self) -> float:
        return self.now_s

    async def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.now_s += max(seconds, 1e-9)  # no sleep is shorter


@pytest.fixture
def wall(monkeypatch: pytest.MonkeyPatch) -> WallClock:
    clock = WallClock()
    monkeypatch.setattr(time_base.time, "monotonic", clock.monotonic)
    monkeypatch.setattr(time_base.asyncio, "sleep", clock.sleep)
    return clock


def test_elastic_time_runs_at_its_speed_where_it_is_looked_at_often_enough(wall: WallClock) -> None:
    base = ElasticTimeBase(speed=20.0, step_s=0.05)
    for i in range(1, 101):
        wall.now_s += 0.002  # 0.04 s of the unit
        assert base.now_s() == pytest.approx(0.04 * i)


@pytest.mark.parametrize("pause_s", [0.0026, 1.0, 3600.0])
def test_elastic_time_never_goes_further_than_a_step_from_one_look_to_the_next(wall: WallClock, pause_s: float) -> None:
    base = ElasticTimeBase(speed=20.0, step_s=0.05)
    seen = [base.now_s()]
    for _ in range(5):
        wall.now_s += pause_s
        seen.append(base.now_s())
    assert seen == pytest.approx([0.05 * i for i in range(6)])


def test_elastic_time_does_not_catch_up_with_what_it_has_missed(wall: WallClock) -> None:
    base = ElasticTimeBase(speed=20.0, step_s=0.05)
    wall.now_s += 3600.0
    assert base.now_s() == pytest.approx(0.05)
    for i in range(1, 11):
        wall.now_s += 0.001
        assert base.now_s() == pytest.approx(0.05 + 0.02 * i)


def test_elastic_time_stands_still_while_the_wall_clock_does(wall: WallClock) -> None:
    base = ElasticTimeBase(speed=20.0)
    wall.now_s += 0.001
    assert base.now_s() == base.now_s() == base.now_s() == pytest.approx(0.02)


async def test_elastic_time_is_waited_for_no_faster_than_its_speed_and_in_steps(wall: WallClock) -> None:
    base = ElasticTimeBase(speed=20.0, step_s=0.05)
    await base.wait_until(1.0)
    assert base.now_s() >= 1.0
    assert wall.now_s - 1000.0 == pytest.approx(1.0 / 20.0)
    assert max(wall.slept) == pytest.approx(0.05 / 20.0 / 2)


@pytest.mark.parametrize(("speed", "slowed"), [(20.0, 1.0), (0.5, 0.5)])
async def test_elastic_time_is_no_faster_than_the_wall_clock_while_the_reader_is_behind(
    wall: WallClock, speed: float, slowed: float
) -> None:
    base, behind = ElasticTimeBase(speed=speed), True
    base.wait_for_reader(lambda: behind)
    await base.wait_until(1.0)
    assert wall.now_s - 1000.0 == pytest.approx(1.0 / slowed)
    behind = False
    await base.wait_until(2.0)
    assert wall.now_s - 1000.0 == pytest.approx(1.0 / slowed + 1.0 / speed)


@pytest.mark.parametrize("behind", [(True, False), (False, True), (False, False)])
async def test_a_clock_that_units_share_waits_for_each_of_their_readers(
    wall: WallClock, behind: tuple[bool, bool]
) -> None:
    base = ElasticTimeBase(speed=20.0)
    for is_behind in behind:
        base.wait_for_reader(lambda is_behind=is_behind: is_behind)
    await base.wait_until(1.0)
    assert wall.now_s - 1000.0 == pytest.approx(1.0 if any(behind) else 1.0 / 20.0)


async def test_a_clock_of_the_wall_or_of_a_test_waits_for_no_reader(wall: WallClock) -> None:
    real, stepped = RealTimeBase(speed=20.0), SteppedTimeBase()
    for base in (real, stepped):
        base.wait_for_reader(lambda: True)
    wall.now_s += 1.0
    await stepped.advance(20.0)
    assert (real.now_s(), stepped.now_s()) == (pytest.approx(20.0), 20.0)


@pytest.mark.parametrize(("speed", "step_s"), [(0.0, 0.05), (-1.0, 0.05), (1.0, 0.0), (float("nan"), 0.05)])
def test_elastic_time_of_no_speed_or_no_step_is_refused(speed: float, step_s: float) -> None:
    with pytest.raises(ValueError, match="above 0"):
        ElasticTimeBase(speed, step_s)
