"""Tones of a machine: found, taken out of the noise, and counted for what they add to a mean."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from benchmarks.noise import first_order, white
from triaxcal.poses.noise_spectrum import Track
from triaxcal.poses.pose import poses_of
from triaxcal.poses.pose_noise import without_tones
from triaxcal.poses.stillness.detector import Span
from triaxcal.poses.stillness.windows import WindowCutter

NOISES = [(white, ()), (first_order, (5.0,))]


def track(deviation: np.ndarray, place: np.ndarray | None = None) -> Track:
    return Track(np.arange(len(deviation)) if place is None else place, deviation - deviation.mean(axis=0))


def sine(n: int, cycles: float, amplitude: float, phase: float) -> np.ndarray:
    return amplitude * np.sin(2 * np.pi * cycles * np.arange(n) / n + phase)[:, None]


@pytest.mark.parametrize(("kind", "parameter"), NOISES)
@pytest.mark.parametrize("n", [24, 50, 200])
def test_noise_seldom_shows_a_tone_and_keeps_its_variance(
    kind: Callable[..., np.ndarray], parameter: tuple[float, ...], n: int
) -> None:
    runs, shown, kept = 400, 0, []
    for seed in range(runs):
        noise = track(kind(n, *parameter, np.random.default_rng(seed)))
        cleaned = without_tones(noise)
        shown += cleaned.track is not noise
        kept.append(cleaned.track.deviation.var() / noise.deviation.var())
    # One pose in two hundred, and four standard deviations of a count of two.
    assert shown <= 8
    assert np.mean(kept) == pytest.approx(1, abs=3e-3)


@pytest.mark.parametrize("missing", [[], [3, 17, 18, 19]], ids=["whole", "with a bump"])
def test_tones_are_taken_out_and_the_noise_is_left(missing: list[int]) -> None:
    place = np.delete(np.arange(80), missing)
    left = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        noise = white(80, rng)
        tones = sine(80, rng.uniform(8, 18), 12.0, rng.uniform(0, 6)) + sine(80, rng.uniform(22, 36), 5.0, 1.0)
        cleaned = without_tones(track((noise + tones)[place], place))
        left.append(cleaned.track.deviation.var() / track(noise[place]).deviation.var())
    assert np.median(left) == pytest.approx(1, abs=0.1)


@pytest.mark.slow
def test_what_a_tone_adds_to_a_mean_is_known_over_its_phases_and_frequencies() -> None:
    rng = np.random.default_rng(0)
    stated, added = [], []
    for _ in range(300):
        cycles, phase = rng.uniform(4.5, 20), rng.uniform(0, 2 * np.pi)
        tone = sine(60, cycles, 10.0, phase)
        added.append(tone.mean() ** 2)
        stated.append(without_tones(track(tone + 0.1 * white(60, rng)[:, :1])).variance[0])
    assert np.mean(stated) == pytest.approx(np.mean(added), rel=0.25)


def test_a_tone_slower_than_four_cycles_a_pose_is_noise_of_the_mean() -> None:
    slow = track(sine(100, 2.3, 20.0, 0.4) + white(100, np.random.default_rng(1)))
    assert without_tones(slow).track.deviation.std() > 10


@pytest.mark.slow
@pytest.mark.parametrize("hertz", [12.4, 27.2, 31.7, 43.3])
def test_poses_shaken_by_a_machine_have_the_standard_errors_of_the_quiet_ones(hertz: float) -> None:
    """Half of 26 poses of 6 s at 100 Hz are shaken by 5 mg beside 0.1 mg of noise."""
    count, samples = 26, 750
    ratios = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        up = rng.standard_normal((count, 3))
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        shaken = (np.arange(count * samples) // samples) % 2 == 1
        tone = 5e-3 * shaken * np.sin(2 * np.pi * hertz * np.arange(len(shaken)) / 100)
        cutter = WindowCutter()
        readings = np.repeat(up, samples, axis=0) + 1e-4 * white(len(shaken), rng) + tone[:, None] * [1.0, -0.6, 0.8]
        cutter.feed(np.arange(len(shaken)) * 10_000_000, readings)
        cutter.finish()
        spans = [Span(np.arange(75 * i, 75 * i + 60)) for i in range(count)]
        poses = poses_of(cutter.windows(), spans)
        # Of a mean: noise over the root of 600 samples; half the mean square over the phases of a tone's part at most.
        most = 5e-3 / (600 * np.sin(np.pi * hertz / 100))
        for i, (p, u) in enumerate(zip(poses, up, strict=True)):
            true = 1e-4**2 / 600 + (i % 2) * (most * (u @ [1.0, -0.6, 0.8])) ** 2 / 4
            ratios.append(np.sqrt(u @ p.covariance @ u / true))
    quiet, loud = np.array(ratios)[::2], np.array(ratios)[1::2]
    assert np.sqrt(np.mean(quiet**2)) == pytest.approx(1, abs=0.2)
    assert np.sqrt(np.mean(loud**2)) == pytest.approx(1, abs=0.35)
