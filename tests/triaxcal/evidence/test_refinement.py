"""Of many poses the moments of a change are looked at coarsely first, and found to the pose all the same."""

from __future__ import annotations

import numpy as np
import pytest

from tests.triaxcal.evidence.conftest import MINUS
from triaxcal.arrays import Floats
from triaxcal.effects import effect_named
from triaxcal.effects.time import MOMENTS
from triaxcal.estimate.pose_fit import fit, poses_of_means
from triaxcal.evidence.posterior import Posterior
from triaxcal.evidence.search import posterior_of
from triaxcal.evidence.terms import CHANGE_POINTS

MANY = 260
"""Poses, more than twice as many as moments that are looked at."""
APART_S = 62.0
SIGMA_G = 1e-5


def outputs(rng: np.random.Generator, bias: Floats) -> Floats:
    """(n,3) of a unit whose ``bias`` (n,3) in g changes."""
    up = rng.standard_normal((len(bias), 3))
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    return np.asarray((up + bias + SIGMA_G * rng.standard_normal(up.shape)) * [-2.4, -2.41, -2.39])


def found(u: Floats) -> Posterior:
    poses = poses_of_means(u, APART_S * np.arange(len(u)), np.full(u.shape, 2.4 * SIGMA_G))
    return posterior_of(poses, fit(poses, signs=MINUS), signs=MINUS, catalogue=[effect_named("bias_step")])


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_exchanged_channels_are_found_to_the_pose_among_many(seed: int) -> None:
    rng = np.random.default_rng(seed)
    first = int(rng.integers(20, MANY - 20))
    u = outputs(rng, np.zeros((MANY, 3)))
    u[first:] = u[first:, [1, 0, 2]]
    posterior = found(u)
    assert int(np.argmax(posterior.change_point_probabilities)) == first
    assert posterior.change_point_probabilities[first] > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_the_moment_of_a_step_is_found_between_two_of_many_poses(seed: int) -> None:
    """Of 300 µg, thirty standard errors: among the moments of the first look no
    one need lie between those two poses."""
    rng = np.random.default_rng(seed)
    first = int(rng.integers(20, MANY - 20))
    bias = np.zeros((MANY, 3))
    bias[first:, 0] = 3e-4
    posterior = found(outputs(rng, bias))
    assert posterior.effect_probabilities["bias_step"] > 0.99
    (best, *_) = posterior.sets
    (effect,) = (t.effect for t in (posterior.evidence.terms[i] for i in best.members) if t.effect is not None)
    before, after = APART_S * (first - 1), APART_S * first
    assert before <= effect.shape["at"][0] <= after


def test_many_poses_have_no_more_moments_of_a_change_than_are_looked_at() -> None:
    rng = np.random.default_rng(5)
    terms = found(outputs(rng, np.zeros((MANY, 3)))).evidence.terms
    assert sum(term.change_point >= 0 for term in terms) == CHANGE_POINTS
    assert len({term.effect.shape["at"] for term in terms if term.effect is not None}) == MOMENTS
