"""The empirical term: harmonics that are harmonic, and that nine parameters leave alone."""

from __future__ import annotations

import numpy as np
import pytest

from triaxcal.effects.contract import TIME
from triaxcal.effects.empirical import KINDS, Empirical

RNG = np.random.default_rng(0)
UPS = RNG.standard_normal((400, 3))
UPS /= np.linalg.norm(UPS, axis=1, keepdims=True)


def share(kind: str, s: np.ndarray) -> np.ndarray:
    """(n,p) by which |a| is off, from what the term adds along the force."""
    covariates = {TIME: np.linspace(-200.0, 200.0, len(s))}
    return np.einsum("ni,nip->np", s, Empirical(kind).basis(s, covariates)) / np.sum(s**2, axis=1)[:, None]


@pytest.mark.parametrize(("kind", "count"), [("odd", 7), ("even", 9)])
def test_there_are_as_many_harmonics_as_a_degree_has_and_their_laplacian_is_zero(kind: str, count: int) -> None:
    def solid(s: np.ndarray) -> np.ndarray:
        return share(kind, s) * np.linalg.norm(s, axis=1, keepdims=True) ** KINDS[kind]

    s, h = 1.3 * UPS[:20], 1e-3
    laplacian = sum(solid(s + e) + solid(s - e) - 2 * solid(s) for e in h * np.eye(3)) / h**2
    assert solid(s).shape[1] == count
    assert np.linalg.matrix_rank(share(kind, UPS)) == count
    assert np.abs(laplacian).max() < 1e-4 * np.abs(solid(s)).max()


@pytest.mark.parametrize("kind", ["odd", "even"])
def test_the_share_depends_on_the_direction_alone(kind: str) -> None:
    assert share(kind, 0.3 * UPS) == pytest.approx(share(kind, UPS), abs=1e-12)


@pytest.mark.parametrize("kind", ["odd", "even"])
def test_over_the_whole_sphere_the_nine_parameters_absorb_none_of_it(kind: str) -> None:
    # Gauss–Legendre in z and evenly in azimuth: exact for polynomials of degree up to 19.
    z, w = np.polynomial.legendre.leggauss(10)
    az = np.arange(24) * 2 * np.pi / 24
    z, az, w = np.repeat(z, 24), np.tile(az, 10), np.repeat(w, 24)
    a = np.stack([np.sqrt(1 - z**2) * np.cos(az), np.sqrt(1 - z**2) * np.sin(az), z], axis=1)
    x, y, z = a.T
    nine = np.stack([x * x, y * y, z * z, x * y, y * z, x * z, x, y, z], axis=1)
    assert (nine * w[:, None]).T @ share(kind, a) == pytest.approx(np.zeros((9, 2 * KINDS[kind] + 1)), abs=1e-12)


@pytest.mark.parametrize("kind", list(KINDS))
def test_the_slope_is_the_finite_difference_of_the_basis(kind: str) -> None:
    effect, s = Empirical(kind), UPS[:20] * 1.1
    covariates = {TIME: np.linspace(-200.0, 200.0, 20)}
    slope = effect.slope(s, covariates)
    assert slope.shape == (20, 3, 3, len(effect.coefficients))
    for by in range(3):
        h = 1e-6 * np.eye(3)[by]
        difference = (effect.basis(s + h, covariates) - effect.basis(s - h, covariates)) / 2e-6
        assert slope[:, :, by] == pytest.approx(difference, rel=1e-6, abs=1e-7)


def test_in_time_it_is_a_polynomial_of_thousands_of_seconds() -> None:
    found = Empirical("time").basis(np.array([[2.0, 0.0, -1.0]]), {TIME: np.array([500.0])})
    assert found[0].T.tolist() == [[2 * p, 0.0, -p] for p in (0.5, 0.25, 0.125, 0.0625)]
