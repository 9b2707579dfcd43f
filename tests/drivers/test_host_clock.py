"""Stamps on one line, whatever is done to the host's clock."""

from __future__ import annotations

import time
from dataclasses import dataclass

import pytest

from triaxcal_drivers.host_clock import HOST, SteadyClock

BEGUN_NS = 1_700_000_000_000_000_000
HOUR_NS = 3600 * 10**9


@dataclass
class Host:
    running_ns: int = 0
    steps_ns: int = 0

    def clock(self) -> SteadyClock:
        return SteadyClock(self.now_ns, lambda: self.running_ns)

    def now_ns(self) -> int:
        return BEGUN_NS + self.running_ns + self.steps_ns


def test_without_a_step_stamps_are_taken_as_they_are() -> None:
    host = Host()
    clock = host.clock()
    host.running_ns = 5 * HOUR_NS
    assert clock.steps_ns() == 0
    assert clock.steady_ns(host.now_ns() - 3) == host.now_ns() - 3
    assert clock.now_ns() == host.now_ns()


@pytest.mark.parametrize("step_ns", [HOUR_NS, -HOUR_NS, 2_000_000_000, -150_000_000])
def test_time_runs_on_over_a_step_and_the_step_is_told(step_ns: int) -> None:
    host = Host()
    clock = host.clock()
    stamps = []
    for second in range(10):
        host.running_ns = second * 10**9
        host.steps_ns = step_ns if second >= 5 else 0
        assert clock.steps_ns() == host.steps_ns
        stamps.append(clock.steady_ns(host.now_ns()))
        assert clock.now_ns() == BEGUN_NS + second * 10**9
    assert stamps == [BEGUN_NS + second * 10**9 for second in range(10)]


def test_a_frame_that_came_before_the_step_is_not_moved_by_it() -> None:
    host = Host()
    clock = host.clock()
    host.running_ns, host.steps_ns = 10**9, HOUR_NS
    before_ns = BEGUN_NS + 10**9 - 20_000_000
    assert clock.steps_ns() == HOUR_NS
    assert [clock.steady_ns(t) for t in (before_ns, host.now_ns())] == [before_ns, BEGUN_NS + 10**9]


def test_stamps_of_an_adapters_own_clock_are_not_moved_by_the_hosts_step() -> None:
    host = Host()
    clock = host.clock()
    host.steps_ns = 2_000_000_000
    clock.steps_ns()
    for second in range(1, 50):
        host.running_ns = second * 10**9
        clock.steps_ns()
        assert clock.steady_ns(BEGUN_NS + second * 10**9) == BEGUN_NS + second * 10**9


def test_an_adapters_clock_is_not_moved_by_a_second_step_either() -> None:
    host = Host()
    clock = host.clock()
    for second in range(1, 30):
        host.running_ns = second * 10**9
        host.steps_ns = 3_000_000_000 * (second // 10)
        clock.steps_ns()
        assert clock.steady_ns(BEGUN_NS + second * 10**9) == BEGUN_NS + second * 10**9
        assert clock.steady_ns(host.now_ns()) == BEGUN_NS + second * 10**9
    assert clock.stepped


def test_steps_there_and_back_leave_nothing() -> None:
    host = Host()
    clock = host.clock()
    for steps_ns in (HOUR_NS, 0, -HOUR_NS, 0):
        host.running_ns += 10**9
        host.steps_ns = steps_ns
        clock.steps_ns()
        assert clock.steady_ns(host.now_ns()) == BEGUN_NS + host.running_ns


def test_the_line_begins_with_the_clock_of_this_machine() -> None:
    assert abs(HOST.now_ns() - time.time_ns()) < 1_000_000_000
