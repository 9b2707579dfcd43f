"""A unit that turns and never rests, judged by its truth and by the Cramér–Rao bound."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy import signal, stats

from triaxcal.errors import InvalidData, Refused
from triaxcal.inputs.moments import MONOMIALS, STRETCHES_MOST, Moments, Temperature
from triaxcal.inputs.rotation import (
    CoarseSteps,
    NoiseUnequal,
    NoiseUnseen,
    RotationFit,
    StretchesDiffer,
    StretchesExcluded,
    fit_rotation,
)
from triaxcal.model.sensor import Sensor

SIGNS = (-1, 1, 1)
Make = Callable[[np.ndarray, np.random.Generator], np.ndarray]


@pytest.fixture(scope="module")
def unit() -> Sensor:
    return Sensor(np.array([-2.41, 2.0, 3.1]), np.array([6e-3, 4e-2, -6e-3]), np.array([0.05, -0.03, 0.04]))


def truth(unit: Sensor) -> np.ndarray:
    return np.concatenate([unit.scale_factor, unit.misalignment, unit.bias])


def path(count: int, step_rad: float = 0.01) -> np.ndarray:
    """Directions (n,3) of a slow turn about two axes at once, which passes everywhere."""
    t = np.arange(count) * step_rad
    z = 0.999 * np.sin(np.pi / 2 * (2 * np.abs(0.618 * t / np.pi % 2 - 1) - 1))
    r = np.sqrt(1 - z**2)
    return np.stack([r * np.cos(np.pi * t), r * np.sin(np.pi * t), z], axis=1)


def outputs(unit: Sensor, a: np.ndarray, noise_g: float | list[float], seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return unit.output(a, {}) + rng.standard_normal(a.shape) * noise_g * unit.scale_factor


def fitted(u: np.ndarray, reference: float = 1.0, signs: tuple[int, int, int] = SIGNS) -> RotationFit:
    moments = Moments()
    moments.feed(u)
    return fit_rotation(moments, signs=signs, reference=reference)


def bound(unit: Sensor, a: np.ndarray, noise_g: float | list[float]) -> np.ndarray:
    """Cramér–Rao (9,9) with each sample's attitude as a nuisance, from derivatives of |a| by differences."""
    p, u = truth(unit), unit.output(a, {})

    def magnitude(p: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.linalg.norm(Sensor(p[:3], p[3:6], p[6:]).specific_force(u, {}), axis=1)

    J = np.stack([(magnitude(p + h, u) - magnitude(p - h, u)) / 2e-6 for h in 1e-6 * np.eye(9)], axis=1)
    by_u = np.stack([(magnitude(p, u + h) - magnitude(p, u - h)) / 2e-6 for h in 1e-6 * np.eye(3)], axis=1)
    variance = (by_u**2) @ (np.broadcast_to(noise_g, 3) * unit.scale_factor) ** 2
    return np.asarray(np.linalg.inv((J.T / variance) @ J))


def squares(errors: list[np.ndarray], covariances: list[np.ndarray]) -> float:
    """Mean over seeds and parameters of squared errors in units of a covariance; 1 is expected of a true one."""
    each = [e @ np.linalg.solve(C, e) for e, C in zip(errors, covariances, strict=True)]
    return float(np.mean(each)) / 9


def chance(seeds: int) -> tuple[float, float]:
    """Within which `squares` of a true covariance lies in all but one of a thousand sets."""
    low, high = stats.chi2.interval(0.999, 9 * seeds) / np.array(9 * seeds)
    return float(low), float(high)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("count", "noise_g", "seeds"),
    [(1000, 1e-4, 60), (1000, 0.05, 60), (10_000, 0.02, 40), (100_000, 0.02, 25)],
)
def test_the_spread_is_within_fifteen_percent_of_the_bound_and_the_stated_errors_are_true(
    unit: Sensor, count: int, noise_g: float, seeds: int
) -> None:
    a = path(count, 0.05 if count == 1000 else 0.01)
    found = [fitted(outputs(unit, a, noise_g, seed)).calibration for seed in range(seeds)]
    errors = [c.values - truth(unit) for c in found]
    assert squares(errors, [bound(unit, a, noise_g)] * seeds) < 1.15**2
    low, high = chance(seeds)
    assert low < squares(errors, [c.covariance for c in found]) < high


