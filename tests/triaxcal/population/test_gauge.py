"""Gauge studies of published data, and known truth over many seeds."""

from __future__ import annotations

import numpy as np
import pytest

from triaxcal.errors import InvalidData
from triaxcal.population import GaugeStudy, Method, gauge_study

AIAG = np.array([
    [0.29, 0.41, 0.64, 0.08, 0.25, 0.07, 0.04, -0.11, -0.15],
    [-0.56, -0.68, -0.58, -0.47, -1.22, -0.68, -1.38, -1.13, -0.96],
    [1.34, 1.17, 1.27, 1.19, 0.94, 1.34, 0.88, 1.09, 0.67],
    [0.47, 0.50, 0.64, 0.01, 1.03, 0.20, 0.14, 0.20, 0.11],
    [-0.80, -0.92, -0.84, -0.56, -1.20, -1.28, -1.46, -1.07, -1.45],
    [0.02, -0.11, -0.21, -0.20, 0.22, 0.06, -0.29, -0.67, -0.49],
    [0.59, 0.75, 0.66, 0.47, 0.55, 0.83, 0.02, 0.01, 0.21],
    [-0.31, -0.20, -0.17, -0.63, 0.08, -0.34, -0.46, -0.56, -0.49],
    [2.26, 1.99, 2.01, 1.80, 2.12, 2.19, 1.77, 1.45, 1.87],
    [-1.36, -1.25, -1.31, -1.68, -1.62, -1.50, -1.49, -1.77, -2.16],
])  # fmt: skip
"""AIAG, Measurement Systems Analysis, 4th edition, 2010, chapter III B: ten parts, three appraisers,
three trials. The same data are Minitab's gageaiag.mtw."""
PART, APPRAISER = np.repeat(np.arange(10), 9), np.tile(np.repeat(np.arange(3), 3), 10)

DYESTUFF = np.array([
    [1545, 1440, 1440, 1520, 1580], [1540, 1555, 1490, 1560, 1495], [1595, 1550, 1605, 1510, 1560],
    [1445, 1440, 1595, 1465, 1545], [1595, 1630, 1515, 1635, 1625], [1520, 1455, 1450, 1480, 1445],
], dtype=float)  # fmt: skip
"""Davies and Goldsmith, Statistical Methods in Research and Production, 1972, table 6.1: yields of six batches. `lme4`
(Bates et al., Journal of Statistical Software 67 (2015) 1) has REML variances of 1764 and 2451."""


def aiag(**options: bool) -> GaugeStudy:
    return gauge_study(AIAG.ravel(), PART, APPRAISER, **options)


def test_the_analysis_of_variance_of_aiag() -> None:
    printed = {
        "part": (9, 88.3619, 9.81799, 492.291), "appraiser": (2, 3.1673, 1.58363, 79.406),
        "interaction": (18, 0.3590, 0.01994, 0.434), "repeatability": (60, 2.7589, 0.04598, None),
    }  # fmt: skip
    for row in aiag().anova:
        dof, total, mean, f = printed[row.name]
        assert row.dof == dof
        assert row.sum_of_squares == pytest.approx(total, abs=5.1e-5)
        assert row.mean_square == pytest.approx(mean, abs=5.1e-6)
        assert row.f is None if f is None else row.f == pytest.approx(f, abs=5.1e-4)
    assert aiag().anova[2].p == pytest.approx(0.974, abs=5e-4)


def test_the_components_of_aiag() -> None:
    """Without the interaction, as Minitab prints them: variance, % of contribution, % of study variation."""
    found = aiag()
    assert found.method is Method.ANOVA
    assert not found.interaction
    printed = {
        "gauge": (0.09143, 7.76, 27.86), "repeatability": (0.03997, 3.39, 18.42),
        "reproducibility": (0.05146, 4.37, 20.90),
        "part": (1.08645, 92.24, 96.04), "total": (1.17788, 100.0, 100.0),
    }  # fmt: skip
    for name, (variance, contribution, study) in printed.items():
        of = found.components[name]
        assert of.variance == pytest.approx(variance, abs=1e-5)
        assert 100 * of.share == pytest.approx(contribution, abs=5.1e-3)
        assert 100 * of.study_share == pytest.approx(study, abs=5.1e-3)
    assert found.components["gauge"].sd == pytest.approx(0.30237, abs=5.1e-6)
    assert found.components["repeatability"].sd == pytest.approx(0.199933, abs=5.1e-7)
    assert found.grr == found.components["gauge"].study_share
    assert found.categories == 4


def test_an_interaction_that_is_asked_for_stays() -> None:
    found = aiag(interaction=True)
    assert found.components["interaction"].variance == 0.0  # its mean square is below that of the error
    assert found.components["repeatability"].variance == pytest.approx(0.04598, abs=5.1e-6)
    assert found.components["appraiser"].variance == pytest.approx((1.58363 - 0.01994) / 30, abs=1e-6)
    assert found.components["part"].variance == pytest.approx((9.81799 - 0.01994) / 9, abs=1e-5)


