"""Errors in poses of another recording."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests.triaxcal.evidence.conftest import MINUS
from triaxcal.diagnosis import diagnose
from triaxcal.effects import effect_named
from triaxcal.errors import InvalidData
from triaxcal.estimate.hold_out import Contradiction, HoldOut, held_out, magnitude_errors
from triaxcal.estimate.pose_fit import fit
from triaxcal.model.sensor import Sensor
from triaxcal.poses.pose import Pose
from triaxcal.synthetic import noisy_poses

SIGMA_G = 1.5e-5
SECOND = {"second_order_nonlinearity": [4e-4, -5e-4, 6e-4]}


def poses_of(unit: Sensor, up: np.ndarray, seed: int) -> list[Pose]:
    rng = np.random.default_rng(seed)
    return noisy_poses(unit, up[rng.permutation(len(up))], SIGMA_G, rng)


@pytest.mark.slow
def test_the_error_in_other_poses_falls_to_the_noise_where_what_acts_is_corrected(
    with_effects: Callable[..., Sensor], twenty_six: np.ndarray
) -> None:
    unit = with_effects(**SECOND)
    held = diagnose(poses_of(unit, twenty_six, 0), signs=MINUS, check=poses_of(unit, twenty_six, 1)).held_out
    assert held is not None
    assert held.poses == 26
    assert held.before_rms_g > 5 * held.noise_floor_g
    assert held.after_rms_g < 2 * held.noise_floor_g
    assert not held.worse


def test_a_calibration_that_does_worse_than_the_linear_one_elsewhere_is_found_out(
    paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    """A swing of the bias that passed for an effect of the unit; the check recording has none."""
    swing = 3e-4 * np.sin(2 * np.pi * np.arange(26) / 9)[:, None] * paper_unit.scale_factor
    quiet = poses_of(paper_unit, twenty_six, 0)
    poses = [replace(p, mean=p.mean + e) for p, e in zip(quiet, swing, strict=True)]
    check = poses_of(paper_unit, twenty_six, 1)
    before = fit(poses, signs=MINUS, excluded=())
    wrong = fit(poses, signs=MINUS, excluded=(), effects=[effect_named("cross_coupling")])
    held = held_out(before, wrong, check)
    assert held.after_rms_g > 1.2 * held.before_rms_g
    assert held.worse
    assert not held_out(wrong, before, check).worse


def test_the_errors_are_those_of_the_magnitude_under_either_calibration(
    paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    c = fit(poses_of(paper_unit, twenty_six, 0), signs=MINUS)
    check = poses_of(paper_unit, twenty_six, 1)
    miss, error = magnitude_errors(c.sensor, check, channel_reference=c.channel_reference, reference=c.reference)
    held = held_out(c, c, check)
    assert held.before_rms_g == held.after_rms_g == pytest.approx(np.sqrt(np.mean(miss**2)))
    assert held.noise_floor_g == pytest.approx(np.sqrt(np.mean(error**2)))


def test_poses_without_a_channel_that_is_needed_are_refused_by_its_name(
    with_effects: Callable[..., Sensor], twenty_six: np.ndarray
) -> None:
    rng = np.random.default_rng(2)
    warm = {"temp_c": 25 + 3 * np.sin(np.arange(26))}
    unit = with_effects(temperature_bias=[3e-4, -2e-4, 4e-4])
    poses = noisy_poses(unit, twenty_six, SIGMA_G, rng, channels=warm, channel_reference={"temp_c": 25.0})
    c = fit(poses, signs=MINUS, effects=[effect_named("temperature_bias")])
    with pytest.raises(InvalidData, match=r"^the check recording: .*temp_c"):
        held_out(c, c, [replace(p, channels={}) for p in poses])
    with pytest.raises(InvalidData, match="no still pose"):
        held_out(c, c, [])


@pytest.mark.parametrize(
    ("held", "expected"),
    [
        (HoldOut(1e-4, 3e-4, 1e-4, 9), Contradiction.UNCERTAINTY),
        (HoldOut(1e-4, 3e-4, 2.9e-4, 9), None),  # noise explains it
        (HoldOut(1e-4, 1.5e-4, 1e-5, 9, worse=True), Contradiction.CORRECTION),
        (HoldOut(2e-4, 1.5e-4, 1e-5, 9), None),
    ],
)
def test_what_poses_of_another_recording_contradict(held: HoldOut, expected: Contradiction | None) -> None:
    assert held.contradicts(2e-4) == expected
