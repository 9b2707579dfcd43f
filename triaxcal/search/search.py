"""The search for the effects that poses show, among those of a catalogue that they can show."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from triaxcal.arrays import Floats, Ints
from triaxcal.calibration import Calibration
from triaxcal.effects.contract import Effect
from triaxcal.effects.in_run import of_clocks
from triaxcal.figures import probability
from triaxcal.poses.pose import Pose
from triaxcal.problem import Problem, State
from triaxcal.pure_error import noise_levels, pure_error_dof
from triaxcal.search.candidates import Candidate, Ground, candidates_of
from triaxcal.search.comparison import CARRIES, NO_LOWER, compared
from triaxcal.search.gains import Gains
from triaxcal.search.left_out import LeftOut
from triaxcal.search.omnibus import anything_p
from triaxcal.search.shape import refined, sharpened
from triaxcal.search.worth import FAMILYWISE, Model, Worth, deviance, parameters

EFFECTS_MOST = 4
SECOND_LOOK = 12
"""So many of the best candidates are fitted in earnest; linear reckoning is good to a thousandth of chi-square."""
LIKE_NOISE, MUCH_BETTER = 2.0, 10.0
"""The cross-validated error of a model is at most so many times what noise makes it, or so many times less than before;
or else the model only bends to the poses."""
MOST = 9.0
"""Where something is left beside it, an effect is named that explains so many times as much."""
FORMS, REACH = 3, 1000
"""Of pairs with the same two names so many are fitted, from so many of the best pairs."""
PARTNERS = 60
"""In pairs, one of the two is among so many that are best by themselves; of each name the best is among them."""


@dataclass(frozen=True)
class Beside:
    """Candidates beside a model, whose orthonormal basis is ``ground.model``: what each gains and costs, the degrees of
    freedom ``left`` and the ``scores`` (c,) of the model with it. The first ``tried`` are as the catalogue has them;
    the shapes of the others were chosen by the residuals."""

    ground: Ground
    tried: int
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


class Search(Worth):
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
        left_out: LeftOut,
    ) -> None:
        super().__init__(problem, poses, signs, reference, catalogue, linear, left_out)
        self.before = self.best = before
        self.found = self.linear
        self.passed_over: dict[str, str] = {}
        self._reckonings: dict[tuple[int, ...], tuple[Model, Beside]] = {}

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

    def _step(self, now: Model) -> Model | None:
        """The best model with one or two effects more, where each of them earns its place."""
        trials = self._trials(now)
        for trial in sorted(trials, key=self.score):
            if not self._better(trial, now) or not self._earned(trial, now):
                continue
            fitted = self.fitted(trial.effects)
            why = "the poses cannot carry it" if fitted is None else _no_better(fitted, self.best)
            if fitted is None or why:
                self.passed_over[_named(trial, now)] = why
                continue
            self.best = fitted
            return trial
        return None

    def _better(self, trial: Model, now: Model) -> bool:
        """By the means alone too: trends tell effects apart, and make none."""
        return self.score(trial) < self.score(now) and self.score_of_means(trial) < self.score_of_means(now)

    def beside(self, now: Model) -> Beside:
        """What may come beside a model, in linear reckoning; of every form of an effect the best with its shape
        refined."""
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
        shaped: dict[tuple[str, ...], Candidate] = {}
        for i in np.argsort(rough.scores, kind="stable"):
            c = candidates[i]
            if c.effect.shape and np.isfinite(rough.scores[i]):
                shaped.setdefault((c.name, *(k.name for k in c.effect.coefficients)), c)
        better = [finer for c in shaped.values() if (finer := sharpened(ground, c)) is not None]
        return replace(self._scored(now, ground, [*candidates, *better]), tried=len(candidates)) if better else rough

    def _scored(self, now: Model, ground: Ground, candidates: Sequence[Candidate]) -> Beside:
        prices = np.array([self.price_of(c.rank, c.tries) for c in candidates])
        left = self.left(now.effects) - np.array([parameters([c.effect]) for c in candidates], dtype=np.int64)
        gains = Gains.of(candidates, ground.y)
        scores = np.empty(0)
        if candidates:
            scores = deviance(float(ground.y @ ground.y) - gains.single(), left) + prices
            scores[left < self.kept] = np.inf
        return Beside(ground, len(candidates), candidates, gains, prices, left, scores)

    def _models(self, now: Model, groups: Iterable[tuple[Effect, ...]]) -> list[Model]:
        return [m for g in groups if (m := self.model([*now.effects, *g])) is not None]

    def singles_from(self, now: Model) -> list[Model]:
        """The best models with one effect more, each fitted.

        What is too much for the means is among them where the trends test it, but for effects of the clocks: a
        polynomial of the time goes along with any two others.
        """
        beside = self.beside(now)
        order = [i for i in np.argsort(beside.scores, kind="stable")[:SECOND_LOOK] if np.isfinite(beside.scores[i])]
        found = self._models(now, [(beside.candidates[i].effect,) for i in order])
        clocks = {e.name for e in self.catalogue if of_clocks(e)}
        return found + self.by_trends(now, clocks | {e.name for e in now.effects})

    def by_trends(self, now: Model, taken: Collection[str]) -> list[Model]:
        """The models with one effect more, of no shape and none of those ``taken``, that is too much for the means, as
        far as the trends inside the poses put them to the test, each fitted."""
        if self.trends is None or not self.left_over(now):
            return []
        others = [e for e in self.catalogue if e.name in self.names and e.name not in taken and self.trends.touch([e])]
        variants = [v for e in others for v in e.variants(self.problem.conditions) if not v.shape]
        return self._models(now, [(v,) for v in variants if self.left((*now.effects, v)) < self.kept])

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
            why = f"p {probability(min(1.0, p))}"
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
        model = self.model(effects) or self.linear
        return model.chi2 + self.against_trends(model)

    # What was found.

    def untestable(self) -> list[Model]:
        """Models of one effect with more coefficients than the poses can test, as far as they explain what there is."""
        ground, found = Ground.at(self.problem, self.linear.state), []
        for c in self.candidates:
            left = self.left((c.effect,))
            chi2 = float(ground.y @ ground.y - np.sum((c.basis.T @ ground.y) ** 2))
            if 0 <= left < self.kept and not self._beyond_noise(chi2, left):
                found.append(self._solved((c.effect,)))
        return [m for m in found if m is not None]

    def earned_all(self, m: Model) -> bool:
        """Whether the effects of a model earn their places, from nothing."""
        return self._earned(m, self.linear)

    def anything_p(self, now: Model) -> float | None:
        """Probability of what a model leaves by chance; None where nothing can be left, or the noise is not known."""
        if self.left(now.effects) <= 0 or pure_error_dof(self.poses) < 1:
            return None
        beside = self.beside(now)
        tried = beside.candidates[: beside.tried]
        gains = Gains(beside.gains.bases[: len(tried)], beside.gains.ranks[: len(tried)], beside.gains.y)
        return anything_p(gains, [c.name for c in tried], beside.ground.model, noise_levels(self.poses))

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


def _named(trial: Model, now: Model) -> str:
    return " with ".join(e.name for e in trial.effects if e not in now.effects)


def _no_better(trial: Calibration, best: Calibration) -> str:
    """Why poses that the fit did not see speak against a model; nothing where they do not."""
    found = compared(trial, best)
    new, old = found.new_g, found.old_g
    if new is None or not found.lower:
        return NO_LOWER
    if new > LIKE_NOISE * found.noise_g and (old is None or new > old / MUCH_BETTER):
        return f"the cross-validated error stays {new / found.noise_g:.1f} times what noise makes it"
    return ""
