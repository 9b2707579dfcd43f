"""The posterior probabilities of effects, outliers and unmodelled parts, over all
likely sets of terms."""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.distributions import log_sum_exp, softmax
from triaxcal.evidence.likelihood import Evidence, SetEvidence
from triaxcal.evidence.terms import Term
from triaxcal.evidence.unmodelled_kernels import UnmodelledKind
from triaxcal.rounding import reaches

EQUAL = 9
"""Decimals to which two probabilities are equal; their order is then that of their
names."""
PARTS = 3
"""Number of unmodelled parts, the likeliest with the name, in the leave-one-out
analysis."""
LEFT_OUT = 200
"""Number of poses that are left out one at a time; in larger sets a single pose
decides little."""
ALTERNATIVES = 8
"""Number of names, the likeliest, among which competing models are sought."""


@dataclass(frozen=True, eq=False)
class Posterior:
    """The posterior over ``sets``, all likely sets of terms, the best first."""

    evidence: Evidence
    sets: Sequence[SetEvidence]

    @cached_property
    def set_probabilities(self) -> Floats:
        """(S,) probability of each set."""
        return softmax([found.total for found in self.sets])

    def names_of(self, found: SetEvidence) -> frozenset[str]:
        """The effects in a set."""
        terms = (self.evidence.terms[i] for i in found.members)
        return frozenset(term.name for term in terms if term.effect is not None)

    def poses_of(self, found: SetEvidence) -> frozenset[int]:
        """The outliers in a set."""
        poses = (self.evidence.terms[i].pose for i in found.members)
        return frozenset(pose for pose in poses if pose >= 0)

    def resized(self, smallest_g: float) -> Posterior:
        """The same sets with sizes of effects from ``smallest_g``: units in a
        comparison need one grid."""
        evidence = self.evidence.resized(smallest_g)
        sets = [evidence.of_set(found.members, found.parts) for found in self.sets]
        return Posterior(evidence, sorted(sets, key=lambda found: -found.total))

    def conditional_on(self, name: str) -> Posterior:
        """The posterior given that this effect acts."""
        return Posterior(self.evidence, [found for found in self.sets if name in self.names_of(found)])

    @cached_property
    def effect_probabilities(self) -> Mapping[str, float]:
        """Marginal probability of each effect, the likeliest first."""
        out: dict[str, float] = defaultdict(float)
        for w, found in zip(self.set_probabilities, self.sets, strict=True):
            for name in sorted(self.names_of(found)):  # in one order in every process
                out[name] += float(w)
        return dict(sorted(out.items(), key=lambda item: (-round(item[1], EQUAL), item[0])))

    @cached_property
    def effect_set_probabilities(self) -> Mapping[frozenset[str], float]:
        """Probability of each set of effects and no other, the likeliest first."""
        out: dict[frozenset[str], float] = defaultdict(float)
        for w, found in zip(self.set_probabilities, self.sets, strict=True):
            out[self.names_of(found)] += float(w)
        return dict(sorted(out.items(), key=lambda item: (-round(item[1], EQUAL), sorted(item[0]))))

    @cached_property
    def term_probabilities(self) -> Floats:
        """(T,) the probability of each term of the evidence."""
        out = np.zeros(len(self.evidence.terms))
        for w, found in zip(self.set_probabilities, self.sets, strict=True):
            out[list(found.members)] += w
        return out

    @cached_property
    def outlier_probabilities(self) -> Floats:
        """(n,) the probability that each pose is an outlier."""
        out = np.zeros(self.evidence.rows.n)
        for p, term in zip(self.term_probabilities, self.evidence.terms, strict=True):
            if term.pose >= 0:
                out[term.pose] = p
        return out

    @cached_property
    def change_point_probabilities(self) -> Floats:
        """(n,) the probability that another unit, or another mounting, begins with
        each pose."""
        out = np.zeros(self.evidence.rows.n)
        for p, term in zip(self.term_probabilities, self.evidence.terms, strict=True):
            if term.change_point >= 0:
                out[term.change_point] = p
        return out

    @cached_property
    def part_probabilities(self) -> Floats:
        """(P,) the probability of each unmodelled part; the first is that of none."""
        out = np.zeros(len(self.evidence.parts))
        for found in self.sets:
            out[list(found.parts)] += np.exp(found.by_part - self._total)
        return out

    @property
    def unmodelled_probability(self) -> float:
        """The probability of an unmodelled part that acts on the pose means."""
        parts = zip(self.part_probabilities, self.evidence.parts, strict=True)
        return float(
            sum(p for p, part in parts if part.kind is not None and part.kind.what != UnmodelledKind.WITHIN_POSE)
        )

    @property
    def unmodelled_kind_probabilities(self) -> Mapping[UnmodelledKind, float]:
        """The probability of each kind of unmodelled part, the likeliest first."""
        out: dict[UnmodelledKind, float] = defaultdict(float)
        for p, part in zip(self.part_probabilities, self.evidence.parts, strict=True):
            if part.kind is not None:
                out[part.kind.what] += float(p)
        return dict(sorted(out.items(), key=lambda item: -item[1]))

    def any_of(self, names: Collection[str]) -> float:
        """The probability that at least one of these effects acts."""
        wanted = frozenset(names)
        return float(sum(p for acting, p in self.effect_set_probabilities.items() if acting & wanted))

    @cached_property
    def certain(self) -> tuple[tuple[str, ...], ...]:
        """Groups of names, each with one that acts for certain. A name alone is
        certain even if any one pose were an outlier."""
        level = self.evidence.odds.certain
        out: list[tuple[str, ...]] = []
        rest: list[str] = []
        for name, p in self.effect_probabilities.items():
            if reaches(p, level) and reaches(self.least_leave_one_out(name), level):
                out.append((name,))
            elif 1 - level <= p and not reaches(p, level):
                rest.append(name)
        while group := self._alternatives(rest):
            out.append(group)
            rest = [name for name in rest if name not in group]
        return tuple(out)

    def _alternatives(self, names: Sequence[str]) -> tuple[str, ...]:
        """The smallest group of names one of which acts for certain, the likeliest
        first; empty where there is none."""
        for size in range(2, min(len(names), ALTERNATIVES) + 1):
            groups = itertools.combinations(names[:ALTERNATIVES], size)
            best = max(groups, key=self.any_of)
            if reaches(self.any_of(best), self.evidence.odds.certain):
                return best
        return ()

    def least_leave_one_out(self, name: str) -> float:
        """The probability of a name if the pose that supports it most were an
        outlier."""
        return float(self.leave_one_out(name).min())

    def leave_one_out(self, name: str) -> Floats:
        """(n,) the probability of a name if each pose were an outlier, conditional on
        the likeliest set with the name, less the name. Unchanged for the outliers of
        that set, and for those of many poses that carry little information."""
        if name not in self._without:
            self._without[name] = self._leave_one_out_of(name)
        return self._without[name]

    @cached_property
    def _without(self) -> dict[str, Floats]:
        """Cached results."""
        return {}

    def _leave_one_out_of(self, name: str) -> Floats:
        evidence = self.evidence
        out = np.full(evidence.rows.n, self.effect_probabilities.get(name, 0.0))
        best = next((found for found in self.sets if name in self.names_of(found)), None)
        if best is None:
            return out
        # The likeliest set without the name, and its likeliest parts.
        rest = tuple(i for i in best.members if evidence.terms[i].name != name)
        mine = np.array([term.name == name for term in evidence.terms])
        rows = np.argsort(-best.by_part)[:PARTS]
        parts = sorted({0, *(best.parts[row] for row in rows)})
        for i in self._telling(best, name):
            term = evidence.terms[i]
            # Add an outlier at the pose; compare all terms with the name to all others.
            members = tuple(sorted((*rest, i)))
            base = evidence.of_set(members, parts)
            others = [other.kind not in {evidence.terms[k].kind for k in members} for other in evidence.terms]
            each = log_sum_exp([evidence.with_each_further(base, row) for row in range(len(parts))], axis=(0, 2))
            each = np.where(others, each + evidence.log_prior, -np.inf)
            acts, none = log_sum_exp(each[mine]), log_sum_exp([base.total, *each[~mine]])
            out[term.pose] = np.exp(acts - np.logaddexp(acts, none))
        return out

    def _telling(self, best: SetEvidence, name: str) -> list[int]:
        """Outlier terms of the leave-one-out analysis of the likeliest set with that
        name. Of many poses, those without which the effect would explain least."""
        evidence = self.evidence
        # Sizes of the best cell of the set.
        row = int(np.argmax(best.by_part))
        sizes = dict(zip(best.members, best.sizes[int(np.argmax(best.log[row]))], strict=True))
        outliers = [i for i, term in enumerate(evidence.terms) if term.pose >= 0 and i not in sizes]
        if len(outliers) <= LEFT_OUT:
            return outliers
        (effect,) = (i for i in best.members if evidence.terms[i].name == name)
        rest = [i for i in best.members if i != effect]
        # Reduction in chi-square by the effect without each pose.
        explained = evidence.explained_without(
            best.parts[row], rest, [sizes[i] for i in rest], (effect, sizes[effect]), outliers
        )
        return [outliers[k] for k in np.sort(np.argsort(explained, kind="stable")[:LEFT_OUT])]

    @cached_property
    def _total(self) -> float:
        return float(log_sum_exp([found.total for found in self.sets]))


