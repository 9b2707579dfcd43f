"""Covariances of all rows without matrices of so many rows, held against the matrices."""

from __future__ import annotations

import numpy as np
import pytest

from triaxcal.evidence.covariances import LowRank, OwnVariances, inverse_of

N, TAUS = 30, (0.4, 3.0, 200.0)


@pytest.fixture(params=["own", "low rank", "none"])
def covariance(request: pytest.FixtureRequest) -> tuple[OwnVariances | LowRank, np.ndarray]:
    rng = np.random.default_rng(4)
    if request.param == "own":
        variances = rng.random(N) * (np.arange(N) < N // 2)
        return OwnVariances(variances), np.diag(variances)
    factor = rng.standard_normal((N, 5)) if request.param == "low rank" else np.empty((N, 0))
    return LowRank(factor), factor @ factor.T


@pytest.mark.parametrize("tau", TAUS)
def test_the_precision_is_the_inverse(covariance: tuple[OwnVariances | LowRank, np.ndarray], tau: float) -> None:
    short, whole = covariance
    noise = np.eye(N) + tau**2 * whole
    precision = short.precision(tau)
    assert precision @ noise == pytest.approx(np.eye(N), abs=1e-8)
    assert np.ones(N) @ precision == pytest.approx(np.linalg.solve(noise, np.ones(N)), abs=1e-9)
    assert precision.half_log_det == pytest.approx(-0.5 * np.linalg.slogdet(noise)[1])


def test_beyond_a_basis_it_is_that_of_the_complement(covariance: tuple[OwnVariances | LowRank, np.ndarray]) -> None:
    short, whole = covariance
    every = np.linalg.qr(np.random.default_rng(2).standard_normal((N, 9)), mode="complete")[0]
    basis, complement = every[:, :9], every[:, 9:]
    assert short.beyond(basis) == pytest.approx(
        np.diag(complement @ complement.T @ whole @ complement @ complement.T), abs=1e-12
    )
    for tau, found in zip(TAUS, short.precisions_beyond(basis, TAUS), strict=True):
        inside = np.eye(N - 9) + tau**2 * complement.T @ whole @ complement
        assert found @ np.eye(N) == pytest.approx(complement @ np.linalg.inv(inside) @ complement.T, abs=1e-8)
        assert found.half_log_det == pytest.approx(-0.5 * np.linalg.slogdet(inside)[1])


def test_an_inverse_keeps_what_is_known_where_something_is_not() -> None:
    """Two parameters of which the data show the sum alone, beside one of quite another size."""
    precision = np.array([[4.0, 4.0, 0.0], [4.0, 4.0, 0.0], [0.0, 0.0, 1e-20]])
    found = inverse_of(precision)
    assert np.isfinite(found).all()
    together = np.array([1.0, 1.0, 0.0])
    assert together @ precision @ found @ precision @ together == pytest.approx(together @ precision @ together)
    assert found[0, 0] > 1e10
    assert found[2, 2] == pytest.approx(1e20)


def test_an_inverse_is_the_inverse_where_all_is_known() -> None:
    columns = np.random.default_rng(1).standard_normal((3, 20, 4)) * [1.0, 1e3, 1e-6, 1.0]
    precision = columns.transpose(0, 2, 1) @ columns
    assert precision @ inverse_of(precision) == pytest.approx(np.tile(np.eye(4), (3, 1, 1)), abs=1e-6)
