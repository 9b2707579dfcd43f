"""A scale factor that drifts: recovered from poses whose order is mixed, unseen where there are too few."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from triaxcal.diagnosis import diagnose
from triaxcal.effects import Effect
from triaxcal.effects.time import BiasDrift, ScaleFactorDrift
from triaxcal.estimate.pose_fit import fit
from triaxcal.evidence.posterior import NotIdentifiable, Why
from triaxcal.model.sensor import Sensor
from triaxcal.synthetic import noisy_poses

MINUS = (-1, -1, -1)
TRUTH = [2e-6, -1e-6, 3e-6]
MIDDLE = {"t_s": 130.0}


def test_the_fit_gives_it_back_as_far_off_as_it_says(recovers: Callable[..., None]) -> None:
    recovers(ScaleFactorDrift(), TRUTH, reference=MIDDLE)


def test_the_scale_factor_is_that_of_the_reference_time_and_moves_from_there(
    twenty_six: np.ndarray, with_effect: Callable[[Effect, Sequence[float]], Sensor]
) -> None:
    sensor = with_effect(ScaleFactorDrift(), TRUTH)
    a = np.array([[0.6, 0.0, 0.8]])
    later = Sensor(sensor.scale_factor * (1 + 100 * np.array(TRUTH)), sensor.misalignment, np.zeros(3))
    at_rest = Sensor(sensor.scale_factor, sensor.misalignment, np.zeros(3), sensor.effects)
    assert at_rest.output(a, {"t_s": np.array([100.0])}) == pytest.approx(later.output(a, {}), rel=1e-12)


def test_it_is_not_a_drifting_bias(
    twenty_six: np.ndarray, with_effect: Callable[[Effect, Sequence[float]], Sensor]
) -> None:
    rng = np.random.default_rng(0)
    ups = twenty_six[rng.permutation(26)]
    sensor = with_effect(ScaleFactorDrift(), TRUTH)
    poses = noisy_poses(sensor, ups, 1.5e-5, rng, channel_reference=MIDDLE)
    right, wrong = (
        fit(poses, signs=MINUS, effects=[e], excluded=()).residual for e in (ScaleFactorDrift(), BiasDrift())
    )
    assert right.lack_of_fit_p is not None
    assert right.lack_of_fit_p > 1e-3
    assert wrong.rms_g > 3 * right.rms_g


def test_poses_all_taken_at_one_moment_say_that_they_cannot_show_it(
    fourteen: np.ndarray, with_effect: Callable[[Effect, Sequence[float]], Sensor]
) -> None:
    effect = ScaleFactorDrift()
    poses = noisy_poses(with_effect(effect, [0, 0, 0]), fourteen, 1.5e-5, np.random.default_rng(0), hold_s=0.0)
    loop = diagnose(poses, signs=MINUS, catalogue=[effect])
    assert loop.after.blind_to == (effect.name,)
    assert loop.not_identifiable[effect.name] == NotIdentifiable(Why.MOVED_ALONG)
