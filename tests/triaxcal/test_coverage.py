"""Honest uncertainty: 95 % intervals hold the truth in 93 to 97 % of cases, at 5 degrees of freedom and at 100."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from benchmarks.coverage import Knowledge, covered, known, own, pooled, unknown
from benchmarks.truth import PAPER_UNIT, Condition, plan
from triaxcal.errors import InvalidData
from triaxcal.estimate.pose_fit import fit
from triaxcal.poses.degrees_of_freedom import raised_dof, within_pose_dof
from triaxcal.poses.pose import Pose

SEEDS = 220
CERTAIN = stats.norm.isf(1e-4)


def pose(dof: float, shared_dof: float = np.inf) -> Pose:
    return Pose(0.0, 1.0, 100, np.zeros(3), np.eye(3), dof, shared_dof=shared_dof)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("poses", "knowledge", "excess", "search"),
    [
        (14, known, 1.0, True),
        (14, known, 1.5, False),
        (14, known, 3.0, True),
        (14, pooled(2), 1.5, False),
        (14, unknown, 1.0, False),
        (26, own(20), 1.0, True),
        (109, known, 1.2, True),
    ],
)
def test_intervals_cover_whatever_is_known_of_the_noise(
    poses: int, knowledge: Knowledge, excess: float, search: bool
) -> None:
    # The nine intervals of one fit go together, so their share is what scatters from fit to fit.
    share = covered(poses, excess, knowledge, SEEDS, search=search).mean(axis=1)
    uncertainty = CERTAIN * share.std(ddof=1) / np.sqrt(SEEDS)
    assert 0.93 - uncertainty < share.mean() < 0.97 + uncertainty


@pytest.mark.slow
def test_normal_quantiles_would_not_cover_at_five_degrees_of_freedom() -> None:
    c = Condition("", PAPER_UNIT, plan(14), np.array(1.5e-5))
    inside = []
    for seed in range(SEEDS):
        rng = np.random.default_rng([seed, 14, 21])
        found = fit(unknown(c.poses(rng.standard_normal(c.ups.shape) * c.error), rng), signs=c.signs, excluded=())
        assert found.dof == 5
        inside.append(np.mean(np.abs(found.values - c.truth) < 1.96 * found.standard_errors))
    # METHOD's figure, and the exact one: P(|t₅| < 1.96) = 0.893.
    assert np.mean(inside) == pytest.approx(stats.t.cdf(1.96, 5) * 2 - 1, abs=4 * np.std(inside) / np.sqrt(SEEDS))


def test_effective_degrees_of_freedom_are_those_of_the_gum_s_example() -> None:
    # JCGM 100, G.4.2: relative standard uncertainties of 0.25, 0.57 and 0.82 % with 9, 4 and 14 degrees of freedom.
    part = np.array([0.25, 0.57, 0.82]) ** 2
    assert within_pose_dof([pose(9), pose(4), pose(14)], part / part.sum()) == pytest.approx(19.0, abs=0.05)


def test_what_all_poses_have_in_common_does_not_average_out() -> None:
    assert within_pose_dof([pose(28)] * 14) == pytest.approx(14 * 28)
    assert within_pose_dof([pose(28, shared_dof=28)] * 14) == pytest.approx(28)
    assert within_pose_dof([pose(28, shared_dof=56)] * 14) == pytest.approx(1 / (1 / 56 + 1 / (14 * 56)))
    assert within_pose_dof([pose(28), pose(0)]) == 0


def test_coverage_factors_are_those_of_the_gum_s_table() -> None:
    c = Condition("", PAPER_UNIT, plan(14), np.array(1.5e-5))
    rng = np.random.default_rng(0)
    found = fit(unknown(c.poses(rng.standard_normal(c.ups.shape) * c.error), rng), signs=c.signs, excluded=())
    # JCGM 100, table G.2, ν = 5.
    expected = {0.6827: 1.11, 0.90: 2.02, 0.95: 2.57, 0.9545: 2.65, 0.99: 4.03, 0.9973: 5.51}
    for level, factor in expected.items():
        assert found.coverage_factor(level) == pytest.approx(factor, abs=0.005)
    low, high = found.interval(0.99)
    assert (low + high) / 2 == pytest.approx(found.values)
    assert (high - low) / 2 == pytest.approx(4.032 * found.standard_errors, rel=1e-3)
    with pytest.raises(InvalidData, match="between 0 and 1"):
        found.coverage_factor(95)


def test_a_factor_raises_the_errors_without_a_jump_and_they_end_with_the_residuals_own_degrees_of_freedom() -> None:
    for pure, left in ((1e6, 5), (28.0, 5), (1e6, 100), (5.0, 17)):
        ratio = np.linspace(0.0, 6.0, 3001)
        dof = np.array([raised_dof(r * left, left, pure) for r in ratio])
        half = np.sqrt(np.maximum(ratio, 1.0)) * stats.t.ppf(0.975, dof)
        assert np.all(np.diff(half) >= -1e-12)
        assert np.max(np.diff(half)) < 0.05
        assert (dof[0], dof[-1]) == (pure + left, left)


def test_where_no_pose_knows_its_noise_the_residuals_lower_the_errors_too() -> None:
    assert raised_dof(0.2, 5, 0.0) == 5
    c = Condition("", PAPER_UNIT, plan(14), np.array(1.5e-5))
    rng = np.random.default_rng(3)
    poses = c.poses(rng.standard_normal(c.ups.shape) * c.error)
    large, small = (
        fit([Pose(p.start_s, p.end_s, p.samples, p.mean, p.covariance * f, 0.0) for p in poses], signs=c.signs)
        for f in (1e4, 1e-4)
    )
    assert large.standard_errors == pytest.approx(small.standard_errors, rel=1e-6)
    assert large.residual.lack_of_fit_p is None
