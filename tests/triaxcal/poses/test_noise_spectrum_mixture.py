"""How large the noise may be: intervals by one number, likelihoods by every level."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate, stats

from triaxcal.poses.noise_spectrum import DOF_LEVEL, NoiseLevels

TWO = NoiseLevels.of(np.array([0.8, 0.2]), np.array([2.0, 9.0]), np.array([200.0, 40.0]))


def drawn(levels: NoiseLevels, count: int, rng: np.random.Generator) -> np.ndarray:
    """(count,) what the true variance over the one stated may be."""
    which = rng.choice(len(levels.share), count, p=levels.share)
    dof = levels._known[which]
    return np.asarray(levels.variance[which] * dof / rng.chisquare(dof))


def test_the_stated_variance_is_the_mean_of_the_levels() -> None:
    assert TWO.share @ TWO.variance == pytest.approx(1)
    assert drawn(TWO, 200_000, np.random.default_rng(0)).mean() == pytest.approx(1, rel=0.03)


def test_an_interval_by_one_number_of_degrees_of_freedom_holds_what_all_levels_together_make() -> None:
    errors = np.random.default_rng(1).standard_normal(400_000) * np.sqrt(drawn(TWO, 400_000, np.random.default_rng(2)))
    reach = stats.t.isf((1 - DOF_LEVEL) / 2, TWO.students_dof)
    assert np.mean(np.abs(errors) > reach) == pytest.approx(1 - DOF_LEVEL, rel=0.06)


@pytest.mark.parametrize("dof", [3.0, 40.0, 1e5])
def test_one_level_is_student_s_distribution(dof: float) -> None:
    noise = NoiseLevels.known_by(dof)
    assert noise.students_dof == pytest.approx(dof, rel=0.02)
    chi2 = np.array([0.5, 5.0, 17.0, 60.0])
    truth = stats.multivariate_t(shape=np.eye(5), df=dof).logpdf(np.sqrt(chi2)[:, None] * np.eye(5)[0])
    ours = noise.log_likelihood(chi2, 5)
    assert ours - ours[0] == pytest.approx(truth - truth[0], abs=1e-3)


def test_the_likelihood_is_that_of_normal_residuals_averaged_over_what_their_variance_may_be() -> None:
    chi2 = np.array([2.0, 17.0, 60.0])
    draws = drawn(TWO, 400_000, np.random.default_rng(3))[:, None]
    by_draws = np.log(np.mean(draws ** (-17 / 2) * np.exp(-chi2 / (2 * draws)), axis=0))
    ours = TWO.log_likelihood(chi2, 17)
    assert ours - ours[0] == pytest.approx(by_draws - by_draws[0], abs=0.03)


def test_a_blurred_level_is_known_by_fewer_degrees_of_freedom() -> None:
    assert NoiseLevels.known_by(50.0).blurred(1 / 50).dof == pytest.approx([25.0])


def test_a_likelihood_is_a_density() -> None:
    def density(chi2: float) -> float:
        return float(chi2 ** (left / 2 - 1) * np.exp(TWO.log_likelihood(np.array([chi2, most]), left)[0]))

    left, most = 6, 400.0
    whole = integrate.quad(density, 1e-2, most, limit=200)[0]
    below = integrate.quad(density, 1e-2, 6.0, limit=200)[0]
    draws = drawn(TWO, 200_000, np.random.default_rng(4)) * np.random.default_rng(5).chisquare(left, 200_000)
    assert below / whole == pytest.approx(np.mean(draws < 6.0), abs=0.01)
