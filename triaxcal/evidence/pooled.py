"""The pooled analysis of several units or recordings: whether an effect acts in all,
and whether its values are common.

An effect that no unit shows for certain may be certain in all of them together. The
product of their evidences decides: one name, form, shape and size for all, with
coefficients of their own or in common. The competing model is that the units are
independent, each with its own posterior.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.distributions import log_sum_exp
from triaxcal.evidence.likelihood import Evidence
from triaxcal.evidence.posterior import Posterior, Shape, shapes_by
from triaxcal.evidence.search import NEGLIGIBLE_LOG_RATIO, BaseModel, base_models, log_ratio_without, log_ratios
from triaxcal.evidence.terms import Term

# The evidence of coefficients that several units share, by Laplace's method.

STEPS = 6
"""Iterations for shared coefficients: each weights the units by the present estimate
of their noise."""


@dataclass(frozen=True, eq=False)
class TermEquations:
    """Information (q,q) and score (q,) of the scaled coefficients of each term of a
    name, in standard errors, conditional on one set with one part and one choice of
    sizes, of chi-square ``chi2``. ``log_share`` is its share of the unit by itself;
    ``variance`` is the noise variance with the best further term."""

    of_terms: Mapping[int, tuple[Floats, Floats]]
    chi2: float
    variance: float
    log_share: float


def term_equations(unit: Posterior, bases: Sequence[BaseModel], name: str, none: bool) -> TermEquations:
    """Conditional on the set with the best further term of this name; without an
    unmodelled part where ``none``."""
    evidence = unit.evidence
    mine = [i for i, term in enumerate(evidence.terms) if term.name == name]
    # The likeliest set, part and sizes without the name.
    others = [base for base in bases if name not in base.names]
    found = max(others, key=lambda base: base.with_each[mine].max()).found
    row = found.parts.index(0) if none and 0 in found.parts else int(np.argmax(found.by_part))
    cell = int(np.argmax(found.log[row]))
    without = float(log_sum_exp([base.found.total for base in others]))
    share = float(found.by_part[row]) - without + log_ratio_without(unit, bases, name)
    of_terms, chi2 = evidence.normal_equations(found.parts[row], found.members, found.sizes[cell], mine)
    explained = max(_explained(*equations) for equations in of_terms.values())
    return TermEquations(of_terms, chi2, evidence.rows.noise_variance_given(chi2 - explained), share)


def _explained(information: Floats, score: Floats) -> float:
    """Largest reduction in chi-square by a term: sᵀ I⁺ s."""
    return float(score @ np.linalg.pinv(information) @ score)


def of_common_values(units: Sequence[Posterior], equations: Sequence[TermEquations], index: Sequence[int]) -> Floats:
    """(R,) log evidence with a term over that without, for each size, with
    coefficients common to all units: Laplace's method about their best values, since
    the noise of no unit is known in advance. Two starting points are used, because a
    unit may lack the effect and be noisy."""
    # Rescale the coefficients of every unit to those of the first.
    first = units[0].evidence.terms[index[0]]
    scaled = []
    for unit, of_unit, i in zip(units, equations, index, strict=True):
        scale = first.combination / unit.evidence.terms[i].combination
        information, score = of_unit.of_terms[i]
        scaled.append((scale[:, None] * information * scale, scale * score))
    shared = (
        np.array([of[0] for of in scaled]),
        np.array([of[1] for of in scaled]),
        np.array([of_unit.chi2 for of_unit in equations]),
    )
    explained = np.array([of_unit.variance for of_unit in equations])
    noisy = np.array([u.evidence.rows.noise_variance_given(e.chi2) for u, e in zip(units, equations, strict=True)])
    found = [_laplace_log_evidence(units, *shared, start) for start in (explained, noisy)]
    return np.asarray(np.max(found, axis=0) + sum(of_unit.log_share for of_unit in equations))


def _laplace_log_evidence(
    units: Sequence[Posterior], information: Floats, score: Floats, chi2: Floats, start: Floats
) -> Floats:
    """(R,) log evidence of coefficients shared by U units over that of none, for each
    size. ``information`` (U,q,q), ``score`` (U,q) and ``chi2`` (U,) of each unit
    without them; ``start`` (U,) are initial noise variances."""
    size = units[0].evidence.sizes
    prior = np.eye(score.shape[1]) / size[:, None, None] ** 2
    variance = np.broadcast_to(start, (len(size), len(units)))
    # Alternate: shared coefficients for the present noise, then noise of every unit.
    for _ in range(STEPS):
        precision = prior + np.einsum("ru,uqp->rqp", 1 / variance, information)
        values = np.linalg.solve(precision, ((1 / variance) @ score)[:, :, None])[:, :, 0]
        squares = np.einsum("rq,uqp,rp->ru", values, information, values)
        left = np.maximum(chi2 - 2 * values @ score.T + squares, 0.0)
        variance = np.array(
            [[u.evidence.rows.noise_variance_given(float(x)) for u, x in zip(units, row, strict=True)] for row in left]
        )
    # Laplace: ln likelihood at the maximum + ln prior − ½ ln|precision|.
    gain = np.zeros(len(size))
    for k, unit in enumerate(units):
        rows = unit.evidence.rows
        gain += rows.log_likelihood(left[:, k]) - rows.log_likelihood(chi2[k])
    precision = prior + np.einsum("ru,uqp->rqp", 1 / variance, information)
    log_det = np.linalg.slogdet(precision * size[:, None, None] ** 2)[1]
    return np.asarray(gain - 0.5 * np.sum((values / size[:, None]) ** 2, axis=1) - 0.5 * log_det)


Form = tuple[str, tuple[str, ...], tuple[int, ...]]
"""A name, the coefficients of a form, and those of them that are free."""


@dataclass(frozen=True, eq=False)
class Pooled:
    """Hypotheses: one effect acts in every unit, of one form, shape and size, or the
    units are independent.

    ``shared`` is the probability of the former by name, ``independent_probability``
    that of the latter. ``probability`` is the probability that each effect acts in
    every unit, whatever else does, the likeliest first; ``common`` that its values
    are then the same, and ``shapes`` has its shape. ``nothing`` is the probability
    that no effect acts in any unit.
    """

    units: Sequence[Posterior]
    shared: Mapping[str, float]
    independent_probability: float
    probability: Mapping[str, float]
    common: Mapping[str, float]
    shapes: Mapping[str, Mapping[str, Shape]]
    nothing: float

    def one_of(self, names: Sequence[str]) -> float:
        """Probability that one of these effects, the same one, acts in every unit; a
        lower bound, since independent units may have several of them."""
        total = self.independent_probability * max(
            _product(unit.effect_probabilities.get(name, 0.0) for unit in self.units) for name in names
        )
        for other, p in self.shared.items():
            if other in names:
                total += p
            elif p > np.exp(-NEGLIGIBLE_LOG_RATIO):
                total += p * max(_product(_acts_given(unit, name, other) for unit in self.units) for name in names)
        return total

    def certain(self, level: float) -> tuple[tuple[str, ...], ...]:
        """Groups of names, one of which acts in every unit with this probability:
        single names, and the smallest group of the others, the likeliest first. Names
        that share columns, such as temperature and its square, form groups."""
        alone = [name for name, p in self.probability.items() if p >= level]
        out = [(name,) for name in alone]
        rest = [name for name, p in self.probability.items() if 1 - level <= p < level]
        for k in range(2, len(rest) + 1):
            if self.one_of(rest[:k]) >= level:
                return (*out, tuple(rest[:k]))
        return tuple(out)


def pool(units: Sequence[Posterior]) -> Pooled:
    """The pooled analysis of units with one catalogue and one grid of sizes
    (`Posterior.resized`). Names that some unit cannot show are omitted. Where an
    effect acts in all, the analysis is repeated conditional on it."""
    found, given = _pooled_conditional_on(units, frozenset()), units
    odds, acting = units[0].evidence.odds, list[str]()
    while len(acting) < odds.together - 1:
        name = next((n for n, p in found.probability.items() if p >= odds.certain and n not in acting), None)
        if name is None:
            break
        given, acting = [unit.conditional_on(name) for unit in given], [*acting, name]
        if not all(unit.sets for unit in given):
            break
        found = _given(found, _pooled_conditional_on(given, frozenset(acting)), found.probability[name])
    return found


def _given(found: Pooled, more: Pooled, p: float) -> Pooled:
    """``found``, updated by the analysis ``more`` that is conditional on an effect of
    probability ``p``."""
    better = {n: p * q for n, q in more.probability.items() if p * q > found.probability[n]}
    of_names = dict(found.probability) | better
    return replace(
        found,
        probability=dict(sorted(of_names.items(), key=lambda item: -item[1])),
        common=dict(found.common) | {n: more.common[n] for n in better},
        shapes=dict(found.shapes) | {n: more.shapes[n] for n in better},
    )


def _pooled_conditional_on(units: Sequence[Posterior], acting: frozenset[str]) -> Pooled:
    """The pooled analysis conditional on effects that are ``acting`` in every
    unit."""
    terms = [_terms(unit.evidence) for unit in units]
    forms = [form for form in terms[0] if form[0] not in acting and all(form in of_unit for of_unit in terms)]
    bases = [base_models(unit, acting) for unit in units]
    scores = {}
    for name in sorted({form[0] for form in forms}):
        alike = _alike(units, terms, [form for form in forms if form[0] == name])
        scores[name] = _Scores.of(units, bases, name, [*alike])
    odds = units[0].evidence.odds
    apart = float(np.log1p(-odds.pooled_effect_probability))
    total = float(log_sum_exp([apart, *(of_name.total for of_name in scores.values())]))
    alone = float(np.exp(apart - total))
    none = _product(unit.effect_set_probabilities.get(frozenset(), 0.0) for unit in units)
    found = Pooled(
        units,
        shared={name: float(np.exp(of_name.total - total)) for name, of_name in scores.items()},
        independent_probability=alone,
        probability={},
        common={name: of_name.common_probability for name, of_name in scores.items()},
        shapes={name: shapes_by(of_name.terms, of_name.weights) for name, of_name in scores.items()},
        nothing=alone * none,
    )
    acts = {name: found.one_of((name,)) for name in found.shared}
    return replace(found, probability=dict(sorted(acts.items(), key=lambda item: -item[1])))


@dataclass(frozen=True, eq=False)
class _Scores:
    """Scores of one name for each of its forms and shapes, the ``terms`` of the first
    unit: log evidence with priors, with values of each unit's ``own`` and with
    ``common`` values."""

    terms: Sequence[Term]
    own: Sequence[float]
    common: Sequence[float]

    @classmethod
    def of(
        cls, units: Sequence[Posterior], bases: Sequence[Sequence[BaseModel]], name: str, alike: Sequence[Sequence[int]]
    ) -> _Scores:
        """``alike`` are the terms of each unit with the same form and shape."""
        first = units[0].evidence
        rescaled = float(np.log(first.odds.pooled_effect_probability / first.odds.effect_odds))
        ratios = [log_ratios(unit, of_unit, name) for unit, of_unit in zip(units, bases, strict=True)]
        # All without an unmodelled part, or each with its likeliest: the
        # coefficients are one for all.
        settings = [
            [term_equations(unit, of_unit, name, none) for unit, of_unit in zip(units, bases, strict=True)]
            for none in (True, False)
        ]
        own, common = [], []
        for index in alike:
            prior = float(first.log_prior[index[0]]) + rescaled - np.log(2)  # each its own values, or common ones
            of_own = np.sum([ratio[i] for ratio, i in zip(ratios, index, strict=True)], axis=0)
            of_common = [_mean(of_common_values(units, equations, index)) for equations in settings]
            own.append(prior + _mean(of_own))
            common.append(prior + float(log_sum_exp(of_common)) - np.log(len(settings)))
        return cls([first.terms[index[0]] for index in alike], own, common)

    @property
    def total(self) -> float:
        return float(log_sum_exp([*self.own, *self.common]))

    @property
    def common_probability(self) -> float:
        """Probability of common values, given that the effect acts in all units."""
        return float(np.exp(log_sum_exp(self.common) - self.total))

    @property
    def weights(self) -> Floats:
        """Probability of each form and shape, given that the effect acts."""
        return np.asarray(np.exp(np.logaddexp(self.own, self.common) - self.total))


def _product(probabilities: Iterable[float]) -> float:
    return float(np.prod([*probabilities]))


def _acts_given(unit: Posterior, name: str, other: str) -> float:
    """Probability of an effect in a unit, given another effect."""
    with_other = {names: p for names, p in unit.effect_set_probabilities.items() if other in names}
    total = sum(with_other.values())
    return sum(p for names, p in with_other.items() if name in names) / total if total > 0 else 0.0


def _mean(by_size: Floats) -> float:
    return float(log_sum_exp(by_size) - np.log(len(by_size)))


def _terms(evidence: Evidence) -> dict[Form, list[int]]:
    """The terms of each form, one for each shape."""
    out: dict[Form, list[int]] = defaultdict(list)
    for i, term in enumerate(evidence.terms):
        if term.effect is not None:
            out[term.name, tuple(c.name for c in term.effect.coefficients), term.kept].append(i)
    return out


def _alike(
    units: Sequence[Posterior], terms: Sequence[Mapping[Form, list[int]]], forms: Sequence[Form]
) -> Iterator[list[int]]:
    """For every form and shape of the first unit, the term of each unit with the
    nearest shape: units with other pose times have other grids of shapes."""
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
