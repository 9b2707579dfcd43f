"""The evidence of a set, held against the density of the data under the whole covariance, which scipy knows."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy import stats
from scipy.special import logsumexp

from tests.triaxcal.evidence.conftest import MINUS, rows_of
from triaxcal.effects import CATALOGUE
from triaxcal.evidence.covariances import PoseInputs
from triaxcal.evidence.likelihood import Evidence
from triaxcal.evidence.prior import Odds
from triaxcal.evidence.terms import terms_of
from triaxcal.poses.pose import Pose


@pytest.fixture
def evidence(poses_with: Callable[..., list[Pose]]) -> Evidence:
    """Of poses of a unit with an effect, whose noise is known well enough to be normal."""
    rows = rows_of(poses_with(3, third_order_nonlinearity=[2e-4, 1e-4, -3e-4]), MINUS)
    odds = Odds()
    return Evidence(rows, terms_of(rows, CATALOGUE, odds), odds)


def density(evidence: Evidence, part: int, members: tuple[int, ...], sizes: np.ndarray) -> float:
    """Of the misfits beside the nine parameters, under the covariance that all of the hypothesis makes."""
    rows, assumed = evidence.rows, evidence.parts[part]
    covariance = np.eye(len(rows.y))
    if assumed.kind is not None:
        here = PoseInputs.of(rows)
        covariance += assumed.tau**2 * assumed.kind.covariance_of(here, here)
    for i, size in zip(members, sizes, strict=True):
        columns = size * np.asarray(evidence.terms[i].columns)
        covariance += columns @ columns.T
    complement = complement_of(rows.linear)
    return float(stats.multivariate_normal(cov=complement.T @ covariance @ complement).logpdf(complement.T @ rows.y))


def complement_of(columns: np.ndarray) -> np.ndarray:
    """An orthonormal basis of what columns leave."""
    return np.linalg.qr(columns, mode="complete")[0][:, columns.shape[1] :]


def of(evidence: Evidence, name: str, rank: int) -> int:
    return next(i for i, term in enumerate(evidence.terms) if term.name == name and len(term.kept) == rank)


@pytest.mark.parametrize("part", [0, 10, 25, 40])
def test_sets_of_any_number_of_terms_have_the_evidence_that_their_densities_say(evidence: Evidence, part: int) -> None:
    cubic, square = of(evidence, "third_order_nonlinearity", 3), of(evidence, "second_order_nonlinearity", 1)
    outlier = next(i for i, term in enumerate(evidence.terms) if term.pose == 4)
    told, expected = [], []
    for members in [(), (cubic,), (square, cubic), (square, cubic, outlier)]:
        found = evidence.of_set(members, [part])
        told.append(found.total)
        prior = evidence.parts[part].log_prior + evidence.log_prior[list(members)].sum() - np.log(len(found.sizes))
        expected.append(prior + logsumexp([density(evidence, part, members, s) for s in found.sizes]))
    # The density of the data themselves, which is common to all, is left out of an evidence; the noise is known by
    # a finite number of degrees of freedom.
    assert np.diff(told) == pytest.approx(np.diff(expected), abs=2e-3)


def test_a_part_costs_what_its_density_says(evidence: Evidence) -> None:
    parts = [0, 3, 17, 33]
    told = [evidence.of_set((), [part]).total for part in parts]
    expected = [evidence.parts[p].log_prior + density(evidence, p, (), np.empty(0)) for p in parts]
    assert np.diff(told) == pytest.approx(np.diff(expected), abs=2e-3)


def test_each_term_beside_others_has_the_evidence_of_the_set_of_both(evidence: Evidence) -> None:
    cubic = of(evidence, "third_order_nonlinearity", 3)
    for part in (0, 12):
        alone = evidence.of_set((cubic,), [part])
        cell = int(np.argmax(alone.log[0]))
        with_each, without = evidence.log_evidence_with_each(part, (cubic,), alone.sizes[cell])
        prior = float(evidence.log_prior[cubic]) - np.log(len(evidence.sizes))
        assert without + prior == pytest.approx(alone.log[0, cell], abs=1e-6)
        for other in (of(evidence, "second_order_nonlinearity", 3), of(evidence, "hysteresis", 1), len(with_each) - 1):
            both = evidence.of_set((cubic, other), [part])
            same = np.flatnonzero(both.sizes[:, 0] == alone.sizes[cell, 0])
            expected = both.log[0, same] - prior - evidence.log_prior[other]
            assert with_each[other] == pytest.approx(expected, abs=1e-6)


def test_coefficients_are_those_of_ridge_regression_over_all_sizes(evidence: Evidence) -> None:
    cubic = of(evidence, "third_order_nonlinearity", 3)
    found = evidence.of_set((cubic,), [0])
    complement = complement_of(evidence.rows.linear)
    columns = complement.T @ np.asarray(evidence.terms[cubic].columns)
    expected = np.zeros(3)
    for size, log in zip(found.sizes[:, 0], found.log[0], strict=True):
        misfits = np.concatenate([complement.T @ evidence.rows.y, np.zeros(3)])
        ridge = np.concatenate([columns, np.eye(3) / size]), misfits
        expected += np.exp(log - found.total) * np.linalg.lstsq(*ridge)[0]
    assert found.mean[0] == pytest.approx(expected, rel=1e-6, abs=1e-12)
