"""A unit that turns and never rests, judged by its truth and by the Cramér–Rao bound."""

from __future__ import annotations

import numpy as np
import pytest

from triaxcal.errors import InvalidData, Refused
from triaxcal.rotation import Moments, fit_rotation
from triaxcal.sensor import Sensor

SIGNS = (-1, 1, 1)


@pytest.fixture(scope="module")
def unit() -> Sensor:
    return Sensor(np.array([-2.41, 2.0, 3.1]), np.array([6e-3, 4e-2, -6e-3]), np.array([0.05, -0.03, 0.04]))


def truth(unit: Sensor) -> np.ndarray:
    return np.concatenate([unit.scale_factor, unit.misalignment, unit.bias])


def turning(unit: Sensor, count: int, noise_g: float, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    a = rng.standard_normal((count, 3))
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    return unit.output(a, {}) + rng.standard_normal((count, 3)) * noise_g * unit.scale_factor


def fitted(u: np.ndarray, reference: float = 1.0) -> tuple[np.ndarray, np.ndarray, float]:
    moments = Moments()
    moments.feed(u)
    found = fit_rotation(moments, signs=SIGNS, reference=reference)
    s = found.sensor
    return np.concatenate([s.scale_factor, s.misalignment, s.bias]), found.standard_error, found.noise_g


def bound(unit: Sensor, count: int, noise_g: float) -> np.ndarray:
    """Of the nine coefficients, with each sample's attitude as a nuisance, for directions all over the sphere."""
    rng = np.random.default_rng(99)
    a = rng.standard_normal((4000, 3))
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    p = truth(unit)

    def magnitude(p: np.ndarray) -> np.ndarray:
        return np.linalg.norm(Sensor(p[:3], p[3:6], p[6:]).specific_force(unit.output(a, {}), {}), axis=1)

    J = np.stack([(magnitude(p + h) - magnitude(p - h)) / 2e-6 for h in 1e-6 * np.eye(9)], axis=1)
    # The noise is alike along each sensitive axis in g; across non-orthogonal axes of 0.04 rad it is so within 2e-3.
    return np.sqrt(np.diag(np.linalg.inv(J.T @ J / len(a) * count))) * noise_g


def test_the_spread_over_seeds_is_within_fifteen_percent_of_the_bound_at_large_noise(unit: Sensor) -> None:
    count, noise_g, seeds = 100_000, 0.02, 40
    errors = np.array([fitted(turning(unit, count, noise_g, seed))[0] - truth(unit) for seed in range(seeds)])
    pulls = errors / bound(unit, count, noise_g)
    # 360 pulls: the rms of unit ones is within 8 % of 1 in all but one of a hundred sets.
    assert np.sqrt(np.mean(pulls**2)) < 1.15


def test_the_mean_over_seeds_is_the_truth_where_an_ordinary_fit_is_biased(unit: Sensor) -> None:
    count, noise_g = 100_000, 0.02
    pulls = np.array(
        [
            (fitted(turning(unit, count, noise_g, seed))[0] - truth(unit)) / bound(unit, count, noise_g)
            for seed in range(20)
        ]
    )
    assert np.max(np.abs(pulls.mean(axis=0))) < 4 / np.sqrt(20)


def test_the_stated_errors_are_the_bound(unit: Sensor) -> None:
    _, stated, _ = fitted(turning(unit, 50_000, 0.002, 1))
    assert stated == pytest.approx(bound(unit, 50_000, 0.002), rel=0.03)


def test_the_noise_is_estimated(unit: Sensor) -> None:
    for noise_g in (1e-3, 0.02, 0.05):
        estimates = [fitted(turning(unit, 20_000, noise_g, seed))[2] for seed in range(10)]
        assert np.mean(estimates) == pytest.approx(noise_g, rel=0.01)


def test_without_noise_the_truth_comes_back(unit: Sensor) -> None:
    found, _, noise_g = fitted(turning(unit, 5000, 0.0, 3))
    assert found == pytest.approx(truth(unit), rel=1e-6, abs=1e-8)
    assert noise_g < 1e-6


def test_an_offset_of_a_24_bit_converter_costs_no_digits() -> None:
    counts = Sensor(np.array([-4e5, 4e5, 4.1e5]), np.array([6e-3, 4e-3, -6e-3]), np.array([20.0, 21.0, 19.0]))
    found, stated, _ = fitted(turning(counts, 50_000, 1e-3, 4))
    assert np.max(np.abs(found - truth(counts)) / stated) < 4.5


def test_blocks_of_any_size_give_the_same(unit: Sensor) -> None:
    u = turning(unit, 30_000, 0.01, 5)
    whole, parts = Moments(), Moments()
    whole.feed(u)
    parts.feed(u[:20_000])  # the first block fixes the scaling, whose range is that of the data seen
    for start in range(20_000, 30_000, 777):
        parts.feed(u[start : min(start + 777, 30_000)])
    one, other = fit_rotation(whole, signs=SIGNS), fit_rotation(parts, signs=SIGNS)
    assert other.sensor.scale_factor == pytest.approx(one.sensor.scale_factor, rel=1e-9)
    assert other.noise_g == pytest.approx(one.noise_g, rel=1e-7)


def test_the_reference_sets_the_unit(unit: Sensor) -> None:
    found, _, _ = fitted(turning(unit, 20_000, 1e-3, 6), reference=9.80665)
    assert found[:3] == pytest.approx(truth(unit)[:3] / 9.80665, rel=1e-3)
    assert found[6:] == pytest.approx(truth(unit)[6:] * 9.80665, abs=1e-3)


def test_memory_does_not_grow_with_the_samples(unit: Sensor) -> None:
    moments = Moments()
    for seed in range(5):
        moments.feed(turning(unit, 1000, 0.01, seed))
        assert moments.sums.shape == (10, 10)
    assert moments.count == 5000


@pytest.mark.parametrize(
    "plane", [np.eye(3)[:2], np.array([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0]]) / np.sqrt([[2.0], [1.0]])]
)
def test_turning_about_one_axis_alone_is_refused(unit: Sensor, plane: np.ndarray) -> None:
    angle = np.linspace(0, 20 * np.pi, 20_000)
    a = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ plane
    moments = Moments()
    moments.feed(unit.output(a, {}) + np.random.default_rng(0).standard_normal((20_000, 3)) * 1e-3)
    with pytest.raises(Refused, match=r"more axes|no ellipsoid"):
        fit_rotation(moments)


def test_too_few_samples_are_refused(unit: Sensor) -> None:
    moments = Moments()
    moments.feed(turning(unit, 50, 0.01, 1))
    with pytest.raises(Refused, match="50 samples"):
        fit_rotation(moments)


def test_a_reading_that_is_no_number_is_refused() -> None:
    with pytest.raises(InvalidData, match="finite"):
        Moments().feed(np.array([[1.0, np.nan, 0.0]]))
