"""Poses of which only the means are known: what they carry, and what their noise is told by."""

from __future__ import annotations

import numpy as np
import pytest

import triaxcal as tc
from triaxcal.model.sensor import Sensor

NOISE = 1e-4
UPS = np.array([pose.up for pose in tc.plan(26)])
UNIT = Sensor(np.array([2.0, 2.02, 1.99]), np.array([2e-3, -1e-3, 3e-3]), np.array([0.02, -0.01, 0.03]))


def means(seed: int, bend: float = 0.0) -> np.ndarray:
    """(27,3) with noise of known size; ``bend`` is a second-order nonlinearity that no model knows of."""
    return UNIT.output(UPS + bend * UPS**2, {}) + np.random.default_rng(seed).normal(0, NOISE, UPS.shape)


@pytest.mark.slow
def test_the_noise_told_from_residuals_gives_errors_of_the_right_size() -> None:
    ratios, scores = [], []
    for seed in range(60):
        poses = tc.Poses.of_means(means(seed))
        ratios.append(poses[0].standard_error[0] / NOISE)
        c = tc.calibrate(poses)
        errors = [c.standard_errors[f"scale_factor.{axis}"] for axis in "xyz"]
        scores.extend((c.scale_factor - UNIT.scale_factor) / errors)
    assert np.sqrt(np.mean(np.square(ratios))) == pytest.approx(1, abs=0.1)
    assert np.std(scores) == pytest.approx(1, abs=0.15)


@pytest.mark.slow
def test_standard_errors_that_are_known_are_taken_and_lack_of_fit_shows() -> None:
    bent = means(1, bend=3e-3)
    known = tc.calibrate(tc.Poses.of_means(bent, standard_errors=np.full(bent.shape, NOISE)))
    assert known.residual.lack_of_fit_p < 1e-6
    assert tc.calibrate(tc.Poses.of_means(bent)).residual.lack_of_fit_p > 0.1
    found = tc.diagnose(tc.Poses.of_means(bent, standard_errors=np.full(bent.shape, NOISE)))
    assert [f.effect for f in found.findings] == ["second_order_nonlinearity"]


def test_a_mean_that_is_spoiled_does_not_count_as_noise() -> None:
    u = means(2)
    u[3] += 0.02
    poses = tc.Poses.of_means(u)
    assert poses[0].standard_error[0] < 2 * NOISE
    assert [str(p.excluded) for p in tc.calibrate(poses).poses if p.excluded] == ["outlier"]


def test_times_and_channels_are_those_of_the_rows() -> None:
    poses = tc.Poses.of_means(means(3), t=np.arange(27) * 10.0 + 5, channels={"temp_c": np.linspace(20, 30, 27)})
    assert [p.t_s for p in poses[:3]] == pytest.approx([0, 10, 20])
    assert poses[26].channels["temp_c"] == 30


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda u: tc.Poses.of_means(u[:9]), tc.Refused, "9 pose means without standard errors"),
        (lambda u: tc.Poses.of_means(u, standard_errors=0 * u), tc.InvalidData, "have to be positive"),
        (
            lambda u: tc.Poses.of_means(u, standard_errors=u[:5]),
            tc.InvalidData,
            r"not \(5, 3\)",
        ),
        (lambda u: tc.Poses.of_means(u[0]), tc.InvalidData, "one row a pose"),
        (lambda u: tc.Poses.of_means(u, t=[1.0, 2.0]), tc.InvalidData, "t has 2 times, and u has 27 poses"),
    ],
)
def test_what_cannot_be_poses_is_said(call, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        call(means(4))
