"""The search for the effects that poses show, among those of a catalogue that they can show."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from triaxcal.arrays import Floats, Ints
from triaxcal.calibration import Calibration
from triaxcal.distributions import beta_cdf, f_sf
from triaxcal.effects.contract import Effect
from triaxcal.errors import Refused
from triaxcal.fit import fit
from triaxcal.poses.pose import Pose
from triaxcal.problem import Problem, State, linearise, solve
from triaxcal.pure_error import lack_of_fit_p, pure_error_dof
from triaxcal.search.candidates import Candidate, Ground, candidates_of, still_conditions
from triaxcal.search.familywise import familywise, independent_tests
from triaxcal.search.gains import Gains
from triaxcal.search.shape import refined, sharpened
from triaxcal.trends import Trends

FAMILYWISE = 0.01
"""Probability of any false finding on data with nothing inside."""
EFFECTS_MOST = 4
P_LEAST = 1e-300
SECOND_LOOK = 12
"""So many of the best candidates are fitted in earnest; linear reckoning is good to a thousandth of chi-square."""
KEPT = 2.6
"""A model keeps at least one of so many degrees of freedom, or it would fit anything."""
LIKE_NOISE, MUCH_BETTER = 2.0, 10.0
"""The cross-validated error of a model is at most so many times what noise makes it, or so many times less than before;
or else the model only bends to the poses."""
MOST = 9.0
"""Where something is left beside it, an effect is named that explains so many times as much."""
CARRIES = 0.05
"""A pose of which the model leaves less than this share carries a parameter, and cannot be left out."""
FORMS, REACH = 3, 1000
"""Of pairs with the same two names so many are fitted, from so many of the best pairs."""
PARTNERS = 60
"""In pairs, one of the two is among so many that are best by themselves; of each name the best is among them."""


@dataclass(frozen=True)
class Model:
    """Effects in the model, fitted: ``chi2`` of the residuals, the price of the effects, and the sum of squares of the
    ``trends`` inside the poses beside those that it foretells."""

    effects: tuple[Effect, ...]
    state: State
    chi2: float
    price: float
    trends: float = 0.0


@dataclass(frozen=True)
class Beside:
    """Candidates beside a model: what each gains and costs, the degrees of freedom ``left`` and the ``scores`` (c,) of
    the model with it."""

    candidates: Sequence[Candidate]
    gains: Gains
    prices: Floats
    left: Ints
    scores: Floats


@dataclass(frozen=True)
class Nearest:
    """An effect that was not adopted, and its familywise p."""

    effect: str
    p_value: float


class Search:
    """Forward, by one effect or by two that only show together; every step refits the whole model and settles it."""

    def __init__(
        self,
        problem: Problem,
        poses: Sequence[Pose],
        signs: Sequence[float],
        reference: float,
        catalogue: Sequence[Effect],
        before: Calibration,
        linear: State,
    ) -> None:
        self.problem, self.poses, self.signs, self.reference = problem, poses, signs, reference
        self.before = self.best = before
        self.catalogue, self.still = catalogue, still_conditions(poses)
        self.pure = max(pure_error_dof(poses), 1.0)
        # Kept with what they are of, so that no other object can come to have the same id.
        self._known: dict[tuple[int, ...], tuple[tuple[Effect, ...], Model | None]] = {}
        self._reckonings: dict[tuple[int, ...], tuple[Model, Beside]] = {}
        self.trends = Trends.of(problem, poses)
        self.linear = self._model((), State(linear.theta[:9], ()), 0.0)
        ground = Ground.at(problem, self.linear.state)
        self.candidates, self.full = candidates_of(ground, catalogue, self.still)
        self.tries = {c.name: c.tries for c in self.candidates}
        self.kept = max(int((len(poses) - 9) / KEPT), 1)
        self.names = list(dict.fromkeys(c.name for c in self.candidates))
        self.tests = independent_tests(Gains.of(self.candidates, ground.y), self.pure)
        self.found = self.linear
        self.passed_over: dict[str, str] = {}

    # What a model is worth.

    def _model(self, effects: tuple[Effect, ...], state: State, price: float) -> Model:
        r, J, s = linearise(self.problem, state)
        found = Model(effects, state, float(np.sum((r / s) ** 2)), price)
        if self.trends is None:
            return found
        return replace(found, trends=self.trends.chi2(state, J / s[:, None]))

    def model(self, effects: Sequence[Effect]) -> Model | None:
        """Fitted; None where the poses cannot carry it."""
        key = tuple(map(id, effects))
        if key not in self._known:
            carried = self.left(effects) >= self.kept
            self._known[key] = tuple(effects), self._solved(tuple(effects)) if carried else None
        return self._known[key][1]

    def _solved(self, effects: tuple[Effect, ...]) -> Model | None:
        try:
            state = solve(self.problem, self.linear.state, effects)
        except Refused:
            return None
        return self._model(effects, state, sum(self.price(e) for e in effects))

    def untestable(self) -> list[Model]:
        """Models of one effect with more coefficients than the poses can test, as far as they explain what there is."""
        ground, found = Ground.at(self.problem, self.linear.state), []
        for c in self.candidates:
            left = self.left((c.effect,))
            chi2 = float(ground.y @ ground.y - np.sum((c.basis.T @ ground.y) ** 2))
            if 0 <= left < self.kept and not self._beyond_noise(chi2, left):
                found.append(self._solved((c.effect,)))
        return [m for m in found if m is not None]

    def coincidence(self, m: Model) -> float:
        """Probability that the best of all candidates would explain as much of residuals as large as these, did they
        lie in any direction: small where a model has been put to the test."""
        left, dof = self.left(m.effects), self.left(())
        rest = min(max(m.chi2, left) / max(self.linear.chi2, 1e-300), 1.0)
        return familywise(float(beta_cdf(rest, left / 2, (dof - left) / 2)), self.tests) if m.effects else 1.0

    def price(self, effect: Effect) -> float:
        """What a model pays for an effect: Schwarz's for its coefficients, and the choice among all that was tried."""
        return self.price_of(len(effect.coefficients), self.tries.get(effect.name, 1))

    def price_of(self, rank: int, tries: int) -> float:
        return rank * float(np.log(len(self.poses))) + 2 * float(np.log(tries * max(len(self.names), 1)))

    def left(self, effects: Sequence[Effect]) -> int:
        """Degrees of freedom of the residuals."""
        return len(self.poses) - 9 - _parameters(effects)

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

    def trends_p(self) -> float:
        """Probability of trends as far as these from those that the model found foretells; 1 where none are known."""
        n = len(self.poses)
        return float(f_sf(self.found.trends / n, n, self.pure))

    def left_over(self, m: Model) -> bool:
        """Whether the residuals are more than noise."""
        return self._beyond_noise(m.chi2, self.left(m.effects))

    def _beyond_noise(self, chi2: float, left: int) -> bool:
        p = lack_of_fit_p(chi2, left, self.pure)
        return p is not None and p < FAMILYWISE

    # The steps.

    def run(self, given: Sequence[Effect] = ()) -> list[Effect]:
        """From the linear model, or from that with effects ``given``, which stay in it if they are earned."""
        now = self.linear
        if given and (first := self.model(given)) and (fitted := self.fitted(given)):
            now, self.best = first, fitted
        while len(now.effects) < EFFECTS_MOST:
            step = self._step(now)
            if step is None:
                break
            now = self._settled(step)
        if given:
            now = self._settled(now)
        self.found = now
        return list(now.effects)

    def earned_all(self, m: Model) -> bool:
        """Whether the effects of a model earn their places, from nothing."""
        return self._earned(m, self.linear)

    def nearest(self) -> Nearest | None:
        """Of single effects beside those found the one that is least likely to be chance; None where none is left."""
        found = [
            Nearest(m.effects[-1].name, self.earned(m.effects[-1], self.found.effects, m))
            for m in self.singles_from(self.found)
        ]
        return min(found, key=lambda n: n.p_value, default=None)

    def settle_on(self, m: Model) -> list[Effect]:
        """Takes a model for the one found."""
        self.found = m
        self.best = (self.fitted(m.effects) if m.effects else None) or self.before
        return list(m.effects)

    def _step(self, now: Model) -> Model | None:
        """The best model with one or two effects more, where each of them earns its place."""
        trials = self._trials(now)
        for trial in sorted(trials, key=self.score):
            if self.score(trial) >= self.score(now) or not self._earned(trial, now):
                continue
            fitted = self.fitted(trial.effects)
            why = "the poses cannot carry it" if fitted is None else _no_better(fitted, self.best)
            if fitted is None or why:
                self.passed_over[_named(trial, now)] = why
                continue
            self.best = fitted
            return trial
        return None

    def beside(self, now: Model) -> Beside:
        """What may come beside a model, in linear reckoning; the best of every effect with its shape refined."""
        key = tuple(map(id, now.effects))
        if key not in self._reckonings:
            self._reckonings[key] = now, self._reckoned(now)
        return self._reckonings[key][1]

    def _reckoned(self, now: Model) -> Beside:
        ground, found = Ground.at(self.problem, now.state), self.candidates
        if now.effects:
            found, _ = candidates_of(ground, [e for e in self.catalogue if e.name in self.names], self.still)
        candidates = [c for c in found if c.name not in {e.name for e in now.effects}]
        rough = self._scored(now, ground, candidates)
        shaped: dict[str, Candidate] = {}
        for i in np.argsort(rough.scores, kind="stable"):
            if candidates[i].effect.shape and np.isfinite(rough.scores[i]):
                shaped.setdefault(candidates[i].name, candidates[i])
        better = [finer for c in shaped.values() if (finer := sharpened(ground, c)) is not None]
        return self._scored(now, ground, [*candidates, *better]) if better else rough

    def _scored(self, now: Model, ground: Ground, candidates: Sequence[Candidate]) -> Beside:
        prices = np.array([self.price_of(c.rank, c.tries) for c in candidates])
        left = self.left(now.effects) - np.array([_parameters([c.effect]) for c in candidates], dtype=np.int64)
        gains = Gains.of(candidates, ground.y)
        scores = np.empty(0)
        if candidates:
            scores = deviance(float(ground.y @ ground.y) - gains.single(), left) + prices
            scores[left < self.kept] = np.inf
        return Beside(candidates, gains, prices, left, scores)

    def _models(self, now: Model, groups: Iterable[tuple[Effect, ...]]) -> list[Model]:
        return [m for g in groups if (m := self.model([*now.effects, *g])) is not None]

    def singles_from(self, now: Model) -> list[Model]:
        """The best models with one effect more, each fitted."""
        beside = self.beside(now)
        order = np.argsort(beside.scores, kind="stable")[:SECOND_LOOK]
        return self._models(now, [(beside.candidates[i].effect,) for i in order])

    def pairs_from(self, now: Model) -> list[Model]:
        """The best models with two effects more, each fitted."""
        return self._models(now, self._pairs(self.beside(now), self.left(now.effects)))

    def spoiled_beside(self) -> int | None:
        """The pose that with one effect explains most of what the linear model leaves, as if something had spoiled it:
        an effect and a spoiled pose hide each other. None where no effect is left to try."""
        now = self.linear
        ground, beside = Ground.at(self.problem, now.state), self.beside(now)
        if not beside.candidates:
            return None
        own = np.eye(len(ground.y)) - ground.model @ ground.model.T
        size = np.linalg.norm(own, axis=0)
        own = own / np.maximum(size, 1e-300)
        some = beside.candidates[0].effect
        poses = [Candidate(some, own[:, i : i + 1], len(own)) for i in range(len(own))]
        gains = Gains.of([*poses, *beside.candidates], ground.y)
        both = gains.pairs(np.arange(len(own)))[:, len(own) :]
        scores = deviance(float(ground.y @ ground.y) - both, beside.left - 1) + beside.prices
        scores[:, ~np.isfinite(beside.scores)] = np.inf
        scores[size < CARRIES] = np.inf
        return int(np.argmin(scores) // scores.shape[1]) if np.isfinite(scores).any() else None

    def _trials(self, now: Model) -> list[Model]:
        models = self.singles_from(now)
        best = min(models, key=self.score, default=now)
        if models and (self.left_over(best) or not self._earned(best, now, note=False)):
            models += self.pairs_from(now)
        return models

    def _pairs(self, beside: Beside, left: int) -> list[tuple[Effect, ...]]:
        candidates, order = beside.candidates, np.argsort(beside.scores, kind="stable")
        if not candidates:
            return []
        names = [c.name for c in candidates]
        first = [*order[:PARTNERS], *(next(i for i in order if names[i] == n) for n in dict.fromkeys(names))]
        rows = np.array(list(dict.fromkeys(int(i) for i in first)), dtype=np.int64)
        chi2 = float(beside.gains.y @ beside.gains.y) - beside.gains.pairs(rows)
        degrees = beside.left[rows][:, None] + beside.left - left
        scores = deviance(chi2, degrees) + beside.prices[rows][:, None] + beside.prices
        same = np.array([[names[i] == n for n in names] for i in rows])
        scores[same | (degrees < self.kept)] = np.inf
        out: dict[frozenset[int], tuple[Effect, ...]] = {}
        seen = Counter[frozenset[str]]()
        for at in np.argsort(scores, axis=None, kind="stable")[:REACH]:
            i, j = int(rows[at // len(candidates)]), int(at % len(candidates))
            pair, both = frozenset((i, j)), frozenset((names[i], names[j]))
            if np.isfinite(scores.flat[at]) and pair not in out and seen[both] < FORMS:
                seen[both] += 1
                out[pair] = (candidates[i].effect, candidates[j].effect)
        return list(out.values())[:SECOND_LOOK]

    def _earned(self, trial: Model, now: Model, note: bool = True) -> bool:
        """Whether every effect that is new in a model is there by more than chance, and explains what it should."""
        new = [e for e in trial.effects if e not in now.effects]
        name = _named(trial, now)
        p = max(self.earned(e, [o for o in trial.effects if o is not e], trial) for e in new)
        if p >= FAMILYWISE:
            why = f"p = {min(1.0, p):.2g}"
        elif self.left_over(trial) and now.chi2 - trial.chi2 < MOST * (trial.chi2 - self.left(trial.effects)):
            # Something else, part of which looks like this: a name is earned by explaining most of what is there.
            why = "it explains less than nine tenths of what is there"
        else:
            return True
        if note:
            self.passed_over.setdefault(name, why)
        return False

    def _settled(self, now: Model) -> Model:
        """Without those that the later ones made needless (drift that had passed as nonlinearity, say), and each
        replaced by what does better in its place now that the others are there; shapes refined."""
        for effect in now.effects:
            rest = [e for e in now.effects if e is not effect]
            if not rest:
                continue
            without = self.model(rest)
            if without is None:
                continue
            if self.earned(effect, rest, now) >= FAMILYWISE:
                now, self.best = self._taken(without) or (now, self.best)
                continue
            base = self.fitted(rest)
            for trial in sorted(self.singles_from(without), key=self.score):
                if self.score(trial) >= self.score(now):
                    break
                taken = self._taken(trial) if self.earned_all(trial) else None
                if taken and base and not _no_better(taken[1], base):
                    now, self.best = taken
                    break
        better = refined(now.effects, self.problem, lambda effects: self._cost(effects))
        if better != now.effects and (model := self.model(better)):
            now, self.best = self._taken(model) or (now, self.best)
        return now

    def _taken(self, m: Model) -> tuple[Model, Calibration] | None:
        fitted = self.fitted(m.effects)
        return None if fitted is None else (m, fitted)

    def _cost(self, effects: Sequence[Effect]) -> float:
        model = self.model(effects)
        return np.inf if model is None else model.chi2

    def fitted(self, effects: Sequence[Effect]) -> Calibration | None:
        """None where the poses cannot carry it."""
        try:
            return fit(self.poses, signs=self.signs, reference=self.reference, effects=effects, aside=())
        except Refused:
            return None

    # Tests.

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
    """
    degrees = np.maximum(left, 1)
    chi2 = np.maximum(chi2, 0.0)
    beyond = np.log(np.maximum(chi2 / degrees, 1.0))
    return np.asarray(np.where(chi2 > degrees, degrees * (1 + beyond), chi2))


def _parameters(effects: Sequence[Effect]) -> int:
    return sum(len(e.coefficients) + len(e.shape) for e in effects)


def _named(trial: Model, now: Model) -> str:
    return " with ".join(e.name for e in trial.effects if e not in now.effects)


def _no_better(trial: Calibration, best: Calibration) -> str:
    """Why poses that the fit did not see speak against a model; nothing where they do not."""
    new, old = trial.residual.cross_validated_rms_g, best.residual.cross_validated_rms_g
    if new is None or (old is not None and new >= old):
        return "it does not lower the cross-validated error"
    noise = np.sqrt(np.mean([p.standard_error_g**2 / max(1 - p.leverage, 1e-9) for p in trial.poses if p.used]))
    if new > LIKE_NOISE * noise and (old is None or new > old / MUCH_BETTER):
        return f"the cross-validated error stays {new / noise:.1f} times what noise makes it"
    return ""
