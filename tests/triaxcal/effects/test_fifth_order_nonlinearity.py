"""The fifth power of the input: recovered beside the third, and told from it where there are edges."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from triaxcal.diagnosis import diagnose
from triaxcal.effects import Effect, effect_named
from triaxcal.effects.nonlinear import FifthOrderNonlinearity
from triaxcal.estimate.pose_fit import fit
from triaxcal.evidence.posterior import NotIdentifiable, Why
from triaxcal.model.directions import directions, linear_design
from triaxcal.model.sensor import Sensor
from triaxcal.planning.design import combinations, observability, radial
from triaxcal.synthetic import noisy_poses

MINUS = (-1, -1, -1)
TRUTH = [4e-4, -3e-4, 6e-4]


def test_the_fit_gives_it_back_as_far_off_as_it_says(recovers: Callable[..., None]) -> None:
    recovers(FifthOrderNonlinearity(), TRUTH)


def test_beside_the_third_order_directions_between_those_of_a_cube_give_each_its_own(
    twenty_six: np.ndarray, with_effects: Callable[..., Sensor]
) -> None:
    sensor = with_effects(third_order_nonlinearity=[1e-3, 0, 0], fifth_order_nonlinearity=[0, 2e-3, -1e-3])
    effects = [effect for effect, _ in sensor.effects]
    truth = np.array([1e-3, 0, 0, 0, 2e-3, -1e-3])
    between = np.array([up for _, up in directions(60)])
    c = fit(noisy_poses(sensor, between, 1e-6, np.random.default_rng(0)), signs=MINUS, effects=effects)
    assert np.all(np.abs(c.values[9:] - truth) < 4 * c.standard_errors[9:])
    assert np.all(c.standard_errors[9:] < 5e-5)
    seen = {
        len(ups): combinations(linear_design(ups, ups), radial(effects, ups, {}))[0] for ups in (twenty_six, between)
    }
    assert {n: found.shape[1] for n, found in seen.items()} == {26: 4, 60: 6}


def test_on_faces_and_vertices_it_is_third_order_and_a_scale_factor(fourteen: np.ndarray) -> None:
    fifth, third = (effect_named(f"{n}_order_nonlinearity").basis(fourteen, {}) for n in ("fifth", "third"))
    linear = fourteen[:, :, None] * np.eye(3)
    assert fifth == pytest.approx((4 * third - linear) / 3, abs=1e-12)


def test_poses_without_edges_say_that_they_show_its_sum_alone(
    fourteen: np.ndarray, twenty_six: np.ndarray, with_effect: Callable[[Effect, Sequence[float]], Sensor]
) -> None:
    effect = FifthOrderNonlinearity()
    assert (observability(fourteen, effect).visible, observability(twenty_six, effect).visible) == (1, 3)
    poses = noisy_poses(with_effect(effect, [0, 0, 0]), fourteen, 1.5e-5, np.random.default_rng(0))
    loop = diagnose(poses, signs=MINUS, catalogue=[effect])
    assert loop.after.blind_to == (effect.name,)
    assert loop.not_identifiable[effect.name] == NotIdentifiable(Why.FEW_DIRECTIONS)
