"""Pose means with standard errors that are true, whatever the noise's moderate colour, and never too proud."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from triaxcal.errors import InvalidData
from triaxcal.model.sensor import Sensor
from triaxcal.poses.pose import Pose, poses_of
from triaxcal.synthetic import Tumble

Detect = Callable[..., tuple[object, object, list[Pose]]]
SEEDS = 12


def noise_of(kind: str, rng: np.random.Generator, count: int) -> np.ndarray:
    """(count,3) of unit variance."""
    length = {"white": 1, "moving average of a third of a window": 3, "moving average of a window": 10}[kind]
    white = rng.standard_normal((count + length - 1, 3))
    total = np.cumsum(np.concatenate([np.zeros((1, 3)), white]), axis=0)
    return (total[length:] - total[:-length]) / np.sqrt(length)


def pulls_of(sensor: Sensor, directions: np.ndarray, kind: str, detect: Detect, noise_g: float) -> np.ndarray:
    """(seeds·k,4): of every pose mean, by axis and along the measured vector."""
    out = []
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        path = Tumble(directions[rng.permutation(len(directions))], hold_s=5.0, move_s=1.5)
        t_s = np.arange(int(100 * path.round_s)) / 100
        noise = noise_of(kind, rng, len(t_s)) * noise_g
        clean = sensor.output(path.specific_force(t_s), {})
        poses = detect(t_s, clean + noise * sensor.scale_factor)[2]
        assert [int(p.t_s // path.step_s) for p in poses] == list(range(len(directions)))
        for pose, a in zip(poses, path.directions, strict=True):
            miss = pose.mean - sensor.output(a[None], {})[0]
            gradient = a / sensor.scale_factor
            along = miss @ gradient / np.sqrt(gradient @ pose.covariance @ gradient)
            out.append([*(miss / pose.standard_error), along])
    return np.array(out)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["white", "moving average of a third of a window"])
def test_pulls_of_pose_means_have_variance_one_within_a_twentieth(
    kind: str, paper_unit: Sensor, twenty_six: np.ndarray, detect: Detect
) -> None:
    pulls = pulls_of(paper_unit, twenty_six, kind, detect, 2e-4)
    # On top of the twentieth, three standard deviations of a variance estimated from as many values as there are.
    by_axis = np.mean(pulls[:, :3] ** 2)
    assert by_axis == pytest.approx(1, abs=0.05 + 3 * np.sqrt(2 / (3 * len(pulls))))
    assert np.mean(pulls[:, 3] ** 2) == pytest.approx(1, abs=0.05 + 3 * np.sqrt(2 / len(pulls)))
    assert np.abs(pulls.mean(axis=0)) == pytest.approx(np.zeros(4), abs=4 / np.sqrt(len(pulls)))


def test_channels_are_means_over_the_span_and_times_are_its_own(
    paper_unit: Sensor, fourteen: np.ndarray, detect: Detect
) -> None:
    path = Tumble(fourteen, hold_s=5.0, move_s=1.5)
    t_s = np.arange(int(100 * path.round_s)) / 100
    u = paper_unit.output(path.specific_force(t_s), {}) + 1e-4 * np.random.default_rng(0).standard_normal((len(t_s), 3))
    # Times from the first sample, wherever the clock stands.
    for pose in detect(t_s + 1e6, u, {"temp_c": 20 + 0.01 * t_s})[2]:
        assert pose.channels["temp_c"] == pytest.approx(20 + 0.01 * pose.t_s, abs=2e-3)
        assert pose.start_s < pose.t_s < pose.end_s < path.round_s


def test_rates_and_bends_of_a_channel_are_those_in_the_middle_of_each_pose(
    paper_unit: Sensor, fourteen: np.ndarray, detect: Detect
) -> None:
    """In the first and the last pose too, where the channel is known to one side alone."""
    path = Tumble(fourteen, hold_s=5.0, move_s=1.5)
    t_s = np.arange(int(100 * path.round_s)) / 100
    rng = np.random.default_rng(0)
    u = paper_unit.output(path.specific_force(t_s), {}) + 1e-4 * rng.standard_normal((len(t_s), 3))
    temp_c = 20 + 3 * np.sin(t_s / 20) + 5e-2 * rng.standard_normal(len(t_s))
    poses = detect(t_s, u, {"temp_c": temp_c})[2]
    truth = np.array([[3 / 20 * np.cos(p.t_s / 20), -3 / 400 * np.sin(p.t_s / 20)] for p in poses])
    found = np.array([[p.rates["temp_c"], p.bends["temp_c"]] for p in poses])
    error = np.array([[p.rate_errors["temp_c"], p.bend_errors["temp_c"]] for p in poses])
    assert error.max() < 5e-3
    assert np.abs((found - truth) / error).max() < 5


def test_a_coarse_thermometer_says_how_little_it_knows_of_the_rate(
    paper_unit: Sensor, fourteen: np.ndarray, detect: Detect
) -> None:
    path = Tumble(fourteen, hold_s=5.0, move_s=1.5)
    t_s = np.arange(int(100 * path.round_s)) / 100
    u = paper_unit.output(path.specific_force(t_s), {}) + 1e-4 * np.random.default_rng(0).standard_normal((len(t_s), 3))
    for pose in detect(t_s, u, {"temp_c": np.round(20 + 0.01 * t_s)})[2]:
        assert abs(pose.rates["temp_c"] - 0.01) < 2 * pose.rate_errors["temp_c"]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["white", "moving average of a window"])
def test_pulls_of_trends_along_the_measured_vector_have_variance_one(
    paper_unit: Sensor, fourteen: np.ndarray, detect: Detect, kind: str
) -> None:
    path = Tumble(fourteen, hold_s=5.0, move_s=1.5)
    t_s = np.arange(int(50 * path.round_s)) / 50
    clean, pulls = paper_unit.output(path.specific_force(t_s), {}), []
    for seed in range(SEEDS):
        noise = noise_of(kind, np.random.default_rng(seed), len(t_s))
        poses = detect(t_s, clean + 1e-4 * noise)[2]
        up = fourteen / paper_unit.scale_factor
        up = up / np.linalg.norm(up, axis=1, keepdims=True)
        pulls += [u @ p.slope / p.slope_error for u, p in zip(up, poses, strict=True)]
    assert len(pulls) == SEEDS * 14
    assert np.mean(np.square(pulls)) == pytest.approx(1, abs=0.35)


def test_correlation_between_axes_is_in_the_covariance(
    paper_unit: Sensor, fourteen: np.ndarray, detect: Detect
) -> None:
    path = Tumble(fourteen, hold_s=20.0, move_s=1.5)
    t_s = np.arange(int(100 * path.round_s)) / 100
    mixing = np.array([[1.0, 0.0, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]]) * 1e-3
    noise = np.random.default_rng(0).standard_normal((len(t_s), 3)) @ mixing.T
    found = [p.covariance for p in detect(t_s, paper_unit.output(path.specific_force(t_s), {}) + noise)[2]]
    mean = np.mean(found, axis=0)
    scale = np.sqrt(np.diag(mean))
    assert (mean / np.outer(scale, scale))[0, 1] == pytest.approx(0.8, abs=0.1)
    assert (mean / np.outer(scale, scale))[0, 2] == pytest.approx(0.0, abs=0.1)


def test_covariances_are_symmetric_and_positive(paper_unit: Sensor, twenty_six: np.ndarray, detect: Detect) -> None:
    path = Tumble(twenty_six, hold_s=2.0, move_s=1.0)
    t_s = np.arange(int(20 * path.round_s)) / 20
    noise = np.random.default_rng(1).standard_normal((len(t_s), 3)) * 1e-3
    for pose in detect(t_s, paper_unit.output(path.specific_force(t_s), {}) + noise)[2]:
        assert pose.covariance == pytest.approx(pose.covariance.T)
        assert np.all(np.linalg.eigvalsh(pose.covariance) > 0)


def test_a_pose_that_creeps_says_so_and_others_do_not(paper_unit: Sensor, fourteen: np.ndarray, detect: Detect) -> None:
    path = Tumble(fourteen, hold_s=10.0, move_s=1.5)
    t_s = np.arange(int(100 * path.round_s)) / 100
    u = paper_unit.output(path.specific_force(t_s), {}) + 1e-3 * np.random.default_rng(0).standard_normal((len(t_s), 3))
    into = t_s - 5 * path.step_s
    u[:, 1] += np.where((into >= 0) & (into < 10), into * 2e-4, 0.0)
    poses = detect(t_s, u)[2]
    assert len(poses) == 14
    assert [bool(np.any(p.creep)) for p in poses] == [i == 5 for i in range(14)]
    assert poses[5].creep[1] == pytest.approx(2e-3, rel=0.3)


def test_what_creep_costs_is_in_the_covariance(paper_unit: Sensor, fourteen: np.ndarray, detect: Detect) -> None:
    path = Tumble(fourteen, hold_s=5.0, move_s=1.5)
    t_s = np.arange(int(100 * path.round_s)) / 100
    u = paper_unit.output(path.specific_force(t_s), {}) + 2e-4 * np.random.default_rng(0).standard_normal((len(t_s), 3))
    still = detect(t_s, u)[2]
    into = t_s - 5 * path.step_s
    # A turn, across the measured vector: what |a| does not feel.
    across = np.cross(fourteen[5], [0.3, -0.5, 0.8])
    during = ((into >= 0) & (into < 5))[:, None]
    turning = detect(t_s, u + np.where(during, into[:, None] * 1e-3 * across * paper_unit.scale_factor, 0.0))[2][5]
    change = 1e-3 * across * paper_unit.scale_factor * (turning.end_s - turning.start_s)
    assert turning.creep == pytest.approx(change, abs=0.1 * np.abs(change).max())
    assert turning.creep_covariance == pytest.approx(np.outer(turning.creep, turning.creep) / 12)
    rest = turning.covariance - turning.creep_covariance
    assert np.all(np.linalg.eigvalsh(rest) > 0)
    assert np.sqrt(np.diag(rest)) == pytest.approx(still[5].standard_error, rel=0.5)
    gradient = fourteen[5] / paper_unit.scale_factor
    assert gradient @ turning.covariance @ gradient < 2 * gradient @ still[5].covariance @ gradient
    assert np.all(still[5].creep_covariance == 0)


@pytest.mark.parametrize(
    ("mean", "covariance", "why"),
    [
        (np.zeros(2), np.eye(3), "mean"),
        (np.zeros(3), np.eye(2), "covariance"),
        (np.array([0, np.nan, 0]), np.eye(3), "not a finite number"),
        (np.zeros(3), np.full((3, 3), np.inf), "not a finite number"),
    ],
)
def test_a_pose_that_cannot_be_is_refused(mean: np.ndarray, covariance: np.ndarray, why: str) -> None:
    with pytest.raises(InvalidData, match=why):
        Pose(0.0, 1.0, 100, mean, covariance, 99.0)


@pytest.mark.parametrize("vibration_g", [5e-3, 5e-2, 0.2])
def test_a_machine_that_shakes_the_stand_does_not_make_poses_creep(
    vibration_g: float, paper_unit: Sensor, fourteen: np.ndarray, detect: Detect
) -> None:
    path = Tumble(fourteen, hold_s=5.0, move_s=1.5)
    t_s = np.arange(int(100 * path.round_s)) / 100
    shaken = vibration_g * np.sin(2 * np.pi * 24.7 * t_s)[:, None] * [1.0, 0.3, 0.5]
    noise = 2e-4 * np.random.default_rng(3).standard_normal((len(t_s), 3))
    poses = detect(t_s, paper_unit.output(path.specific_force(t_s) + shaken + noise, {}))[2]
    assert len(poses) == 14
    assert not any(p.creep.any() for p in poses)


@pytest.mark.slow
def test_a_faulty_span_is_named_and_tells_nothing_of_the_noise_of_the_others(
    paper_unit: Sensor, twenty_six: np.ndarray, detect: Detect
) -> None:
    path = Tumble(twenty_six, hold_s=5.0, move_s=1.5)
    t_s = np.arange(int(100 * path.round_s)) / 100
    noise = 1e-4 * np.random.default_rng(0).standard_normal((len(t_s), 3)) * paper_unit.scale_factor
    u = paper_unit.output(path.specific_force(t_s), {}) + noise
    windows, spans, clean = detect(t_s, u)
    assert [p.fault for p in clean] == [""] * 26
    u[(t_s > clean[9].start_s) & (t_s < clean[9].end_s), 0] = clean[9].mean[0]
    windows, spans, _ = detect(t_s, u)
    assert len(spans) == 26
    poses = poses_of(windows, spans, {9: "stuck_output"})
    assert [p.fault for p in poses] == [""] * 9 + ["stuck_output"] + [""] * 16
    for before, after in zip(clean, poses, strict=True):
        if not after.fault:
            assert after.standard_error == pytest.approx(before.standard_error, rel=0.05)
    assert poses[10].before == pytest.approx(poses[9].mean)
