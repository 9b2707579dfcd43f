"""Drift of known worlds over many seeds, and the time that a calibration lasts, by formula and by simulation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from triaxcal.errors import InvalidData
from triaxcal.population import Drift, Movement, Moving, Part, drift_of, recalibration_interval

UNITS, TIMES = 30, 4


def world(
    seed: int, *, walk: float = 0.0, slope: float = 0.0, trend: float = 0.0, start: float = 0.0, noise: float = 0.4
) -> tuple[np.ndarray, ...]:
    """Unit, time, value and standard error."""
    rng = np.random.default_rng(seed)
    t = np.sort(rng.uniform(0, 100, (UNITS, TIMES)), axis=1)
    moved = np.zeros((UNITS, TIMES))
    moved[:, 1:] = np.cumsum(rng.normal(0, walk, (UNITS, TIMES - 1)) * np.sqrt(np.diff(t)), axis=1)
    moved += (rng.normal(trend, slope, (UNITS, 1))) * t
    errors = rng.normal(0, start, t.shape) + rng.normal(0, noise, t.shape)
    values = rng.normal(0, 50, (UNITS, 1)) + moved + errors
    return np.repeat(np.arange(UNITS), TIMES), t.ravel(), values.ravel(), np.full(t.size, noise)


def found(seed: int, **of: float) -> Drift:
    one = drift_of(*world(seed, **of))
    assert one is not None
    return one


@pytest.mark.slow
def test_a_random_walk_is_found() -> None:
    every = [found(seed, walk=0.5, start=0.3) for seed in range(60)]
    walks = [d for d in every if d.movement is Movement.RANDOM_WALK]
    assert len(walks) > 54
    held = np.mean([d.rate_interval[0] <= 0.5 <= d.rate_interval[1] for d in walks])
    assert held > 0.88
    assert np.mean([d.rate for d in walks]) == pytest.approx(0.5, rel=0.05)
    trends = np.array([d.trend / d.trend_standard_error for d in walks])
    assert np.std(trends) == pytest.approx(1.0, abs=0.3)


@pytest.mark.slow
def test_a_slope_of_each_unit_and_a_trend_of_all_are_found() -> None:
    every = [found(seed, slope=0.05, trend=0.2) for seed in range(40)]
    assert np.mean([d.movement is Movement.SLOPE for d in every]) > 0.95
    slopes = [d for d in every if d.movement is Movement.SLOPE]
    assert np.mean([d.rate for d in slopes]) == pytest.approx(0.05, rel=0.06)
    assert np.mean([d.trend for d in slopes]) == pytest.approx(0.2, abs=0.006)
    assert np.mean([d.rate_interval[0] <= 0.05 <= d.rate_interval[1] for d in slopes]) > 0.85


@pytest.mark.slow
def test_without_a_movement_the_rate_reaches_down_to_zero() -> None:
    every = [found(seed, start=0.5) for seed in range(12)]
    assert np.mean([d.rate_interval[0] == 0.0 for d in every]) > 0.8
    assert np.mean([d.start_to_start for d in every]) == pytest.approx(0.5, rel=0.2)


def test_one_time_between_all_measurements_does_not_tell_starts_from_drift() -> None:
    rng = np.random.default_rng(3)
    unit, time = np.repeat(np.arange(40), 2), np.tile([0.0, 10.0], 40)
    one = drift_of(unit, time, rng.normal(0, 1, 80), np.zeros(80))
    assert one is not None
    assert not one.separable
    assert one.start_to_start == 0.0
    # Nothing moves, and all of it counts as drift: a variance of 2 in a time of 10.
    assert one.variance(10.0) == pytest.approx(2.0, rel=0.5)


def test_too_few_changes_state_no_drift() -> None:
    assert drift_of(np.array([0, 0, 1, 1]), np.arange(4.0), np.arange(4.0), np.zeros(4)) is None
    assert drift_of(np.repeat([0, 1, 2], 3), np.zeros(9), np.arange(9.0), np.zeros(9)) is None
    with pytest.raises(InvalidData):
        drift_of(np.zeros(2, dtype=int), np.zeros(3), np.zeros(3), np.zeros(3))


# How long a calibration lasts.

WALK = Drift(Movement.RANDOM_WALK, 0.1, (0.08, 0.12), 0.0, 0.0, 0.0, True, 10, 30, 100.0, 0.0)


def test_a_calibration_lasts_as_long_as_a_simulated_one() -> None:
    """Biases that walk: the error of |a| is their part along a direction."""
    figures = [Moving(Part.BIAS, (i,), WALK) for i in range(3)]
    one = recalibration_interval(figures, 1.0, 0.05)
    assert one.time == pytest.approx(100 / 1.959964**2, rel=1e-3)  # 1.96 · 0.1 √t = 1
    assert one.interval[0] < one.time < (one.interval[1] or 0)
    assert one.at_start == 0.0


def test_scale_factors_angles_and_trends_count_by_their_direction() -> None:
    rng = np.random.default_rng(8)
    trend = replace(WALK, trend=0.01)
    figures = [
        Moving(Part.BIAS, (0,), trend, 0.2), Moving(Part.SCALE_FACTOR, (1,), replace(WALK, start_to_start=0.1)),
        Moving(Part.MISALIGNMENT, (1, 2), replace(WALK, movement=Movement.SLOPE, rate=0.02)),
    ]  # fmt: skip
    one = recalibration_interval(figures, 1.0, 0.1)
    assert one.time is not None
    n = rng.normal(size=(200_000, 3))
    n /= np.linalg.norm(n, axis=1)[:, None]
    z = rng.normal(size=(5, len(n)))
    bias = 0.01 * one.time + 0.1 * np.sqrt(one.time) * z[0] + 0.2 * z[1]
    scale = 0.1 * np.sqrt(one.time) * z[2] + 0.1 * np.sqrt(2) * z[3]
    error = n[:, 0] * bias + n[:, 1] ** 2 * scale + n[:, 1] * n[:, 2] * 0.02 * one.time * z[4]
    assert np.mean(np.abs(error) > 1.0) == pytest.approx(0.1, abs=0.004)


def test_a_limit_that_a_new_calibration_breaks_lasts_for_no_time() -> None:
    one = recalibration_interval([Moving(Part.BIAS, (0,), WALK, 5.0)], 1.0)
    assert (one.time, one.interval) == (0.0, (0.0, 0.0))
    assert one.at_start > 0.5


def test_figures_that_do_not_move_last_for_ever() -> None:
    still = replace(WALK, rate=0.0, rate_interval=(0.0, 0.05))
    one = recalibration_interval([Moving(Part.BIAS, (0,), still)], 1.0)
    assert one.time is None
    assert one.interval[0] > 100
    assert one.interval[1] is None
    with pytest.raises(InvalidData):
        recalibration_interval([], 1.0)
