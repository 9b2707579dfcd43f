"""A size means the same for every effect: the rms in g of all that the effect adds."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from tests.triaxcal.evidence.conftest import MINUS, rows_of
from triaxcal.effects import CATALOGUE, effect_named
from triaxcal.evidence.linearised_data import LinearisedData
from triaxcal.evidence.prior import Odds
from triaxcal.evidence.terms import terms_of
from triaxcal.poses.pose import Pose


@pytest.fixture
def rows(poses_with: Callable[..., list[Pose]]) -> LinearisedData:
    return rows_of(poses_with(1), MINUS)


def test_coefficients_of_size_one_add_an_rms_of_one(rows: LinearisedData) -> None:
    """Drawn at random, over directions at random, for an effect of direction alone."""
    rng = np.random.default_rng(1)
    s = rng.standard_normal((4000, 3))
    s /= np.linalg.norm(s, axis=1, keepdims=True)
    for name in ("third_order_nonlinearity", "scale_factor_asymmetry", "cross_coupling"):
        terms = [term for term in terms_of(rows, [effect_named(name)], Odds()) if term.effect is not None]
        for term in terms:
            assert term.effect is not None
            basis = term.effect.basis(s, {})[:, :, list(term.kept)] * term.combination
            added = np.einsum("nip,np->ni", basis, rng.standard_normal((len(s), term.rank)))
            assert np.sqrt(np.mean(np.sum(added**2, axis=1))) == pytest.approx(1.0, rel=0.1)


def test_priors_of_an_effect_are_shares_of_its_odds(rows: LinearisedData) -> None:
    odds = Odds()
    terms = [term for term in terms_of(rows, CATALOGUE, odds) if term.effect is not None]
    by_name = {name: sum(np.exp(t.log_prior) for t in terms if t.name == name) for name in {t.name for t in terms}}
    assert sum(by_name.values()) <= odds.effect_odds + 1e-12
    assert max(by_name.values()) == pytest.approx(odds.effect_odds / len(by_name), rel=1e-9)


def test_every_pose_may_be_an_outlier(rows: LinearisedData) -> None:
    outliers = [term for term in terms_of(rows, [], Odds()) if term.pose >= 0]
    assert [term.pose for term in outliers] == list(range(rows.n))
    for term in outliers:
        off = np.flatnonzero(np.abs(term.columns).sum(axis=1))
        assert set(off) <= {term.pose, rows.n + term.pose}
