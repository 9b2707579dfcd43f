"""Capability and distributions by published figures, SciPy's tests and known truth."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from triaxcal.errors import InvalidData
from triaxcal.population import capability_of, distribution, heterogeneity, holm, normality_p
from triaxcal.population.distributions import anderson_darling_p


def exactly(mean: float, sd: float, n: int) -> np.ndarray:
    values = np.random.default_rng(5).normal(size=n)
    return mean + sd * (values - values.mean()) / values.std(ddof=1)


def test_the_capability_of_the_handbook() -> None:
    """NIST/SEMATECH e-Handbook, 6.1.6: limits 8 and 20, mean 16, standard deviation 2: 0.6667."""
    found = capability_of(exactly(16, 2, 100), 8.0, 20.0)
    assert found.ppk == pytest.approx(0.6667, abs=5e-5)
    assert found.interval is not None
    assert found.interval[0] < 0.6667 < found.interval[1]


def test_the_two_sided_interval_holds_the_truth() -> None:
    held = 0
    for seed in range(400):
        found = capability_of(np.random.default_rng(seed).normal(0.5, 1, 50), -4.0, 4.0)
        assert found.interval is not None
        held += found.interval[0] <= 3.5 / 3 <= found.interval[1]
    assert 0.92 < held / 400 < 0.98


def test_below_thirty_units_and_without_a_limit_there_is_no_ppk() -> None:
    assert capability_of(exactly(0, 1, 29), None, 3.0).ppk is None
    assert capability_of(exactly(0, 1, 30), None, 3.0).ppk == pytest.approx(1.0)
    assert capability_of(exactly(0, 1, 50)).ppk is None
    assert capability_of(np.ones(50), None, 3.0).ppk is None
    with pytest.raises(InvalidData):
        capability_of(np.ones(3), 2.0, 1.0)


def test_values_outside_are_counted_with_their_share() -> None:
    found = capability_of(np.arange(40.0), 0.5, 38.5)
    assert found.outside == 2
    assert found.outside_interval == pytest.approx((0.00611, 0.16920), abs=5e-5)


def test_normality_has_the_published_critical_values() -> None:
    """D'Agostino and Stephens, Goodness-of-Fit Techniques, 1986, table 4.7: mean and variance unknown."""
    for level, critical in ((0.10, 0.631), (0.05, 0.752), (0.025, 0.873), (0.01, 1.035)):
        assert anderson_darling_p(critical) == pytest.approx(level, rel=0.02)


def test_normality_is_evenly_spread_for_normal_values() -> None:
    rng = np.random.default_rng(2)
    p = np.array([normality_p(rng.normal(size=30)) for _ in range(2000)], dtype=float)
    for level in (0.05, 0.25, 0.5):
        assert np.mean(p < level) == pytest.approx(level, abs=4 * np.sqrt(level * (1 - level) / 2000))


def test_moments_and_outliers() -> None:
    values = np.append(exactly(5.0, 1.0, 200), 100.0)
    found = distribution(values)
    assert found.outliers == (200,)
    assert found.robust_sd == pytest.approx(1.0, abs=0.15)
    assert found.sd is not None
    assert found.sd > 6
    assert found.quantiles == pytest.approx(np.quantile(values, [0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99]))
    assert distribution(np.array([2.0])).sd is None


def test_groups_are_compared_as_scipy_does() -> None:
    rng = np.random.default_rng(4)
    values, group = np.round(rng.normal(0, 1, 90), 1), rng.integers(0, 4, 90)
    found = heterogeneity(values, group)
    assert found is not None
    parts = [values[group == i] for i in range(4)]
    assert found.location_p == pytest.approx(stats.kruskal(*parts).pvalue, rel=1e-9)
    assert found.scatter_p == pytest.approx(stats.levene(*parts, center="median").pvalue, rel=1e-9)


def test_one_outlier_makes_no_difference_between_groups() -> None:
    rng = np.random.default_rng(6)
    values, group = rng.normal(0, 1, 200), np.arange(200) % 4
    values[0] = 1e4
    found = heterogeneity(values, group)
    assert found is not None
    assert found.location_p > 0.05
    assert found.between_sd < 0.5


def test_the_scatter_between_groups_is_found() -> None:
    found = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        group = np.arange(1000) % 20
        one = heterogeneity(rng.normal(0, 1.0, 20)[group] + rng.normal(0, 2.0, 1000), group)
        assert one is not None
        found.append(one.between_sd**2)
    assert np.mean(found) == pytest.approx(1.0, abs=4 * np.std(found) / np.sqrt(40))


def test_groups_that_are_too_small_do_not_count() -> None:
    assert heterogeneity(np.arange(5.0), np.array([0, 0, 0, 1, 1])) is None
    assert heterogeneity(np.ones(8), np.arange(8) % 2) is None
    found = heterogeneity(np.arange(8.0), np.array([0, 0, 0, 1, 1, 1, 2, 2]))
    assert found is not None
    assert (found.groups, found.n) == (2, 6)


def test_holm_of_a_published_example() -> None:
    """Holland and Copenhaver, Biometrics 43 (1987) 417: p 0.01, 0.02, 0.03 and 0.04 by the definition of Holm."""
    assert holm([0.04, 0.01, 0.03, 0.02]) == pytest.approx([0.06, 0.04, 0.06, 0.06])
    assert holm([]) == []


def test_empty_worlds_show_a_difference_in_one_of_twenty() -> None:
    shown = 0
    for seed in range(200):
        rng = np.random.default_rng(seed)
        figures = [rng.normal(0, 1, 60) for _ in range(4)]
        found = [heterogeneity(of, group) for of in figures for group in (np.arange(60) % 3, np.arange(60) // 20)]
        shown += min(holm([p for one in found if one for p in (one.location_p, one.scatter_p)])) < 0.05
    assert shown / 200 < 0.09
