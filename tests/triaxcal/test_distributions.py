"""Tails and quantiles of distributions, against scipy.stats."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import special, stats

from triaxcal import distributions as d

DOF = [0.0, -1.0, 0.5, 1.0, 2.0, 7.0, 33.3, 1e4]
X = np.r_[-1.0, 0.0, 1e-300, np.geomspace(1e-12, 1e6, 500), np.linspace(0, 100, 500), np.nan]
Q = np.r_[np.geomspace(1e-15, 1, 500), np.linspace(0.001, 1, 500), np.nan]


@pytest.mark.parametrize("dof", DOF)
def test_one_number_of_degrees_of_freedom_gives_what_scipy_stats_gives(dof: float) -> None:
    assert np.array_equal(d.chi2_cdf(X, dof), stats.chi2.cdf(X, dof), equal_nan=True)
    assert np.array_equal(d.chi2_sf(X, dof), stats.chi2.sf(X, dof), equal_nan=True)
    assert np.array_equal(d.chi2_ppf(Q, dof), stats.chi2.ppf(Q, dof), equal_nan=True)
    assert np.array_equal(d.chi2_isf(Q, dof), stats.chi2.isf(Q, dof), equal_nan=True)
    assert np.array_equal(d.t_ppf(Q, dof), stats.t.ppf(Q, dof), equal_nan=True)
    assert np.array_equal(d.t_isf(Q, dof), stats.t.isf(Q, dof), equal_nan=True)
    assert np.array_equal(d.gamma_sf(X, dof), stats.gamma.sf(X, dof), equal_nan=True)


@pytest.mark.parametrize("b", DOF)
@pytest.mark.parametrize("a", DOF)
def test_two_numbers_of_degrees_of_freedom_give_what_scipy_stats_gives(a: float, b: float) -> None:
    assert np.array_equal(d.f_sf(X, a, b), stats.f.sf(X, a, b), equal_nan=True)


def test_the_standard_normal_gives_what_scipy_stats_gives() -> None:
    assert np.array_equal(d.normal_isf(Q), stats.norm.isf(Q), equal_nan=True)


def test_degrees_of_freedom_may_be_an_array() -> None:
    dof = np.array(DOF)[:, None]
    assert np.array_equal(d.chi2_isf(Q, dof), stats.chi2.isf(Q, dof), equal_nan=True)
    assert np.array_equal(d.f_sf(X, dof, 7), stats.f.sf(X, dof, 7), equal_nan=True)


def test_softmax_is_that_of_scipy_along_any_axis_and_for_terms_that_are_impossible() -> None:
    log = np.random.default_rng(1).normal(-500.0, 30.0, (4, 9))
    log[1, 3] = -np.inf
    for axis in (None, 0, 1):
        assert d.softmax(log, axis) == pytest.approx(special.softmax(log, axis=axis), rel=1e-12)
