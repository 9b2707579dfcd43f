"""The search for the effects that poses show, among those of a catalogue that they can show."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from triaxcal.calibration import Calibration
from triaxcal.effects.contract import Effect
from triaxcal.errors import Refused
from triaxcal.fit import fit
from triaxcal.poses.pose import Pose
from triaxcal.problem import Problem, State, linearise, solve
from triaxcal.pure_error import pure_error_dof
from triaxcal.visibility import projected

FAMILYWISE = 0.01
"""Probability of any false finding on data with nothing inside."""
EFFECTS_MOST = 4
P_LEAST = 1e-300


@dataclass(frozen=True)
class _Candidate:
    effects: tuple[Effect, ...]
    rank: int
    chi2: float
    state: State


class Search:
    """Forward, by one effect or by two that only show together; every step refits the whole model and settles it."""

    def __init__(
        self,
        problem: Problem,
        poses: Sequence[Pose],
        signs: Sequence[float],
        reference: float,
        seen: Sequence[Effect],
        before: Calibration,
    ) -> None:
        self.problem, self.poses, self.signs, self.reference = problem, poses, signs, reference
        self.seen = seen
        self.before = self.best = before
        self.pure = max(pure_error_dof(poses), 1.0)
        self.passed_over: dict[str, str] = {}

    def chi2(self, state: State) -> float:
        r, _, s = linearise(self.problem, state)
        return float(np.sum((r / s) ** 2))

    def with_effects(self, linear: State, effects: Sequence[Effect]) -> State:
        return solve(self.problem, State(linear.theta[:9], ()), tuple(effects))

    def run(self, linear: State) -> list[Effect]:
        self.linear = linear
        adopted: list[Effect] = []
        for _ in range(EFFECTS_MOST):
            # Two effects of a size hide each other: beside either alone, what is left passes for noise.
            step = self._step(adopted, 1) or (self._step(adopted, 2) if self._left_over() else None)
            if step is None or len(adopted) + len(step) > EFFECTS_MOST:
                break
            adopted = self._settled([*adopted, *step])
        return adopted

    def _left_over(self) -> bool:
        p = self.best.residual.lack_of_fit_p
        return p is not None and p < FAMILYWISE

    def _step(self, adopted: list[Effect], size: int) -> tuple[Effect, ...] | None:
        """The best ``size`` effects to add, where each of them earns its place."""
        candidates = self._candidates(adopted, size)
        if not candidates:
            return None
        best = min(candidates, key=lambda c: c.chi2 + c.rank * np.log(len(self.poses)))
        now = self.chi2(self.with_effects(self.linear, adopted))
        p_family = self.p_value(now, best.chi2, best.rank, best.state) * len(candidates)
        if size > 1:
            each = (self.given(e, [*adopted, *(o for o in best.effects if o is not e)]) for e in best.effects)
            p_family = max(p_family, *(p * len(self.seen) for p in each))
        name = " with ".join(e.name for e in best.effects)
        beyond = best.chi2 - (len(self.poses) - len(best.state.theta))
        if self._left_over() and now - best.chi2 < beyond:
            # Something else, part of which looks like this: a name is earned by explaining most of what is there.
            self.passed_over[name] = "it explains less than half of it"
            return None
        if p_family >= FAMILYWISE:
            self.passed_over[name] = f"p = {min(1.0, p_family):.2g}"
            return None
        trial = self.fitted([*adopted, *best.effects])
        if trial is None or not _improves(trial, self.best):
            self.passed_over[name] = "it does not lower the cross-validated error"
            return None
        self.best = trial
        return best.effects

    def _candidates(self, adopted: list[Effect], size: int) -> list[_Candidate]:
        out = []
        for group in itertools.combinations([e for e in self.seen if e not in adopted], size):
            ranks = [len(projected(self.problem, self.linear, e, [*adopted, *group[:i]])) for i, e in enumerate(group)]
            whole = [len(e.coefficients) for e in group]
            # One that contains an adopted one shows in part beside it, and may take its place.
            if not all(ranks) or (ranks != whole and (size > 1 or not adopted)):
                continue
            if len(self.poses) - 9 - _coefficients([*adopted, *group]) < 1:
                continue
            try:
                state = self.with_effects(self.linear, [*adopted, *group])
            except Refused:
                continue
            out.append(_Candidate(group, sum(ranks), self.chi2(state), state))
        return out

    def p_value(self, before: float, after: float, rank: int, state: State) -> float:
        """Of a drop of chi-square: against the noise, and against what is left where more than noise is left."""
        p = float(stats.f.sf(max(before - after, 0.0) / rank, rank, self.pure))
        left = len(self.poses) - len(state.theta)
        if left > 0 and stats.f.sf(after / left, left, self.pure) < FAMILYWISE:
            p = max(p, float(stats.f.sf(max(before - after, 0.0) / rank / (after / left), rank, left)))
        return max(p, P_LEAST)

    def fitted(self, effects: Sequence[Effect]) -> Calibration | None:
        try:
            return fit(self.poses, signs=self.signs, reference=self.reference, effects=effects, aside=())
        except Refused:
            return None

    def _settled(self, adopted: list[Effect]) -> list[Effect]:
        """Without those that the later ones made needless (drift that had passed as nonlinearity, say), and each
        replaced by what does better in its place now that the others are there."""
        for effect in list(adopted):
            rest = [e for e in adopted if e is not effect]
            if rest and self.earned(effect, rest) >= FAMILYWISE:
                trial = rest
            else:
                others = [e for e in self.seen if e not in adopted and self.earned(e, rest) < FAMILYWISE]
                best = min([effect, *others], key=lambda e: self._criterion([*rest, e]))
                trial = [best if e is effect else e for e in adopted]
            if trial != adopted and (fitted := self.fitted(trial)) is not None:
                adopted, self.best = trial, fitted
        return adopted

    def _criterion(self, effects: Sequence[Effect]) -> float:
        """Schwarz's, for a known noise."""
        chi2 = self.chi2(self.with_effects(self.linear, effects))
        return chi2 + _coefficients(effects) * float(np.log(len(self.poses)))

    def earned(self, effect: Effect, others: Sequence[Effect]) -> float:
        """Familywise p of an effect beside the others."""
        return min(1.0, self.given(effect, others) * len(self.seen))

    def given(self, effect: Effect, others: Sequence[Effect]) -> float:
        """p of an effect when the others are in the model already; 1 where it has nothing to add to them."""
        rank = len(projected(self.problem, self.linear, effect, others))
        if not rank:
            return 1.0
        try:
            both = self.with_effects(self.linear, [*others, effect])
            alone = self.with_effects(self.linear, others)
        except Refused:
            return 1.0
        return self.p_value(self.chi2(alone), self.chi2(both), rank, both)

    def alternatives(self, effect: Effect, adopted: list[Effect]) -> tuple[str, ...]:
        """Effects that would do as well in its place: with one of them in the model, it has nothing to add."""
        rest = [e for e in adopted if e is not effect]
        out = []
        for other in self.seen:
            if other in adopted:
                continue
            contains = not len(projected(self.problem, self.linear, effect, [*rest, other]))
            larger = len(other.coefficients) > len(effect.coefficients)
            if not (contains and larger) and self.given(effect, [*rest, other]) > FAMILYWISE:
                out.append(other.name)
        return tuple(out)


def _coefficients(effects: Sequence[Effect]) -> int:
    return sum(len(e.coefficients) for e in effects)


def _improves(trial: Calibration, best: Calibration) -> bool:
    new, old = trial.residual.cross_validated_rms_g, best.residual.cross_validated_rms_g
    return new is not None and (old is None or new < old)
