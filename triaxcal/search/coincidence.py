"""Whether a name was put to the test: how likely effects were to explain the poses whatever acts on them."""

from __future__ import annotations

from itertools import combinations
from math import comb

import numpy as np

from triaxcal.distributions import beta_cdf
from triaxcal.effects.contract import Effect
from triaxcal.search.familywise import familywise
from triaxcal.search.worth import FAMILYWISE, P_LEAST, WORSE, Model, Worth, parameters

FAILED, MOST = 1.0, 0.99
"""Of a test that was failed; and at most of any other."""


def coincidence(search: Worth, effect: Effect, m: Model) -> float:
    """Probability that the best of all candidates would explain as much as an effect of the model does, did what is
    there lie in any direction: small where it has been put to the test.

    It has where it explains most by itself, or beside some of the others what these leave, if all of them together are
    no coincidence; with the poses that were left out for being off as part of the explanation, and without. `FAILED`
    where |a| goes inside the poses otherwise than foretold because of it.
    """
    if _failed(search, effect, m):
        return FAILED
    others, found = [e for e in m.effects if e is not effect], [MOST]
    for size in range(len(others) + 1):
        for beside in combinations(others, size):
            of_both = [e for e in m.effects if e is effect or e in beside]
            part = m if size == len(others) else search.model(of_both)
            base = search.model(beside) if beside else None
            if part is not None and (base or not beside):
                found.append(max(_beside(search, part, b, m.effects) for b in (search.linear, base) if b))
    return min(found)


def _failed(search: Worth, effect: Effect, m: Model) -> bool:
    """Whether the trends inside the poses contradict what an effect makes in a model: they are nearer to what the rest
    of it foretells, or nearer to nothing than to the whole and to the effect alone; and no part of the model is nearer
    with it than all are without it. Nothing is fitted again: without an effect that is there the others would take its
    part, and it would bear the blame."""
    others = [e for e in m.effects if e is not effect]
    if not others:
        return search.contradicted(m, search.linear)

    def acting(*effects: Effect) -> Model:
        return search.in_part(m, effects) if effects else search.linear

    by_itself = all(search.contradicted(x, search.linear) for x in (m, acting(effect)))
    if not by_itself and not search.contradicted(m, acting(*others)):
        return False
    sets = [s for size in range(len(others) + 1) for s in combinations(others, size)]
    without, best = (min(search.against_trends(acting(*one, *s)) for s in sets) for one in ((), (effect,)))
    return without - best <= WORSE


def coincidence_of_spoiled(search: Worth, m: Model) -> float:
    """The same of the poses that were left out for being off, beside the effects of the model: of each beside the
    others, and of all. 0 where there is none."""
    left_out, unknown = search.left_out, search.left_out.unknown(m.effects)
    spoiled = left_out.spoiled(m.effects)
    sets = [{i} for i in spoiled] + [spoiled] * (len(spoiled) > 1)
    chances = [_chance(search, m, m, len(s), left_out.chi2(m.effects, unknown | spoiled - s)) for s in sets]
    return max(chances, default=0.0)


def _beside(search: Worth, m: Model, base: Model, effects: tuple[Effect, ...]) -> float:
    """Of what a model has more than its base: as if nobody had left out a pose, and with those left out as they are
    beside all ``effects``."""
    left_out = search.left_out
    spoiled = len(left_out.spoiled(effects))
    alone = _chance(search, m, base, 0, base.chi2)
    if not spoiled:
        return alone
    return max(alone, _chance(search, m, base, spoiled, left_out.chi2(base.effects, left_out.unknown(effects))))


def _chance(search: Worth, m: Model, base: Model, spoiled: int, whole: float) -> float:
    """Probability that the best candidates, as many as the model has more than its base, with so many poses left out
    as ``spoiled``, would explain as much of the ``whole``, and foretell the trends inside the poses as well where there
    are any."""
    n, rank = len(search.poses), parameters(m.effects) - parameters(base.effects)
    left, moves = search.left(m.effects), search.trends_p(base) < FAMILYWISE
    p = _as_small(m.chi2, left, max(whole, base.chi2), search.left(base.effects) + spoiled)
    if rank and base.foretells and moves:
        both = p * _as_small(m.trends if m.foretells else base.trends, n - rank, base.trends, n)
        p = both * (1 - float(np.log(max(both, P_LEAST))))  # of a product of two probabilities (Fisher)
    tries = search.tests ** (len(m.effects) - len(base.effects)) * comb(n + spoiled, spoiled)
    return min(familywise(p, tries), MOST)


def _as_small(rest: float, left: int, whole: float, dof: int) -> float:
    """Probability that of residuals in ``dof`` dimensions, of any direction and ``whole`` as their sum of squares, no
    more than ``rest`` lies in ``left`` of them; a rest of less than its noise counts as that."""
    if left <= 0:
        return 1.0
    share = min(max(rest, left) / max(whole, P_LEAST), 1.0)
    return float(beta_cdf(share, left / 2, (dof - left) / 2))