def test_the_mean_over_seeds_is_the_truth_where_an_ordinary_fit_is_biased(unit: Sensor) -> None:
    a, seeds = path(100_000), 8
    errors = [fitted(outputs(unit, a, 0.02, seed)).calibration.values - truth(unit) for seed in range(seeds)]
    pulls = np.mean(errors, axis=0) / np.sqrt(np.diag(bound(unit, a, 0.02)) / seeds)
    assert np.max(np.abs(pulls)) < stats.norm.isf(0.0005 / 9)


@pytest.mark.slow
@pytest.mark.parametrize("noise_g", [[0.02, 0.01, 0.02], [0.01, 0.01, 0.03]])
def test_unequal_noise_is_told_by_axis_and_biases_nothing(unit: Sensor, noise_g: list[float]) -> None:
    a, seeds = path(20_000), 30
    found = [fitted(outputs(unit, a, noise_g, seed)) for seed in range(seeds)]
    assert np.mean([f.noise_g for f in found], axis=0) == pytest.approx(noise_g, rel=0.02)
    errors = [f.calibration.values - truth(unit) for f in found]
    low, high = chance(seeds)
    assert low < squares(errors, [f.calibration.covariance for f in found]) < high
    # Without weights the errors are larger than the bound, by no more than this at a ratio of three.
    assert squares(errors, [bound(unit, a, noise_g)] * seeds) < 1.35**2
    warned = [any(isinstance(c, NoiseUnequal) for c in f.calibration.cautions) for f in found]
    assert all(warned) if max(noise_g) / min(noise_g) > 2.5 else not any(warned)


@pytest.mark.slow
def test_the_noise_is_estimated(unit: Sensor) -> None:
    for noise_g in (1e-6, 1e-3, 0.02, 0.05):
        estimates = [fitted(outputs(unit, path(20_000), noise_g, seed)).noise_g for seed in range(10)]
        assert np.mean(estimates) == pytest.approx(noise_g, rel=0.01)


def test_without_noise_the_truth_comes_back_and_the_stated_error_covers_the_arithmetic(unit: Sensor) -> None:
    f = fitted(outputs(unit, path(5000), 0.0, 3))
    error = np.abs(f.calibration.values - truth(unit))
    assert np.max(error) < 1e-9
    assert np.all(error < 4 * f.calibration.standard_errors)
    assert np.max(f.noise_g) < 1e-7


def test_an_offset_of_a_24_bit_converter_costs_no_digits() -> None:
    counts = Sensor(np.array([-4e5, 4e5, 4.1e5]), np.array([6e-3, 4e-3, -6e-3]), np.array([20.0, 21.0, 19.0]))
    c = fitted(np.round(outputs(counts, path(50_000), 1e-3, 4))).calibration
    assert np.max(np.abs(c.values - truth(counts)) / c.standard_errors) < 4.5


def test_sensitivities_of_ten_to_one_mixed_signs_and_25_degrees_are_no_harder() -> None:
    skew = Sensor(np.array([1e5, -1e4, 3e4]), np.array([0.01, -0.02, 0.42]), np.array([0.5, -0.4, 0.3]))
    a, seeds = path(10_000), 40
    found = [fitted(outputs(skew, a, 0.01, seed), signs=(1, -1, 1)).calibration for seed in range(seeds)]
    low, high = chance(seeds)
    assert low < squares([c.values - truth(skew) for c in found], [c.covariance for c in found]) < high


@pytest.mark.parametrize("factor", [1e-30, 1e30])
def test_the_unit_of_the_outputs_does_not_matter(unit: Sensor, factor: float) -> None:
    u = outputs(unit, path(5000), 0.01, 1)
    plain, scaled = fitted(u).calibration.sensor, fitted(u * factor).calibration.sensor
    assert scaled.scale_factor / factor == pytest.approx(plain.scale_factor, rel=1e-9)
    assert scaled.bias == pytest.approx(plain.bias, rel=1e-8)


