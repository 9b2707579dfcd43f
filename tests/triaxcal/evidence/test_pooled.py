"""Several units with an effect that none shows for certain."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from tests.triaxcal.evidence.conftest import MINUS
from triaxcal.effects import effect_named
from triaxcal.estimate.pose_fit import fit
from triaxcal.evidence import Posterior, posterior_of
from triaxcal.evidence.pooled import pool
from triaxcal.poses.pose import Pose

UNITS = 8
LEAST_G = 2e-6


FEW = [
    effect_named(name)
    for name in ("temperature_bias", "temperature_bias_quadratic", "second_order_nonlinearity", "hysteresis")
]


def of_units(poses: Sequence[list[Pose]]) -> list[Posterior]:
    return [posterior_of(p, fit(p, signs=MINUS), signs=MINUS, catalogue=FEW).resized(LEAST_G) for p in poses]


@pytest.mark.slow
def test_an_effect_with_common_values_is_certain_in_all_and_in_none_alone(
    poses_with: Callable[..., list[Pose]],
) -> None:
    weak = {"temperature_bias": [1.4e-5, -1.2e-5, 1e-5]}
    units = of_units([poses_with(seed, **weak) for seed in range(UNITS)])
    assert max(unit.effect_probabilities.get("temperature_bias", 0.0) for unit in units) < 0.9
    found = pool(units)
    assert next(iter(found.probability)) == "temperature_bias"
    assert found.probability["temperature_bias"] > 0.9  # that it is a little bent cannot be excluded
    assert found.nothing < 0.01
    assert found.common["temperature_bias"] > 0.5
    assert any("temperature_bias" in group for group in found.certain(0.99))


@pytest.mark.slow
def test_values_of_their_own_are_not_called_common(poses_with: Callable[..., list[Pose]]) -> None:
    rng = np.random.default_rng(3)
    values = rng.standard_normal((UNITS, 3)) * 4e-5
    found = pool(of_units([poses_with(i, temperature_bias=list(q)) for i, q in enumerate(values)]))
    assert found.probability["temperature_bias"] > 0.99
    assert found.common["temperature_bias"] < 0.01


@pytest.mark.slow
def test_where_nothing_acts_nothing_is_found_together(poses_with: Callable[..., list[Pose]]) -> None:
    found = pool(of_units([poses_with(seed + 50) for seed in range(UNITS)]))
    assert max(found.probability.values()) < 0.5
    assert found.independent_probability > 0.5
    assert found.nothing > 0.3
    assert found.certain(0.99) == ()


@pytest.mark.slow
def test_what_one_unit_has_alone_is_no_effect_of_all(poses_with: Callable[..., list[Pose]]) -> None:
    """Each unit for itself is far likelier."""
    poses = [poses_with(seed + 70) for seed in range(UNITS)]
    poses[2] = poses_with(72, hysteresis=[8e-4, -7e-4, 9e-4])
    units = of_units(poses)
    assert units[2].effect_probabilities["hysteresis"] > 0.99
    found = pool(units)
    assert found.probability["hysteresis"] < 0.01
    assert found.nothing < 0.01


@pytest.mark.slow
def test_what_takes_the_place_of_an_unmodelled_part_in_each_is_an_effect_of_all(
    poses_with: Callable[..., list[Pose]],
) -> None:
    """By each unit alone an even function of the reading may be anything."""
    rng = np.random.default_rng(5)
    poses = [poses_with(i, second_order_nonlinearity=list(1.5e-4 * rng.standard_normal(3))) for i in range(UNITS)]
    units = of_units(poses)
    found = pool(units)
    assert min(unit.effect_probabilities["second_order_nonlinearity"] for unit in units) < 0.95
    assert found.probability["second_order_nonlinearity"] > 0.99


def test_names_that_one_unit_cannot_show_are_left_out(poses_with: Callable[..., list[Pose]]) -> None:
    cold = [replace(p, channels={}) for p in poses_with(1)]
    found = pool(of_units([poses_with(0), cold]))
    assert "temperature_bias" not in found.probability
    assert "hysteresis" in found.probability


@pytest.mark.slow
def test_what_no_name_describes_in_each_is_no_common_effect(poses_with: Callable[..., list[Pose]]) -> None:
    """A bias that wanders smoothly, otherwise in each."""
    poses = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        phase, swing = rng.uniform(0, 6, 3), rng.uniform(1e-4, 2e-4, 3)
        at = [swing * np.sin(2 * np.pi * p.t_s / 110 + phase) for p in poses_with(seed)]
        scale = np.array([-2.41, -2.40, -2.37])
        poses.append([replace(p, mean=p.mean + scale * b) for p, b in zip(poses_with(seed), at, strict=True)])
    found = pool(of_units(poses))
    assert max(found.probability.values()) < 0.9
