"""What residuals show beyond noise: one standard deviation beside it, whatever each pose's own noise and creep."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.truth import PAPER_UNIT, Condition, plan
from triaxcal.diagnosis import diagnose
from triaxcal.estimate.calibration import Calibration
from triaxcal.estimate.fit_assessment import Excess
from triaxcal.estimate.pose_fit import fit
from triaxcal.poses.pose import Pose

NOISE_G = 6e-6
SEEDS = 30


def unequal(seed: int, most: float = 30.0) -> Condition:
    """26 poses in any order, some with far more noise than others."""
    rng = np.random.default_rng([seed, 1])
    noise = NOISE_G * rng.permutation(np.geomspace(1, most, 26))[:, None]
    return Condition("", PAPER_UNIT, plan(26)[rng.permutation(26)], noise)


def pulls(c: Condition, found: Calibration) -> np.ndarray:
    return np.asarray((found.values - c.truth) / found.standard_errors)


def rms(values: list[np.ndarray]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def swinging(seed: int, amplitude_g: float, period_s: float) -> tuple[Condition, list[Pose]]:
    """Poses of 6 s, every 7.5 s, in which the bias swings along a direction of its own, by the sine's mean and change
    over each."""
    rng = np.random.default_rng([seed, 2])
    c = Condition("", PAPER_UNIT, plan(26)[rng.permutation(26)], np.array(NOISE_G))
    along = rng.standard_normal(3)
    along *= amplitude_g / np.linalg.norm(along) * c.unit.scale_factor
    w, phase = 2 * np.pi / period_s, rng.uniform(0, 2 * np.pi)
    begin = 7.5 * np.arange(26)
    first, last = (w * t + phase for t in (begin, begin + 6))
    mean, change = (np.cos(first) - np.cos(last)) / (6 * w), np.sin(last) - np.sin(first)
    still = c.poses(rng.standard_normal((26, 3)) * c.error + mean[:, None] * along)
    return c, [
        replace(
            p, start_s=t, end_s=t + 6, creep=d * along, covariance=p.covariance + np.outer(along, along) * d**2 / 12
        )
        for p, t, d in zip(still, begin, change, strict=True)
    ]


def test_a_swing_that_no_model_has_leaves_honest_errors_and_no_pose_looks_spoiled() -> None:
    found, left_out = [], 0
    for seed in range(SEEDS):
        c, poses = swinging(seed, 5e-4, 40.0)
        calibration = fit(poses, signs=c.signs)
        found.append(pulls(c, calibration))
        left_out += any(not p.used for p in calibration.poses)
    # Poses in which the swing turns back do not creep: by a factor on all errors they had the fit for themselves, and
    # the pulls an rms of 3.
    assert 0.8 < rms(found) < 1.2
    assert np.mean(np.abs(found) > 2) < 0.1
    assert left_out <= 1


@pytest.mark.slow
def test_a_swing_that_no_effect_has_is_unexplained_and_no_pose_is_an_outlier() -> None:
    for seed in range(3):
        c, poses = swinging(seed, 5e-4, 40.0)
        known = [replace(p, before=q.mean) for p, q in zip(poses[1:], poses, strict=False)]
        loop = diagnose([poses[0], *known], signs=c.signs)
        assert loop.found.unexplained.probability > 0.9
        assert loop.findings == loop.candidates == ()
        assert loop.found.outliers == {}
        assert all(p.used for p in loop.after.poses)
        assert rms([pulls(c, loop.after)]) < 2


def test_creep_that_is_all_there_is_stays_as_it_was() -> None:
    c = Condition("", PAPER_UNIT, plan(26), np.array(NOISE_G))
    found = []
    for seed in range(SEEDS):
        rng = np.random.default_rng([seed, 3])
        creep = rng.standard_normal((26, 3)) * 20 * NOISE_G * c.unit.scale_factor
        where = rng.uniform(-0.5, 0.5, 26)[:, None]
        still = c.poses(rng.standard_normal((26, 3)) * c.error + where * creep)
        poses = [
            replace(p, creep=d, covariance=p.covariance + np.outer(d, d) / 12)
            for p, d in zip(still, creep, strict=True)
        ]
        found.append(pulls(c, fit(poses, signs=c.signs)))
    assert 0.8 < rms(found) < 1.15


@pytest.mark.parametrize("most", [4, 30])
def test_poses_that_come_back_less_well_than_their_unequal_noise_have_it_beside_their_noise(most: float) -> None:
    found, told, left_out, beside_g = [], [], 0, 3e-4
    for seed in range(SEEDS):
        c = unequal(seed, most)
        _, noise = c.draw(seed)
        rng = np.random.default_rng([seed, 4])
        # Along the measured vector, as an effect makes it that goes with the attitude.
        off = beside_g * rng.standard_normal(26)[:, None] * c.ups * c.unit.scale_factor
        calibration = fit(c.poses(noise + off), signs=c.signs)
        found.append(pulls(c, calibration))
        told.append(calibration.excess_g)
        left_out += any(not p.used for p in calibration.poses)
    # By a factor the quietest poses had the fit for themselves, and the pulls an rms of 2.
    assert 0.85 < rms(found) < 1.15
    assert np.sqrt(np.mean(np.square(told))) == pytest.approx(beside_g, rel=0.1)
    assert left_out <= 2


def test_unequal_noise_that_is_twice_what_the_poses_tell_has_honest_errors_too() -> None:
    found = []
    for seed in range(SEEDS):
        c = unequal(seed)
        _, noise = c.draw(seed)
        found.append(pulls(c, fit(c.poses(2 * noise), signs=c.signs)))
    assert 0.85 < rms(found) < 1.15


@pytest.mark.slow
def test_noise_alone_keeps_its_weights() -> None:
    assert not any(fit((c := unequal(seed)).draw(seed)[0], signs=c.signs).excess_g for seed in range(3 * SEEDS))


def test_where_all_poses_have_the_same_noise_an_excess_is_birge_s_factor_on_it() -> None:
    c = Condition("", PAPER_UNIT, plan(26), np.array(NOISE_G))
    _, noise = c.draw(1)
    before, little, much = (fit(c.poses(times * noise), signs=c.signs) for times in (1.0, 1.3, 5.0))
    assert (before.excess_g, little.excess_g, much.birge_ratio) == (0, 0, 1)
    for after in (little, much):
        birge = np.sqrt(sum((p.residual_g / p.standard_error_g) ** 2 for p in after.poses) / (26 - 9))
        assert after.standard_errors == pytest.approx(birge * before.standard_errors / before.birge_ratio, rel=0.01)
        assert [p.total_standard_error_g for p in after.poses] == pytest.approx(
            [birge * p.standard_error_g for p in after.poses], rel=0.01
        )
        assert [p.leverage for p in after.poses] == pytest.approx([p.leverage for p in before.poses], abs=2e-3)


def test_the_excess_is_paule_and_mandels_of_thirteen_trials_of_a_vaccine() -> None:
    # Log risk ratios and variances of 13 trials of BCG; τ² by Paule and Mandel is 0.3181 (Viechtbauer 2010, J. Stat.
    # Softw. 36:3, and the manual of metafor).
    y = [-0.8893, -1.5854, -1.3481, -1.4416, -0.2175, -0.7861, -1.6209, 0.0120, -0.4694, -1.3713, -0.3394, 0.4459]
    y += [-0.0173]
    v = [0.3256, 0.1946, 0.4154, 0.0200, 0.0512, 0.0069, 0.2230, 0.0040, 0.0564, 0.0730, 0.0124, 0.5325, 0.0714]
    shown = Excess.estimated((np.array(y), np.ones((13, 1)), np.sqrt(v)), 13, 12, 1e6)
    assert shown.birge_ratio == 1
    assert shown.excess_g**2 == pytest.approx(0.3181, abs=1e-4)
