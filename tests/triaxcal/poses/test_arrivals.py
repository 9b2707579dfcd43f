"""Times of samples that come in bursts, against the times at which they were taken."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from triaxcal.arrays import Floats, Ints
from triaxcal.poses.arrivals import SampleTimes


def nanoseconds(times_s: Floats) -> Ints:
    """Rising, as a decoder gives them."""
    time_ns, index = np.round(times_s * 1e9).astype(np.int64), np.arange(len(times_s))
    return np.maximum.accumulate(time_ns - index) + index


def delivered(taken_s: Floats, every_s: float, jitter: float, seed: int) -> Floats:
    """Arrival of samples that are sent together, every so many seconds and up to a
    share ``jitter`` of that sooner or later, over a line that carries 50,000 a
    second."""
    burst = np.floor(taken_s / every_s + 1e-9).astype(int)
    at_s = (
        np.arange(burst[-1] + 1) + 1 + np.random.default_rng(seed).uniform(-jitter, jitter, burst[-1] + 1)
    ) * every_s
    return np.asarray(at_s[burst] + (np.arange(len(burst)) - np.searchsorted(burst, burst)) * 2e-5)


def laid(arrival_ns: Ints, block: int = 10**9) -> tuple[Ints, tuple[int, float] | None]:
    times = SampleTimes()
    out = [times.feed(arrival_ns[at : at + block]) for at in range(0, len(arrival_ns), block)]
    return np.concatenate([*out, times.finish()]), times.bursts()


SEEDS = range(5)
EVERY_S = [0.03, 0.05, 0.1, 0.17, 0.25]


@pytest.mark.parametrize("jitter", [0.0, 0.1, 0.25])
@pytest.mark.parametrize("every_s", EVERY_S)
@pytest.mark.parametrize("rate_hz", [100.0, 1000.0])
def test_bursts_are_laid_where_the_samples_were_taken(rate_hz: float, every_s: float, jitter: float) -> None:
    taken = np.arange(int(60 * rate_hz)) / rate_hz
    for seed in SEEDS:
        arrival = delivered(taken, every_s, jitter, seed)
        time_ns, bursts = laid(nanoseconds(arrival))
        assert (np.diff(time_ns) > 0).all()
        off = time_ns * 1e-9 - taken
        assert np.ptp(off) < (jitter + 0.05) * every_s + 0.5 / rate_hz, "nearer than the bursts scatter"
        assert bursts is not None
        assert bursts[0] == pytest.approx(every_s * rate_hz, abs=1)
        assert bursts[1] == pytest.approx(every_s, rel=0.1)


@pytest.mark.parametrize("block", [1, 13, 997])
def test_the_times_do_not_depend_on_the_blocks(block: int) -> None:
    taken = np.arange(6000) / 100
    arrival = np.where((taken > 20) & (taken < 40), delivered(taken, 0.17, 0.2, 1), taken)
    for times in (delivered(taken, 0.25, 0.2, 0), arrival):
        whole, bursts = laid(nanoseconds(times))
        part, same = laid(nanoseconds(times), block)
        assert (part == whole).all()
        assert same == bursts


EVEN: dict[str, Callable[[np.random.Generator, Ints], Floats]] = {
    "even": lambda rng, n: n / 100,
    "scattered": lambda rng, n: (n + rng.normal(0, 0.2, len(n))) / 100,
    "a clock that wanders": lambda rng, n: n / 100 * (1 + 0.01 * np.sin(n / 5e3)),
    "in steps of a millisecond": lambda rng, n: np.floor(n / 100 * 1000 / 7) * 7 / 1000,
    "with gaps": lambda rng, n: n / 100 + 1.5 * (n // 700) + 0.3 * (n // 450),
}


@pytest.mark.parametrize("kind", EVEN)
def test_even_streams_keep_their_times(kind: str) -> None:
    arrival_ns = nanoseconds(EVEN[kind](np.random.default_rng(2), np.arange(6000)))
    time_ns, bursts = laid(arrival_ns)
    assert (time_ns == arrival_ns).all()
    assert bursts is None


@pytest.mark.parametrize("jitter", [0.0, 0.1])
def test_lost_bursts_stay_gaps(jitter: float) -> None:
    taken = np.arange(6000) / 100
    for seed in SEEDS:
        burst = (taken / 0.25 + 1e-9).astype(int)
        lost = np.isin(burst, np.random.default_rng(seed).choice(np.arange(5, 230, 4), 6, replace=False))
        time_ns, _ = laid(nanoseconds(delivered(taken, 0.25, jitter, seed)[~lost]))
        gaps = np.flatnonzero(np.diff(time_ns) > 0.1e9)
        assert (gaps == np.flatnonzero(np.diff(taken[~lost]) > 0.1)).all()
        missing = np.diff(time_ns)[gaps] * 1e-9 * 100 - 1
        assert missing == pytest.approx(25, abs=0.1 if not jitter else 10)


@pytest.mark.parametrize("after_s", [0.25, 2.0])
def test_a_long_gap_before_the_last_bursts_stays_one(after_s: float) -> None:
    taken = np.concatenate([np.arange(3000) / 100, 100.0 + np.arange(int(after_s * 100)) / 100])
    time_ns, _ = laid(nanoseconds(delivered(taken, 0.25, 0.0, 0)))
    assert np.diff(time_ns * 1e-9).max() == pytest.approx(70.01, abs=0.3)
    assert np.ptp(time_ns * 1e-9 - taken) < 0.3


def test_a_host_that_stalls_now_and_then_delays_samples_and_loses_none() -> None:
    taken = np.arange(6000) / 100
    arrival = taken.copy()
    for at in (5.0, 21.3, 40.0):
        arrival[(taken > at) & (taken < at + 0.4)] = at + 0.4
    time_ns, bursts = laid(nanoseconds(arrival))
    assert time_ns * 1e-9 == pytest.approx(taken, abs=0.02)
    assert bursts is None, "a few stalls"


def test_polls_at_any_intervals_are_bursts() -> None:
    taken = np.arange(6000) / 100
    for seed in SEEDS:
        polled = np.cumsum(np.random.default_rng(seed).uniform(0.03, 0.25, 600))
        time_ns, bursts = laid(nanoseconds(polled[np.searchsorted(polled, taken)]))
        assert bursts is not None
        assert np.abs(np.diff(time_ns) * 1e-9 * 100 - 1).max() < 0.5


@pytest.mark.parametrize("share", [0.3, 0.7, 0.85])
def test_a_buffer_that_is_sent_little_faster_than_it_fills_is_laid_evenly(share: float) -> None:
    taken = np.arange(6000) / 100
    within = np.arange(6000) % 25
    time_ns, _ = laid(nanoseconds((np.arange(6000) // 25 + 1) * 0.25 + within * share / 100))
    assert np.ptp(time_ns * 1e-9 - taken) < 0.1
    assert np.diff(time_ns).max() < 0.02e9


@pytest.mark.parametrize("count", [0, 1, 2, 11, 30, 64, 200])
def test_short_streams_come_through_whole(count: int) -> None:
    arrival_ns = nanoseconds(delivered(np.arange(max(count, 1)) / 100, 0.25, 0.1, 3))[:count]
    time_ns, _ = laid(arrival_ns)
    assert len(time_ns) == count
    assert (np.diff(time_ns) > 0).all()
