"""What several units, or recordings, show together: whether an effect acts at all, then whether its values are common.

An effect that no unit shows for certain may be certain in all of them together. So existence is asked of the product
of their evidences: one name, form, shape and size for all, and coefficients of its own for each unit, or the same.
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from triaxcal.arrays import Floats
from triaxcal.posterior.evidence import Evidence, SetEvidence
from triaxcal.posterior.posterior import Posterior

LIKELY = 3
"""Sets of a unit, the likeliest, beside which an effect is asked about."""
NEGLIGIBLE = 14.0
"""In the logarithm: parts that are less likely by more add nothing."""
Key = tuple[str, tuple[str, ...], tuple[int, ...], int]
"""A name, the coefficients of a form, those of them that are free, and the place of a shape among its shapes."""


@dataclass(frozen=True)
class Together:
    """By name: the ``probability`` that this effect acts in the units beside what each shows by itself, and that its
    values are ``common`` to them, if it acts; ``nothing`` is the probability that none does."""

    probability: Mapping[str, float]
    common: Mapping[str, float]
    nothing: float

    def certain(self, level: float) -> tuple[str, ...]:
        """The fewest names of which one acts in all with this probability, the likeliest first; none where nothing is
        as certain. Names that hold each other's columns, as temperature and its square, stand together."""
        total, names = 0.0, []
        for name, p in self.probability.items():
            names.append(name)
            total += p
            if total >= level:
                return tuple(names)
        return ()


def together(units: Sequence[Posterior]) -> Together:
    """Of units whose posteriors are of one catalogue and one grid of sizes (`triaxcal.posterior.posterior`). Names that
    some unit cannot show are left out."""
    terms = [_terms(unit.evidence) for unit in units]
    names = set.intersection(*({key[0] for key in of_unit} for of_unit in terms))
    alike = [key for key in terms[0] if key[0] in names and all(key in of_unit for of_unit in terms)]
    bases = [_bases(unit) for unit in units]
    own: dict[str, list[float]] = defaultdict(list)
    shared: dict[str, list[float]] = defaultdict(list)
    for name in sorted({key[0] for key in alike}):
        gains = [_gain(of_unit, name) for of_unit in bases]
        # All without an unmodelled part, or each with its likeliest: the coefficients are one for all.
        settings = [
            [_equations(unit, of_unit, name, none) for unit, of_unit in zip(units, bases, strict=True)]
            for none in (True, False)
        ]
        for key in (key for key in alike if key[0] == name):
            index = [of_unit[key] for of_unit in terms]
            prior = float(units[0].evidence.log_prior[index[0]]) - np.log(2)  # common values, or each its own
            of_own = np.sum([gain[i] for gain, i in zip(gains, index, strict=True)], axis=0)
            own[name].append(prior + _mean(of_own))
            of_one = [_mean(_of_common_values(units, equations, index)) for equations in settings]
            shared[name].append(prior + float(logsumexp(of_one)) - np.log(len(settings)))
    nothing = float(np.log1p(-units[0].evidence.odds.effect))
    weight = {name: float(logsumexp([*own[name], *shared[name]])) for name in own}
    of_values = {name: float(np.exp(logsumexp(shared[name]) - weight[name])) for name in own}
    # One effect beside what each unit shows by itself: two that do the same are alternatives, not both certain.
    total = float(logsumexp([nothing, *weight.values()]))
    acts = {name: float(np.exp(w - total)) for name, w in weight.items()}
    return Together(dict(sorted(acts.items(), key=lambda item: -item[1])), of_values, float(np.exp(nothing - total)))


def _mean(by_size: Floats) -> float:
    return float(logsumexp(by_size) - np.log(len(by_size)))


def _terms(evidence: Evidence) -> dict[Key, int]:
    out: dict[Key, int] = {}
    seen: dict[tuple[str, tuple[str, ...], tuple[int, ...]], int] = defaultdict(int)
    for i, term in enumerate(evidence.terms):
        if term.effect is not None:
            form = term.name, tuple(c.name for c in term.effect.coefficients), term.kept
            out[(*form, seen[form])] = i
            seen[form] += 1
    return out


