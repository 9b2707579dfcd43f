"""The average as a calibration: its errors, its residuals, its budget."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from tests.triaxcal.evidence.conftest import FEW, MINUS, SIGMA_G
from tests.undeclared.examine import Case, still_poses
from triaxcal.estimate.calibration import Calibration, ReferenceEpoch
from triaxcal.estimate.pose_fit import fit
from triaxcal.evidence import posterior_of
from triaxcal.evidence.model_average import corrected
from triaxcal.model.samples import Moment
from triaxcal.model.sensor import Sensor
from triaxcal.poses.covariates import at_moment
from triaxcal.poses.pose import Pose
from triaxcal.uncertainty import budget
from triaxcal.uncertainty.propagation import Extrapolated

Poses = Callable[..., list[Pose]]
START = ReferenceEpoch(Moment.SECONDS, 0.0, 0.0)


def of(poses: list[Pose], signs: tuple[float, ...] = MINUS) -> tuple[Calibration, Calibration]:
    before = fit(poses, signs=signs)
    return before, corrected(before, posterior_of(poses, before, signs=signs, catalogue=FEW), START)[0]


@pytest.mark.slow
def test_coefficients_are_as_uncertain_as_the_budget_says(
    poses_with: Poses, with_effects: Callable[..., Sensor]
) -> None:
    """Of effects from invisible to clear, where the poses leave open which it is: as likely as the prior has them, and
    so all together."""
    off = []
    for seed, by_g in enumerate([0.0, 0.0, 0.0, 0.0, 3e-5, 5e-5, 8e-5, 1.5e-4, 3e-4, 6e-4]):
        effects = {"second_order_nonlinearity": [by_g, -by_g, 0.7 * by_g]} if by_g else {}
        _, after = of(poses_with(seed, **effects))
        truth = with_effects(**effects)
        true = np.concatenate([truth.scale_factor, truth.misalignment, truth.bias])
        off.append((after.values[:9] - true) / np.asarray(budget(after).parameters.standard)[:9])
    assert 0.6 < np.sqrt(np.mean(np.square(off))) < 1.4


@pytest.mark.slow
def test_residuals_in_the_poses_come_down_to_their_noise(poses_with: Poses) -> None:
    before, after = of(poses_with(4, hysteresis=[8e-4, -7e-4, 9e-4]))
    assert after.terms == ("linear", "hysteresis")
    assert after.residual.rms_g < 1.2 * SIGMA_G < 0.2 * before.residual.rms_g
    assert after.residual.rms_g == pytest.approx(np.sqrt(np.mean([p.residual_g**2 for p in after.poses])))
    # A pose that has a part in its own prediction comes out better than one that has none.
    assert after.residual.cross_validated_rms_g is not None
    assert after.residual.rms_g < after.residual.cross_validated_rms_g < 3 * after.residual.rms_g
    assert 0 < sum(p.leverage for p in after.poses) < len(after.parameters)


@pytest.mark.slow
def test_a_budget_has_the_whole_covariance_and_says_what_may_act(poses_with: Poses) -> None:
    _, after = of(poses_with(2, second_order_nonlinearity=[8e-5, -8e-5, 6e-5]))
    found = budget(after)
    lines = {line.source: line for line in found.components}
    assert {"noise", "choice_of_effect", "temperature"} <= set(lines)
    told = np.sqrt(sum(np.square(line.parameters) for line in found.components))
    assert told == pytest.approx(after.standard_errors, rel=0.05)


def test_temperature_is_in_the_budget_as_far_as_the_poses_leave_it_open(poses_with: Poses) -> None:
    """It moved by several kelvin, so that 500 µg/K would have shown as milligrams."""
    _, after = of(poses_with(5))
    line = next(line for line in budget(after).components if line.source == "temperature")
    assert line.magnitude < SIGMA_G


@pytest.mark.slow
def test_where_nothing_is_corrected_the_linear_calibration_stays_with_wider_errors() -> None:
    recording = Case("dead_zone", 1, (100.0, 200.0), 26, "white").make()
    before, after = of(still_poses(recording.samples()), recording.signs)
    assert after.sensor is before.sensor
    assert after.terms == ("linear",)
    assert after.linear_only is None
    assert budget(after).magnitude.standard > budget(before).magnitude.standard


@pytest.mark.slow
def test_the_linear_calibration_is_kept_beside_the_effects(poses_with: Poses) -> None:
    before, after = of(poses_with(4, hysteresis=[8e-4, -7e-4, 9e-4]))
    assert after.linear_only is before
    assert after.weights == pytest.approx({"hysteresis": 1.0})


@pytest.mark.slow
def test_beyond_the_last_pose_the_error_of_the_extrapolation_is_told(
    poses_with: Poses, with_effects: Callable[..., Sensor]
) -> None:
    """As large as it is, over several units; within the recording nothing is told."""
    drift = {"bias_drift": [8e-4, -6e-4, 7e-4]}
    off = []
    for seed in range(6):
        poses = poses_with(seed, **drift)
        before = fit(poses, signs=MINUS)
        posterior = posterior_of(poses, before, signs=MINUS, catalogue=FEW)
        inside, after = (
            corrected(before, posterior, ReferenceEpoch(Moment.SECONDS, t_s, t_s))[0]
            for t_s in (poses[-1].end_s, 2 * poses[-1].end_s)
        )
        assert not [c for c in inside.cautions if isinstance(c, Extrapolated)]
        (told,) = (c for c in after.cautions if isinstance(c, Extrapolated))
        assert told.beyond_s == pytest.approx(poses[-1].end_s)
        ups = np.concatenate([np.eye(3), -np.eye(3)])
        at = at_moment(after.channel_reference, len(ups), after.moment)
        truth = with_effects(**drift).departure(ups, at)
        off.append((after.sensor.departure(ups, at) - truth) / told.uncertainty_g)
    assert 0.5 < np.sqrt(np.mean(np.square(off))) < 1.5
