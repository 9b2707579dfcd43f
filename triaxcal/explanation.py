"""What explains still poses best: effects, poses that something spoiled, or both.

A strong effect looks like spoiled poses to the linear model, and the reverse. So effects are sought with some poses
left out, and with others, and what comes out is compared by one score.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from triaxcal.calibration import Calibration, Exclusion
from triaxcal.effects.contract import Effect
from triaxcal.errors import Refused
from triaxcal.pose_fit import fit
from triaxcal.poses.pose import Pose
from triaxcal.problem import solve
from triaxcal.runs import expected_of
from triaxcal.search import NEAR, LeftOut, Search, alternatives
from triaxcal.start import problem_of, start, with_history

ANYTHING = 5
"""An effect beside others, with so many alternatives, is none."""
SPOILED = 0.02
"""Of so many poses something spoils one, as far as nothing is known of them."""
OPEN = 6.0
"""Poses are left out as spoiled for certain where every effect is worse by so much, in deviance: odds of 20 to 1."""
ROUNDS_MOST = 3
"""Effects and spoiled poses are sought in turn so often."""


@dataclass(frozen=True)
class Explanation:
    """``adopted`` are the effects that the ``search`` found with the poses ``aside`` left out."""

    search: Search
    adopted: list[Effect]
    aside: tuple[int, ...]
    linear: Search
    """That with those poses left out which the linear fit leaves out."""
    rivals: tuple[tuple[Effect, ...], ...] = ()
    """Effects that explain as much with other poses left out."""
    instead: tuple[tuple[Effect, ...], ...] = ()
    """Effects that explain as much as the linear fit does by the poses that it leaves out."""
    spoiled: tuple[int, ...] = ()
    """Poses that explain as much without any effect, were they spoiled."""
    whole_p: float | None = None
    """Where the linear fit leaves poses out: the probability of what it leaves of all of them."""

    @property
    def score(self) -> float:
        """The score of the model; a pose left out costs a parameter and how seldom one is spoiled."""
        return self.search.score(self.search.found) + self.price

    @property
    def price(self) -> float:
        """Of the poses left out."""
        n = len(self.search.poses) + len(self.aside)
        spoiled = len(self.search.left_out.spoiled(self.adopted))
        return len(self.aside) * float(np.log(n)) + spoiled * 2 * float(np.log(1 / SPOILED - 1))


def left_out(c: Calibration) -> tuple[int, ...]:
    return tuple(i for i, p in enumerate(c.poses) if not p.used)


def explained(
    poses: Sequence[Pose],
    aside: tuple[int, ...],
    signs: Sequence[float],
    reference: float,
    effects: Sequence[Effect],
) -> Explanation:
    """The best explanation; ``aside`` are the poses that the linear fit leaves out. Raises Refused as that does."""

    def tried(rows: tuple[int, ...]) -> list[Explanation]:
        """Nothing where the poses that are left cannot carry the linear model."""
        try:
            return [_searched(poses, rows, signs, reference, effects)]
        except Refused:
            return []

    asked = [(), aside, left_out(fit(poses, signs=signs, reference=reference))]
    # What looks like spoiled poses may be an effect that the linear model lacks.
    trials = [t for rows in dict.fromkeys(asked) for t in tried(rows)]
    first = trials[0].search
    # Nothing, or much, may be made of an effect and a spoiled pose that hide each other.
    unsure = len(trials[0].adopted) != 1 and first.left_over(first.linear)
    if unsure and not trials[0].aside and (row := first.spoiled_beside()) is not None:
        trials += tried((row,))
    found = min(trials, key=lambda t: t.score)
    for _ in range(ROUNDS_MOST):
        # Beside an effect a spoiled pose may not have shown; with the effect in the model it does.
        again = left_out(fit(poses, signs=signs, reference=reference, effects=found.adopted))
        if again == found.aside or not found.adopted:
            break
        other = next(iter(tried(again)), found)
        if other.score >= found.score:
            break
        trials.append(other)
        found = other
    return replace(
        _compared(found, trials, aside),
        linear=next((t.search for t in trials if t.aside == aside), found.search),
        whole_p=first.anything_p(first.linear) if aside and not trials[0].aside else None,
    )


def _compared(found: Explanation, trials: Sequence[Explanation], aside: tuple[int, ...]) -> Explanation:
    """With what explains as much; ``aside`` are the poses that the linear fit leaves out."""
    near = found.score + NEAR
    without = [t for t in trials if t.aside != found.aside and found.adopted and not t.adopted and t.score < near]
    spoiled = min(without, key=lambda t: t.score).aside if without else ()
    linear = [t.search.score(t.search.linear) + t.price for t in trials if aside and t.aside == aside]
    instead = _others(trials, aside, linear[0] + OPEN) if linear else ()
    return replace(found, rivals=_others(trials, found.aside, near), instead=instead, spoiled=spoiled)


def _others(trials: Sequence[Explanation], aside: tuple[int, ...], limit: float) -> tuple[tuple[Effect, ...], ...]:
    """The effects of all models of other poses than those without ``aside`` that score below a limit."""
    out: list[tuple[Effect, ...]] = []
    for t in trials:
        models = [] if t.aside == aside else [t.search.found, *t.search.singles_from(t.search.linear)]
        out += [m.effects for m in models if m.effects and t.search.score(m) + t.price < limit]
    return tuple(out)


def _searched(
    poses: Sequence[Pose],
    aside: tuple[int, ...],
    signs: Sequence[float],
    reference: float,
    catalogue: Sequence[Effect],
) -> Explanation:
    before = fit(poses, signs=signs, reference=reference, aside=aside, why=Exclusion.OUTLIER)
    kept = [p for i, p in enumerate(poses) if i not in aside]
    problem = problem_of(kept, signs=signs, reference=reference, effects=catalogue)
    linear = solve(problem, start(problem, kept, signs), ())
    problem = with_history(problem, kept, linear.sensor(problem))
    left_out = LeftOut(poses, aside, signs, reference)
    search = Search(problem, kept, signs, reference, catalogue, before, linear, left_out)
    other = copy(search)
    other.passed_over = {}
    adopted = search.run()
    expected = [e for e in expected_of(kept) if e.name in search.full]
    # What is nearly always there: beside it others show that neither alone nor in pairs would have.
    if expected and len(other.run(expected)) > 1 and other.score(other.found) < search.score(search.found):
        search, adopted = other, list(other.found.effects)
    adopted = adopted if expected else _without_fillers(search)
    return Explanation(search, adopted, aside, search)


def _without_fillers(search: Search) -> list[Effect]:
    """The effects found, but where one of several could be almost anything: then it only fills what no effect explains,
    and what stands beside it has to earn its place without it."""
    now = search.found
    while len(now.effects) > 1:
        filler = next((e for e in reversed(now.effects) if len(alternatives(search, e, now)) >= ANYTHING), None)
        if filler is None:
            break
        search.passed_over[filler.name] = "almost any effect would do as well"
        rest = search.model([e for e in now.effects if e is not filler])
        now = rest if rest is not None and search.earned_all(rest) else search.linear
    return list(now.effects) if now is search.found else search.settle_on(now)
