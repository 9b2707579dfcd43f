"""A bias by the sign of the pose before: recovered, told from hysteresis, and the first pose's own history unknown."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from triaxcal.diagnosis import diagnose
from triaxcal.effects import Effect
from triaxcal.effects.contract import BEFORE
from triaxcal.effects.memory import Hysteresis, Remanence
from triaxcal.estimate.calibration import Exclusion
from triaxcal.estimate.pose_fit import fit
from triaxcal.evidence.posterior import NotIdentifiable, Why
from triaxcal.model.sensor import Sensor
from triaxcal.poses.covariates import of_unknown_history
from triaxcal.synthetic import noisy_poses

MINUS = (-1, -1, -1)
TRUTH = [2e-4, -1e-4, 3e-4]


def test_the_fit_gives_it_back_as_far_off_as_it_says(recovers: Callable[..., None]) -> None:
    recovers(Remanence(), TRUTH)


def test_it_has_the_sign_of_the_pose_before_and_goes_through_zero_where_that_had_next_to_none() -> None:
    for reference in (1.0, 9.80665, 5e4, 4.8e-5):
        order = 10.0 ** np.rint(np.log10(reference))
        before = {n: np.array([v * order]) for n, v in zip(BEFORE, (0.7, -0.06, 0.0125), strict=True)}
        s = reference * np.array([[0.61, -0.5, 0.6]])
        assert np.diag(Remanence().basis(s, before)[0]) == pytest.approx([1.0, -1.0, 0.25])


def test_it_is_told_from_a_memory_in_proportion(
    twenty_six: np.ndarray, with_effect: Callable[[Effect, Sequence[float]], Sensor]
) -> None:
    rng = np.random.default_rng(0)
    sensor = with_effect(Remanence(), [1e-3, -1e-3, 1e-3])
    poses = noisy_poses(sensor, twenty_six[rng.permutation(26)], 1.5e-5, rng)
    right, wrong = (fit(poses, signs=MINUS, effects=[e], excluded=()).residual for e in (Remanence(), Hysteresis()))
    assert right.lack_of_fit_p is not None
    assert right.lack_of_fit_p > 1e-3
    assert wrong.rms_g > 3 * right.rms_g


def test_a_first_pose_that_came_from_somewhere_else_is_left_out_as_of_unknown_history(
    twenty_six: np.ndarray, with_effect: Callable[[Effect, Sequence[float]], Sensor]
) -> None:
    effect, truth = Remanence(), np.array([4e-4, 5e-4, 6e-4])
    for seed in range(10):
        rng = np.random.default_rng(seed)
        shown = twenty_six[rng.permutation(26)]
        # From the opposite of the first pose, of which the recording has nothing.
        came = np.concatenate([-shown[:1], shown])
        _, first, *others = noisy_poses(with_effect(effect, [*truth]), came, 1.5e-5, rng)
        poses = [replace(first, before=None), *others]
        assert of_unknown_history(poses, [effect]) == (0,)
        c = fit(poses, signs=MINUS, effects=[effect])
        assert [p.excluded for p in c.poses if not p.used] == [Exclusion.UNKNOWN_HISTORY]
        assert np.all(np.abs(c.values[9:] - truth) < 4.5 * c.standard_errors[9:])


def test_poses_that_all_follow_the_same_one_say_that_they_cannot_show_it(
    twenty_six: np.ndarray, with_effect: Callable[[Effect, Sequence[float]], Sensor]
) -> None:
    """Whatever the fixture goes through on its way to every pose leaves one offset, which is bias."""
    effect = Remanence()
    sensor = with_effect(effect, TRUTH)
    rest = Sensor(sensor.scale_factor, sensor.misalignment, sensor.bias).output(np.full((1, 3), 3**-0.5), {})[0]
    poses = noisy_poses(with_effect(effect, [0, 0, 0]), twenty_six, 1.5e-5, np.random.default_rng(0))
    loop = diagnose([replace(p, before=rest) for p in poses], signs=MINUS, catalogue=[effect])
    assert loop.after.blind_to == (effect.name,)
    assert loop.not_identifiable[effect.name] == NotIdentifiable(Why.MOVED_ALONG)
