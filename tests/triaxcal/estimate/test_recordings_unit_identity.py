"""Recordings of one unit are told from those of two by the shape of the triad."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from triaxcal.effects import effect_named
from triaxcal.estimate.pose_fit import fit
from triaxcal.estimate.recordings import Shape, shape_by_poses, shape_in, shape_of, shape_without_effects
from triaxcal.model.directions import directions
from triaxcal.model.sensor import Sensor
from triaxcal.poses.pose import Pose
from triaxcal.synthetic import noisy_poses
from triaxcal.text.pooled_units import other_unit

KNOWN = 1e-5
"""Standard error of scale factors, as a share, and of misalignments [rad]."""


def _shape(
    scale_factor: tuple[float, ...] = (2.0, 2.0, 2.0),
    misalignment: tuple[float, ...] = (0.0, 0.0, 0.0),
    known: float = KNOWN,
    dof: float = 20.0,
) -> Shape:
    k = np.array(scale_factor)
    return Shape.of(k, np.array(misalignment), np.diag(np.concatenate([k * known, np.full(3, known)]) ** 2), dof)


def _asked(one: Shape | None, another: Shape | None) -> bool:
    return bool(other_unit("a.csv", "b.csv", one, another))


@pytest.mark.parametrize(
    "other",
    [
        _shape((2.1, 2.1, 2.1)),  # temperature scales all axes alike
        _shape((2.0, 2.02, 2.0)),  # and one of them a little more
        _shape((-2.0, -2.0, -2.0)),  # signs are asked about elsewhere
        _shape(misalignment=(2e-3, -2e-3, 1e-3)),
    ],
)
def test_what_age_and_temperature_do_to_a_unit_is_not_asked_about(other: Shape) -> None:
    assert not _asked(_shape(), other)


def test_a_unit_of_other_misalignment_or_of_other_ratios_of_scale_factors_is_asked_about_in_one_line() -> None:
    (line,) = other_unit("a.csv", "b.csv", _shape(), _shape((2.0, 2.02, 2.02), (8e-3, 0.0, -5e-3)))
    assert line.startswith("a.csv and b.csv: misalignment differs by up to 8 mrad and the ratio of scale factors by ")
    assert line.endswith("by up to 1 %, more than age and 20 K make of one unit: the same unit?")
    assert _asked(_shape(), _shape(misalignment=(0.0, 8e-3, 0.0)))
    assert _asked(_shape(), _shape((2.0, 2.0, 2.1)))


def test_no_axis_tells_more_than_another() -> None:
    apart = [
        _asked(_shape(), _shape(tuple(2.0 + d * (i == axis) for i in range(3))))
        for d in (0.04, 0.1)
        for axis in range(3)
    ]
    assert apart == [False] * 3 + [True] * 3


def test_what_the_poses_do_not_know_is_not_asked_about() -> None:
    far = (8e-3, 0.0, -5e-3)
    assert not _asked(_shape(), _shape(misalignment=far, known=5e-3))
    assert _asked(_shape(), _shape(misalignment=far, known=1e-3))
    assert not _asked(_shape(), _shape(misalignment=far, known=1e-3, dof=1.0))
    assert _asked(_shape(), _shape(misalignment=far, dof=1.0))  # so well known that it does not matter
    assert not _asked(None, _shape(misalignment=far))
    assert not _asked(_shape(), None)
    assert shape_by_poses([], (1, 1, 1), 1.0) is None


def test_a_document_has_the_shape_that_it_says_it_knows() -> None:
    document: dict[str, Any] = {
        "scale_factor": [2.0, 2.0, 2.0],
        "misalignment": [8e-3, 0.0, -5e-3],
        "standard_error": {"scale_factor": [2e-5] * 3, "misalignment": [1e-5] * 3},
    }
    assert _asked(_shape(), shape_in(document))
    for errors in ({}, {"scale_factor": [2e-5] * 3, "misalignment": [None] * 3}, {"scale_factor": 1}, None):
        assert shape_in({**document, "standard_error": errors}) is None
    assert shape_in({**document, "scale_factor": [1e-300, 2.0, 2.0]}) is None


UP = np.array([v for _, v in directions(26)])


def _recorded(unit: Sensor, seed: int, poses: int = 26, temp_c: float = 25.0) -> list[Pose]:
    rng = np.random.default_rng(seed)
    channels = {"temp_c": temp_c + 5 * np.sin(1.7 * np.arange(poses))}
    up = UP[rng.permutation(26)[:poses]]
    return noisy_poses(unit, up, 2e-5, rng, channels=channels, channel_reference={"temp_c": 25.0})


@pytest.mark.slow
def test_a_unit_is_not_asked_about_beside_itself_in_another_temperature() -> None:
    for seed in range(20):
        rng = np.random.default_rng(seed)
        own = ((effect_named("temperature_scale_factor"), 3e-4 * rng.standard_normal(3)),)
        unit = Sensor(np.array([2.41, 2.40, 2.37]), np.array([6e-3, 4e-3, -6e-4]), np.zeros(3), own)
        cold, warm = (shape_by_poses(_recorded(unit, seed, temp_c=t), (1, 1, 1), 1.0) for t in (25.0, 45.0))
        assert cold is not None
        assert warm is not None
        assert not _asked(cold, warm)


def test_what_a_calibration_corrects_is_not_asked_about() -> None:
    effects = (
        (effect_named("temperature_scale_factor"), 3e-4 * np.array([1, -1, 0.3])),
        (effect_named("second_order_nonlinearity"), np.array([1e-2, -8e-3, 6e-3])),
    )
    unit = Sensor(np.array([2.41, 2.40, 2.37]), np.array([6e-3, 4e-3, -6e-4]), np.zeros(3), effects)
    held = fit(_recorded(unit, 0), effects=[e for e, _ in effects])
    for seed in range(1, 11):
        assert not _asked(shape_of(held), shape_without_effects(held, _recorded(unit, seed, poses=14, temp_c=100.0)))
    other = replace(unit, misalignment=unit.misalignment + np.array([8e-3, 0.0, -5e-3]))
    assert _asked(shape_of(held), shape_without_effects(held, _recorded(other, 1, poses=14, temp_c=100.0)))


def test_a_recording_of_few_poses_has_no_shape_to_ask_about() -> None:
    unit = Sensor(np.array([2.41, 2.40, 2.37]), np.array([6e-3, 4e-3, -6e-4]), np.zeros(3))
    assert shape_by_poses(_recorded(unit, 0, poses=14), (1, 1, 1), 1.0) is not None
    assert shape_by_poses(_recorded(unit, 0, poses=10), (1, 1, 1), 1.0) is None
