"""A bias that follows the temperature late: its lag against the exact solution, and recovered from poses and from a
stream of samples."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from triaxcal.diagnosis import diagnose
from triaxcal.effects import Effect, effect_named
from triaxcal.effects.contract import LAGS_S, RUN, SINCE_START, lag_in, lag_of
from triaxcal.effects.thermal import TemperatureLag
from triaxcal.errors import InvalidData
from triaxcal.estimate.creep import with_unexplained_creep
from triaxcal.estimate.pose_fit import fit
from triaxcal.evidence.posterior import NotIdentifiable, Why
from triaxcal.model.sensor import Sensor
from triaxcal.poses.covariates import channels_of, covariates_elsewhere, lag_deviation, lags_for
from triaxcal.poses.pose import Pose, Run
from triaxcal.synthetic import Environment, SyntheticUnit, Tumble, noisy_poses

MINUS = (-1, -1, -1)
TRUTH = [2e-4, -1e-4, 3e-4]  # g/K
T_S = (np.arange(26) + 0.5) * 10.0
SWINGING = {"temp_c": 25 + 3 * np.sin(T_S / 20) + np.cos(T_S / 7)}
REFERENCE = {"temp_c": 25.0}
ROOM = Environment(ramp_c_per_s=0.01, swing_c=3.0, swing_period_s=200.0)


def swinging(sensor: Sensor, ups: np.ndarray, rng: np.random.Generator) -> list[Pose]:
    return noisy_poses(sensor, ups, 1.5e-5, rng, channels=SWINGING, channel_reference=REFERENCE)


@pytest.mark.parametrize("constant_s", [33.0, 120.0])
def test_the_fit_gives_it_back_as_far_off_as_it_says(constant_s: float, recovers: Callable[..., None]) -> None:
    recovers(TemperatureLag(constant_s), TRUTH, SWINGING, REFERENCE)


@pytest.mark.parametrize("constant_s", [10, 47, 330, 10000])
def test_a_lag_is_the_solution_of_its_equation(constant_s: int) -> None:
    t = np.linspace(0, 1000, 4001)
    # A ramp and a swing from a standstill, in closed form; and by hand where the ramp has long been the same.
    assert lag_deviation(t, ROOM.temperature(t), constant_s) == pytest.approx(
        ROOM.temperature_lag(t, constant_s), abs=2e-4
    )
    step = 1e-3
    rate = (ROOM.temperature_lag(t[1:] + step, constant_s) - ROOM.temperature_lag(t[1:] - step, constant_s)) / 2e-3
    lagging = ROOM.temperature_lag(t[1:], constant_s)
    assert rate + ROOM.temperature_rate(t[1:]) == pytest.approx(-lagging / constant_s, abs=1e-7)
    assert lag_deviation(np.array([0.0, 1e6]), np.array([20.0, 20.0 + 1e3]), constant_s)[-1] == pytest.approx(
        -constant_s / 1e3
    )


def test_straight_from_pose_to_pose_a_lag_hardly_depends_on_how_many_poses_there_are() -> None:
    """A step in one go, or in parts of the same straight line."""
    few, many = np.array([0.0, 10.0, 60.0]), np.linspace(0, 60, 25)
    line = np.interp(many, few, [20.0, 25.0, 25.0])
    assert lag_deviation(few, np.array([20.0, 25.0, 25.0]), 33)[-1] == pytest.approx(
        lag_deviation(many, line, 33)[-1], rel=1e-12
    )
    # Two poses at one moment: a jump, of which nothing has been followed yet.
    assert lag_deviation(np.zeros(2), np.array([20.0, 25.0]), 33).tolist() == [0.0, -5.0]


def test_between_two_time_constants_the_lag_is_right_within_three_per_cent() -> None:
    t = np.linspace(5, 1000, 200)
    for temp_c in (np.sin(t / 50), 0.01 * t, np.where(t > 200, 1.0, 0.0)):
        for constant_s in np.geomspace(LAGS_S[0], LAGS_S[-1], 60):
            effect = TemperatureLag(float(constant_s))
            held = {"temp_c": temp_c} | {n: lag_deviation(t, temp_c, lag_in(n)[1]) for n in effect.needs[1:]}  # type: ignore[index]
            found = effect.basis(np.zeros((200, 3)), held)[:, 0, 0] - temp_c
            exact = lag_deviation(t, temp_c, float(constant_s))
            assert np.abs(found - exact).max() < 0.03 * np.abs(exact).max()


def test_it_needs_the_temperature_and_the_lags_next_to_its_own() -> None:
    assert TemperatureLag(150.0).needs == ("temp_c", "temp_c.lag:150")
    assert TemperatureLag(200.0).needs == ("temp_c", "temp_c.lag:150", "temp_c.lag:220")
    assert all(TemperatureLag(float(c)).needs == ("temp_c", lag_of("temp_c", c)) for c in LAGS_S)
    assert TemperatureLag(3.0).needs == ("temp_c", "temp_c.lag:10")
    assert TemperatureLag(1e9).needs == ("temp_c", "temp_c.lag:10000")


def test_the_posterior_sums_over_time_constants_from_a_few_poses_to_twice_the_recording() -> None:
    tried = [v.shape["time_constant"][0] for v in TemperatureLag().variants({SINCE_START: T_S})]
    assert tried == [15, 22, 33, 47, 68, 100, 150, 220, 330, 470]
    # One pose shows none.
    assert TemperatureLag().variants({SINCE_START: T_S[:1]}) == (TemperatureLag(),)


def test_lags_are_derived_for_those_who_ask_and_for_nobody_else(paper_unit: Sensor, twenty_six: np.ndarray) -> None:
    poses = swinging(paper_unit, twenty_six, np.random.default_rng(0))
    assert not [n for n in channels_of(poses) if lag_in(n)]
    wanted = lags_for([TemperatureLag(200.0), TemperatureLag(33.0), effect_named("temperature_bias")])
    assert wanted == tuple(lag_of("temp_c", c) for c in LAGS_S)
    assert lags_for([effect_named("thermal_gradient")]) == ()
    found = channels_of(poses, [*wanted, "other.lag:33", "temp_c.rate"])
    assert {n for n in found if lag_in(n)} == set(wanted)
    assert found["temp_c.lag:33"] == pytest.approx(lag_deviation(T_S, SWINGING["temp_c"], 33))
    # In whatever order the poses come.
    assert channels_of(poses[::-1], wanted)["temp_c.lag:33"][::-1] == pytest.approx(found["temp_c.lag:33"])


def test_a_lag_begins_with_the_first_pose_where_the_rate_in_that_is_known(
    paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    first, *others = swinging(paper_unit, twenty_six, np.random.default_rng(0))
    assert channels_of([first, *others], ["temp_c.lag:33"])["temp_c.lag:33"][0] == 0
    moving = replace(first, rates={"temp_c": 0.1})
    found = channels_of([moving, *others], ["temp_c.lag:33"])["temp_c.lag:33"]
    assert found[0] == pytest.approx(-0.1 * 33 * (1 - np.exp(-5 / 33)))


def test_every_recording_of_several_begins_with_a_lag_of_its_own(paper_unit: Sensor, twenty_six: np.ndarray) -> None:
    poses = swinging(paper_unit, twenty_six, np.random.default_rng(0))
    both = [replace(p, run=Run(i, 2, 130.0)) for i in (0, 1) for p in poses]
    found = channels_of(both, ["temp_c.lag:33"])
    assert found["temp_c.lag:33"][:26].tolist() == found["temp_c.lag:33"][26:].tolist()
    assert found["temp_c.lag:33"][26] == 0
    assert found[RUN][26] == 1


def test_poses_of_another_recording_have_the_lag_of_their_own_temperature(
    paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    poses = swinging(paper_unit, twenty_six, np.random.default_rng(0))
    reference = {"temp_c": 20.0, "temp_c.lag:33": 0.0}
    held = covariates_elsewhere(poses, reference, paper_unit.scale_factor, paper_unit.bias)
    assert held["temp_c"] == pytest.approx(SWINGING["temp_c"] - 20)
    assert held["temp_c.lag:33"] == pytest.approx(lag_deviation(T_S, SWINGING["temp_c"], 33))


def test_it_is_told_from_a_bias_that_follows_at_once_and_from_one_by_the_rate(
    twenty_six: np.ndarray, with_effect: Callable[[Effect, Sequence[float]], Sensor]
) -> None:
    rng = np.random.default_rng(0)
    poses = swinging(with_effect(TemperatureLag(33.0), TRUTH), twenty_six[rng.permutation(26)], rng)
    poses = [replace(p, rates={"temp_c": 3 / 20 * np.cos(p.t_s / 20) - np.sin(p.t_s / 7) / 7}) for p in poses]
    effects = [[TemperatureLag(33.0)], [effect_named("temperature_bias")],
               [effect_named("temperature_bias"), effect_named("thermal_gradient")]]  # fmt: skip
    right, at_once, by_rate = (fit(poses, signs=MINUS, effects=e, excluded=()).residual for e in effects)
    assert right.lack_of_fit_p is not None
    assert right.lack_of_fit_p > 1e-3
    assert at_once.rms_g > 3 * right.rms_g
    assert by_rate.rms_g > 1.5 * right.rms_g


def test_the_time_constant_is_where_least_is_left_and_has_an_error(
    twenty_six: np.ndarray, with_effect: Callable[[Effect, Sequence[float]], Sensor]
) -> None:
    rng = np.random.default_rng(0)
    poses = swinging(with_effect(TemperatureLag(47.0), TRUTH), twenty_six[rng.permutation(26)], rng)
    tried = TemperatureLag().variants({SINCE_START: T_S})
    fits = {e.shape["time_constant"][0]: fit(poses, signs=MINUS, effects=[e], excluded=()) for e in tried}
    best = min(fits, key=lambda constant_s: fits[constant_s].residual.rms_g)
    assert best == 47
    _, error, unit = fits[best].coefficients_of("temperature_lag")["time_constant"]
    assert unit == "s"
    assert error is not None
    assert 0.1 < error < 10


@pytest.mark.slow
def test_from_a_stream_it_comes_back_with_the_trends_inside_the_poses(
    twenty_six: np.ndarray,
    with_effect: Callable[[Effect, Sequence[float]], Sensor],
    detect: Callable[..., tuple[object, object, list[Pose]]],
) -> None:
    """The unit's temperature lags by the closed form, at every sample; the fit knows it by the poses."""
    effect, truth = TemperatureLag(68.0), np.array([4e-4, -3e-4, 5e-4])
    sensor = with_effect(effect, [*truth])
    for seed in range(4):
        path = Tumble(twenty_six[np.random.default_rng(seed).permutation(26)], hold_s=8.0, move_s=2.0, lever_m=0.0)
        unit = SyntheticUnit(
            sensor, path, np.full(3, 3e-4), ROOM, channel_reference=REFERENCE | {"t_s": 0.0}, seed=seed
        )
        t = np.arange(0, 26 * path.step_s, 0.02)
        readings, temp_c = unit.sample(t)
        _, _, poses = detect(t, readings, {"temp_c": temp_c})
        assert len(poses) == 26
        c = fit(poses, signs=MINUS, effects=[effect], excluded=())
        assert c.slopes
        assert np.all(np.abs(c.values[9:] - truth) < 4.5 * c.standard_errors[9:]), seed
        assert np.all(c.standard_errors[9:] < 0.2 * np.abs(truth))
        assert c.residual.lack_of_fit_p is not None
        assert c.residual.lack_of_fit_p > 1e-3


