"""What would do as well as a finding: effects that explain as much when they stand in its place."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence

import numpy as np

from triaxcal.effects.contract import Effect
from triaxcal.problem import State
from triaxcal.search.candidates import Candidate, Ground
from triaxcal.search.coincidence import coincidence
from triaxcal.search.search import Search
from triaxcal.search.worth import FAMILYWISE, Model, parameters

NEAR = 10.0
"""An alternative is out where it is worse by so much in deviance and price. Of two effects that differ by δ standard
errors the wrong one is better by Δ with a probability of Φ(−(Δ + δ²)/2δ), at most Φ(−√Δ), 0.08 %, however alike."""
CONTAINED = 1e-6
VARIANTS = 2


def alternatives(search: Search, effect: Effect, now: Model) -> dict[str, Model]:
    """What would do as well in the place of ``effect``, by name, nearest first, each with its model."""
    rest = [e for e in now.effects if e is not effect]
    without = search.model(rest)
    if without is None:
        return {}
    found: list[tuple[str, Model]] = []
    taken = {e.name for e in now.effects}
    near = _near(search, without, taken, search.score_of_means(now))
    others = [m for c in near if (m := search.model([*rest, c.effect])) is not None]
    for other in [*others, *search.by_trends(without, taken)]:
        if search.score(other) > search.score(now) + NEAR:
            continue
        if search.left(other.effects) < search.left(now.effects) and _contains(search, other.state, effect):
            continue  # it has more to it: the simpler of the two is the name
        found.append((other.effects[-1].name, other))
    out: dict[str, Model] = {}
    for name, other in sorted([*found, *_jointly(search, effect, now)], key=lambda f: search.score(f[1])):
        out.setdefault(name, other)
    if coincidence(search, effect, now) >= FAMILYWISE:
        # So few poses would have shown one effect or another whatever it was: also one that they cannot test.
        for other in search.untestable():
            name = other.effects[0].name
            if name not in taken and search.against_trends(other) < search.against_trends(now) + NEAR:
                out.setdefault(name, other)
    return out


def _near(search: Search, without: Model, taken: Collection[str], best: float) -> list[Candidate]:
    """The best variants of every other effect, as far as linear reckoning puts them near."""
    beside = search.beside(without)
    scores = beside.scores + without.price
    # What linear reckoning is off by grows with the effect.
    reach = best + NEAR + 5 + 0.02 * without.chi2
    out, seen = [], Counter[str]()
    for i in np.argsort(scores, kind="stable"):
        c = beside.candidates[int(i)]
        if scores[i] < reach and c.name not in taken and seen[c.name] < VARIANTS:
            seen[c.name] += 1
            out.append(c)
    return out


def _contains(search: Search, state: State, effect: Effect) -> bool:
    """Whether the model at a state makes whatever an effect makes."""
    ground = Ground.at(search.problem, state)
    return not ground.shown(ground.columns(effect), CONTAINED)[0].shape[1]


def _jointly(search: Search, effect: Effect, now: Model) -> list[tuple[str, Model]]:
    """Where two effects were found: the names in other pairs that explain as much, as `instead_of` has them; but of two
    others none of which stands beside one of the two as well.
    """
    if len(now.effects) != 2:
        return []
    near = [m for m in search.pairs_from(search.linear) if search.score(m) < search.score(now) + NEAR]
    same = [_same(search, now.effects, m.effects) for m in near]
    beside = {e.name for m, kept in zip(near, same, strict=True) if any(kept) for e in m.effects}
    out = []
    for m, kept in zip(near, same, strict=True):
        if any(kept) or not beside & {e.name for e in m.effects}:
            out += [(name, m) for name in _new(effect, now.effects, m.effects, kept)]
    return out


def instead_of(search: Search, effect: Effect, others: Sequence[Effect]) -> list[str]:
    """The names among ``others``, which explain as much as all effects found, that stand for ``effect``. Of those that
    have one of the effects found, in whatever form, the other names stand for the rest of these; of those that have
    none, all stand for the first.
    """
    found = search.found.effects
    return _new(effect, found, others, _same(search, found, others))


def _new(effect: Effect, found: Sequence[Effect], others: Sequence[Effect], same: Sequence[set[str]]) -> list[str]:
    kept = set().union(*same)
    if effect.name in kept or not (kept or effect is found[0]):
        return []
    return sorted(e.name for e, is_there in zip(others, same, strict=True) if not is_there)


def _same(search: Search, found: Sequence[Effect], others: Sequence[Effect]) -> list[set[str]]:
    """For each of the others the names of the effects found that it is, or contains and has more to it."""

    def is_there(f: Effect, e: Effect) -> bool:
        more = parameters([e]) > parameters([f])
        return e.name == f.name or (more and _contains(search, search.linear.state.extended([e]), f))

    return [{f.name for f in found if is_there(f, e)} for e in others]
