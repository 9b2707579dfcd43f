"""What a model is worth on given poses: its deviance, its price, and whether its effects earn their places."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from triaxcal.arrays import Floats, Ints
from triaxcal.calibration import Calibration
from triaxcal.distributions import f_sf
from triaxcal.effects.contract import Effect
from triaxcal.effects.plugins import EffectFault
from triaxcal.errors import Refused
from triaxcal.pose_fit import fit
from triaxcal.poses.pose import Pose
from triaxcal.problem import Problem, State, linearise, solve
from triaxcal.pure_error import lack_of_fit_p, pure_error_dof
from triaxcal.search.candidates import Ground, candidates_of, still_conditions
from triaxcal.search.familywise import familywise, independent_tests
from triaxcal.search.gains import Gains
from triaxcal.search.left_out import LeftOut
from triaxcal.trends import Trends, left_by_means, left_by_trends, trends_p

FAMILYWISE = 0.01
"""Probability of any false finding on data with nothing inside."""
WORSE = 10.0
"""A model that foretells the trends worse by so much in deviance is contradicted by them. Were it right, chance would
do that with a probability of 0.08 % at most, however alike the two (`triaxcal.search.alternatives.NEAR`)."""
P_LEAST = 1e-300
DECIMALS = 7
"""Of a deviance, of which a tenth matters."""
KEPT = 2.6
"""A model keeps at least one of so many degrees of freedom, or it would fit anything."""


@dataclass(frozen=True)
class Model:
    """Effects in the model, fitted: ``chi2`` of the residuals, the price of the effects, and the sum of squares of the
    ``trends`` inside the poses beside those that it ``foretells``."""

    effects: tuple[Effect, ...]
    state: State
    chi2: float
    price: float
    trends: float = 0.0
    foretells: bool = True


class Worth:
    """Models of some poses, and how they compare. What was fitted once is kept."""

    def __init__(
        self,
        problem: Problem,
        poses: Sequence[Pose],
        signs: Sequence[float],
        reference: float,
        catalogue: Sequence[Effect],
        linear: State,
        left_out: LeftOut,
    ) -> None:
        self.left_out = left_out
        self.problem, self.poses, self.signs, self.reference = problem, poses, signs, reference
        self.catalogue, self.still = catalogue, still_conditions(poses)
        self.pure = max(pure_error_dof(poses), 1.0)
        # Kept with what they are of, so that no other object can come to have the same id.
        self._known: dict[tuple[int, ...], tuple[tuple[Effect, ...], Model | None]] = {}
        self.trends = Trends.of(problem, poses)
        self.linear = self._model((), State(linear.theta[:9], ()), 0.0)
        ground = Ground.at(problem, self.linear.state)
        self.candidates, self.full = candidates_of(ground, catalogue, self.still)
        self.tries = {c.name: c.tries for c in self.candidates}
        self.kept = max(int((len(poses) - 9) / KEPT), 1)
        self.names = list(dict.fromkeys(c.name for c in self.candidates))
        self.tests = independent_tests(Gains.of(self.candidates, ground.y), self.pure)

    def _model(self, effects: tuple[Effect, ...], state: State, price: float) -> Model:
        r, J, s = linearise(self.problem, state)
        found = Model(effects, state, float(np.sum((r / s) ** 2)), price)
        if self.trends is None:
            return found
        try:
            return replace(found, trends=self.trends.chi2(state, J / s[:, None]))
        except EffectFault:  # it is known in the middle of the poses alone, and foretells nothing
            return replace(found, trends=self.linear.trends, foretells=False)

    def model(self, effects: Sequence[Effect]) -> Model | None:
        """Fitted; None where the poses cannot carry it."""
        key = tuple(map(id, effects))
        if key not in self._known:
            by_means = self.left(effects) >= self.kept
            found = self._solved(tuple(effects)) if by_means else self._by_trends(tuple(effects))
            self._known[key] = tuple(effects), found
        return self._known[key][1]

    def _solved(self, effects: tuple[Effect, ...]) -> Model | None:
        try:
            state = solve(self.problem, self.linear.state, effects)
        except (Refused, EffectFault):
            return None
        found = self._model(effects, state, sum(self.price(e) for e in effects))
        return found if np.isfinite(found.chi2 + found.trends) else None

    def _by_trends(self, effects: tuple[Effect, ...]) -> Model | None:
        """A model that is too much for the means alone, where the trends inside the poses put it to the test: they are
        as it foretells, and were far from nothing."""
        if self.trends is None or not self.trends.touch(effects):
            return None
        both = replace(self.problem, further=self.trends)
        try:
            state = solve(both, self.linear.state, effects)
        except (Refused, EffectFault):
            return None
        if trends_p(both, state, self.pure) < FAMILYWISE:
            return None
        trends, n, rank = left_by_trends(both, state), len(self.poses), parameters(effects)
        tested = familywise(self.p_value(self.linear.trends, trends, rank, n - rank), self.tests)
        if tested >= FAMILYWISE:
            return None
        price = sum(self.price(e) for e in effects)
        return Model(effects, state, left_by_means(both, state), price, trends)

    def trends_p(self, m: Model) -> float:
        """Probability of trends as far as these from those that a model foretells; 1 where none are known."""
        if not m.foretells:
            return 1.0
        n = len(self.poses)
        return float(f_sf(m.trends / n, n, self.pure))

    def in_part(self, m: Model, effects: Sequence[Effect]) -> Model:
        """A model with nothing fitted again, in which only some of its effects act: what these foretell."""
        if self.trends is None or not m.foretells:
            return m
        acts = [np.full(len(e.coefficients), any(e is kept for kept in effects)) for e in m.effects]
        theta = m.state.theta * np.concatenate([np.ones(9), *acts])
        try:
            return self._model(m.effects, State(theta, m.effects), m.price)
        except (Refused, EffectFault):
            return replace(m, trends=self.linear.trends, foretells=False)

    def contradicted(self, m: Model, base: Model) -> bool:
        """Whether |a| goes inside the poses otherwise than a model foretells, its base being nearer to it."""
        return m.foretells and self.against_trends(m) - self.against_trends(base) > WORSE

    def price(self, effect: Effect) -> float:
        """What a model pays for an effect: Schwarz's for its coefficients, and the choice among all that was tried."""
        return self.price_of(len(effect.coefficients), self.tries.get(effect.name, 1))

    def price_of(self, rank: int, tries: int) -> float:
        return rank * float(np.log(len(self.poses))) + 2 * float(np.log(tries * max(len(self.names), 1)))

    def left(self, effects: Sequence[Effect]) -> int:
        """Degrees of freedom of the residuals."""
        return len(self.poses) - 9 - parameters(effects)

    def score(self, m: Model) -> float:
        """Deviance, more than the linear model has inside the poses, and price; the lower the better."""
        return self.score_of_means(m) + self.against_trends(m)

    def score_of_means(self, m: Model) -> float:
        """The same as far as the means of the poses tell it."""
        return float(deviance(np.array(m.chi2), self.left(m.effects))) + m.price

    def against_trends(self, m: Model) -> float:
        """By how much worse than the linear model it foretells the trends inside the poses, in deviance."""
        own, linear = deviance(np.array([m.trends, self.linear.trends]), len(self.poses))
        return float(own - linear)

    def left_over(self, m: Model) -> bool:
        """Whether the residuals are more than noise."""
        return self._beyond_noise(m.chi2, self.left(m.effects))

    def _beyond_noise(self, chi2: float, left: int) -> bool:
        p = lack_of_fit_p(chi2, left, self.pure)
        return p is not None and p < FAMILYWISE

    def fitted(self, effects: Sequence[Effect]) -> Calibration | None:
        """None where the poses cannot carry it."""
        try:
            return fit(self.poses, signs=self.signs, reference=self.reference, effects=effects, aside=())
        except (Refused, EffectFault):
            return None

    def p_value(self, before: float, after: float, rank: int, left: int) -> float:
        """Of a drop of chi-square: against the noise, which what is left tells as well as the poses' own does, and
        against what is left alone where that is more than noise."""
        drop = max(before - after, 0.0) / rank
        degrees = self.pure + max(left, 0)
        p = float(f_sf(drop * degrees / (self.pure + after), rank, degrees))
        if self._beyond_noise(after, left):
            p = max(p, float(f_sf(drop / (after / left), rank, left)))
        return max(p, P_LEAST)

    def given(self, effect: Effect, others: Sequence[Effect], both: Model | None = None) -> float:
        """p of an effect when the others are in the model already; 1 where it has nothing to add to them."""
        both, alone = both or self.model([*others, effect]), self.model(others)
        if both is None or alone is None:
            return 1.0
        ground = Ground.at(self.problem, alone.state)
        rank = ground.shown(ground.columns(effect))[0].shape[1]
        return self.p_value(alone.chi2, both.chi2, rank, self.left(both.effects)) if rank else 1.0

    def earned(self, effect: Effect, others: Sequence[Effect], both: Model | None = None) -> float:
        """Familywise p of an effect beside the others."""
        return familywise(self.given(effect, others, both), self.tests)


def deviance(chi2: Floats, left: Ints | int) -> Floats:
    """Chi-square as far as noise explains it; beyond its ``left`` degrees of freedom by its logarithm, as what is left
    may be another noise, of a size that nobody told (profile likelihood of a factor on the errors, at least 1).

    Rounded, lest a processor's rounding decide between models that say the same: a step after one of the first poses
    and one after the next, say.
    """
    degrees = np.maximum(left, 1)
    chi2 = np.maximum(chi2, 0.0)
    beyond = np.log(np.maximum(chi2 / degrees, 1.0))
    return np.round(np.where(chi2 > degrees, degrees * (1 + beyond), chi2), DECIMALS)


def parameters(effects: Sequence[Effect]) -> int:
    return sum(len(e.coefficients) + len(e.shape) for e in effects)
