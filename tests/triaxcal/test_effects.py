"""Every effect of the catalogue keeps the contract: names, basis, slope, needs, remedy, one file."""

from __future__ import annotations

import importlib
import pkgutil

import numpy as np
import pytest

import triaxcal.effects
from triaxcal.effects import CATALOGUE, TIME, Effect, effect_named

# The names that others script against (the contract of the command line).
AGREED = {
    "second_order_nonlinearity", "third_order_nonlinearity", "scale_factor_asymmetry", "cross_coupling",
    "temperature_bias", "temperature_bias_quadratic", "temperature_scale_factor", "thermal_gradient",
    "bias_drift", "warm_up", "bias_step", "hysteresis", "vibration_rectification",
}  # fmt: skip

# What a unit of each coefficient adds to axis x, y, z: written by hand for s = (2, 3, 5), ΔT = 7 K, Δt = 11 s.
BY_HAND = {
    "second_order_nonlinearity": np.diag([4.0, 9.0, 25.0]),
    "third_order_nonlinearity": np.diag([8.0, 27.0, 125.0]),
    "temperature_bias": 7.0 * np.eye(3),
    "temperature_bias_quadratic": np.concatenate([7.0 * np.eye(3), 49.0 * np.eye(3)], axis=1),
    "temperature_scale_factor": 7.0 * np.diag([2.0, 3.0, 5.0]),
    "bias_drift": 11.0 * np.eye(3),
}


def each(effect: Effect) -> str:
    return effect.name


def held(n: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    return {"temp_c": rng.uniform(-20, 20, n), TIME: rng.uniform(-300, 300, n)}


@pytest.mark.parametrize("effect", CATALOGUE, ids=each)
def test_the_name_is_one_agreed_on_and_units_and_remedy_are_stated(effect: Effect) -> None:
    assert effect.name in AGREED
    assert effect_named(effect.name) is effect
    assert all(c.name and c.unit for c in effect.coefficients)
    assert len({c.name for c in effect.coefficients}) == len(effect.coefficients)
    assert effect.remedy.endswith(".")


@pytest.mark.parametrize("effect", CATALOGUE, ids=each)
def test_a_unit_of_each_coefficient_adds_what_the_formula_says(effect: Effect) -> None:
    s = np.array([[2.0, 3.0, 5.0]])
    basis = effect.basis(s, {"temp_c": np.array([7.0]), TIME: np.array([11.0])})
    assert basis.shape == (1, 3, len(effect.coefficients))
    assert basis[0] == pytest.approx(BY_HAND[effect.name])


@pytest.mark.parametrize("effect", CATALOGUE, ids=each)
def test_the_slope_is_the_finite_difference_of_the_basis(effect: Effect) -> None:
    rng = np.random.default_rng(0)
    s, conditions = rng.uniform(-1.5, 1.5, (20, 3)), held(20, rng)
    slope = effect.slope(s, conditions)
    assert slope.shape == (20, 3, 3, len(effect.coefficients))
    for by in range(3):
        h = 1e-6 * np.eye(3)[by]
        difference = (effect.basis(s + h, conditions) - effect.basis(s - h, conditions)) / 2e-6
        assert slope[:, :, by] == pytest.approx(difference, rel=1e-7, abs=1e-7)


@pytest.mark.parametrize("effect", CATALOGUE, ids=each)
def test_no_more_conditions_are_used_than_are_declared(effect: Effect) -> None:
    rng = np.random.default_rng(0)
    s, conditions = rng.standard_normal((5, 3)), held(5, rng)
    declared = {n: conditions[n] for n in effect.needs}
    assert np.array_equal(effect.basis(s, declared), effect.basis(s, conditions))
    for name in effect.needs:
        with pytest.raises(KeyError):
            effect.basis(s, {n: v for n, v in declared.items() if n != name})


def test_every_effect_is_one_file_of_its_own_name() -> None:
    files = {m.name for m in pkgutil.iter_modules(triaxcal.effects.__path__)} - {"contract"}
    assert files == {e.name for e in CATALOGUE}
    for effect in CATALOGUE:
        module = importlib.import_module(f"triaxcal.effects.{effect.name}")
        assert type(effect).__module__ == module.__name__


def test_a_name_that_is_not_in_the_catalogue_is_a_key_error() -> None:
    with pytest.raises(KeyError, match="witchcraft"):
        effect_named("witchcraft")