def test_one_appraiser_takes_reml_with_the_figures_of_lme4() -> None:
    found = gauge_study(DYESTUFF.ravel(), np.repeat(np.arange(6), 5), np.zeros(30, dtype=int))
    assert found.method is Method.REML
    assert found.components["part"].variance == pytest.approx(1764, abs=0.6)
    assert found.components["repeatability"].variance == pytest.approx(2451, abs=0.6)
    assert "reproducibility" not in found.components


def test_an_interval_of_the_repeatability_is_that_of_a_chi_square() -> None:
    from scipy import stats

    found = aiag(interaction=True).components["repeatability"]
    low, high = (60 * found.variance / stats.chi2.ppf(q, 60) for q in (0.975, 0.025))
    assert found.interval == pytest.approx((low, high), rel=2e-3)


def simulated(
    seed: int, sds: tuple[float, float, float, float], shape: tuple[int, int, int] = (10, 3, 2)
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Values, part and appraiser, with the scatter of part, appraiser, interaction and repetition."""
    rng, (p, o, r) = np.random.default_rng(seed), shape
    part, appraiser = np.repeat(np.arange(p), o * r), np.tile(np.repeat(np.arange(o), r), p)
    crossed = rng.normal(0, sds[2], (p, o))
    values = rng.normal(0, sds[0], p)[part] + rng.normal(0, sds[1], o)[appraiser] + crossed[part, appraiser]
    return 5 + values + rng.normal(0, sds[3], len(part)), part, appraiser


def test_reml_is_the_analysis_of_variance_where_data_are_balanced() -> None:
    """A known identity, where no variance is zero (Searle, Casella and McCulloch, Variance Components, 1992, 6.7)."""
    values, part, appraiser = simulated(1, (1.0, 0.7, 0.5, 0.3))
    balanced = gauge_study(values, part, appraiser, interaction=True)
    assert min(c.variance for c in balanced.components.values()) > 0
    # Each measurement twice in a cell and once more where the same mean leaves the cell: no longer balanced.
    cell = part == 0
    mean = values[cell & (appraiser == 0)].mean()
    nearly = gauge_study(
        np.append(values, mean), np.append(part, 0), np.append(appraiser, 0), interaction=True
    )  # fmt: skip
    assert (balanced.method, nearly.method) == (Method.ANOVA, Method.REML)
    for name, of in balanced.components.items():
        assert nearly.components[name].variance == pytest.approx(of.variance, rel=0.06)


@pytest.mark.slow
def test_intervals_of_balanced_studies_hold_the_truth() -> None:
    truth = (1.0, 0.4, 0.2, 0.3)
    gauge = 0.4**2 + 0.2**2 + 0.3**2
    held = np.zeros(3)
    for seed in range(300):
        found = gauge_study(*simulated(seed, truth, (10, 4, 3)), interaction=True)
        low, high = found.components["gauge"].interval
        held += [
            low <= gauge <= high, found.grr_interval[0] <= np.sqrt(gauge / (1 + gauge)) <= found.grr_interval[1],
            found.components["part"].interval[0] <= 1.0 <= found.components["part"].interval[1],
        ]  # fmt: skip
    # 95 % of 300, within 3.5 standard deviations of a binomial.
    assert (np.abs(held / 300 - 0.95) < 3.5 * np.sqrt(0.95 * 0.05 / 300)).all()


@pytest.mark.slow
def test_studies_with_gaps_find_the_truth() -> None:
    truth = (1.0, 0.4, 0.0, 0.3)
    found, held = [], 0
    for seed in range(60):
        values, part, appraiser = simulated(seed, truth, (25, 6, 2))
        kept = np.random.default_rng(1000 + seed).random(len(values)) < 0.6
        one = gauge_study(values[kept], part[kept], appraiser[kept])
        assert one.method is Method.REML
        found.append([one.components[name].variance for name in ("part", "appraiser", "repeatability")])
        low, high = one.components["gauge"].interval
        held += low <= 0.25 <= high
    error = np.std(found, axis=0) / np.sqrt(len(found))
    assert (np.abs(np.mean(found, axis=0) - [1.0, 0.16, 0.09]) < 4 * error).all()
    assert held / 60 > 0.85


def test_data_without_a_repetition_are_refused() -> None:
    for part, appraiser in (([0, 1, 2], [0, 0, 0]), ([0, 0], [0, 1])):
        with pytest.raises(InvalidData):
            gauge_study(np.arange(len(part), dtype=float), np.array(part), np.array(appraiser))
    with pytest.raises(InvalidData):
        gauge_study(np.array([1.0, np.nan]), np.array([0, 0]), np.array([0, 0]))


def test_a_gauge_without_scatter_has_no_categories() -> None:
    part, appraiser = np.repeat(np.arange(4), 4), np.tile([0, 0, 1, 1], 4)
    found = gauge_study(part.astype(float), part, appraiser)
    assert found.grr == 0.0
    assert found.categories is None
