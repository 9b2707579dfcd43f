"""What would do as well as a finding: effects that explain as much when they stand in its place."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection

import numpy as np

from triaxcal.effects.contract import Effect
from triaxcal.search.candidates import Candidate, Ground
from triaxcal.search.search import Search
from triaxcal.search.worth import FAMILYWISE, Model

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
        ground = Ground.at(search.problem, other.state)
        contained = not ground.shown(ground.columns(effect), CONTAINED)[0].shape[1]
        if contained and search.left(other.effects) < search.left(now.effects):
            continue  # it contains the finding, and has more to it: the simpler of the two is the name
        found.append((other.effects[-1].name, other))
    out: dict[str, Model] = {}
    for name, other in sorted([*found, *_jointly(search, effect, now)], key=lambda f: search.score(f[1])):
        out.setdefault(name, other)
    if search.coincidence(now) >= FAMILYWISE:
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


def _jointly(search: Search, effect: Effect, now: Model) -> list[tuple[str, Model]]:
    """Where two effects were found: the names in other pairs that explain as much. Of a pair that has one of the two,
    in whatever form, its other name stands for the other; of a pair of two others, none of which stands beside one of
    the two as well, both stand for the first.
    """
    if len(now.effects) != 2:
        return []
    taken = [e.name for e in now.effects]
    mine = effect.name
    near = [m for m in search.pairs_from(search.linear) if search.score(m) < search.score(now) + NEAR]
    named = [{e.name for e in m.effects} for m in near]
    beside = {name for names in named if names & set(taken) for name in names}
    out = []
    for m, names in zip(near, named, strict=True):
        kept = names & set(taken)
        if mine not in names and (kept or (mine == taken[0] and not names & beside)):
            out += [(name, m) for name in sorted(names - kept)]
    return out
