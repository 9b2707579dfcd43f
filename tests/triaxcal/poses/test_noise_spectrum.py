"""Standard errors of pose means from the common spectrum: formulas against matrices, pulls against truth."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy import integrate, linalg, stats

from benchmarks.noise import first_order, flicker, moving_average, white
from triaxcal.poses import noise_spectrum
from triaxcal.poses.noise_spectrum import SLOWEST, Components, NoiseLevels, Spectrum, Track, periodogram
from triaxcal.poses.pose import Pose, poses_of
from triaxcal.poses.stillness.detector import Span
from triaxcal.poses.stillness.windows import WindowCutter

WINDOW = 10
PLACES = [np.arange(31), np.arange(32), np.delete(np.arange(40), [3, 4, 5, 20])]


def averaged(of_lag: Callable[[np.ndarray], np.ndarray], lags: int, fine: int = 400) -> np.ndarray:
    """Autocovariance of averages over unit windows of a process whose autocovariance is given, by brute force."""
    inside = (np.arange(fine) + 0.5) / fine
    apart = inside[:, None] - inside[None]
    return np.array([of_lag(np.abs(k + apart)).mean() for k in range(lags)])


def test_autocovariances_of_window_averages_are_those_of_a_fine_grid() -> None:
    c = Components.of(6, 40.0, 1000.0).autocovariance
    for constant, row in ((0.4, c[2]), (8.0, c[13])):
        assert row == pytest.approx(averaged(lambda lag, t=constant: np.exp(-lag / t), 6), abs=1e-4)
    for length, row in ((0.5, c[14]), (5.0, c[25])):
        by_hand = averaged(lambda lag, n=length: np.maximum(1 - lag / n, 0), 6)
        assert row == pytest.approx(by_hand / by_hand[0], abs=1e-3)


def test_flicker_about_its_mean_over_the_recording_is_that_above_the_slowest_frequency() -> None:
    inside, _ = integrate.quad(lambda x: (1 - np.sinc(x) ** 2) / x, 1e-9, 50, limit=2000)
    assert inside == pytest.approx(np.log(50 / SLOWEST), abs=0.01)


@pytest.mark.parametrize("place", PLACES, ids=["odd", "even", "with a bump"])
def test_variances_of_mean_and_slope_are_those_of_the_whole_covariance_matrix(place: np.ndarray) -> None:
    c = Components.of(40, 40.0, 1000.0)
    track = Track(place, np.zeros((len(place), 1)))
    for row in c.autocovariance[:-1]:
        matrix = linalg.toeplitz(row)[np.ix_(place, place)]
        spectrum = Spectrum(row[None], (NoiseLevels.known_by(10.0),), 0.5)
        x = place - place.mean()
        assert spectrum.variance_of_mean(track) == pytest.approx(matrix.mean(), rel=1e-9)
        assert spectrum.variance_of_slope(track) == pytest.approx(x @ matrix @ x / (x @ x) ** 2, rel=1e-9)


def test_the_expected_periodogram_has_the_same_bits_where_a_long_pose_takes_it_in_parts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tracks = [Track(np.arange(n), np.random.default_rng(n).standard_normal((n, 3))) for n in (600, 90)]
    c = Components.of(600, 90.0, 3000.0)
    whole = periodogram(tracks, c)
    assert len(list(c.parts(600))) == 1
    monkeypatch.setattr(noise_spectrum, "PART", 8 * 600)
    assert [len(part) for part in c.parts(600)] == [8, 8, 8, 3]
    assert np.array_equal(periodogram(tracks, c).expected, whole.expected)
    assert np.array_equal(periodogram(tracks, c).power, whole.power)


def test_the_expected_periodogram_is_that_of_the_whole_covariance_matrix() -> None:
    n = 13
    c = Components.of(n, 13.0, 300.0)
    p = periodogram([Track(np.arange(n), np.zeros((n, 1)))], c)
    centre = np.eye(n) - 1 / n
    for j in range(1, n // 2 + 1):
        wave = np.exp(-2j * np.pi * j * np.arange(n) / n)
        for i, row in enumerate(c.autocovariance):
            power = (wave.conj() @ centre @ linalg.toeplitz(row) @ centre @ wave).real / n
            assert p.expected[j - 1, i] == pytest.approx(power, abs=1e-9)


def test_the_expected_periodogram_of_a_pose_with_a_long_gap_is_without_what_its_mean_takes() -> None:
    n, place = 23, np.r_[0:7, 16:23]
    c = Components.of(n, 23.0, 300.0)
    p = periodogram([Track(place, np.zeros((len(place), 1)))], c)
    there = np.zeros(n)
    there[place] = 1.0
    less_mean = np.diag(there) - np.outer(there, there) / len(place)
    for j in range(1, 8):  # those above stand in bands
        wave = np.exp(-2j * np.pi * j * np.arange(n) / n) @ less_mean
        for i, row in enumerate(c.autocovariance):
            power = (wave.conj() @ linalg.toeplitz(row) @ wave).real / len(place)
            assert p.expected[j - 1, i] == pytest.approx(power, abs=1e-9)


def poses_in(noise: np.ndarray, count: int, seconds: float, gap_s: float) -> tuple[list[Pose], np.ndarray]:
    """Poses of ``seconds`` at 100 Hz in noise, whose spans are known, about directions all over the sphere."""
    step = int((seconds + gap_s) * 100)
    directions = np.random.default_rng(count).standard_normal((count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    cutter = WindowCutter()
    cutter.feed(np.arange(count * step) * 10_000_000, np.repeat(directions, step, axis=0) + noise)
    cutter.finish()
    starts = [-(-i * step // WINDOW) for i in range(count)]
    spans = [Span(np.arange(a, a + int(seconds * 100 / WINDOW))) for a in starts]
    return poses_of(cutter.windows(), spans), directions


def pulls(kind: Callable[..., np.ndarray], *parameter: float, seconds: float = 5.0, seeds: int = 12) -> np.ndarray:
    """(seeds, 26, 3)"""
    out = []
    for seed in range(seeds):
        noise = kind(26 * int((seconds + 1.5) * 100), *parameter, np.random.default_rng(seed)) * 1e-3
        poses, truth = poses_in(noise, 26, seconds, 1.5)
        out.append([(p.mean - a) / p.standard_error for p, a in zip(poses, truth, strict=True)])
    return np.array(out)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "parameter", "seconds"),
    [
        (white, (), 5.0),
        (white, (), 1.0),
        (moving_average, (10,), 5.0),
        (first_order, (10.0,), 5.0),
        (first_order, (50.0,), 5.0),
        (first_order, (50.0,), 20.0),
        (flicker, (0.1,), 5.0),
    ],
)
def test_pulls_have_variance_one_within_a_twentieth_for_white_and_coloured_noise(
    kind: Callable[..., np.ndarray], parameter: tuple[float, ...], seconds: float
) -> None:
    by_run = (pulls(kind, *parameter, seconds=seconds) ** 2).mean(axis=(1, 2))
    # On top of the twentieth, three standard deviations of a mean over the runs.
    assert by_run.mean() == pytest.approx(1, abs=0.05 + 3 * by_run.std(ddof=1) / np.sqrt(len(by_run)))


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 6])
def test_with_few_windows_student_intervals_still_cover(count: int) -> None:
    hits, trials = 0, 0
    for seed in range(40):
        noise = white(count * 250, np.random.default_rng(seed)) * 1e-3
        poses, truth = poses_in(noise, count, 1.0, 1.5)
        for p, a in zip(poses, truth, strict=True):
            limit = stats.t.ppf(0.975, p.dof)
            hits += int((np.abs((p.mean - a) / p.standard_error) < limit).sum())
            trials += 3
    # One run's poses share their noise estimate: at least as many independent trials as there are runs and axes.
    assert hits / trials > 0.95 - 3 * np.sqrt(0.95 * 0.05 / 120)


@pytest.mark.slow
def test_one_noise_is_seen_where_the_axes_differ_a_thousandfold() -> None:
    squares = []
    for seed in range(10):
        noise = first_order(26 * 650, 20.0, np.random.default_rng(seed)) * np.array([1e-6, 1e-4, 1e-3])
        poses, truth = poses_in(noise, 26, 5.0, 1.5)
        squares.append([((p.mean - a) / p.standard_error) ** 2 for p, a in zip(poses, truth, strict=True)])
    assert np.mean(squares, axis=(0, 1)) == pytest.approx(np.ones(3), abs=0.05 + 4 * np.sqrt(2 / 260))
