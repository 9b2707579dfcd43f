"""The synthetic sensor is itself true: path, environment, noise."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy import stats

from triaxcal.effects import TIME, Effect
from triaxcal.effects.memory import Hysteresis, Remanence
from triaxcal.effects.thermal import TemperatureLag, ThermalGradient
from triaxcal.effects.time import BiasStep, ScaleFactorDrift, WarmUp
from triaxcal.model.sensor import Sensor
from triaxcal.synthetic import STANDARD_GRAVITY, Environment, SyntheticUnit, Tumble, noisy_poses


def fine(path: Tumble, rate_hz: float = 2000.0) -> np.ndarray:
    return np.arange(int(path.round_s * rate_hz)) / rate_hz


def test_while_holding_the_force_is_the_direction_of_up_and_one_g(twenty_six: np.ndarray) -> None:
    path = Tumble(twenty_six, hold_s=2.0, move_s=1.0)
    t_s = fine(path, 200)
    holding = t_s % 3.0 < 2.0 - 1e-9
    a = path.specific_force(t_s)[holding]
    assert np.linalg.norm(a, axis=1) == pytest.approx(np.ones(holding.sum()), abs=1e-12)
    assert a == pytest.approx(twenty_six[(t_s[holding] // 3.0).astype(int)], abs=1e-12)


@pytest.mark.parametrize("turned_deg", [1.0, 90.0, 179.999, 180.0])
def test_a_move_is_smooth_and_stays_near_one_g(turned_deg: float) -> None:
    angle = np.radians(turned_deg)
    path = Tumble(np.array([[0.0, 0.0, 1.0], [np.sin(angle), 0.0, np.cos(angle)]]), hold_s=1.0, move_s=1.5)
    t_s = fine(path)
    a = path.specific_force(t_s)
    assert np.isfinite(a).all()
    # Peak rate of a minimum-jerk move is 1.875 angle/time; peak angular acceleration 5.77 angle/time².
    lever = path.lever_m / STANDARD_GRAVITY
    most = lever * (5.78 * angle / 1.5**2 + (1.875 * angle / 1.5) ** 2)
    assert np.max(np.abs(np.linalg.norm(a, axis=1) - 1)) <= most
    steps = np.linalg.norm(np.diff(a, axis=0), axis=1)
    jerk = lever * 60 * angle / 1.5**3 * 1.2
    assert np.max(steps) < (1.875 * angle / 1.5 * (1 + most) + jerk) / 2000 + 1e-6


def test_opposite_poses_are_joined_through_a_half_turn() -> None:
    path = Tumble(np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]), hold_s=1.0, move_s=1.0)
    a = path.specific_force(np.array([0.5, 1.5, 2.5]))
    assert a[0] == pytest.approx([1, 0, 0])
    assert a[2] == pytest.approx([-1, 0, 0])
    assert abs(a[1, 0]) < 1e-9
    assert np.linalg.norm(a[1]) == pytest.approx(1, abs=0.4)


def test_the_felt_acceleration_is_that_of_a_point_off_the_axis(fourteen: np.ndarray) -> None:
    path = Tumble(fourteen[[0, 2]], hold_s=1.0, move_s=1.0, lever_m=0.3)
    t_s = fine(path, 10000)
    moving = (t_s > 1.0) & (t_s < 2.0)
    still = Tumble(fourteen[[0, 2]], 1.0, 1.0, lever_m=0.0).specific_force(t_s)
    angle = np.unwrap(np.arctan2(still @ fourteen[2], still @ fourteen[0]))
    rate = np.gradient(angle, t_s)
    acceleration = np.gradient(rate, t_s)
    felt = path.specific_force(t_s) - still
    along = np.sum(felt * still, axis=1)[moving]
    across = np.linalg.norm(felt - np.sum(felt * still, axis=1)[:, None] * still, axis=1)[moving]
    assert along == pytest.approx(-0.3 / 9.80665 * rate[moving] ** 2, abs=2e-4)
    assert across == pytest.approx(0.3 / 9.80665 * np.abs(acceleration[moving]), abs=2e-3)


def test_the_path_goes_round_for_ever(fourteen: np.ndarray) -> None:
    path = Tumble(fourteen, hold_s=2.0, move_s=1.0)
    t_s = fine(path, 50)
    assert path.specific_force(t_s + 7 * path.round_s) == pytest.approx(path.specific_force(t_s), abs=1e-9)


def test_temperature_starts_ramps_and_swings() -> None:
    t_s = np.array([0.0, 150.0, 600.0])
    place = Environment(temperature_c=20.0, ramp_c_per_s=0.01, swing_c=2.0, swing_period_s=600.0)
    assert place.temperature(t_s) == pytest.approx([20.0, 23.5, 26.0])


def test_the_unit_s_noise_is_white_and_as_stated_and_goes_on_from_call_to_call(paper_unit: Sensor) -> None:
    path = Tumble(np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]), hold_s=1e4, move_s=1.0)
    unit = SyntheticUnit(paper_unit, path, np.array([1e-3, 2e-3, 3e-3]), seed=4)
    blocks = [unit.sample(np.arange(1000) / 100)[0] for _ in range(20)]
    clean = paper_unit.output(np.array([[0.0, 0.0, 1.0]]), {})
    noise = (np.concatenate(blocks) - clean) / np.abs(paper_unit.scale_factor)
    assert noise.std(axis=0) == pytest.approx([1e-3, 2e-3, 3e-3], rel=4 / np.sqrt(2 * len(noise)))
    assert not np.array_equal(blocks[0], blocks[1])
    lagged = np.array([np.corrcoef(n[:-1], n[1:])[0, 1] for n in noise.T])
    assert np.abs(lagged).max() < 4 / np.sqrt(len(noise))


def test_the_same_seed_gives_the_same_samples(paper_unit: Sensor, fourteen: np.ndarray) -> None:
    units = [SyntheticUnit(paper_unit, Tumble(fourteen, 2.0, 1.0), np.full(3, 1e-3), seed=s) for s in (1, 1, 2)]
    first, again, other = (u.sample(np.arange(50) / 10)[0] for u in units)
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_effects_count_from_their_references(with_effects: Callable[..., Sensor]) -> None:
    path = Tumble(np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]), hold_s=1e4, move_s=1.0)
    sensor, plain = with_effects(temperature_bias=[1e-3, 0, 0], bias_drift=[0, 1e-3, 0]), with_effects()
    unit = SyntheticUnit(
        sensor, path, np.zeros(3), Environment(temperature_c=30.0), channel_reference={"temp_c": 25.0, TIME: 10.0}
    )
    u, temperature = unit.sample(np.array([12.0]))
    added = (u - plain.output(np.array([[0.0, 0.0, 1.0]]), {}))[0] / plain.scale_factor
    assert temperature == pytest.approx([30.0])
    assert added == pytest.approx([5e-3, 2e-3, 0.0], abs=1e-12)


FORCE = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
OF_TIME: list[tuple[Effect, float, float, list[float]]] = [
    (WarmUp(10.0), 6.0, 1e-3, [1e-3 * np.exp(-0.6)] * 3),
    (BiasStep(7.0), 6.0, 1e-3, [-1e-3] * 3),
    (BiasStep(5.0), 6.0, 1e-3, [0.0] * 3),
    (ThermalGradient(), 6.0, 1e-3, [2e-3] * 3),
    # From the second pose (1, 0, 0), which began at 5 s, one looks back at the first (0, 0, 1).
    (Hysteresis(), 6.0, 1e-3, [0.0, 0.0, 1e-3]),
    (Hysteresis("reversal"), 6.0, 1e-3, [1e-3, 0.0, -1e-3]),
    (Remanence(), 6.0, 1e-3, [0.0, 0.0, 1e-3]),
    (ScaleFactorDrift(), 6.0, 1e-3, [6e-3, 0.0, 0.0]),
    # A ramp of 2 K/s for 6 s, followed with 10 s.
    (TemperatureLag(10.0), 6.0, 1e-3, [2e-3 * (6 - 10 * (1 - np.exp(-0.6)))] * 3),
    (Hysteresis(), 3.0, 1e-3, [0.0, 0.0, 1e-3]),
    (Hysteresis("reversal"), 3.0, 1e-3, [0.0, 0.0, 0.0]),
    (Hysteresis("reversal"), 16.0, 1e-3, [0.0, 1e-3, 1e-3]),
]


@pytest.mark.parametrize(("effect", "t_s", "size", "added"), OF_TIME)
def test_effects_go_with_the_time_since_the_start_the_temperatures_rate_and_the_pose_before(
    effect: Effect, t_s: float, size: float, added: list[float]
) -> None:
    path = Tumble(FORCE, hold_s=4.0, move_s=1.0)
    square = Sensor(np.ones(3), np.zeros(3), np.zeros(3), ((effect, np.full(3, size)),))
    unit = SyntheticUnit(square, path, np.zeros(3), Environment(ramp_c_per_s=2.0))
    u, _ = unit.sample(np.array([t_s]))
    assert u - path.specific_force(np.array([t_s])) == pytest.approx(np.array([added]), abs=1e-12)


def test_the_rate_of_the_temperature_is_that_of_its_course() -> None:
    room = Environment(ramp_c_per_s=0.01, swing_c=3.0, swing_period_s=50.0)
    t_s, step = np.linspace(0, 100, 41), 1e-4
    slope = (room.temperature(t_s + step) - room.temperature(t_s - step)) / (2 * step)
    assert room.temperature_rate(t_s) == pytest.approx(slope, abs=1e-8)


def test_noisy_poses_scatter_by_the_standard_error_that_they_state(paper_unit: Sensor, fourteen: np.ndarray) -> None:
    error = np.array([1e-5, 2e-5, 4e-5])
    rng = np.random.default_rng(0)
    truth = paper_unit.output(fourteen, {})
    pulls = np.array(
        [(p.mean - truth[i]) / p.standard_error for _ in range(50) for i, p in enumerate(
            noisy_poses(paper_unit, fourteen, error, rng)
        )]
    )  # fmt: skip
    assert stats.kstest(pulls.ravel(), "norm").pvalue > 1e-3
    one = noisy_poses(paper_unit, fourteen, error, rng)[3]
    assert one.standard_error / np.abs(paper_unit.scale_factor) == pytest.approx(error)


def test_noisy_poses_follow_one_another_and_carry_their_channels(paper_unit: Sensor, fourteen: np.ndarray) -> None:
    temp_c = np.linspace(20, 30, 14)
    rng = np.random.default_rng(0)
    poses = noisy_poses(paper_unit, fourteen, 1e-5, rng, channels={"temp_c": temp_c}, hold_s=4.0)
    assert [p.t_s for p in poses] == pytest.approx(4.0 * np.arange(14) + 2.0)
    assert [p.channels["temp_c"] for p in poses] == pytest.approx(temp_c)
