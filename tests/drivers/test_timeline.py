"""Where samples come to lie in time, and which of them are new."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from triaxcal_drivers.timeline import Arrivals, Clockwork, Timeline

PERIOD_NS = 10_000_000
COUNTED = Clockwork(PERIOD_NS, counter_bits=16, stamp_bits=None, repeat_window=12)
STAMPED = Clockwork(PERIOD_NS, counter_bits=16, stamp_bits=32, tick_ns=1000.0, repeat_window=12)
STAMP_ALONE = Clockwork(PERIOD_NS, counter_bits=None, stamp_bits=32, tick_ns=1000.0, repeat_window=12)
BARE = Clockwork(PERIOD_NS, counter_bits=None, stamp_bits=None)


def arrivals(counter=None, stamp_us=None, arrival_ns=None, broken=(), skipped=None, after_gap=()):
    n = len(counter if counter is not None else stamp_us if stamp_us is not None else arrival_ns)
    lost = np.zeros(n, dtype=bool)
    lost[list(broken)] = True
    gap = np.zeros(n, dtype=bool)
    gap[list(after_gap)] = True
    return Arrivals(
        None if counter is None else np.asarray(counter, dtype=np.int64) % 2**16,
        None if stamp_us is None else np.asarray(stamp_us, dtype=np.int64) % 2**32,
        np.zeros(n, np.int64) if skipped is None else np.asarray(skipped, dtype=np.int64),
        np.full(n, 5_000) if arrival_ns is None else np.asarray(arrival_ns, dtype=np.int64),
        lost,
        gap,
    )


def test_a_counter_is_unwrapped_and_sets_the_time():
    placed = Timeline(COUNTED).place(arrivals(counter=[65534, 65535, 0, 1]))
    assert placed.counter.tolist() == [65534, 65535, 65536, 65537]
    assert placed.time_ns.tolist() == [5_000 + i * PERIOD_NS for i in range(4)]
    assert placed.missing == 0


def test_a_gap_in_the_counter_is_counted_as_missing():
    placed = Timeline(COUNTED).place(arrivals(counter=[7, 8, 12, 13]))
    assert placed.missing == 3
    assert placed.time_ns[2] - placed.time_ns[1] == 4 * PERIOD_NS


def test_a_window_sent_twice_is_dropped_the_second_time():
    placed = Timeline(COUNTED).place(arrivals(counter=[5, 6, 7, 6, 7, 8]))
    assert placed.new.tolist() == [True, True, True, False, False, True]
    assert placed.counter.tolist() == [5, 6, 7, 8]
    assert placed.missing == 0


def test_time_stamps_are_unwrapped_and_beat_the_nominal_rate():
    stamp = 2**32 - 15_000 + np.arange(4) * 10_100  # the device is 1 % slow
    placed = Timeline(STAMPED).place(arrivals(counter=range(4), stamp_us=stamp))
    assert (placed.time_ns - placed.time_ns[0]).tolist() == [0, 10_100_000, 20_200_000, 30_300_000]


def test_a_gap_of_more_than_a_counter_turn_is_known_from_the_time_stamp():
    gap = 2**16 + 100
    counts = np.array([10, 11, 11 + gap])
    placed = Timeline(STAMPED).place(arrivals(counter=counts, stamp_us=counts * 10_000, arrival_ns=counts * 10_000_000))
    assert placed.missing == gap - 1
    assert placed.counter.tolist() == [10, 11, 11 + gap]


@pytest.mark.parametrize("clockwork", [STAMPED, STAMP_ALONE])
def test_a_time_stamp_back_at_zero_is_a_restart(clockwork):
    """The first sample after it lies after the last before it by the host's time between their arrivals."""
    counter = None if clockwork is STAMP_ALONE else [5000, 5001, 0, 1]
    placed = Timeline(clockwork).place(
        arrivals(
            counter,
            stamp_us=[50_000_000, 50_010_000, 0, 10_000],
            arrival_ns=[1_000, 1_000, 700_001_000, 700_001_000],
        )
    )
    assert np.diff(placed.time_ns).tolist() == [PERIOD_NS, 700_000_000, PERIOD_NS]
    assert np.diff(placed.counter).tolist() == [1, 1, 1]
    assert placed.missing == 0


