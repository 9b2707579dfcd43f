"""Spoiled poses: named and set aside where the poses can tell, never guessed where they cannot."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import numpy as np
import pytest
from scipy import stats

from benchmarks.outliers import clean_loses, measure
from benchmarks.truth import plan
from triaxcal.effects.memory import Hysteresis
from triaxcal.estimate.calibration import (
    Calibration,
    Caution,
    ExcludedPose,
    Exclusion,
    OutliersExcluded,
    PosesExcludedByCaller,
    UnknownHistoryExcluded,
)
from triaxcal.estimate.pose_fit import fit, not_as_predicted, outlier_set
from triaxcal.model.directions import linear_design
from triaxcal.model.sensor import Sensor
from triaxcal.poses.pose import Pose
from triaxcal.synthetic import noisy_poses

SIGMA = 1.5e-5
SIGNS = (-1, -1, -1)


def spoil(pose: Pose, unit: Sensor, direction: np.ndarray, sigmas: float) -> Pose:
    """The pose with its mean moved along the measured vector by so many standard errors."""
    return replace(pose, mean=pose.mean + unit.scale_factor * direction * sigmas * SIGMA)


Kind = TypeVar("Kind", bound=Caution)


def caution_of(c: Calibration, kind: type[Kind]) -> Kind:
    return next(caution for caution in c.cautions if isinstance(caution, kind))


def left_out(c: Calibration) -> list[int]:
    return [i for i, p in enumerate(c.poses) if not p.used]


@pytest.mark.slow
@pytest.mark.parametrize("sigmas", [10, 30, 1000])
@pytest.mark.parametrize("number", [1, 2])
def test_one_or_two_spoiled_poses_of_the_26_are_named(
    paper_unit: Sensor, twenty_six: np.ndarray, number: int, sigmas: float
) -> None:
    named, pulls, clean_pulls = 0, [], []
    true = np.concatenate([paper_unit.scale_factor, paper_unit.misalignment, paper_unit.bias])
    for seed in range(40):
        rng = np.random.default_rng([seed, number])
        poses = noisy_poses(paper_unit, twenty_six, SIGMA, rng)
        bad = sorted(int(i) for i in rng.choice(26, number, replace=False))
        for i in bad:
            poses[i] = spoil(poses[i], paper_unit, twenty_six[i], sigmas * rng.choice([-1, 1]))
        found = fit(poses, signs=SIGNS)
        clean = fit(poses, signs=SIGNS, excluded=bad)
        named += left_out(found) == bad
        pulls.append((found.values - true) / clean.standard_errors)
        clean_pulls.append((clean.values - true) / clean.standard_errors)
    assert named >= stats.binom.ppf(1e-3, 40, 0.95)
    assert np.sqrt(np.mean(np.square(pulls))) <= 1.1 * np.sqrt(np.mean(np.square(clean_pulls)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("poses", "excess", "dof"), [(14, 1.0, 1e6), (26, 1.0, 1e6), (26, 1.0, 8.0), (50, 1.5, 1e6), (26, 1.0, 0.0)]
)
def test_a_clean_set_hardly_ever_loses_a_pose(poses: int, excess: float, dof: float) -> None:
    runs = 160
    # One in a hundred is promised; so many or fewer are seen in all but one of a thousand sets of runs.
    assert clean_loses(poses, runs, excess, dof) <= stats.binom.ppf(0.999, runs, 0.01) / runs


@pytest.mark.slow
@pytest.mark.parametrize("sigmas", [10.0, 1000.0])
def test_a_spoiled_pose_of_the_14_is_named_nearly_as_often_as_it_can_be(sigmas: float) -> None:
    runs = 120
    found = measure(14, 1, sigmas, runs, peer=False)
    assert found.named >= stats.binom.ppf(1e-3, runs, 0.95) / runs
    assert found.wrong <= stats.binom.ppf(1 - 1e-3, runs, 0.01) / runs
    assert found.error_named <= 1.1
    # Nor can a rule that knows the noise, the unit, and that it is one pose do much better.
    assert found.optimum - found.named < 0.05


@pytest.mark.slow
def test_two_spoiled_poses_of_the_14_that_cannot_be_told_from_others_are_not_guessed() -> None:
    runs = 60
    found = measure(14, 2, 30.0, runs, peer=False)
    # Not even the most likely pair is the right one in a quarter of the runs.
    assert found.optimum < 0.9
    assert found.wrong <= stats.binom.ppf(1 - 1e-3, runs, 0.03) / runs
    assert found.ambiguous > 0.2


def test_a_spoiled_pose_is_named_in_a_warning_and_keeps_its_place_among_the_results(
    paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    poses = noisy_poses(paper_unit, twenty_six, SIGMA, np.random.default_rng(1), hold_s=10.0)
    poses[7] = spoil(poses[7], paper_unit, twenty_six[7], 50)
    c = fit(poses, signs=SIGNS)
    assert [p.pose for p in c.poses] == poses
    assert c.poses[7].studentized == pytest.approx(50, abs=5)
    assert c.poses[7].residual_g == pytest.approx(50 * SIGMA, rel=0.1)
    (outlier,) = caution_of(c, OutliersExcluded).poses
    assert outlier == ExcludedPose(poses[7].began, c.poses[7].studentized)
    assert c.poses[7].excluded is Exclusion.OUTLIER
    assert c.residual.lack_of_fit_p is not None
    assert c.residual.lack_of_fit_p > 0.001


def test_a_spoiled_pose_is_named_where_only_the_other_residuals_tell_the_noise(
    paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    named = 0
    for seed in range(40):
        rng = np.random.default_rng([seed, 3])
        poses = noisy_poses(paper_unit, twenty_six, SIGMA, rng)
        bad = int(rng.integers(26))
        poses[bad] = spoil(poses[bad], paper_unit, twenty_six[bad], 15)
        named += left_out(fit([replace(p, covariance=p.covariance * 100, dof=0.0) for p in poses], signs=SIGNS)) == [
            bad
        ]
    assert named >= stats.binom.ppf(1e-3, 40, 0.95)


def test_a_pose_that_only_the_noise_inside_the_poses_calls_spoiled_leaves_the_errors_wide(
    paper_unit: Sensor, fourteen: np.ndarray
) -> None:
    doubtful = {12: 0, 300: 0}
    for seed in range(20):
        poses = noisy_poses(paper_unit, fourteen, SIGMA, np.random.default_rng(seed))
        for sigmas in doubtful:
            found = fit([*poses[:4], spoil(poses[4], paper_unit, fourteen[4], sigmas), *poses[5:]], signs=SIGNS)
            told = fit([p.pose for p in found.poses], signs=SIGNS, excluded=[4])
            if left_out(found) == [4] and caution_of(found, OutliersExcluded).doubtful:
                doubtful[sigmas] += 1
                assert np.all(found.standard_errors > 1.5 * told.standard_errors)
            elif left_out(found) == [4]:
                assert found.standard_errors == pytest.approx(told.standard_errors)
    assert doubtful[12] >= 8
    assert doubtful[300] == 0


def test_the_pose_that_every_likely_pair_contains_is_left_out() -> None:
    n = 14
    design = linear_design(plan(n), plan(n))
    shown = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        r = rng.standard_normal(n)
        r[3] += 200
        r[int(rng.integers(4, n))] += 8
        verdict = outlier_set(r, design, np.full(n, 1e6), 1e6)
        if verdict.tied:
            assert verdict.rows == (3,)
            assert all(3 not in each for each in verdict.tied)
            shown += 1
    assert shown > 5


def remembering(paper_unit: Sensor, directions: np.ndarray, seed: int, *, rested: bool) -> list[Pose]:
    """Poses of a unit with hysteresis, of which the first was reached from another, unless the unit had ``rested``."""
    rng = np.random.default_rng(seed)
    up = directions[rng.permutation(len(directions))]
    unit = replace(paper_unit, effects=((Hysteresis(), np.array([4e-4, 3e-4, -5e-4])),))
    poses = noisy_poses(unit, up if rested else np.vstack([-up[:1], up]), SIGMA, rng, hold_s=10.0)
    return poses if rested else [replace(poses[1], before=None), *poses[2:]]


def test_a_first_pose_that_another_went_before_is_left_out_and_not_called_spoiled(
    paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    for seed in range(5):
        poses = remembering(paper_unit, twenty_six, seed, rested=False)
        c = fit(poses, signs=SIGNS, effects=[Hysteresis()])
        assert left_out(c) == [0]
        (unknown,) = caution_of(c, UnknownHistoryExcluded).poses
        assert unknown.began == poses[0].began
        assert c.poses[0].excluded is Exclusion.UNKNOWN_HISTORY
        told = fit(poses, signs=SIGNS, effects=[Hysteresis()], excluded=[0])
        assert isinstance(told.cautions[0], PosesExcludedByCaller)
        assert c.cautions[1:] == told.cautions[1:]
        assert c.birge_ratio == told.birge_ratio
        assert not any(isinstance(caution, OutliersExcluded) for caution in c.cautions)


def test_beside_it_another_pose_is_spoiled_as_ever(paper_unit: Sensor, twenty_six: np.ndarray) -> None:
    poses = remembering(paper_unit, twenty_six, 0, rested=False)
    poses[7] = replace(poses[7], mean=poses[7].mean * (1 + 60 * SIGMA))
    c = fit(poses, signs=SIGNS, effects=[Hysteresis()])
    assert left_out(c) == [0, 7]
    assert [type(caution) for caution in c.cautions[:2]] == [UnknownHistoryExcluded, OutliersExcluded]
    assert [p.excluded for p in c.poses if not p.used] == [Exclusion.UNKNOWN_HISTORY, Exclusion.OUTLIER]


def test_a_first_pose_in_which_the_unit_had_rested_stays(paper_unit: Sensor, twenty_six: np.ndarray) -> None:
    lost = 0
    for seed in range(40):
        poses = remembering(paper_unit, twenty_six, seed, rested=True)
        lost += left_out(fit(poses, signs=SIGNS, effects=[Hysteresis()])) == [0]
    # It costs ln 26, which noise takes out of the sum of squares in one case of fourteen.
    assert lost <= stats.binom.ppf(0.999, 40, stats.chi2.sf(np.log(26), 1))


def test_without_an_effect_of_the_pose_before_a_first_pose_that_is_off_is_spoiled(
    paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    poses = noisy_poses(paper_unit, twenty_six, SIGMA, np.random.default_rng(2))
    poses[0] = spoil(poses[0], paper_unit, twenty_six[0], 50)
    c = fit(poses, signs=SIGNS)
    assert left_out(c) == [0]
    assert caution_of(c, OutliersExcluded).poses[0].began == poses[0].began
    assert c.poses[0].excluded is Exclusion.OUTLIER


def test_a_pose_is_as_foretold_unless_it_takes_out_more_than_a_coefficient_costs() -> None:
    n = 26
    design = linear_design(plan(n), plan(n))
    q, _ = np.linalg.qr(design)
    for taken, found in ((0.9 * np.log(n), ()), (1.1 * np.log(n), (4,))):
        own = np.eye(n)[4] - q @ q[4]
        r = own / np.linalg.norm(own) * np.sqrt(taken)
        assert not_as_predicted(r, design, 1e6, [4]) == found
        assert not_as_predicted(r, design, 1e6, []) == ()
