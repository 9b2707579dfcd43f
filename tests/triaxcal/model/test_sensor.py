"""The model by its formula, and its inverse by going there and back."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from triaxcal.effects import CATALOGUE, TIME, effect_named
from triaxcal.effects.contract import BEFORE, CHANGE, DURATION, LAGS_S, SCATTER, SINCE_START, lag_of, rate_of
from triaxcal.errors import Refused
from triaxcal.model.sensor import Sensor

SIZED: dict[str, list[float]] = {
    "second_order_nonlinearity": [8e-3, -9e-3, 5e-3],
    "third_order_nonlinearity": [-7e-3, 4e-3, 2e-3],
    "scale_factor_asymmetry": [1e-3, -2e-3, 1e-3],
    "cross_coupling": [4e-3, -1e-3, 2e-3, 1e-3, -2e-3, 1e-3, 3e-3],
    "temperature_bias": [1e-3, -2e-3, 3e-3],
    "temperature_bias_quadratic": [1e-4, 1e-4, -2e-4, 1e-5, -2e-5, 3e-5],
    "temperature_scale_factor": [2e-3, -1e-3, 3e-3],
    "thermal_gradient": [1e-2, -2e-2, 1e-2],
    "bias_drift": [1e-5, -2e-5, 1e-5],
    "warm_up": [1e-3, 2e-3, -1e-3],
    "bias_step": [1e-3, -1e-3, 2e-3],
    "hysteresis": [1e-3, 1e-3, -2e-3],
    "vibration_rectification": [10.0, -20.0, 30.0],
    "fifth_order_nonlinearity": [2e-3, -3e-3, 1e-3],
    "compression": [5e-3, -4e-3, 6e-3],
    "scale_factor_drift": [1e-5, -2e-5, 1e-5],
    "temperature_lag": [1e-3, -1e-3, 2e-3],
    "remanence": [1e-3, -1e-3, 1e-3],
}
EVERYTHING = {e.name: SIZED.get(e.name, [1e-3] * len(e.coefficients)) for e in CATALOGUE}
"""Of every effect; those not in `SIZED` act alike on all axes, by a thousandth."""


def covariates(n: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    within = {name: rng.uniform(-1, 1, n) for name in (*BEFORE, *CHANGE)}
    within |= {name: rng.uniform(0, 1e-4, n) for name in SCATTER}
    there = {"temp_c": rng.uniform(-15, 15, n), rate_of("temp_c"): rng.uniform(-0.1, 0.1, n)}
    there |= {lag_of("temp_c", constant_s): rng.uniform(-3, 3, n) for constant_s in LAGS_S}
    # The step of the catalogue is at 0 s: poses on either side of it.
    times = {TIME: rng.uniform(-300, 300, n), SINCE_START: rng.uniform(-10, 300, n), DURATION: np.full(n, 10.0)}
    return within | there | times


def test_the_output_is_the_paper_s_equation_written_out() -> None:
    ax, ay, az = 0.01, 0.02, 0.03
    sensor = Sensor(np.array([2.0, -3.0, 4.0]), np.array([ax, ay, az]), np.array([0.1, 0.2, 0.3]))
    x, y, z = 0.5, -0.6, 0.7
    expected = [2 * (x + az * y + ay * z + 0.1), -3 * (y + ax * z + 0.2), 4 * (z + 0.3)]
    assert sensor.output(np.array([[x, y, z]]), {})[0] == pytest.approx(expected)


def test_matrix_and_centre_invert_the_linear_model(paper_unit: Sensor) -> None:
    a = np.random.default_rng(0).standard_normal((20, 3))
    u = paper_unit.output(a, {})
    assert (u - paper_unit.centre) @ paper_unit.matrix.T == pytest.approx(a, abs=1e-14)
    assert np.all(np.tril(paper_unit.matrix, -1) == 0)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_there_and_back_with_every_effect_is_exact(seed: int, with_effects: Callable[..., Sensor]) -> None:
    rng = np.random.default_rng(seed)
    sensor = with_effects(**EVERYTHING)
    a, held = rng.uniform(-1.2, 1.2, (30, 3)), covariates(30, rng)
    assert sensor.specific_force(sensor.output(a, held), held) == pytest.approx(a, abs=1e-12)


def test_an_effect_adds_to_the_reading_in_g_along_the_sensitive_axis(with_effects: Callable[..., Sensor]) -> None:
    sensor, plain = with_effects(second_order_nonlinearity=[1e-3, 0, 0]), with_effects()
    a = np.array([[0.5, 0.1, -0.8]])
    s = a @ plain.axes.T
    difference = (sensor.output(a, {}) - plain.output(a, {})) / plain.scale_factor
    assert difference[0] == pytest.approx([1e-3 * s[0, 0] ** 2, 0, 0], abs=1e-15)


def test_the_magnitude_s_gradient_is_its_central_difference(with_effects: Callable[..., Sensor]) -> None:
    sensor = with_effects(**EVERYTHING)
    assert {effect.name for effect, _ in sensor.effects} == {effect.name for effect in CATALOGUE} >= set(SIZED)
    rng = np.random.default_rng(1)
    held = covariates(15, rng)
    u = sensor.output(rng.standard_normal((15, 3)), held)
    length, gradient = sensor.magnitude(u, held)
    assert length == pytest.approx(np.linalg.norm(sensor.specific_force(u, held), axis=1))
    for axis in range(3):
        h = 1e-6 * np.eye(3)[axis]
        difference = (sensor.magnitude(u + h, held)[0] - sensor.magnitude(u - h, held)[0]) / 2e-6
        assert gradient[:, axis] == pytest.approx(difference, abs=1e-8)


@pytest.mark.slow
def test_derivatives_by_every_parameter_are_their_central_differences(with_effects: Callable[..., Sensor]) -> None:
    sensor = with_effects(**EVERYTHING)
    rng = np.random.default_rng(2)
    held = covariates(15, rng)
    u = sensor.output(rng.standard_normal((15, 3)), held)
    of_radius = sensor.radius_by_parameters(u, held)
    a, _, of_force = sensor.specific_force_and_derivatives(u, held)
    assert a == pytest.approx(sensor.specific_force(u, held), abs=1e-12)
    sizes = np.maximum(1.0, np.abs(of_force).max(axis=(0, 1)))  # by a coefficient of kelvins squared it is hundreds
    for k, step in enumerate(np.diag(1e-6 / sizes)):
        more, less = (sensor.moved(s).specific_force(u, held) for s in (step, -step))
        by_difference = np.linalg.norm(more, axis=1) - np.linalg.norm(less, axis=1)
        assert of_force[:, :, k] / sizes[k] == pytest.approx((more - less) / 2e-6, abs=1e-6)
        assert of_radius[:, k] / sizes[k] == pytest.approx(by_difference / 2e-6, abs=1e-6)


def test_a_reading_at_which_the_model_turns_back_is_refused_in_one_line() -> None:
    """s + q s² has no slope at s = −1/2q, where Newton's method begins."""
    bent = effect_named("second_order_nonlinearity"), np.array([0.25, 0.0, 0.0])
    sensor = Sensor(np.ones(3), np.zeros(3), np.zeros(3), (bent,))
    for ask in (sensor.specific_force, sensor.magnitude):
        with pytest.raises(Refused, match="no inverse at these readings"):
            ask(np.array([[-2.0, 0.0, 0.5]]), {})
