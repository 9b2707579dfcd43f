"""What is told of poses whose truth is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests.triaxcal.evidence.conftest import MINUS, SIGMA_G
from triaxcal.estimate.pose_fit import fit
from triaxcal.evidence import Findings, findings, posterior_of
from triaxcal.evidence.covariances import UnmodelledKind
from triaxcal.model.sensor import Sensor
from triaxcal.poses.pose import Pose

Poses = Callable[..., list[Pose]]


def told(poses: list[Pose], signs: tuple[float, ...] = MINUS) -> Findings:
    return findings(posterior_of(poses, fit(poses, signs=signs), signs=signs))


@pytest.mark.slow
def test_where_nothing_acts_that_is_the_likeliest(poses_with: Poses) -> None:
    found = told(poses_with(0))
    assert (found.named, dict(found.candidates), dict(found.outliers), found.change_point) == ((), {}, {}, None)
    assert found.nothing > 0.3


@pytest.mark.slow
def test_an_effect_that_is_certain_is_named_alone(poses_with: Poses) -> None:
    (named,) = told(poses_with(11, temperature_bias=[5e-4, -4e-4, 6e-4])).named
    assert named.unique
    assert named.effect == "temperature_bias"


@pytest.mark.slow
def test_effects_that_do_the_same_are_named_together_each_with_its_probability(
    poses_with: Poses, paper_unit: Sensor
) -> None:
    """A temperature that rises all along as time does."""
    poses = [replace(p, channels={"temp_c": 20 + p.t_s / 60}) for p in poses_with(3)]
    drift = np.array([4e-6, -3e-6, 5e-6])
    poses = [replace(p, mean=p.mean + paper_unit.scale_factor * drift * p.t_s) for p in poses]
    found = told(poses)
    assert len(found.named) == 1
    assert not found.named[0].unique
    assert {"temperature_bias", "bias_drift"} <= set(found.named[0].probabilities)
    assert sum(found.named[0].probabilities.values()) > 0.9


@pytest.mark.slow
def test_an_outlier_is_told_with_its_pose(
    poses_with: Poses, knocked: Callable[[list[Pose], int, float], list[Pose]]
) -> None:
    found = told(knocked(poses_with(2), 7, 5e-4))
    assert list(found.outliers) == [7]
    assert found.nothing < 0.01


@pytest.mark.slow
def test_what_has_no_name_goes_with_what_it_went_with(poses_with: Poses, paper_unit: Sensor) -> None:
    """A bias that swings twice in the recording."""

    def bias_g(t_s: float) -> np.ndarray:
        return np.sin(2 * np.pi * t_s / 140) * np.array([6e-4, -4e-4, 5e-4])

    poses = poses_with(3)
    found = told([replace(p, mean=p.mean + paper_unit.scale_factor * bias_g(p.t_s)) for p in poses])
    assert found.unexplained.probability > 0.9
    assert found.unexplained.kind is UnmodelledKind.TIME


def test_a_size_is_that_of_what_was_put_in(poses_with: Poses) -> None:
    """Each pose off by so much along its own direction, and nothing else."""
    rng = np.random.default_rng(5)
    off_g = 20 * SIGMA_G * rng.standard_normal(30)
    poses = [replace(p, mean=p.mean * (1 + d)) for p, d in zip(poses_with(5), off_g, strict=True)]
    found = told(poses)
    assert found.unexplained.probability > 0.9
    assert found.unexplained.rms_g == pytest.approx(20 * SIGMA_G, rel=0.6)


def test_poses_are_counted_among_all_that_were_given(
    poses_with: Poses, knocked: Callable[[list[Pose], int, float], list[Pose]]
) -> None:
    poses = knocked(poses_with(2), 7, 5e-4)
    poses[3] = replace(poses[3], fault="saturation")
    assert list(told(poses).outliers) == [7]


@pytest.mark.slow
def test_a_name_that_hangs_on_one_pose_is_a_candidate_and_no_finding(
    monkeypatch: pytest.MonkeyPatch, poses_with: Poses
) -> None:
    poses = poses_with(11, temperature_bias=[5e-4, -4e-4, 6e-4])
    posterior = posterior_of(poses, fit(poses, signs=MINUS), signs=MINUS)
    monkeypatch.setattr(type(posterior), "least_leave_one_out", lambda self, name: 0.5)
    found = findings(posterior)
    assert found.named == ()
    assert "temperature_bias" in found.candidates
