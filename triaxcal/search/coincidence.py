"""Whether a name was put to the test: how likely effects were to explain the poses whatever acts on them."""

from __future__ import annotations

from itertools import combinations
from math import comb

import numpy as np

from triaxcal.distributions import beta_cdf
from triaxcal.effects.contract import Effect
from triaxcal.search.familywise import familywise
from triaxcal.search.worth import FAMILYWISE, P_LEAST, Model, Worth, parameters


def coincidence(search: Worth, effect: Effect, m: Model) -> float:
    """Probability that the best of all candidates would explain as much as an effect of the model does, did what is
    there lie in any direction: small where it has been put to the test.

    It has where it explains most by itself, or beside some of the others what these leave, if all of them together are
    no coincidence.
    """
    others = [e for e in m.effects if e is not effect]
    found = 1.0
    for size in range(len(others) + 1):
        for beside in combinations(others, size):
            of_both = [e for e in m.effects if e is effect or e in beside]
            part = m if size == len(others) else search.model(of_both)
            if part is not None:
                found = min(found, max(_by_chance(search, part, ()), _by_chance(search, part, beside)))
    return found


def coincidence_of_spoiled(search: Worth, m: Model) -> float:
    """The same of the poses that were left out for being off, beside the effects of the model; 0 where none was."""
    return _by_chance(search, m, m.effects) if search.left_out.spoiled(m.effects) else 0.0


def _by_chance(search: Worth, m: Model, given: tuple[Effect, ...]) -> float:
    """Probability that the best candidates, as many as the model has beside those ``given``, would explain as much of
    what these leave, with as many poses left out, and foretell the trends inside the poses as well where there are any.
    """
    base = m if given == m.effects else search.model(given) if given else search.linear
    if base is None:
        return 1.0
    n, spoiled, whole = len(search.poses), search.left_out.spoiled(m.effects), base.chi2
    if spoiled:
        whole = max(whole, search.left_out.chi2(given, search.left_out.unknown(m.effects)))
    rank = parameters(m.effects) - parameters(given)
    tests = [_as_small(m.chi2, search.left(m.effects), whole, search.left(given) + spoiled)]
    if rank and base.foretells and search.trends_p(base) < FAMILYWISE:
        tests.append(_as_small(m.trends if m.foretells else base.trends, n - rank, base.trends, n))
    p = tests[0]
    if len(tests) == 2:  # of a product of two probabilities (Fisher)
        p = tests[0] * tests[1]
        p *= 1 - float(np.log(max(p, P_LEAST)))
    return familywise(p, search.tests ** (len(m.effects) - len(given)) * comb(n + spoiled, spoiled))


def _as_small(rest: float, left: int, whole: float, dof: int) -> float:
    """Probability that of residuals in ``dof`` dimensions, of any direction and ``whole`` as their sum of squares, no
    more than ``rest`` lies in ``left`` of them; a rest of less than its noise counts as that."""
    if left <= 0:
        return 1.0
    share = min(max(rest, left) / max(whole, P_LEAST), 1.0)
    return float(beta_cdf(share, left / 2, (dof - left) / 2))
