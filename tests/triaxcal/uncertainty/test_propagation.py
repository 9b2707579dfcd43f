"""How parameters follow from readings, where coefficients are held by their sizes."""

from __future__ import annotations

import numpy as np
import pytest

from triaxcal.uncertainty.propagation import gain_given_prior


@pytest.mark.parametrize("others", [[], [1e-3], [1e3, 1e-6]])
def test_a_coefficient_of_no_spread_changes_nothing(others: list[float]) -> None:
    """As if the model had no such coefficient, whatever its column."""
    weighted = np.random.default_rng(1).normal(size=(26, 10 + len(others)))
    fixed = gain_given_prior(weighted, np.array([*others, 0.0]))
    without = gain_given_prior(weighted[:, :-1], np.array(others))
    np.testing.assert_allclose(fixed[:-1], without, rtol=1e-9, atol=1e-12)
    assert not fixed[-1].any()


def test_a_wide_prior_is_a_free_coefficient_and_a_narrow_one_none() -> None:
    weighted = np.random.default_rng(2).normal(size=(26, 10))
    for spread, as_if in ((1e9, weighted), (1e-9, weighted[:, :9])):
        gain = gain_given_prior(weighted, np.array([spread]))[: as_if.shape[1]]
        np.testing.assert_allclose(gain, np.linalg.pinv(as_if), rtol=1e-6, atol=1e-9)
