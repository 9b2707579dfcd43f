"""One unit's evidence with a further term, and without a name: what the pooled
analysis of several units multiplies."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.distributions import log_sum_exp
from triaxcal.evidence.marginal_likelihood import SetEvidence
from triaxcal.evidence.posterior import Posterior

BASE_SETS = 3
"""Sets of a unit, the likeliest, beside which an effect is asked about."""
NEGLIGIBLE_LOG_RATIO = 14.0
"""In the logarithm: parts that are less likely by more add nothing."""


@dataclass(frozen=True, eq=False)
class BaseModel:
    """A set that a further term may stand beside: ``found``, the ``names`` in
    it, and ``with_each`` (T,R), the logarithm of its evidence with each term at
    each size, of the sizes one by one."""

    found: SetEvidence
    names: frozenset[str]
    with_each: Floats


def base_models(unit: Posterior, acting: frozenset[str]) -> list[BaseModel]:
    """The likeliest sets, and what is left of the likeliest without some of its
    terms, but for effects that are ``acting``; where none is, the empty set
    too."""
    evidence = unit.evidence
    best = unit.sets[0].members
    less = [kept for k in range(len(best) + 1) for kept in itertools.combinations(best, k)]
    some = [*less, *(found.members for found in unit.sets[:BASE_SETS])]
    sets = [m for m in dict.fromkeys(some) if acting <= {evidence.terms[i].name for i in m}]
    known = {found.members: found for found in unit.sets}
    # Whatever part is likely beside some set: an effect may take the place of a
    # part.
    likely = [
        row
        for row, part in enumerate(unit.sets[0].parts)
        if unit.part_probabilities[part] > np.exp(-NEGLIGIBLE_LOG_RATIO)
    ]
    out = []
    for members in sets:
        found = known.get(members) or evidence.of_set(members, unit.sets[0].parts)
        rows = {*likely, *np.flatnonzero(found.by_part >= found.by_part.max() - NEGLIGIBLE_LOG_RATIO).tolist()}
        whole = log_sum_exp([evidence.with_each_further(found, row) for row in sorted(rows)], axis=0)
        whole = whole + np.log(len(evidence.sizes))
        out.append(BaseModel(found, unit.names_of(found), np.asarray(whole)))
    return out


def log_ratios(unit: Posterior, bases: Sequence[BaseModel], name: str) -> Floats:
    """(T,R) the logarithm of the evidence of the unit with each term at each
    size, over that of the unit by itself."""
    others = [base for base in bases if name not in base.names]
    with_each = log_sum_exp([base.with_each for base in others], axis=0)
    without = log_sum_exp([base.found.total for base in others])
    return np.asarray(with_each - without + log_ratio_without(unit, bases, name))


def log_ratio_without(unit: Posterior, bases: Sequence[BaseModel], name: str) -> float:
    """The logarithm of the evidence of the unit without that name, over that of
    the unit by itself."""
    every = {found.members: found for found in (*(base.found for base in bases), *unit.sets)}.values()
    others = [found.total for found in every if name not in unit.names_of(found)]
    return float(log_sum_exp(others) - log_sum_exp([found.total for found in every]))
