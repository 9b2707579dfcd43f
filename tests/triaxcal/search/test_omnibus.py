"""The test of whether anything is left: its level, and its power beside that of the tests it takes the place of."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pytest
from scipy import stats

from triaxcal.effects import CATALOGUE, effect_named
from triaxcal.poses.noise_levels import NoiseLevels
from triaxcal.poses.pose import Pose
from triaxcal.search.candidates import Candidate, Ground, candidates_of, still_conditions
from triaxcal.search.familywise import familywise, independent_tests
from triaxcal.search.gains import Gains
from triaxcal.search.omnibus import anything_p

CERTAIN = NoiseLevels.known_by(1e6)
N, FITTED = 26, 9
MODEL = np.linalg.qr(np.random.default_rng(1).standard_normal((N, FITTED)))[0]
EFFECT = effect_named("bias_drift")


@dataclass(frozen=True)
class Known:
    """What 26 poses could show of the catalogue."""

    candidates: Sequence[Candidate]
    model: np.ndarray

    @property
    def names(self) -> list[str]:
        return [c.name for c in self.candidates]

    @cached_property
    def tests(self) -> float:
        return independent_tests(Gains.of(self.candidates, np.zeros(N)), 1e6)

    def p(self, y: np.ndarray, noise: NoiseLevels) -> float:
        rest = y - self.model @ (self.model.T @ y)
        return anything_p(Gains.of(self.candidates, rest), self.names, self.model, noise)


@pytest.fixture(scope="module")
def known(poses: list[Pose], ground_of: Callable[[list[Pose]], Ground]) -> Known:
    ground = ground_of(poses)
    found, _ = candidates_of(ground, CATALOGUE, still_conditions(poses))
    return Known(found, ground.model)


def bases_beside_the_model(count: int, rank: int, seed: int = 0) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    columns = [rng.standard_normal((N, rank)) for _ in range(count)]
    return [np.linalg.qr(c - MODEL @ (MODEL.T @ c))[0] for c in columns]


def p_of(y: np.ndarray, bases: Sequence[np.ndarray], names: Sequence[str], noise: NoiseLevels = CERTAIN) -> float:
    rest = y - MODEL @ (MODEL.T @ y)
    return anything_p(Gains.of([Candidate(EFFECT, b, 1) for b in bases], rest), names, MODEL, noise)


def at_most(share: float, of: int) -> int:
    """So many of these at most, in all but one of a thousand times."""
    return int(stats.binom.ppf(1 - 1e-3, of, share))


def test_one_pose_that_is_off_is_seen_more_often_than_by_the_sum_of_squares(known: Known) -> None:
    seen = np.zeros(2)
    for seed in range(60):
        rng = np.random.default_rng(seed)
        y = rng.standard_normal(N)
        row = int(rng.integers(N))
        y[row] += 4.5 / np.sqrt(1 - np.sum(known.model[row] ** 2))
        rest = y - known.model @ (known.model.T @ y)
        seen += [known.p(y, CERTAIN) < 0.01, stats.chi2.sf(rest @ rest, N - FITTED) < 0.01]
    assert seen[0] > 1.1 * seen[1]


@pytest.mark.parametrize("pure_dof", [12.0, 200.0])
def test_noise_alone_is_called_something_as_seldom_as_claimed(known: Known, pure_dof: float) -> None:
    rng, runs, noise = np.random.default_rng(3), 40, NoiseLevels.known_by(pure_dof)
    truth = np.sqrt(noise.drawn(runs, rng))
    p = np.array([known.p(rng.standard_normal(N) * scale, noise) for scale in truth])
    for level in (0.01, 0.05, 0.2, 0.5):
        assert np.sum(p < level) <= at_most(level, runs)
    assert np.sum(p < 0.5) >= runs - at_most(0.5, runs)


def test_it_sees_as_much_as_the_best_candidate_at_the_same_level_and_more_than_the_sum_of_squares(known: Known) -> None:
    rng, runs = np.random.default_rng(4), 100
    seen = np.zeros(3)
    names, ranks = sorted(set(known.names)), np.array([c.rank for c in known.candidates])
    for k in range(runs):
        own = [c for c in known.candidates if c.name == names[k % len(names)]]
        inside = own[rng.integers(len(own))].basis
        way = rng.standard_normal(inside.shape[1])
        y = rng.standard_normal(N) + 4 * inside @ (way / np.linalg.norm(way))
        rest = y - known.model @ (known.model.T @ y)
        best = stats.chi2.sf(Gains.of(known.candidates, rest).single(), ranks).min()
        seen += [known.p(y, CERTAIN) < 0.05, familywise(best, known.tests) < 0.05,
                 stats.chi2.sf(rest @ rest, N - FITTED) < 0.05]  # fmt: skip
    assert seen[0] > 0.97 * seen[1]
    assert seen[0] > 1.1 * seen[2]


def test_nobody_sees_more_than_who_was_told() -> None:
    bases = bases_beside_the_model(10, 2)
    for k, basis in enumerate(bases):
        y = np.random.default_rng(k).standard_normal(N) + 20 * basis[:, 0]
        told = float(stats.chi2.sf(np.sum((basis.T @ y) ** 2), 2))
        assert told < p_of(y, bases, [str(i) for i in range(10)]) < 1e-6


def test_many_variants_of_a_name_weigh_as_much_as_one() -> None:
    bases = bases_beside_the_model(3, 2)
    y = np.random.default_rng(0).standard_normal(N) + 3 * bases[0][:, 0]
    once = p_of(y, bases, ["a", "b", "c"])
    assert p_of(y, [bases[0]] * 5 + bases[1:], ["a"] * 5 + ["b", "c"]) == pytest.approx(once, abs=1e-12)
    assert p_of(y, bases[::-1], ["c", "b", "a"]) == pytest.approx(once, abs=1e-12)


def test_what_has_no_name_is_seen_where_there_is_much_of_it() -> None:
    bases = bases_beside_the_model(5, 1)
    for seed in range(5):
        y = np.random.default_rng(seed).standard_normal(N) * 3
        assert p_of(y, bases, [str(i) for i in range(5)]) < 1e-3


@pytest.mark.parametrize("pure_dof", [3.0, 6.0, 30.0])
def test_what_has_no_name_and_is_large_is_seen_though_the_noise_is_hardly_known(known: Known, pure_dof: float) -> None:
    for seed in range(5):
        y = 30 * np.random.default_rng(seed).standard_normal(N)
        assert known.p(y, NoiseLevels.known_by(pure_dof)) < 0.01


SLOW_OR_NOT = NoiseLevels.of(np.array([0.9, 0.1]), np.array([1.0, 6.0]), np.array([500.0, 30.0]))
"""Slow noise below what the poses show is not ruled out."""


def test_noise_that_may_be_slow_is_called_something_as_seldom_as_claimed(known: Known) -> None:
    rng, runs = np.random.default_rng(5), 40
    truth = np.sqrt(SLOW_OR_NOT.drawn(runs, rng))
    p = np.array([known.p(rng.standard_normal(N) * scale, SLOW_OR_NOT) for scale in truth])
    for level in (0.01, 0.05, 0.2):
        assert np.sum(p < level) <= at_most(level, runs)


def test_an_effect_is_seen_though_slow_noise_is_not_ruled_out(known: Known) -> None:
    quiet, of_t = float(SLOW_OR_NOT.variance[0]), NoiseLevels.known_by(SLOW_OR_NOT.students_dof)
    seen = np.zeros(2)
    for seed in range(40):
        rng = np.random.default_rng(seed)
        one = known.candidates[rng.integers(len(known.candidates))].basis[:, 0]
        y = np.sqrt(quiet) * (rng.standard_normal(N) + 6 * one)
        seen += [known.p(y, SLOW_OR_NOT) < 0.01, known.p(y, of_t) < 0.01]
    assert seen[0] > 1.3 * seen[1]


def test_what_is_huge_is_no_noise_though_some_level_is_hardly_known(known: Known) -> None:
    noise = NoiseLevels.of(np.array([0.98, 0.02]), np.array([1.0, 1.01]), np.array([1000.0, 1.4]))
    y = 12 * np.random.default_rng(0).standard_normal(N)
    assert known.p(y, noise) < 1e-6
