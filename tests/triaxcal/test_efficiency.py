"""At the bound: the fit's errors over the seeds are those of the Cramér–Rao bound, whatever the noise and the unit."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from benchmarks.efficiency import measure
from benchmarks.truth import Condition, bound_and_best, covariates, hard, information
from triaxcal.estimate.initial_estimate import problem_of, start
from triaxcal.estimate.likelihood import linearise, solve

FAMILYWISE = 1e-4
COVARIATES = {c.name: c for c in covariates()}


def named(name: str) -> Condition:
    return COVARIATES[name]


@pytest.mark.parametrize("name", COVARIATES)
def test_the_bound_by_the_whole_likelihood_is_the_bound_by_the_ellipsoid_s_normals(name: str) -> None:
    c = named(name)
    whole, best = bound_and_best(c)
    # With an offset of thousands of times the signal, seven digits are left of the scale factor's and the bias's.
    assert np.diag(np.linalg.inv(information(c.unit, c.ups, c.error))) / np.diag(whole) == pytest.approx(
        np.ones(9), abs=1e-6
    )
    assert best @ np.diag(c.error.ravel() ** 2) @ best.T == pytest.approx(whole, rel=1e-9, abs=1e-12 * np.max(whole))


@pytest.mark.slow
def test_a_thousand_fits_of_a_unit_with_every_difficulty_at_once_are_at_the_bound() -> None:
    seeds = 1000
    found = measure(hard(), seeds)
    low, high = stats.chi2.ppf([FAMILYWISE / 18, 1 - FAMILYWISE / 18], seeds) / seeds
    assert np.all((low < found.plain**2) & (found.plain**2 < high)), found.plain
    assert np.all(np.abs(found.ratio - 1) + 4 * found.uncertainty < 0.03), found.ratio
    limit = stats.norm.isf(FAMILYWISE / 18) / np.sqrt(seeds)
    assert np.all(np.abs(np.mean(found.errors / found.bound, axis=0)) < limit)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "14 poses, 0.001 g",
        "20 poses, 1e-06 g",
        "noise 1 : 3 : 30 by axis, 14 poses",
        "noise 1 to 30 by pose, 26 poses",
        "sensitivities 10 : 1, equal in output",
        "offset 2^23 counts",
        "25° off square, 14 poses",
        "signs + − +",
    ],
)
def test_the_errors_are_within_three_percent_of_the_bound(name: str) -> None:
    found = measure(named(name), 100)
    assert np.all(np.abs(found.ratio - 1) + 4 * found.uncertainty < 0.03), found.ratio


@pytest.mark.parametrize("name", COVARIATES)
def test_the_search_ends_far_below_the_noise(name: str) -> None:
    c = named(name)
    poses, _ = c.draw(7)
    problem = problem_of(poses, signs=c.signs)
    r, J, s = linearise(problem, solve(problem, start(problem, poses, c.signs), ()))
    q, _ = np.linalg.qr(J / s[:, None])
    # What another step would still move, in standard errors.
    assert np.linalg.norm(q.T @ (r / s)) < 1e-5


def test_the_jacobian_is_exact_by_complex_steps() -> None:
    poses, _ = hard().draw(0)
    problem = problem_of(poses, signs=hard().signs)
    state = start(problem, poses, hard().signs)
    x = (problem.u - problem.middle) / problem.half

    def magnitude(theta: np.ndarray) -> np.ndarray:
        s = theta[:3] * x - theta[3:6]
        ax, ay, az = theta[6:9]
        y = s[:, 1] - ax * s[:, 2]
        return np.asarray(np.sqrt((s[:, 0] - az * y - ay * s[:, 2]) ** 2 + y**2 + s[:, 2] ** 2))

    r, J, _ = linearise(problem, state)
    assert r == pytest.approx(magnitude(state.theta) - 1, abs=1e-14)
    # No difference is taken, so the step may be as small as one likes (Squire and Trapp 1998, SIAM Rev. 40:110).
    exact = np.stack([magnitude(state.theta + 1e-30j * h).imag / 1e-30 for h in np.eye(9)], axis=1)
    assert pytest.approx(exact, abs=1e-13) == J
