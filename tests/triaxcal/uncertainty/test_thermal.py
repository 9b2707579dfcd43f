"""What the temperature may have done, and what to do about it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from triaxcal.effects import effect_named
from triaxcal.estimate.pose_fit import fit
from triaxcal.model.directions import directions, spiral
from triaxcal.model.sensor import Sensor
from triaxcal.poses.pose import Pose
from triaxcal.synthetic import noisy_poses
from triaxcal.uncertainty import Component, Stated, budget
from triaxcal.uncertainty.components import _posterior
from triaxcal.uncertainty.statements import (
    LongerOrMorePoses,
    PosesAtOtherTemperatures,
    SteadierTemperature,
    TemperatureModelled,
    ThermometerNotStated,
    UnmodelledTemperature,
)

NOISE = 2e-5
SIGNS = (-1, -1, -1)

TYPICAL = Stated(thermal_sensitivity=5e-4)
THERMAL = ("temperature_bias", "temperature_scale_factor")


def test_a_thermometer_matters_once_thermal_effects_are_in_the_model(
    with_effects: Callable[..., Sensor], twenty_six: np.ndarray
) -> None:
    unit = with_effects(temperature_bias=[3e-4, -2e-4, 1e-4])
    swing = {"temp_c": 25 + 6 * np.sin(np.arange(26) * 1.7)}
    poses = noisy_poses(unit, twenty_six, NOISE, np.random.default_rng(5), channels=swing)
    c = fit(poses, signs=SIGNS, effects=[effect_named("temperature_bias")], excluded=())
    line = next(x for x in budget(c, Stated(thermometer_k=0.4)).components if x.source == "thermometer")
    coefficients = c.values[9:12]
    np.testing.assert_allclose(line.parameters[6:9], np.abs(coefficients) * 0.4, rtol=0.02)
    assert ThermometerNotStated() in budget(c).not_evaluated
    sources = [x.source for x in budget(fit(poses, signs=SIGNS, excluded=()), Stated(thermometer_k=0.4)).components]
    assert "thermometer" not in sources
    assert "temperature" in sources


def test_what_temperature_may_have_done_grows_with_how_far_it_moved(paper_unit: Sensor, twenty_six: np.ndarray) -> None:
    def share(swing_k: float) -> float:
        moved = {"temp_c": 25 + swing_k * np.sin(np.arange(26) * 1.7)}
        poses = noisy_poses(paper_unit, twenty_six, NOISE, np.random.default_rng(5), channels=moved)
        found = budget(fit(poses, signs=SIGNS, excluded=()), TYPICAL).components
        return next(x.magnitude for x in found if x.source == "temperature")

    steady, moving, wild = share(0.001), share(0.05), share(20.0)
    assert steady < 0.05 * NOISE
    assert steady < moving < wild
    # However far it moves, it cannot cost more than letting the coefficients free.
    assert wild < 1.5 * NOISE


def test_a_stated_sensitivity_is_what_the_line_is_made_of(paper_unit: Sensor, fourteen: np.ndarray) -> None:
    """Where the poses tell nothing, the line is as large as the sensitivity."""
    poses = _warming(paper_unit, fourteen, np.linspace(24.9, 25.1, 14), noise=1e-3)
    c = fit(poses, signs=SIGNS, excluded=())

    def line(sensitivity: float | None) -> Component | None:
        found = budget(c, Stated(thermal_sensitivity=sensitivity)).components
        return next((x for x in found if x.source == "temperature"), None)

    typical, better, tenth, unstated = line(5e-4), line(5e-5), line(5e-6), line(None)
    assert typical is not None
    assert better is not None
    assert tenth is not None
    assert unstated is not None
    assert better.magnitude == pytest.approx(10 * tenth.magnitude, rel=0.01)
    assert 5 * better.magnitude < typical.magnitude < 11 * better.magnitude
    assert isinstance(unstated.basis, UnmodelledTemperature)
    assert isinstance(better.basis, UnmodelledTemperature)
    assert (unstated.basis.stated, better.basis.stated) == (False, True)
    nothing = line(0.0)
    assert nothing is None or nothing.magnitude < 1e-9


@pytest.mark.parametrize("steady_c", [22.45, -3.49, 1 / 3])
def test_a_steady_temperature_costs_nothing_whatever_it_is(
    paper_unit: Sensor, twenty_six: np.ndarray, steady_c: float
) -> None:
    held = {"temp_c": np.full(26, steady_c)}
    poses = noisy_poses(paper_unit, twenty_six, NOISE, np.random.default_rng(5), channels=held)
    line = next(x for x in budget(fit(poses, signs=SIGNS, excluded=())).components if x.source == "temperature")
    assert line.magnitude < 1e-3 * NOISE


def _line(poses: Sequence[Pose], *effects: str) -> Component:
    c = fit(poses, signs=SIGNS, effects=[effect_named(n) for n in effects], excluded=())
    return next(x for x in budget(c, TYPICAL).components if x.source == "temperature")


def _warming(unit: Sensor, up: np.ndarray, temperatures_c: np.ndarray, noise: float = NOISE) -> list[Pose]:
    channels, reference = {"temp_c": temperatures_c}, {"temp_c": 25.0}
    return noisy_poses(unit, up, noise, np.random.default_rng(5), channels=channels, channel_reference=reference)


def test_poses_that_cannot_tell_what_a_wide_swing_did_are_to_be_more_not_steadier(
    paper_unit: Sensor, fourteen: np.ndarray
) -> None:
    rising = np.linspace(18, 32, 14)
    line = _line(_warming(paper_unit, fourteen, rising))
    assert line.basis == UnmodelledTemperature(THERMAL, pytest.approx(14), identifiable=False, stated=True)
    assert line.halved_by == PosesAtOtherTemperatures(THERMAL)
    wider = _line(_warming(paper_unit, fourteen, 25 + 2 * (rising - 25)))
    assert wider.magnitude > line.magnitude / 2
    again = np.random.default_rng(1).permutation(fourteen)
    both = _line(_warming(paper_unit, np.concatenate([fourteen, again]), np.r_[rising, rising + 3]))
    assert both.magnitude < line.magnitude / 20


def test_a_temperature_that_hardly_moved_is_to_be_steadier(paper_unit: Sensor, fourteen: np.ndarray) -> None:
    """The same poses and the same rise, but within what noise hides."""
    rising = np.linspace(-0.005, 0.005, 14)
    line, steadier = (_line(_warming(paper_unit, fourteen, 25 + share * rising)) for share in (1, 0.5))
    assert line.halved_by == SteadierTemperature(THERMAL)
    assert line.basis == UnmodelledTemperature(THERMAL, pytest.approx(0.01), identifiable=True, stated=True)
    assert steadier.magnitude == pytest.approx(line.magnitude / 2, rel=0.1)


def test_a_thermal_effect_that_shows_is_to_be_in_the_model(
    with_effects: Callable[..., Sensor], twenty_six: np.ndarray
) -> None:
    unit = with_effects(temperature_bias=[3e-4, -2e-4, 1e-4])
    poses = _warming(unit, twenty_six, 25 + 6 * np.sin(np.arange(26) * 1.7))
    line = _line(poses)
    assert line.halved_by == TemperatureModelled(THERMAL)
    assert _line(poses, "temperature_bias").magnitude < line.magnitude / 2


def test_what_noise_leaves_of_thermal_effects_is_to_be_halved_as_noise_is(
    paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    swing = 25 + 6 * np.sin(np.arange(26) * 1.7)
    line, quieter, steadier = (
        _line(_warming(paper_unit, twenty_six, 25 + share * (swing - 25), noise))
        for share, noise in ((1, NOISE), (1, NOISE / 2), (0.5, NOISE))
    )
    assert isinstance(line.halved_by, LongerOrMorePoses)
    assert line.halved_by.poses == 104
    assert quieter.magnitude == pytest.approx(line.magnitude / 2, rel=0.1)
    assert steadier.magnitude == pytest.approx(line.magnitude, rel=0.1)


COURSES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "rising": lambda x: x,
    "warming": lambda x: 1 - np.exp(-4 * x),
    "swinging": lambda x: np.sin(8 * x) / 2,
}
"""Of a temperature, over the share of the recording that is over."""


def _stated_and_true(unit: Sensor, true: Sensor, up: np.ndarray, temperatures_c: np.ndarray, seed: int) -> np.ndarray:
    """(2,) the squares of the stated error of |a|, and of the true one over the sphere."""
    rng = np.random.default_rng(seed)
    channels, reference = {"temp_c": temperatures_c}, {"temp_c": float(np.mean(temperatures_c))}
    poses = noisy_poses(true, rng.permutation(up), NOISE, rng, channels=channels, channel_reference=reference)
    c = fit(poses, signs=SIGNS)
    everywhere = spiral(200)
    off = np.linalg.norm(c.sensor.specific_force(unit.output(everywhere, {}), {}), axis=1) - 1
    return np.array([float(budget(c).magnitude.standard) ** 2, np.mean(off**2)])


@pytest.mark.parametrize("moved_k", [1.0, 20.0])
@pytest.mark.parametrize("course", COURSES)
@pytest.mark.parametrize("poses", [14, 26])
def test_a_moving_temperature_that_does_nothing_costs_little(
    paper_unit: Sensor, poses: int, course: str, moved_k: float
) -> None:
    up = np.array([v for _, v in directions(poses)])
    temperatures_c = 25 + moved_k * COURSES[course](np.linspace(0, 1, poses))
    stated, true = np.mean([_stated_and_true(paper_unit, paper_unit, up, temperatures_c, s) for s in range(12)], axis=0)
    assert 0.9 < np.sqrt(stated / true) < 3.0


@pytest.mark.parametrize("size", [3.0, 30.0])
@pytest.mark.parametrize("name", THERMAL)
def test_what_a_temperature_does_is_in_the_stated_error(
    paper_unit: Sensor, twenty_six: np.ndarray, name: str, size: float
) -> None:
    """In units of the noise of a pose, on axes drawn at random."""
    temperatures_c = 25 + 10 * COURSES["rising"](np.linspace(0, 1, 26))
    found = []
    for seed in range(12):
        q = np.random.default_rng(seed).standard_normal(3) * size * NOISE / np.std(temperatures_c)
        true = replace(paper_unit, effects=((effect_named(name), q),))
        found.append(_stated_and_true(paper_unit, true, twenty_six, temperatures_c, seed))
    stated, truth = np.mean(found, axis=0)
    assert 0.9 < np.sqrt(stated / truth) < 2.0


def test_what_the_data_leave_is_a_covariance_also_beside_effects_of_any_size() -> None:
    """Two coefficients that do the same, and so much that a unit matrix is nothing beside it."""
    alike = np.outer(np.arange(1.0, 6.0), [1.0, 1.0])
    np.testing.assert_allclose(_posterior(alike), np.linalg.inv(np.eye(2) + alike.T @ alike), rtol=1e-12)
    remaining = np.linalg.eigvalsh(_posterior(1e200 * alike))
    assert np.all((remaining >= 0) & (remaining <= 1))
