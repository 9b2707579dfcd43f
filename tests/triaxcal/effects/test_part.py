"""Part of an effect: its coefficients held to fewer, and the whole that it stands for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from triaxcal.calibration import Calibration
from triaxcal.effects import effect_named
from triaxcal.effects.contract import Coefficient
from triaxcal.effects.part import Part, mix_of, whole
from triaxcal.effects.warm_up import WarmUp
from triaxcal.pose_fit import fit
from triaxcal.poses.pose import Pose
from triaxcal.sensor import Sensor
from triaxcal.synthetic import noisy_poses

MINUS = (-1, -1, -1)
SECOND = effect_named("second_order_nonlinearity")
CROSS = effect_named("cross_coupling")
# x and y together, and z against them: no single coefficient of the whole.
MIX = np.array([[0.6, 0.0], [0.8, 0.5], [0.0, -2.0]])


def test_one_axis_of_an_effect_is_its_column_alone() -> None:
    part = Part.of(SECOND, "y")
    s = np.array([[2.0, 3.0, 5.0]])
    assert part.basis(s, {})[0].tolist() == [[0.0], [9.0], [0.0]]
    assert part.slope(s, {})[0, 1, 1].tolist() == [6.0]
    assert (part.name, part.needs, part.remedy) == (SECOND.name, (), SECOND.remedy)
    assert part.coefficients == (Coefficient("y", "g/g²", "y"),)


def test_a_part_may_have_several_coefficients() -> None:
    part = Part.of(effect_named("temperature_bias_quadratic"), "z")
    assert [c.name for c in part.coefficients] == ["linear_z", "quadratic_z"]
    assert [c.unit for c in part.coefficients] == ["g/K", "g/K²"]
    basis = part.basis(np.zeros((1, 3)), {"temp_c": np.array([7.0])})
    assert basis[0].tolist() == [[0, 0], [0, 0], [7.0, 49.0]]


def test_a_combination_adds_what_its_mix_of_the_whole_adds() -> None:
    part = Part(SECOND, MIX)
    s = np.random.default_rng(0).standard_normal((5, 3))
    by_hand = np.stack([np.stack([0.6 * s[:, 0] ** 2, 0.8 * s[:, 1] ** 2, 0 * s[:, 2]], axis=1),
                        np.stack([0 * s[:, 0], 0.5 * s[:, 1] ** 2, -2 * s[:, 2] ** 2], axis=1)], axis=2)  # fmt: skip
    assert part.basis(s, {}) == pytest.approx(by_hand)
    assert [c.name for c in part.coefficients] == ["combination_1", "combination_2"]
    assert {c.unit for c in part.coefficients} == {"g/g²"}


def test_the_whole_of_a_part_and_of_a_whole() -> None:
    assert whole(Part.of(SECOND, "x")) is SECOND
    assert whole(SECOND) is SECOND
    assert np.array_equal(mix_of(SECOND), np.eye(3))
    assert np.array_equal(mix_of(Part(SECOND, MIX)), MIX)


def test_a_part_has_the_shape_of_its_whole_and_one_form() -> None:
    part = Part.of(WarmUp(90.0), "x")
    assert dict(part.shape) == {"time_constant": (90.0, "s")}
    other = part.shaped({"time_constant": 40.0})
    assert whole(other) == WarmUp(40.0)
    assert np.array_equal(mix_of(other), mix_of(part))
    assert part.forms == (part,)
    assert list(part.variants({})) == [part]


# In a calibration.


@pytest.fixture(scope="module")
def poses(with_effects: Callable[..., Sensor], twenty_six: np.ndarray) -> list[Pose]:
    sensor = with_effects(second_order_nonlinearity=[6e-4, 1.3e-3, -2e-3], cross_coupling=[0, 0, 1e-3, 0, 0, 0, 0])
    rng = np.random.default_rng(0)
    v = twenty_six + 0.1 * rng.standard_normal((26, 3))
    return noisy_poses(sensor, v / np.linalg.norm(v, axis=1, keepdims=True), 1e-5, rng)


@pytest.fixture(scope="module")
def fitted(poses: list[Pose]) -> Calibration:
    return fit(poses, signs=MINUS, effects=[Part(SECOND, MIX), Part.of(CROSS, "10")])


def test_the_whole_calibration_keeps_the_magnitude_of_any_reading(fitted: Calibration) -> None:
    u = np.random.default_rng(1).uniform(-4, 4, (200, 3))
    assert fitted.whole.specific_force(u, {}) == pytest.approx(fitted.specific_force(u, {}), abs=1e-14)
    assert [e for e, _ in fitted.whole.sensor.effects] == [SECOND, CROSS]
    assert fitted.whole.whole.values == pytest.approx(fitted.whole.values)


def test_coefficients_of_the_whole_are_mixed_from_those_of_the_part(fitted: Calibration) -> None:
    q = fitted.values[9:11]
    assert fitted.whole.values[9:12] == pytest.approx([0.6 * q[0], 0.8 * q[0] + 0.5 * q[1], -2 * q[1]])
    assert np.flatnonzero(fitted.whole.values[12:]).tolist() == [2]
    assert fitted.whole.values[14] == fitted.values[11]
    assert fitted.whole.parameters[9:] == (
        "second_order_nonlinearity.x", "second_order_nonlinearity.y", "second_order_nonlinearity.z",
        *(f"cross_coupling.{c.name}" for c in CROSS.coefficients),
    )  # fmt: skip


def test_the_covariance_is_mapped_to_the_whole(fitted: Calibration) -> None:
    """Every entry written out by hand, from the covariances of sums."""
    C, W = fitted.covariance, fitted.whole.covariance
    assert W.shape == (19, 19)
    assert W[:9, :9] == pytest.approx(C[:9, :9])
    p, r, cross = 9, 10, 11
    assert W[9, 9] == pytest.approx(0.36 * C[p, p])
    assert W[10, 10] == pytest.approx(0.64 * C[p, p] + 2 * 0.8 * 0.5 * C[p, r] + 0.25 * C[r, r])
    assert W[9, 11] == pytest.approx(0.6 * -2 * C[p, r])
    assert W[11, 14] == pytest.approx(-2 * C[r, cross])
    assert W[3, 10] == pytest.approx(0.8 * C[3, p] + 0.5 * C[3, r])
    # What the part leaves out is zero, without error.
    left_out = [12, 13, 15, 16, 17, 18]
    assert np.all(W[left_out] == 0)
    assert np.all(fitted.whole.values[left_out] == 0)


def test_coefficients_by_name_have_values_errors_and_units(fitted: Calibration) -> None:
    found = fitted.whole.coefficients_of("second_order_nonlinearity")
    assert list(found) == ["x", "y", "z"]
    value, error, unit = found["y"]
    assert value == fitted.whole.values[10]
    assert error is None  # only a combination of the three is known
    assert unit == "g/g²"
    assert list(fitted.coefficients_of("cross_coupling")) == ["y_yx"]
    errors = np.sqrt(np.diag(fitted.whole.covariance))[9:12]
    for truth, (value, _, _), error in zip([6e-4, 1.3e-3, -2e-3], found.values(), errors, strict=True):
        assert abs(value - truth) < 4 * error
    with pytest.raises(KeyError):
        fitted.coefficients_of("bias_drift")


def test_a_shape_stands_beside_the_coefficients_with_its_error_or_without(
    paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    effect = WarmUp(80.0)
    sensor = replace(paper_unit, effects=((effect, np.array([1e-3, -1e-3, 1e-3])),))
    poses = noisy_poses(sensor, twenty_six, 1e-5, np.random.default_rng(0))
    found = fit(poses, signs=MINUS, effects=[effect]).coefficients_of("warm_up")
    assert list(found) == ["x", "y", "z", "time_constant"]
    value, error, unit = found["time_constant"]
    assert (value, unit) == (80.0, "s")
    assert error is not None
    assert 0.1 < error < 10
    whole_too = fit(poses, signs=MINUS, effects=[Part.of(effect, "x")]).whole.coefficients_of("warm_up")
    assert list(whole_too) == list(found)
    assert [v for v, _, _ in whole_too.values()][1:3] == [0.0, 0.0]
