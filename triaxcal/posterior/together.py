"""What several units, or recordings, show together: whether an effect acts in all, then whether its values are common.

An effect that no unit shows for certain may be certain in all of them together. So existence is asked of the product
of their evidences: one name, form, shape and size for all, and coefficients of its own for each unit, or the same. Its
competitor is that each unit is for itself, with its own posterior.
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import logsumexp

from triaxcal.arrays import Floats
from triaxcal.posterior.evidence import Evidence, SetEvidence
from triaxcal.posterior.posterior import Posterior
from triaxcal.posterior.shapes import Shape, shapes_by
from triaxcal.posterior.terms import Term

LIKELY = 3
"""Sets of a unit, the likeliest, beside which an effect is asked about."""
NEGLIGIBLE = 14.0
"""In the logarithm: parts that are less likely by more add nothing."""
Form = tuple[str, tuple[str, ...], tuple[int, ...]]
"""A name, the coefficients of a form, and those of them that are free."""


@dataclass(frozen=True, eq=False)
class Together:
    """Hypotheses are that one effect acts in every unit, of one form, shape and size, or that each unit is for itself.

    ``shared`` is the probability of the first by name, ``apart`` that of the second. ``common`` is the probability that
    the values are one for all, if that effect is the shared one, and ``shapes`` has what its shape then is. ``nothing``
    is the probability that no effect acts in any unit.
    """

    units: Sequence[Posterior]
    shared: Mapping[str, float]
    apart: float
    common: Mapping[str, float]
    shapes: Mapping[str, Mapping[str, Shape]]
    nothing: float

    @cached_property
    def probability(self) -> Mapping[str, float]:
        """That each effect acts in every unit, whatever else does, the likeliest first."""
        found = {name: self.one_of((name,)) for name in self.shared}
        return dict(sorted(found.items(), key=lambda item: -item[1]))

    def one_of(self, names: Sequence[str]) -> float:
        """The probability that one of these effects, the same, acts in every unit; at least, where units that share
        nothing may have several of them."""
        total = self.apart * max(_product(unit.of_names.get(name, 0.0) for unit in self.units) for name in names)
        for other, p in self.shared.items():
            if other in names:
                total += p
            elif p > np.exp(-NEGLIGIBLE):
                total += p * max(_product(_beside(unit, name, other) for unit in self.units) for name in names)
        return total

    def certain(self, level: float) -> tuple[tuple[str, ...], ...]:
        """Groups of names, in each of which one acts in every unit with this probability: names alone, and the fewest
        of the others, the likeliest first. Names that hold each other's columns, as temperature and its square, stand
        together."""
        alone = [name for name, p in self.probability.items() if p >= level]
        out = [(name,) for name in alone]
        rest = [name for name, p in self.probability.items() if 1 - level <= p < level]
        for k in range(2, len(rest) + 1):
            if self.one_of(rest[:k]) >= level:
                return (*out, tuple(rest[:k]))
        return tuple(out)


def together(units: Sequence[Posterior]) -> Together:
    """Of units whose posteriors are of one catalogue and one grid of sizes (`Posterior.resized`). Names that some unit
    cannot show are left out."""
    first = units[0].evidence
    terms = [_terms(unit.evidence) for unit in units]
    forms = [form for form in terms[0] if all(form in of_unit for of_unit in terms)]
    bases = [_bases(unit) for unit in units]
    own: dict[str, list[float]] = defaultdict(list)
    one: dict[str, list[float]] = defaultdict(list)
    index: dict[str, list[int]] = defaultdict(list)
    for name in sorted({form[0] for form in forms}):
        ratios = [_ratio(unit, of_unit, name) for unit, of_unit in zip(units, bases, strict=True)]
        # All without an unmodelled part, or each with its likeliest: the coefficients are one for all.
        settings = [
            [_equations(unit, of_unit, name, none) for unit, of_unit in zip(units, bases, strict=True)]
            for none in (True, False)
        ]
        for alike in _alike(units, terms, [form for form in forms if form[0] == name]):
            prior = float(first.log_prior[alike[0]]) - np.log(2)  # common values, or each its own
            of_own = np.sum([ratio[i] for ratio, i in zip(ratios, alike, strict=True)], axis=0)
            of_one = [_mean(_of_common_values(units, equations, alike)) for equations in settings]
            own[name].append(prior + _mean(of_own))
            one[name].append(prior + float(logsumexp(of_one)) - np.log(len(settings)))
            index[name].append(alike[0])
    apart = float(np.log1p(-first.odds.effect))
    weight = {name: float(logsumexp([*own[name], *one[name]])) for name in own}
    total = float(logsumexp([apart, *weight.values()]))
    shared = {name: float(np.exp(w - total)) for name, w in weight.items()}
    of_values = {name: float(np.exp(logsumexp(one[name]) - weight[name])) for name in own}
    shapes = {
        name: shapes_by(
            [first.terms[i] for i in index[name]], np.exp(np.logaddexp(own[name], one[name]) - weight[name])
        )
        for name in own
    }
    none = np.prod([unit.of_sets_of_names.get(frozenset(), 0.0) for unit in units])
    return Together(
        units,
        dict(sorted(shared.items(), key=lambda item: -item[1])),
        float(np.exp(apart - total)),
        of_values,
        shapes,
        float(np.exp(apart - total) * none),
    )


def _product(probabilities: Iterable[float]) -> float:
    return float(np.prod([*probabilities]))


def _beside(unit: Posterior, name: str, other: str) -> float:
    """The probability that an effect acts in a unit in which the other does."""
    with_other = {names: p for names, p in unit.of_sets_of_names.items() if other in names}
    total = sum(with_other.values())
    return sum(p for names, p in with_other.items() if name in names) / total if total > 0 else 0.0


def _mean(by_size: Floats) -> float:
    return float(logsumexp(by_size) - np.log(len(by_size)))


def _terms(evidence: Evidence) -> dict[Form, list[int]]:
    """The terms of each form, one for each shape that it is asked about with."""
    out: dict[Form, list[int]] = defaultdict(list)
    for i, term in enumerate(evidence.terms):
        if term.effect is not None:
            out[term.name, tuple(c.name for c in term.effect.coefficients), term.kept].append(i)
    return out


def _alike(
    units: Sequence[Posterior], terms: Sequence[Mapping[Form, list[int]]], forms: Sequence[Form]
) -> Iterator[list[int]]:
    """Of every form and shape of the first unit the term in each unit whose shape comes nearest: units that were held
    still at other times have other grids of shapes."""
    for form in forms:
        shapes = [
            np.array([_shape_of(unit.evidence.terms[i]) for i in of_unit[form]])
            for unit, of_unit in zip(units, terms, strict=True)
        ]
        for shape in shapes[0]:
            yield [
                of_unit[form][int(np.argmin(np.sum((of_shapes - shape) ** 2, axis=1)))]
                for of_shapes, of_unit in zip(shapes, terms, strict=True)
            ]


def _shape_of(term: Term) -> list[float]:
    return [] if term.effect is None else [value for value, _ in term.effect.shape.values()]


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
    # Whatever part is likely beside some set: an effect may take the place of a part.
    likely = [row for row, part in enumerate(unit.sets[0].parts) if unit.of_parts[part] > np.exp(-NEGLIGIBLE)]
    out = []
    for members in sets:
        found = known.get(members) or evidence.of_set(members, unit.sets[0].parts)
        rows = {*likely, *np.flatnonzero(found.by_part >= found.by_part.max() - NEGLIGIBLE).tolist()}
        whole = logsumexp([evidence.with_further(found, row, cells=1) for row in sorted(rows)], axis=0)
        whole = whole + np.log(len(evidence.sizes))
        out.append(_Base(found, unit.names_of(found), np.asarray(whole)))
    return out


def _ratio(unit: Posterior, bases: Sequence[_Base], name: str) -> Floats:
    """(T,R) the logarithm of the evidence of the unit with each term at each size, over that of the unit by itself."""
    others = [base for base in bases if name not in base.names]
    with_each = logsumexp([base.with_each for base in others], axis=0)
    without = logsumexp([base.found.total for base in others])
    return np.asarray(with_each - without + _log_without(unit, bases, name))


def _log_without(unit: Posterior, bases: Sequence[_Base], name: str) -> float:
    """The logarithm of the evidence of the unit without that name, over that of the unit by itself."""
    every = {found.members: found for found in (*(base.found for base in bases), *unit.sets)}.values()
    others = [found.total for found in every if name not in unit.names_of(found)]
    return float(logsumexp(others) - logsumexp([found.total for found in every]))


@dataclass(frozen=True, eq=False)
class _Equations:
    """``information`` (C,C) and ``score`` (C,) of the scaled coefficients of all terms, over the variance of the noise,
    beside one set with one part and one choice of sizes, whose share of the unit by itself is ``log_share``."""

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
    without = float(logsumexp([base.found.total for base in others]))
    share = float(found.by_part[row]) - without + _log_without(unit, bases, name)
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