# The posterior of the shape of an effect: a time constant, or the moment of a step.

AT_AN_END = 0.5
"""If an end value of the grid holds more than this probability, the data do not
bound the shape. No standard error is given then."""


@dataclass(frozen=True)
class Shape:
    """Posterior mean and standard deviation. ``standard_error`` is None where the
    shape lies at an end of its grid."""

    value: float
    standard_error: float | None
    unit: str


def shapes_of(posterior: Posterior, name: str) -> Mapping[str, Shape]:
    """Posterior shapes of an effect by name, given that it acts; empty where it has
    none."""
    terms, weights = posterior.evidence.terms, posterior.term_probabilities
    mine = [i for i, term in enumerate(terms) if term.effect is not None and term.name == name]
    return shapes_by([terms[i] for i in mine], weights[mine]) if weights[mine].any() else {}


def shapes_by(terms: Sequence[Term], weights: Floats) -> Mapping[str, Shape]:
    """Shapes by name from terms of one effect, with their weights (n,)."""
    every = [{} if term.effect is None else term.effect.shape for term in terms]
    out = {}
    for name, unit in {name: unit for shape in every for name, (_, unit) in shape.items()}.items():
        some = [i for i, shape in enumerate(every) if name in shape]
        value, error = _spread(np.array([every[i][name][0] for i in some]), weights[some])
        out[name] = Shape(value, error, unit)
    return out


def _spread(values: Floats, weights: Floats) -> tuple[float, float | None]:
    """Weighted mean and standard deviation over grid cells: each value represents its
    cell, so width²/12 of a rectangular distribution is added."""
    grid, which = np.unique(values, return_inverse=True)
    share = np.bincount(which, weights)
    share = share / share.sum()
    mean = float(share @ grid)
    if len(grid) == 1 or max(share[0], share[-1]) > AT_AN_END:
        return mean, None
    step = np.diff(grid)
    width = np.concatenate([step[:1], (step[1:] + step[:-1]) / 2, step[-1:]])
    return mean, float(np.sqrt(share @ ((grid - mean) ** 2 + width**2 / 12)))
