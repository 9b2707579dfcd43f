"""What models are worth: fitted as scipy fits them, tested by scipy's distributions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import least_squares

from triaxcal.effects import effect_named
from triaxcal.effects.bias_drift import BiasDrift
from triaxcal.effects.bias_step import BiasStep
from triaxcal.effects.part import Part
from triaxcal.poses.pose import Pose
from triaxcal.search import Search
from triaxcal.search.worth import deviance

SECOND, WARMTH = effect_named("second_order_nonlinearity"), effect_named("temperature_bias")


def chi2_by_scipy(poses: list[Pose], squared: bool) -> float:
    """Of nine parameters, and of three second-order coefficients too, by scipy alone; all axes have the same noise."""
    u = np.array([p.mean for p in poses])
    sigma = np.array([np.sqrt(np.diag(p.covariance)) for p in poses])
    middle, half = (u.max(axis=0) + u.min(axis=0)) / 2, np.ptp(u, axis=0) / 2

    def miss(p: np.ndarray) -> np.ndarray:
        v = (u - middle) / half * p[:3] - p[3:6]
        s = v
        if squared:
            for _ in range(8):
                s = v - p[9:] * s**2
        ax, ay, az = p[6:9]
        R = np.array([[1, az, ay], [0, 1, ax], [0, 0, 1]])
        return (np.linalg.norm(np.linalg.solve(R, s.T), axis=0) - 1) / (sigma[:, 0] / abs(half[0]))

    first = np.r_[np.full(3, -1.0), np.zeros(9 if squared else 6)]
    return float(2 * least_squares(miss, first, xtol=1e-15, ftol=1e-15, gtol=1e-15).cost)


def test_the_chi_square_of_a_model_is_that_of_a_fit_by_scipy(search: Search, poses: list[Pose]) -> None:
    # Scipy's weights are of one axis for all, which are alike to 2 %, and do not follow the gradient.
    assert search.linear.chi2 == pytest.approx(chi2_by_scipy(poses, squared=False), rel=0.03)
    model = search.model([SECOND])
    assert model is not None
    assert model.chi2 == pytest.approx(chi2_by_scipy(poses, squared=True), rel=0.03)


def test_degrees_of_freedom_are_spent_by_coefficients_and_by_shapes(search: Search) -> None:
    assert search.left([]) == 26 - 9
    assert search.left([SECOND]) == 14
    assert search.left([BiasDrift(2), SECOND]) == 8
    assert search.left([BiasStep(100.0)]) == 13
    assert search.left([Part.of(BiasStep(100.0), "x")]) == 15


def test_a_model_that_leaves_too_little_is_none(search: Search) -> None:
    # At least an eighth and at most a half of the 17 degrees of freedom is kept.
    assert 2 < search.kept < 9
    assert search.model([BiasDrift(3), SECOND, WARMTH]) is None
    assert search.model([BiasDrift(1), SECOND]) is not None


def test_deviance_is_chi_square_up_to_what_noise_explains_and_its_logarithm_beyond() -> None:
    assert deviance(np.array([3.0, 10.0]), 10).tolist() == [3.0, 10.0]
    # −2 log likelihood of n residuals whose common factor f² ≥ 1 is free: chi2/f² + n log f², at its minimum.
    for chi2, n in ((25.0, 10), (4000.0, 17)):
        f2 = np.linspace(1, 1000, 1_000_000)
        assert float(deviance(np.array(chi2), n)) == pytest.approx(np.min(chi2 / f2 + n * np.log(f2)), rel=1e-6)


def test_a_drop_is_judged_by_the_noise_or_by_what_is_left_where_that_is_more(search: Search) -> None:
    # 30 in 3 degrees of freedom, noise known for certain, nothing but noise left.
    assert search.p_value(44.0, 14.0, 3, 14) == pytest.approx(stats.chi2.sf(30.0, 3), rel=1e-3)
    # The same beside four times the noise: an F test against it.
    assert search.p_value(254.0, 224.0, 3, 14) == pytest.approx(stats.f.sf(30.0 / 3 / 16, 3, 14), rel=1e-9)


def test_noise_that_few_windows_tell_is_told_by_what_is_left_too(search: Search) -> None:
    """A drop of 30 in 3 degrees of freedom beside 14 in 14: an F test against the noise of poses and rest together."""
    known, search.pure = search.pure, 9.0
    p = search.p_value(44.0, 14.0, 3, 14)
    search.pure = known
    assert p == pytest.approx(stats.f.sf(10.0 / ((9 + 14) / 23), 3, 23), rel=1e-9)
    assert p < stats.f.sf(10.0, 3, 9) / 5


def test_what_an_effect_adds_beside_others_is_its_drop_of_chi_square(search: Search) -> None:
    both, alone = search.model([SECOND, WARMTH]), search.model([SECOND])
    assert both is not None
    assert alone is not None
    drop = alone.chi2 - both.chi2
    assert search.given(WARMTH, [SECOND]) == pytest.approx(stats.chi2.sf(drop, 3), rel=1e-3)
    assert search.given(SECOND, [WARMTH]) < 1e-12


def test_beside_itself_an_effect_has_nothing_to_add(search: Search) -> None:
    assert search.given(Part.of(SECOND, "x"), [SECOND]) == 1.0
    assert search.given(BiasDrift(1), [BiasDrift(2)]) == 1.0


def test_the_rounding_of_a_processor_tells_no_models_apart() -> None:
    left = 17.0 + 100 * np.random.default_rng(0).random(200)
    apart = deviance(left, 17) - deviance(left * (1 + 1e-12), 17)
    assert np.count_nonzero(apart) <= 2
    assert deviance(np.array(30.0), 17) < deviance(np.array(30.001), 17)