def test_inside_a_pose_it_explains_the_creep_of_the_lagging_temperature(
    twenty_six: np.ndarray, with_effect: Callable[[Effect, Sequence[float]], Sensor]
) -> None:
    rng = np.random.default_rng(0)
    effect = TemperatureLag(33.0)
    sensor = with_effect(effect, TRUTH)
    lag, rate = lag_deviation(T_S, SWINGING["temp_c"], 33), 3 / 20 * np.cos(T_S / 20) - np.sin(T_S / 7) / 7
    rate[0] = 0.0  # before the first pose it stood still
    # By its equation it changes by −lag/τ a second, whatever the thermometer does.
    creep = sensor.scale_factor * np.array(TRUTH) * 10.0 * (-lag / 33)[:, None]
    poses = [
        replace(p, creep=creep[i], covariance=p.covariance + np.outer(creep[i], creep[i]) / 12,
                rates={"temp_c": float(rate[i])})
        for i, p in enumerate(swinging(sensor, twenty_six[rng.permutation(26)], rng))
    ]  # fmt: skip
    left = with_unexplained_creep(poses, fit(poses, signs=MINUS, effects=[effect], excluded=()))
    for before, after in zip(poses, left, strict=True):
        assert np.linalg.norm(after.creep) <= 0.2 * np.linalg.norm(before.creep) + 1e-12


@pytest.mark.slow
def test_poses_whose_temperature_stands_still_or_is_not_known_say_so(
    twenty_six: np.ndarray, with_effect: Callable[[Effect, Sequence[float]], Sensor]
) -> None:
    sensor, effect = with_effect(TemperatureLag(33.0), [0, 0, 0]), TemperatureLag(33.0)
    still = noisy_poses(sensor, twenty_six, 1.5e-5, np.random.default_rng(0), channels={"temp_c": np.full(26, 25.0)})
    plain = [replace(p, channels={}) for p in still]
    for poses, why in ((still, Why.STOOD_STILL), (plain, Why.NOT_LOGGED)):
        loop = diagnose(poses, signs=MINUS, catalogue=[effect])
        assert loop.after.blind_to == (effect.name,)
        assert loop.not_identifiable[effect.name] == NotIdentifiable(why, "temp_c")
    with pytest.raises(InvalidData, match="no channel temp_c, which the effects need"):
        fit(plain, signs=MINUS, effects=[effect])
