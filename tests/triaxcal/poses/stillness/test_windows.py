"""Outputs in steps as wide as their noise, or wider: bits that are few, and dither that is partial."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from triaxcal.estimate.pose_fit import fit
from triaxcal.model.sensor import Sensor
from triaxcal.poses.pose import Pose
from triaxcal.poses.quality import QualityDetector
from triaxcal.poses.stillness.windows import (
    mean_rounding_variance,
    noise_of,
    resolution,
    shown_step,
    widest_variance,
)
from triaxcal.synthetic import SyntheticUnit, Tumble

Detect = Callable[..., Any]
STEP_G = 4 / 4096
"""Twelve bits over ±2 g."""
PARTIAL = [0.05, 0.1, 0.2, 0.3, 0.4, 0.6]
"""Noise in steps."""


def unit_of(seed: int) -> Sensor:
    rng = np.random.default_rng(seed)
    return Sensor(1 + 0.03 * rng.standard_normal(3), 0.01 * rng.standard_normal(3), 0.03 * rng.standard_normal(3))


def coarse(
    sigma: float, seed: int, directions: np.ndarray, rate_hz: float = 50.0, decimals: int | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, Tumble]:
    """Times, readings in steps of `STEP_G` with noise of ``sigma`` steps, the true means, and the path. An axis differs
    from the next in its noise; ``decimals`` are printed.
    """
    rng = np.random.default_rng([7, seed])
    tilted = directions + 0.03 * rng.standard_normal(directions.shape)
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    path = Tumble(tilted, 5.0, 1.5)
    t_s = np.arange(int(rate_hz * (path.round_s - path.move_s))) / rate_hz
    noise = sigma * STEP_G * np.array([0.8, 1.0, 1.25])
    u, _ = SyntheticUnit(unit_of(seed), path, noise, seed=seed).sample(t_s)
    u = np.round(u / STEP_G) * STEP_G
    return t_s, u if decimals is None else np.round(u, decimals), unit_of(seed).output(tilted, {}), path


def in_which(poses: list[Pose], path: Tumble) -> list[int]:
    return [int((p.start_s + p.end_s) / 2 // path.step_s) for p in poses]


def rounded(place: np.ndarray, sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance of rounded Gaussian noise about each place, by the exact sums."""
    codes = np.arange(-8, 9)[None, :]
    at = place[:, None]
    p = stats.norm.cdf((codes + 0.5 - at) / sigma) - stats.norm.cdf((codes - 0.5 - at) / sigma)
    mean = (codes * p).sum(axis=1)
    return mean, ((codes - mean[:, None]) ** 2 * p).sum(axis=1)


@pytest.mark.parametrize("sigma", [0.03, *PARTIAL, 0.95])
def test_what_rounding_does_to_means_and_scatters_is_that_of_the_exact_sums(sigma: float) -> None:
    place = (np.arange(2000) + 0.5) / 2000
    mean, variance = rounded(place, sigma)
    one = np.array([sigma])
    assert mean_rounding_variance(one)[0] == pytest.approx(np.mean((mean - place) ** 2), rel=0.01, abs=1e-9)
    assert widest_variance(one)[0] == pytest.approx(rounded(np.array([0.5]), sigma)[1][0], rel=0.02)
    assert noise_of(np.array([variance.mean()]))[0] == pytest.approx(sigma, abs=0.004)


@pytest.mark.slow
@pytest.mark.parametrize("decimals", [None, 4])
@pytest.mark.parametrize("sigma", PARTIAL)
def test_every_pose_is_found_once_however_little_dither(
    sigma: float, decimals: int | None, fourteen: np.ndarray, detect: Detect
) -> None:
    for seed in range(2):
        t_s, u, _, path = coarse(sigma, seed, fourteen, decimals=decimals)
        poses = detect(t_s, u)[2]
        assert in_which(poses, path) == list(range(len(fourteen)))
        for i, p in enumerate(poses):
            # A move shows when the output has left its step.
            assert p.start_s > i * path.step_s - 0.2
            assert p.end_s < i * path.step_s + path.hold_s + 0.2