def test_blocks_of_any_size_give_the_same_to_the_last_bit(unit: Sensor) -> None:
    u = outputs(unit, path(30_000), 0.01, 5)
    temp_c = np.random.default_rng(1).uniform(20, 30, len(u))
    whole, parts = Moments(), Moments()
    whole.feed(u, temp_c)
    rng = np.random.default_rng(0)
    at = 0
    while at < len(u):
        size = int(rng.integers(0, 3000))
        parts.feed(u[at : at + size], temp_c[at : at + size])
        at += size
    one, other = whole.summary(), parts.summary()
    for name in ("middle", "half", "counts", "moments", "quick", "sampled"):
        assert np.array_equal(getattr(one, name), getattr(other, name)), name
    assert one.temperature is not None
    assert one.temperature == other.temperature


def test_the_sums_are_those_of_all_samples(unit: Sensor) -> None:
    for count in (100, 129, 2048, 2049, 33_333):
        u = outputs(unit, path(count), 0.01, 2)
        moments = Moments()
        moments.feed(u)
        held = moments.summary()
        x = ((u - held.middle) / held.half).T
        terms = np.stack([x[0] ** i * x[1] ** j * x[2] ** k for i, j, k in MONOMIALS])
        assert held.count == count
        assert held.mean() == pytest.approx(terms @ terms.T / count, abs=1e-12)


def test_a_first_block_that_does_not_move_costs_nothing(unit: Sensor) -> None:
    a = path(20_000)
    a[:2000] = a[0]
    u = np.round(outputs(unit, a, 1e-3, 7) * 1e3) / 1e3
    u[:500] = u[0]
    parts = Moments()
    parts.feed(u[:500])
    parts.feed(u[500:])
    c = fit_rotation(parts, signs=SIGNS).calibration
    assert np.max(np.abs(c.values - truth(unit)) / c.standard_errors) < 4.5


def test_the_reference_sets_the_unit(unit: Sensor) -> None:
    c = fitted(outputs(unit, path(20_000), 1e-3, 6), reference=9.80665).calibration
    assert c.sensor.scale_factor == pytest.approx(truth(unit)[:3] / 9.80665, rel=1e-3)
    assert c.sensor.bias == pytest.approx(truth(unit)[6:] * 9.80665, abs=1e-3)
    assert c.reference == 9.80665


def test_a_magnetometer_with_a_hard_iron_of_seven_fields_has_true_errors() -> None:
    magnetometer = Sensor(np.array([15.0, 14.0, 16.0]), np.array([0.02, -0.03, 0.01]), np.array([200.0, -350.0, 90.0]))
    a, seeds = 48.0 * path(5000, 0.03), 40
    found = [
        fitted(outputs(magnetometer, a, 0.3, seed), reference=48.0, signs=(1, 1, 1)).calibration
        for seed in range(seeds)
    ]
    low, high = chance(seeds)
    assert low < squares([c.values - truth(magnetometer) for c in found], [c.covariance for c in found]) < high


def test_memory_does_not_grow_with_the_samples(unit: Sensor) -> None:
    moments = Moments()

    def held() -> int:
        return sum(v.nbytes for v in vars(moments).values() if isinstance(v, np.ndarray))

    for seed in range(20):
        moments.feed(outputs(unit, path(20_000), 0.01, seed))
    early = held()
    for seed in range(30):
        moments.feed(outputs(unit, path(20_000), 0.01, seed))
    assert held() <= early + 8 * 4 * (1 << 13)  # what waits to be summed up, and its temperature
    assert moments.count == 50 * 20_000
    assert len(moments.summary().counts) <= STRETCHES_MOST + 1


# Temperature


def test_the_biases_hold_at_the_mean_temperature_that_is_told(unit: Sensor) -> None:
    """A bias of 1 mg/K while the unit warms by 10 K and cools again twenty times, a recording's mean not the middle."""
    a, slope, seeds = path(20_000), np.array([1e-3, -1e-3, 0.5e-3]), 20
    pulls = []
    for seed in range(seeds):
        temp_c = 20 + 10 * np.abs(np.sin(np.linspace(0, 20 * np.pi, len(a)) + seed))
        moments = Moments()
        warmed = outputs(unit, a, 0.01, seed) + (temp_c[:, None] - 20) * slope * unit.scale_factor
        moments.feed(warmed, temp_c)
        found = fit_rotation(moments, signs=SIGNS)
        t = found.temperature
        assert t is not None
        assert (t.mean, t.lowest, t.highest) == pytest.approx((np.mean(temp_c), np.min(temp_c), np.max(temp_c)))
        bias = unit.bias + slope * (t.mean - 20)
        pulls.append((found.calibration.values[6:] - bias) / found.calibration.standard_errors[6:])
    assert np.sqrt(np.mean(np.square(pulls))) < 1.5
    assert np.max(np.abs(np.mean(pulls, axis=0))) < 3.9 / np.sqrt(seeds)


