"""An adapter's clock against the host's: synthetic, with delays and drift that are known."""

from __future__ import annotations

import random

import pytest

from triaxcal_drivers.can.socketcan import HardwareClock

MS, S = 1_000_000, 1_000_000_000


@pytest.mark.parametrize("drift_ns", [400, -400])
def test_jitter_of_the_way_to_the_host_goes_and_drift_is_followed(drift_ns: int) -> None:
    """A frame each 10 ms for ten minutes, delays of 0.2 ms to 3 ms, a clock 40 ppm fast or slow that starts at 0."""
    generator = random.Random(5)
    clock, worst, last = HardwareClock(), 0, 0
    for i in range(60_000):
        arrived_ns = 1_700_000_000 * S + i * 10 * MS
        hardware_ns = i * 10 * MS + i * drift_ns
        kernel_ns = arrived_ns + 200_000 + generator.randrange(2_800_000)
        time_ns = clock.time_ns(hardware_ns, kernel_ns)
        assert time_ns >= last
        last = time_ns
        if i > 100:
            worst = max(worst, abs(time_ns - arrived_ns - 200_000))
    assert worst < 1 * MS  # the drift of 20 s, and not the 2.8 ms of the delays


def test_a_step_of_the_hosts_clock_is_followed_at_once() -> None:
    clock = HardwareClock()
    assert clock.time_ns(10 * S, 100 * S) == 100 * S
    for step_ns in (3600 * S, -3600 * S):
        assert clock.time_ns(11 * S, 101 * S + step_ns) == 101 * S + step_ns
        assert clock.time_ns(12 * S, 102 * S + step_ns) == 102 * S + step_ns


def test_an_adapters_clock_that_begins_anew_is_followed() -> None:
    clock = HardwareClock()
    clock.time_ns(4_000 * S, 100 * S)
    assert clock.time_ns(1 * S, 101 * S) == 101 * S
