"""The closed form gives back what made the data, where the printed formulas do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from triaxcal.errors import Refused
from triaxcal.estimate.initial_estimate import closed_form, coefficients
from triaxcal.estimate.pose_fit import fit
from triaxcal.model.sensor import Sensor
from triaxcal.poses.pose import Pose
from triaxcal.synthetic import noisy_poses


def still(u: np.ndarray, standard_error: np.ndarray | float = 1e-9) -> list[Pose]:
    covariance = np.diag(np.broadcast_to(np.asarray(standard_error, dtype=float) ** 2, 3))
    return [Pose(float(i), i + 1.0, 100, v, covariance, 99.0) for i, v in enumerate(u)]


def through_fit(sensor: Sensor, directions: np.ndarray) -> Sensor:
    u = sensor.output(directions, {})
    signs = np.sign(sensor.scale_factor)
    return fit(still(u, 1e-9 * np.abs(sensor.scale_factor)), signs=signs.tolist()).sensor


def assert_same(found: Sensor, truth: Sensor, tolerance: float = 1e-12) -> None:
    assert found.scale_factor / truth.scale_factor == pytest.approx(np.ones(3), abs=tolerance)
    assert found.misalignment == pytest.approx(truth.misalignment, abs=tolerance)
    assert found.bias == pytest.approx(truth.bias, abs=tolerance)


def test_the_paper_s_unit_is_recovered_exactly_from_noise_free_poses(paper_unit: Sensor, fourteen: np.ndarray) -> None:
    A, c = closed_form(paper_unit.output(fourteen, {}))
    k, angles, bias = coefficients(A, c)
    # The closed form's scale factors are positive; with all three negative only k and b change sign (METHOD §3).
    assert_same(Sensor(-k, angles, -bias), paper_unit)
    assert_same(through_fit(paper_unit, fourteen), paper_unit)


DISTORTED = {
    "25 degrees off square": Sensor(np.ones(3), np.tan(np.radians([0.0, 25.0, 0.0])), np.full(3, 0.1)),
    "25 degrees off the other way": Sensor(np.ones(3), np.tan(np.radians([-25.0, 0.0, 0.0])), np.full(3, 0.1)),
    "sensitivities ten to one": Sensor(np.array([10.0, 1.0, 3.0]), np.array([0.01, -0.02, 0.03]), np.full(3, 0.02)),
    "a bias of half a g": Sensor(np.full(3, 2.4), np.full(3, 0.01), np.array([0.5, -0.5, 0.5])),
    "micro-units": Sensor(np.full(3, 2e-9), np.array([0.01, 0.02, -0.01]), np.array([0.1, 0.0, -0.1])),
    "24-bit counts": Sensor(np.array([2.0e6, 1.9e6, 2.1e6]), np.array([0.01, 0.02, -0.01]), np.zeros(3)),
}


@pytest.mark.parametrize("name", DISTORTED)
def test_a_strongly_distorted_unit_is_recovered_exactly(name: str, twenty_six: np.ndarray) -> None:
    truth = DISTORTED[name]
    A, c = closed_form(truth.output(twenty_six, {}))
    assert_same(Sensor(*coefficients(A, c)), truth)
    assert_same(through_fit(truth, twenty_six), truth)


def test_three_angles_of_25_degrees_are_past_the_closed_form_s_constraint_yet_the_fit_recovers_them(
    twenty_six: np.ndarray,
) -> None:
    # The shortest half-axis is less than half the longest: 4J − I² > 0 does not hold (METHOD §3, eq. 16).
    truth = Sensor(np.ones(3), np.tan(np.radians([25.0, -25.0, 25.0])), np.zeros(3))
    half_axes = np.linalg.svd(truth.axes, compute_uv=False)
    assert half_axes[2] < half_axes[0] / 2
    assert_same(through_fit(truth, twenty_six), truth)


def test_outputs_offset_by_half_of_the_range_of_24_bits_are_recovered(fourteen: np.ndarray) -> None:
    # 2^23 counts at 2000 counts a g: the offset is 4194 times the signal, of which rounding keeps 12 digits.
    truth = Sensor(np.full(3, 2000.0), np.array([0.01, -0.02, 0.005]), np.full(3, 2**23 / 2000.0))
    found = through_fit(truth, fourteen)
    assert found.scale_factor / 2000 == pytest.approx(np.ones(3), abs=1e-11)
    assert found.misalignment == pytest.approx(truth.misalignment, abs=1e-11)
    assert found.bias - truth.bias == pytest.approx(np.zeros(3), abs=1e-8)


@pytest.mark.parametrize("signs", [(1, -1, 1), (-1, 1, 1), (1, 1, -1), (-1, -1, 1), (-1, -1, -1)])
def test_mixed_signs_change_angles_and_biases_with_them(signs: tuple[int, ...], twenty_six: np.ndarray) -> None:
    truth = Sensor(np.array([2.4, 2.3, 2.5]) * signs, np.array([0.01, -0.02, 0.03]), np.array([0.05, -0.03, 0.02]))
    assert_same(through_fit(truth, twenty_six), truth)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_any_sensible_sensor_is_recovered_exactly_from_any_well_spread_poses(seed: int) -> None:
    rng = np.random.default_rng(seed)
    signs = rng.choice([-1.0, 1.0], 3)
    truth = Sensor(signs * np.exp(rng.uniform(-1, 1, 3)), rng.uniform(-0.2, 0.2, 3), rng.uniform(-0.5, 0.5, 3))
    v = rng.standard_normal((40, 3))
    assert_same(through_fit(truth, v / np.linalg.norm(v, axis=1, keepdims=True)), truth, 1e-11)


@pytest.mark.parametrize("seed", range(5))
def test_the_fit_agrees_with_scipy_s_least_squares_on_the_magnitude(
    seed: int, paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    rng = np.random.default_rng(seed)
    poses = [replace(p, covariance=np.eye(3) * 2.4e-4**2) for p in noisy_poses(paper_unit, twenty_six, 1e-4, rng)]
    u = np.array([p.mean for p in poses])

    def miss(p: np.ndarray) -> np.ndarray:
        # Weighted as equal noise in volts asks for: by the gradient of |a| with respect to the outputs.
        A = np.array([[p[0], p[1], p[2]], [0, p[3], p[4]], [0, 0, p[5]]])
        a = (u - p[6:]) @ A.T
        length = np.linalg.norm(a, axis=1)
        return (length - 1) / np.linalg.norm(a @ A / length[:, None], axis=1)

    first = np.array([1 / 2.4, 0, 0, 1 / 2.4, 0, 1 / 2.4, 0, 0, 0])
    p = least_squares(miss, first, xtol=1e-15, ftol=1e-15, gtol=1e-15).x
    found = fit(poses)
    theirs = np.array([[p[0], p[1], p[2]], [0, p[3], p[4]], [0, 0, p[5]]])
    # The weights follow the gradient but are not differentiated: what that neglects is of the order of noise squared.
    assert found.sensor.matrix == pytest.approx(theirs, abs=5e-8)
    assert found.sensor.centre == pytest.approx(p[6:], abs=1e-7)


def test_readings_of_g_are_not_high_by_the_printed_normalisation(paper_unit: Sensor, fourteen: np.ndarray) -> None:
    A, c = closed_form(paper_unit.output(fourteen, {}))
    other = np.random.default_rng(0).standard_normal((100, 3))
    u = paper_unit.output(other / np.linalg.norm(other, axis=1, keepdims=True), {})
    assert np.linalg.norm((u - c) @ A.T, axis=1) == pytest.approx(np.ones(100), abs=1e-12)
    # Taking the last coefficient as −1 (eq. 9, 10, 13) scales H by 1 + (c'Hc) instead: 3.1e-5 g too much.
    printed = A * np.sqrt(1 / (1 - c @ A.T @ A @ c))
    high = np.linalg.norm((u - c) @ printed.T, axis=1) - 1
    assert high == pytest.approx(np.full(100, 3.1e-5), rel=0.02)


def test_the_factor_is_the_upper_one(paper_unit: Sensor, fourteen: np.ndarray) -> None:
    A, _ = closed_form(paper_unit.output(fourteen, {}))
    assert np.all(np.tril(A, -1) == 0)
    assert np.all(np.diag(A) > 0)


@pytest.mark.parametrize(
    ("u", "why"),
    [
        (np.eye(3)[[0, 1, 2] * 2], "6 poses"),
        (np.zeros((12, 3)), "nine that differ in every axis"),
        (np.outer(np.linspace(-1, 1, 12), [1.0, 2.0, 3.0]), "no ellipsoid|one plane"),
    ],
)
def test_outputs_on_no_ellipsoid_are_refused(u: np.ndarray, why: str) -> None:
    with pytest.raises(Refused, match=why):
        closed_form(u)