def test_what_is_excluded_does_not_warm_the_rest(unit: Sensor) -> None:
    u, temp_c = outputs(unit, path(20_000), 0.01, 1), np.full(20_000, 25.0)
    u[7000:7005] += 50.0
    temp_c[7000:7005] = 80.0
    moments = Moments()
    moments.feed(u, temp_c)
    found = fit_rotation(moments, signs=SIGNS)
    assert any(isinstance(c, StretchesExcluded) for c in found.calibration.cautions)
    assert found.temperature == Temperature(25.0, 25.0, 25.0)


def test_a_temperature_that_is_not_there_for_all_samples_is_not_told(unit: Sensor) -> None:
    u = outputs(unit, path(20_000), 0.01, 1)
    half, none = Moments(), Moments()
    half.feed(u[:9000], np.full(9000, 25.0))
    half.feed(u[9000:])
    none.feed(u)
    found = [fit_rotation(moments, signs=SIGNS) for moments in (half, none)]
    assert [f.temperature for f in found] == [None, None]
    assert np.array_equal(found[0].calibration.values, found[1].calibration.values)


# Is noise all there is?


def filtered(a: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return signal.lfilter(*signal.butter(2, 0.1), rng.standard_normal(a.shape), axis=0) * 0.02


def correlated(a: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    slow = signal.lfilter([0.14], [1, -0.99], rng.standard_normal(a.shape), axis=0)
    return 0.002 * slow + 0.005 * rng.standard_normal(a.shape)


def shaken(a: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    push = signal.lfilter(*signal.butter(2, 0.01), rng.standard_normal(a.shape), axis=0)
    return 0.02 * push + 0.002 * rng.standard_normal(a.shape)


@pytest.mark.parametrize("disturbed", [filtered, correlated, shaken])
def test_what_is_not_white_is_said_and_covered_by_the_stated_errors(unit: Sensor, disturbed: Make) -> None:
    a = path(20_000)
    pulls = []
    for seed in range(15):
        u = unit.output(a + disturbed(a, np.random.default_rng(seed)), {})
        c = fitted(u).calibration
        assert c.birge_ratio > 1.5
        assert any(isinstance(caution, StretchesDiffer) for caution in c.cautions)
        pulls.append((c.values - truth(unit)) / c.standard_errors)
    # 135 pulls, of which those of one seed go together: the rms of true ones is below this in all but one of 1000 sets.
    assert np.sqrt(np.mean(np.square(pulls))) < np.sqrt(stats.chi2.isf(0.001, 15 * 3) / (15 * 3))


@pytest.mark.slow
def test_white_noise_alone_raises_no_warning(unit: Sensor) -> None:
    warned = sum(bool(fitted(outputs(unit, path(3000, 0.03), 0.01, seed)).calibration.cautions) for seed in range(100))
    assert warned <= stats.binom.isf(0.001, 100, 0.01)


def test_vibration_along_one_axis_is_said_and_covered(unit: Sensor) -> None:
    a = path(30_000)
    shake = 0.02 * np.sin(0.7 * np.arange(len(a)))[:, None] * [0.0, 0.0, 1.0]
    f = fitted(outputs(unit, a + shake, 0.002, 1))
    c = f.calibration
    assert any(isinstance(caution, NoiseUnseen) for caution in c.cautions)
    assert np.max(np.abs(c.values - truth(unit)) / c.standard_errors) < 3
    white = fitted(outputs(unit, a, 0.01, 1)).calibration
    assert np.all(c.standard_errors[:3] > 1.5 * white.standard_errors[:3])


def test_samples_in_no_order_leave_the_share_of_the_axes_unknown(unit: Sensor) -> None:
    a = np.random.default_rng(0).permutation(path(20_000))
    f = fitted(outputs(unit, a, 0.01, 1))
    assert f.unseen_share == 1
    assert np.ptp(f.noise_g) < 1e-6
    assert NoiseUnseen(1.0) in f.calibration.cautions


@pytest.mark.parametrize("value", [0.0, 1e3, -3e6])
def test_spikes_are_left_out_and_told(unit: Sensor, value: float) -> None:
    a = path(30_000)
    u = outputs(unit, a, 2e-3, 1)
    u[[0, 12_000]] = value
    c = fitted(u).calibration
    excluded = next(caution for caution in c.cautions if isinstance(caution, StretchesExcluded))
    assert excluded.stretches == 2
    assert np.max(np.abs(c.values - truth(unit)) / c.standard_errors) < 4.5


def test_steps_larger_than_the_noise_are_told(unit: Sensor) -> None:
    u = unit.output(path(20_000), {})
    assert CoarseSteps() in fitted(np.round(u / 0.02) * 0.02).calibration.cautions
    noisy = outputs(unit, path(20_000), 0.01, 1)
    assert CoarseSteps() not in fitted(np.round(noisy / 0.02) * 0.02).calibration.cautions


# Refusals


@pytest.mark.parametrize(
    "plane", [np.eye(3)[:2], np.eye(3)[1:], np.array([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0]]) / np.sqrt([[2.0], [1.0]])]
)
def test_turning_about_one_axis_alone_is_refused_with_the_sides_that_were_never_up(
    unit: Sensor, plane: np.ndarray
) -> None:
    angle = np.linspace(0, 20 * np.pi, 20_000)
    a = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ plane
    with pytest.raises(Refused, match="axes") as refused:
        fitted(outputs(unit, a, 1e-3, 0))
    assert refused.value.wanted
    normal = np.cross(*plane)
    assert all(any(abs(normal[axis]) > 0.1 for axis in range(3) if "XYZ"[axis] in w) for w in refused.value.wanted)


def test_a_unit_that_hardly_moved_is_refused_with_a_whole_plan(unit: Sensor) -> None:
    a = path(20_000) * [0.2, 0.2, 0.0] + [0.0, 0.0, 1.0]
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    with pytest.raises(Refused, match=r"every side is up") as refused:
        fitted(outputs(unit, a, 1e-3, 0))
    assert len(refused.value.wanted) >= 6


def test_a_unit_at_rest_is_refused(unit: Sensor) -> None:
    with pytest.raises(Refused, match="every side is up"):
        fitted(outputs(unit, np.tile([0.0, 0.0, 1.0], (5000, 1)), 1e-3, 0))


def test_a_unit_thrown_about_is_refused_and_asked_for_no_side_that_it_has_shown(unit: Sensor) -> None:
    a = path(20_000)
    a *= np.abs(np.random.default_rng(1).standard_cauchy(len(a)))[:, None] * 0.2 + 1
    with pytest.raises(Refused, match="accelerations besides gravity") as refused:
        fitted(unit.output(a, {}))
    assert len(refused.value.wanted) < 5


def test_too_few_samples_are_refused(unit: Sensor) -> None:
    with pytest.raises(Refused, match="50 samples"):
        fitted(outputs(unit, path(50), 0.01, 1))


def test_an_output_that_never_changes_is_no_sensors(unit: Sensor) -> None:
    u = outputs(unit, path(500), 0.01, 1)
    u[:, 1] = 3.0
    with pytest.raises(InvalidData, match="axis y never changes"):
        fitted(u)


def test_sums_that_overflow_warn_nobody_before_they_are_refused() -> None:
    with np.errstate(all="raise"), pytest.raises(InvalidData, match="cannot be summed up"):
        fitted(1e100 * np.random.default_rng(0).standard_normal((20_000, 3)))


def test_outputs_beyond_what_can_be_summed_are_refused() -> None:
    with pytest.raises(InvalidData, match="cannot be summed up"):
        fitted(path(500) * 1e80)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_reading_that_is_no_number_is_refused_with_its_place(bad: float) -> None:
    moments = Moments()
    moments.feed(np.zeros((5, 3)))
    with pytest.raises(InvalidData, match="reading 7"):
        moments.feed(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [1.0, bad, 0.0]]))


@pytest.mark.parametrize("reference", [0.0, -1.0, np.nan])
def test_a_reference_that_is_no_magnitude_is_refused(unit: Sensor, reference: float) -> None:
    with pytest.raises(InvalidData, match="reference"):
        fitted(outputs(unit, path(500), 0.01, 1), reference=reference)
