"""What held in each pose beside its attitude, computed by hand from few poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest

from triaxcal.diagnosis import diagnose
from triaxcal.effects.channel import ChannelBias
from triaxcal.effects.contract import BEFORE, CHANGE, DURATION, RUN, SCATTER, SINCE_START, TIME
from triaxcal.effects.memory import Hysteresis
from triaxcal.effects.thermal import TemperatureBias
from triaxcal.effects.time import BiasDrift
from triaxcal.errors import InvalidData
from triaxcal.estimate.pose_fit import fit
from triaxcal.model.sensor import Sensor
from triaxcal.poses.covariates import (
    at_reference,
    channels_of,
    covariates,
    covariates_elsewhere,
    of_readings,
    of_unknown_history,
    references,
    with_scale,
)
from triaxcal.poses.pose import Pose
from triaxcal.synthetic import noisy_poses

K, B = np.array([2.0, -4.0, 5.0]), np.array([0.1, 0.2, -0.1])


def pose(start_s: float, end_s: float, mean: list[float], before: list[float] | None, temp_c: float) -> Pose:
    return Pose(
        start_s=start_s,
        end_s=end_s,
        samples=100,
        mean=np.array(mean),
        covariance=np.eye(3) * 1e-10,
        dof=99,
        channels={"temp_c": temp_c, "supply_v": 5.0},
        rates={"temp_c": temp_c / 1000},
        before=None if before is None else np.array(before),
        scatter=np.array([4e-4, 16e-4, 25e-4]),
    )


def by_axis(found: Mapping[str, np.ndarray], names: Sequence[str]) -> np.ndarray:
    """(n,3)"""
    return np.stack([found[n] for n in names], axis=1)


@pytest.fixture
def three() -> list[Pose]:
    return [
        pose(2.0, 12.0, [2.2, 0.8, -0.5], None, 24.0),
        pose(15.0, 21.0, [0.2, -4.8, -0.5], [2.2, 0.8, -0.5], 25.0),
        # The pose before it was set aside, but it is what the unit felt before all the same.
        pose(40.0, 60.0, [0.2, -0.8, 4.5], [2.2, -0.8, -0.5], 26.3),
    ]


def test_time_is_the_middle_of_a_pose_and_rates_stand_beside_their_channels(three: list[Pose]) -> None:
    found = channels_of(three)
    assert found[TIME].tolist() == found[SINCE_START].tolist() == [7.0, 18.0, 50.0]
    assert found[DURATION].tolist() == [10.0, 6.0, 20.0]
    assert found["temp_c"].tolist() == [24.0, 25.0, 26.3]
    assert found["temp_c.rate"].tolist() == [0.024, 0.025, 0.0263]
    assert set(found) == {TIME, SINCE_START, DURATION, "temp_c", "temp_c.rate", "supply_v"}


def test_a_channel_that_one_pose_lacks_is_none_at_all(three: list[Pose]) -> None:
    poses = [*three[:2], replace(three[2], channels={"temp_c": 26.0})]
    assert "supply_v" not in channels_of(poses)
    assert "temp_c.rate" not in channels_of([*three[:2], replace(three[2], rates={})])


@pytest.mark.parametrize("name", [TIME, SINCE_START, DURATION, RUN, "before_x", "change_x", "scatter_x", "temp_c.rate"])
def test_a_logged_channel_stands_beside_the_derived_condition_of_its_name(name: str, three: list[Pose]) -> None:
    logged = [4.0, 7.0, 5.5]
    poses = [replace(p, channels=p.channels | {name: v}) for p, v in zip(three, logged, strict=True)]
    found, clean = (with_scale(channels_of(p), p, K, B) for p in (poses, three))
    added = set(found) - set(clean)
    (condition,) = added
    assert found[condition].tolist() == logged
    assert all(np.array_equal(found[n], clean[n]) for n in clean)
    # It counts from its mean, elsewhere and for single readings too, as any other channel does.
    reference = references(found)
    assert reference[condition] == 5.5
    assert covariates_elsewhere(poses, reference, K, B)[condition].tolist() == [-1.5, 1.5, 0.0]
    given = {"temp_c": np.zeros(1), "supply_v": np.zeros(1), name: np.array([6.0])}
    held, missing = of_readings(given, {condition: 5.5}, 1, CLOCKS)
    assert (held[condition].tolist(), missing) == ([0.5], ())
    with pytest.raises(InvalidData, match=f"no channel {name},"):
        covariates_elsewhere(three, reference, K, B)


@pytest.mark.slow
def test_an_effect_of_a_channel_is_found_whatever_the_channel_is_called(
    paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    rng = np.random.default_rng(0)
    names = [DURATION, SINCE_START, "before_y", "scatter_z", "supply.rate", "temp_c.rate"]
    for name in names:
        logged = 5 + rng.standard_normal(26)
        sensor = replace(paper_unit, effects=((ChannelBias("c"), np.array([2e-4, 0.0, -1e-4])),))
        poses = noisy_poses(sensor, twenty_six, 1.5e-5, rng, channels={"c": logged}, channel_reference={"c": 5.0})
        poses = [replace(p, channels={name: p.channels["c"]}) for p in poses]
        loop = diagnose(poses, signs=(-1, -1, -1))
        assert [f.effect for f in loop.findings] == [f"channel_bias:{name}"]


def test_the_pose_before_and_the_scatter_come_in_g_along_the_axes(three: list[Pose]) -> None:
    found = with_scale(channels_of(three), three, K, B)
    # u = k (s + b), so s = u/k − b; the first pose has itself before it, and no change.
    assert by_axis(found, BEFORE) == pytest.approx(np.array([[1.0, -0.4, 0.0], [1.0, -0.4, 0.0], [1.0, 0.0, 0.0]]))
    assert by_axis(found, CHANGE) == pytest.approx(np.array([[0, 0, 0], [-1.0, 1.4, 0.0], [-1.0, 0.0, 1.0]]))
    assert by_axis(found, SCATTER) == pytest.approx(np.full((3, 3), 1e-4))
    assert set(found) == {*channels_of(three), *BEFORE, *CHANGE, *SCATTER}


def test_only_to_an_effect_of_the_pose_before_is_the_history_of_the_first_pose_unknown(three: list[Pose]) -> None:
    for effect in Hysteresis(), Hysteresis("reversal"):
        assert of_unknown_history(three, [TemperatureBias(), effect]) == (0,)
        assert of_unknown_history(three[1:], [effect]) == ()
    assert of_unknown_history(three, [TemperatureBias(), BiasDrift()]) == ()


def test_channels_and_time_count_from_a_round_mean_and_all_else_from_zero(three: list[Pose]) -> None:
    reference = references(with_scale(channels_of(three), three, K, B))
    assert reference["temp_c"] == 25.1
    assert reference[TIME] == 25.0
    assert reference["supply_v"] == 5.0
    assert {v for n, v in reference.items() if n not in ("temp_c", TIME, "supply_v")} == {0.0}
    held = covariates(channels_of(three), reference)
    assert held["temp_c"] == pytest.approx([-1.1, -0.1, 1.2])
    assert held[TIME].tolist() == [-18.0, -7.0, 25.0]
    assert held[SINCE_START].tolist() == [7.0, 18.0, 50.0]


def test_a_channel_that_is_not_finite_has_no_reference_and_is_left_out() -> None:
    channels = {"temp_c": np.array([20.0, np.nan]), TIME: np.array([1.0, 3.0])}
    assert references(channels) == {TIME: 2.0}
    assert set(covariates(channels, references(channels))) == {TIME}


@pytest.mark.parametrize(
    ("middle", "swing"),
    [
        pytest.param(3.345, 4e-4, id="volts"),
        pytest.param(4.7e-5, 5e-7, id="tesla"),
        pytest.param(0.0123, 1e-4, id="amperes"),
        pytest.param(1.38e5, 2e3, id="pascals"),
        pytest.param(24.97, 1.5, id="degrees"),
    ],
)
def test_a_reference_lies_within_the_range_of_its_channel_whatever_the_unit(middle: float, swing: float) -> None:
    """A channel counted from afar is a constant and a little more: beside a bias, only that little shows."""
    values = middle + swing * np.random.default_rng(0).standard_normal(26)
    assert values.min() < references({"channel": values})["channel"] < values.max()


CLOCKS = {SINCE_START: np.inf, TIME: 0.0}


def test_poses_of_another_recording_count_their_time_as_at_the_reference_and_long_after_the_start(
    three: list[Pose],
) -> None:
    reference = {"temp_c": 20.0, TIME: 130.0, SINCE_START: 0.0, DURATION: 0.0, "before_x": 0.0, "temp_c.rate": 0.0}
    found = covariates_elsewhere(three, reference, K, B)
    assert set(found) == set(reference)
    assert found[TIME].tolist() == [0.0, 0.0, 0.0]
    assert np.all(np.isposinf(found[SINCE_START]))
    assert found["temp_c"] == pytest.approx([4.0, 5.0, 6.3])
    assert found["before_x"] == pytest.approx([1.0, 1.0, 1.0])
    assert found["temp_c.rate"] == pytest.approx([0.024, 0.025, 0.0263])


def test_poses_of_another_recording_without_the_channel_are_refused_by_its_name(three: list[Pose]) -> None:
    with pytest.raises(InvalidData, match="humidity_rh"):
        covariates_elsewhere(three, {"humidity_rh": 40.0}, K, B)


def test_single_readings_need_no_condition_that_nobody_logs() -> None:
    reference = {"temp_c": 25.0, SINCE_START: 0.0, DURATION: 0.0, "change_y": 0.0, "scatter_z": 0.0, "temp_c.rate": 0.0}
    found, missing = of_readings({"temp_c": np.array([26.0, 27.5])}, reference, 2, CLOCKS)
    assert found["temp_c"].tolist() == [1.0, 2.5]
    assert np.all(np.isposinf(found[SINCE_START]))
    assert all(found[n].tolist() == [0.0, 0.0] for n in (DURATION, "change_y", "scatter_z", "temp_c.rate"))
    assert missing == ("change_y", "scatter_z", "temp_c.rate")
    # What is given counts.
    given = {"temp_c": np.zeros(1), "temp_c.rate": np.array([0.01])}
    found, missing = of_readings(given, reference, 1, CLOCKS)
    assert found["temp_c.rate"].tolist() == [0.01]
    assert missing == ("change_y", "scatter_z")


def test_single_readings_without_a_channel_count_as_at_its_reference_and_say_so() -> None:
    found, missing = of_readings({}, {"temp_c": 25.0, TIME: 100.0}, 2, {SINCE_START: 130.0, TIME: 130.0})
    assert missing == ("temp_c",)
    assert (found["temp_c"].tolist(), found[TIME].tolist()) == ([0.0, 0.0], [30.0, 30.0])


def test_poses_of_another_recording_count_their_time_as_at_the_moment_that_is_chosen(three: list[Pose]) -> None:
    reference = {TIME: 130.0, SINCE_START: 0.0}
    found = covariates_elsewhere(three, reference, K, B, (240.0, 230.0))
    assert found[SINCE_START].tolist() == [240.0] * 3
    assert found[TIME].tolist() == [100.0] * 3


def test_at_the_reference_nothing_deviates_and_the_start_was_long_ago() -> None:
    found = at_reference(["temp_c", SINCE_START], 2)
    assert found["temp_c"].tolist() == [0.0, 0.0]
    assert np.all(np.isposinf(found[SINCE_START]))


def test_the_fit_knows_the_conditions_of_its_own_poses(paper_unit: Sensor, twenty_six: np.ndarray) -> None:
    """By the true scale and bias: those fitted differ by parts in a hundred thousand."""
    poses = noisy_poses(paper_unit, twenty_six, 1e-6, np.random.default_rng(0))
    held = fit(poses, signs=(-1, -1, -1), effects=[Hysteresis()]).covariates_of(poses)
    s = twenty_six @ paper_unit.axes.T
    before = np.concatenate([s[:1], s[:-1]])
    assert set(held) == set(BEFORE)
    assert by_axis(held, BEFORE) == pytest.approx(before, abs=1e-4)