@pytest.mark.slow
def test_knocks_on_a_unit_of_few_bits_split_no_pose(fourteen: np.ndarray, detect: Detect) -> None:
    for seed in range(3):
        t_s, u, _, path = coarse(0.1, seed, fourteen)
        knocked = (t_s // path.step_s % 4 == 0) & (np.abs(t_s % path.step_s - 2.5) < 0.1)
        shock = np.round(20 * np.random.default_rng(seed).standard_normal(u.shape)) * STEP_G
        assert in_which(detect(t_s, u + shock * knocked[:, None])[2], path) == list(range(len(fourteen)))


@pytest.mark.slow
@pytest.mark.parametrize("decimals", [None, 4])
@pytest.mark.parametrize("sigma", PARTIAL)
def test_standard_errors_hold_what_partial_dither_leaves(
    sigma: float, decimals: int | None, twenty_six: np.ndarray, detect: Detect
) -> None:
    squares, p_values = [], []
    for seed in range(3):
        t_s, u, truth, _ = coarse(sigma, seed, twenty_six, decimals=decimals)
        poses = detect(t_s, u)[2]
        squares += [((p.mean - v) / p.standard_error) ** 2 for p, v in zip(poses, truth, strict=True)]
        p_values.append(fit(poses, signs=(1, 1, 1)).residual.lack_of_fit_p)
    # 234 errors: by chance 0.1 off.
    assert np.mean(squares) == pytest.approx(1.0, abs=0.3)
    assert all(p is not None and 0.001 < p < 0.999 for p in p_values)


def test_steps_are_seen_behind_decimals_that_do_not_fit_them(fourteen: np.ndarray, detect: Detect) -> None:
    t_s, u, _, _ = coarse(0.2, 0, fourteen, decimals=4)
    w = detect(t_s, u)[0]
    assert len(np.unique(np.round(np.diff(np.unique(u[:, 0])), 6))) > 1
    assert resolution(w) == pytest.approx(np.full(3, STEP_G), rel=0.05)


def test_windows_that_move_by_two_steps_hide_no_step(fourteen: np.ndarray, detect: Detect) -> None:
    t_s, u, _, _ = coarse(0.2, 0, fourteen, decimals=4)
    w = detect(t_s, u)[0]
    at = np.flatnonzero((w.hop > 0).all(axis=1))[:11]
    few = np.zeros_like(w.hop)
    few[at] = w.hop[at] * np.where(np.arange(11) < 2, 2, 1)[:, None]
    assert resolution(replace(w, hop=few)) == pytest.approx(np.full(3, STEP_G), rel=0.05)


def test_steps_that_the_readings_keep_are_taken_as_they_are(fourteen: np.ndarray, detect: Detect) -> None:
    for sigma in (0.2, 3.0):
        t_s, u, _, _ = coarse(sigma, 0, fourteen)
        assert resolution(detect(t_s, u)[0]) == pytest.approx(np.full(3, STEP_G), rel=1e-6)


def test_outputs_without_steps_show_none(fourteen: np.ndarray, detect: Detect) -> None:
    rng = np.random.default_rng(0)
    # Three samples a window, and a sensor that is read eight times as often as it updates.
    for rate_hz, repeats in ((30.0, 1), (200.0, 8)):
        t_s = np.arange(int(60 * rate_hz)) / rate_hz
        noise = np.repeat(rng.standard_normal((len(t_s) // repeats + 1, 3)), repeats, axis=0)[: len(t_s)]
        w = detect(t_s, fourteen[(t_s // 5).astype(int)] + 1e-3 * noise)[0]
        assert (shown_step(w) == 0).all()


def test_decimals_neither_hide_coarse_steps_nor_make_an_output_stuck(fourteen: np.ndarray, detect: Detect) -> None:
    for sigma in (0.05, 0.15):
        t_s, u, _, _ = coarse(sigma, 1, fourteen, decimals=4)
        w, spans, _ = detect(t_s, u)
        judge = QualityDetector()
        judge.feed(np.round(t_s * 1e9).astype(np.int64), u)
        judge.finish()
        assert [f.name for f in judge.findings(w, spans)] == ["coarse_quantization"]