@pytest.mark.parametrize(
    "clockwork", [COUNTED, STAMPED, STAMP_ALONE, BARE, Clockwork(PERIOD_NS, None, None, counted=True)]
)
def test_over_a_gap_in_which_the_device_was_lost_the_hosts_time_counts(clockwork):
    """The counter has wrapped once and more meanwhile, the time stamp too."""
    hour_ns = 3600 * 10**9
    placed = Timeline(clockwork).place(
        arrivals(
            [5000, 5001, 5001 + 360_000, 5002 + 360_000] if clockwork.counter_bits else None,
            stamp_us=[0, 10_000, 3_600_010_000, 3_600_020_000] if clockwork.stamp_bits else None,
            arrival_ns=[1_000, 1_000 + PERIOD_NS, 1_000 + PERIOD_NS + hour_ns, 1_000 + 2 * PERIOD_NS + hour_ns],
            after_gap=[2],
        )
    )
    assert np.diff(placed.time_ns).tolist() == [PERIOD_NS, hour_ns, PERIOD_NS]
    assert np.diff(placed.counter).tolist() == [1, 1, 1]


def test_a_restart_that_the_time_stamp_alone_could_take_for_its_turn_shows_in_the_counter():
    before_turn = 2**32 - 20_000
    placed = Timeline(STAMPED).place(
        arrivals(
            counter=[before_turn // 10_000, 0],
            stamp_us=[before_turn, 0],
            arrival_ns=[0, 300_000_000],
        )
    )
    assert np.diff(placed.time_ns).tolist() == [300_000_000]
    assert placed.missing == 0


def test_without_a_time_stamp_a_counter_near_zero_after_a_failed_request_is_a_restart():
    placed = Timeline(COUNTED).place(
        arrivals(counter=[40_000, 40_001, 3, 4], arrival_ns=[0, 0, 10**9, 10**9], broken=[2])
    )
    assert np.diff(placed.time_ns).tolist() == [PERIOD_NS, 10**9, PERIOD_NS]
    assert placed.missing == 0


def test_without_a_failed_request_it_is_a_gap_where_there_was_time_for_it():
    at_ns = [0, PERIOD_NS, (65_536 + 3 - 40_000) * PERIOD_NS]
    placed = Timeline(COUNTED).place(arrivals(counter=[40_000, 40_001, 3], arrival_ns=at_ns))
    assert placed.missing == 65_536 + 3 - 40_001 - 1


@pytest.mark.parametrize("before", [300, 30_000, 60_000])
def test_a_counter_that_outruns_the_hosts_time_a_hundredfold_has_started_anew(before):
    """The unit restarted between two replies: no request failed."""
    at_ns = [0, PERIOD_NS, 30 * PERIOD_NS, 31 * PERIOD_NS]
    placed = Timeline(COUNTED).place(arrivals(counter=[before, before + 1, 0, 1], arrival_ns=at_ns))
    assert ((placed.time_ns - placed.time_ns[0]) // PERIOD_NS).tolist() == [0, 1, 30, 31]
    assert placed.counter.tolist() == [before, before + 1, before + 2, before + 3]
    assert placed.restarts == 1
    told = arrivals(counter=[before, before + 1, 0, 1], arrival_ns=at_ns, after_gap=[2])
    assert Timeline(COUNTED).place(told).restarts == 0


def test_a_simulated_device_may_be_sixty_times_as_fast():
    placed = Timeline(COUNTED).place(arrivals(counter=[300, 301, 6_301], arrival_ns=[0, PERIOD_NS, 101 * PERIOD_NS]))
    assert placed.missing == 5_999


def test_a_counter_that_turns_during_a_failed_request_is_no_restart():
    placed = Timeline(COUNTED).place(arrivals(counter=[65_530, 65_531, 4], broken=[2]))
    assert placed.missing == 8
    assert placed.counter.tolist() == [65_530, 65_531, 65_540]


def test_a_restart_soon_after_a_start_is_not_taken_for_a_repeat():
    placed = Timeline(STAMPED).place(
        arrivals(
            counter=[8, 9, 0, 1],
            stamp_us=[80_000, 90_000, 0, 10_000],
            arrival_ns=[0, 0, 10**9, 10**9],
            broken=[2],
        )
    )
    assert placed.new.all()
    assert np.diff(placed.time_ns).tolist() == [PERIOD_NS, 10**9, PERIOD_NS]


@pytest.mark.parametrize("clockwork", [COUNTED, STAMPED, STAMP_ALONE])
def test_a_window_sent_again_after_a_failed_request_is_a_repeat(clockwork):
    counter = np.array([5000, 5001, 5000, 5001, 5002])
    placed = Timeline(clockwork).place(
        arrivals(
            None if clockwork is STAMP_ALONE else counter,
            None if clockwork is COUNTED else counter * 10_000,
            broken=[2],
        )
    )
    assert placed.new.tolist() == [True, True, False, False, True]
    assert np.diff(placed.time_ns).tolist() == [PERIOD_NS, PERIOD_NS]


def test_time_never_goes_back_though_the_host_clock_does():
    placed = Timeline(STAMPED).place(
        arrivals(counter=[900, 0], stamp_us=[9_000_000, 0], arrival_ns=[10**9, 0], broken=[1])
    )
    assert np.diff(placed.time_ns).tolist() == [PERIOD_NS]
    bare = Timeline(BARE).place(arrivals(arrival_ns=[10, 20, 15, 15, 30]))
    assert bare.time_ns.tolist() == [10, 20, 21, 22, 30]


def test_samples_without_any_clock_bear_the_host_time_and_a_running_number():
    placed = Timeline(BARE).place(arrivals(arrival_ns=[100, 250, 400]))
    assert placed.time_ns.tolist() == [100, 250, 400]
    assert placed.counter.tolist() == [0, 1, 2]


def test_samples_the_device_says_it_lost_are_missing_where_there_is_no_counter():
    placed = Timeline(Clockwork(PERIOD_NS, None, None, counted=True)).place(
        arrivals(arrival_ns=[100] * 4, skipped=[0, 0, 5, 0])
    )
    assert placed.missing == 5
    assert np.diff(placed.time_ns).tolist() == [PERIOD_NS, 6 * PERIOD_NS, PERIOD_NS]


def test_a_poll_faster_than_the_device_gives_each_sample_once():
    placed = Timeline(STAMP_ALONE).place(arrivals(stamp_us=[0, 0, 10_000, 10_000, 10_000, 20_000]))
    assert placed.new.tolist() == [True, False, True, False, False, True]
    assert placed.counter.tolist() == [0, 1, 2]


histories = st.lists(
    st.tuples(
        st.sampled_from(["next", "next", "next", "gap", "repeat", "restart", "lost"]),
        st.integers(1, 400),
        st.booleans(),
    ),
    min_size=1,
    max_size=40,
)


@given(histories, st.lists(st.integers(0, 40), max_size=5), st.sampled_from([COUNTED, STAMPED, STAMP_ALONE]))
def test_the_result_does_not_depend_on_the_cuts(history, cuts, clockwork):
    counter, stamp, arrival, broken, after_gap, at = [], [], [], [], [], 60_000
    for i, (kind, number, failed) in enumerate(history):
        at = {"next": at + 1, "gap": at + number, "repeat": max(0, at - number % 8), "restart": 0, "lost": at + 70_000}[
            kind
        ]
        after_gap += [i] if kind == "lost" else []
        counter.append(at)
        stamp.append(at * 10_000)
        arrival.append((arrival[-1] if arrival else 0) + number * 1_000_000)
        broken += [i] if failed else []
    whole = arrivals(counter, stamp, arrival, broken, after_gap=after_gap)
    if clockwork.counter_bits is None:
        whole = replace(whole, counter=None)
    if clockwork.stamp_bits is None:
        whole = replace(whole, stamp=None)
    expected = Timeline(clockwork).place(whole)
    timeline, parts = Timeline(clockwork), []
    edges = [0, *sorted(min(c, len(history)) for c in cuts), len(history)]
    for lo, hi in itertools.pairwise(edges):
        parts.append(
            timeline.place(
                Arrivals(
                    whole.counter[lo:hi] if whole.counter is not None else None,
                    whole.stamp[lo:hi] if whole.stamp is not None else None,
                    whole.skipped[lo:hi],
                    whole.arrival_ns[lo:hi],
                    whole.broken[lo:hi],
                    whole.after_gap[lo:hi],
                )
            )
        )
    np.testing.assert_array_equal(np.concatenate([p.new for p in parts]), expected.new)
    np.testing.assert_array_equal(np.concatenate([p.time_ns for p in parts]), expected.time_ns)
    np.testing.assert_array_equal(np.concatenate([p.counter for p in parts]), expected.counter)
    assert sum(p.missing for p in parts) == expected.missing
    assert (np.diff(expected.time_ns) > 0).all()
    assert (np.diff(expected.counter) > 0).all()