@dataclass(frozen=True, eq=False)
class _Base:
    """A set that a further term may stand beside: ``found``, the ``names`` in it, and ``with_each`` (T,R), the
    logarithm of its evidence with each term at each size, of the sizes one by one."""

    found: SetEvidence
    names: frozenset[str]
    with_each: Floats


def _bases(unit: Posterior) -> list[_Base]:
    """The likeliest sets, what is left of the likeliest without some of its terms, and the empty one."""
    evidence = unit.evidence
    best = unit.sets[0].members
    less = [kept for k in range(len(best)) for kept in itertools.combinations(best, k)]
    sets = dict.fromkeys([(), *less, *(found.members for found in unit.sets[:LIKELY])])
    known = {found.members: found for found in unit.sets}
    out = []
    for members in sets:
        found = known.get(members) or evidence.of_set(members, unit.sets[0].parts)
        rows = np.flatnonzero(found.by_part >= found.by_part.max() - NEGLIGIBLE)
        whole = logsumexp([evidence.with_further(found, int(row), cells=1) for row in rows], axis=0)
        whole = whole + np.log(len(evidence.sizes))
        out.append(_Base(found, unit.names_of(found), np.asarray(whole)))
    return out


def _gain(bases: Sequence[_Base], name: str) -> Floats:
    """(T,R) the logarithm of the evidence of each term at each size over that without, whatever else acts."""
    others = [base for base in bases if name not in base.names]
    without = logsumexp([base.found.total for base in others])
    return np.asarray(logsumexp([base.with_each for base in others], axis=0) - without)


@dataclass(frozen=True, eq=False)
class _Equations:
    """``information`` (C,C) and ``score`` (C,) of the scaled coefficients of all terms, over the variance of the noise,
    beside one set with one part and one choice of sizes, whose share of all without the name is ``log_share``."""

    information: Floats
    score: Floats
    log_share: float


def _equations(unit: Posterior, bases: Sequence[_Base], name: str, none: bool) -> _Equations:
    """Beside what explains most with one more term of this name; without an unmodelled part, where ``none``."""
    evidence = unit.evidence
    mine = [i for i, term in enumerate(evidence.terms) if term.name == name]
    others = [base for base in bases if name not in base.names]
    found = max(others, key=lambda base: base.with_each[mine].max()).found
    row = found.parts.index(0) if none and 0 in found.parts else int(np.argmax(found.by_part))
    sizes = found.sizes[int(np.argmax(found.log[row]))]
    share = float(found.by_part[row]) - float(logsumexp([base.found.total for base in others]))
    information, score, chi2 = evidence.normal_equations(found.parts[row], found.members, sizes)
    explained = max(_explained(evidence, information, score, i) for i in mine)
    variance = max(evidence.rows.noise_given(chi2 - explained), 1.0)
    return _Equations(information / variance, score / variance, share)


def _explained(evidence: Evidence, information: Floats, score: Floats, term: int) -> float:
    """By how much a term lowers the sum of squares, at most."""
    places = evidence.places([term])
    return float(score[places] @ np.linalg.pinv(information[np.ix_(places, places)]) @ score[places])


def _of_common_values(units: Sequence[Posterior], equations: Sequence[_Equations], index: Sequence[int]) -> Floats:
    """(R,) the same gain, where all have the coefficients of the first, for a noise that is known."""
    first = units[0].evidence.terms[index[0]]
    information, score = np.zeros((first.rank, first.rank)), np.zeros(first.rank)
    for unit, of_unit, i in zip(units, equations, index, strict=True):
        scale = first.mix / unit.evidence.terms[i].mix
        places = unit.evidence.places([i])
        information += scale[:, None] * of_unit.information[np.ix_(places, places)] * scale
        score += scale * of_unit.score[places]
    size = units[0].evidence.sizes[:, None, None]
    precision = np.eye(first.rank) + size**2 * information
    found = np.linalg.solve(precision, np.broadcast_to(score[:, None], (len(size), first.rank, 1)))[:, :, 0]
    gain = 0.5 * size[:, 0, 0] ** 2 * (found @ score) - 0.5 * np.linalg.slogdet(precision)[1]
    return np.asarray(gain + sum(of_unit.log_share for of_unit in equations))
