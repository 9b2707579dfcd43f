"""The posterior probabilities of effects, outliers and unmodelled parts, over all
likely sets of terms, and the findings that follow from them.
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.distributions import log_sum_exp, softmax
from triaxcal.effects.contract import SCATTER, Effect, channel_of, is_derived, rate_of
from triaxcal.evidence.covariances import UnmodelledKind, reading_geometry
from triaxcal.evidence.likelihood import Evidence, SetEvidence
from triaxcal.evidence.prior import Odds
from triaxcal.evidence.terms import Term
from triaxcal.model.directions import spiral
from triaxcal.planning.design import VISIBLE
from triaxcal.poses.covariates import static_covariates
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


# Findings from the posterior: certain names, likely names, outliers, and unmodelled
# parts.


@dataclass(frozen=True)
class Named:
    """One of these effects acts for certain; each with its probability, the likeliest
    first. ``together`` is the probability of at least one. A single name is
    certain."""

    probabilities: Mapping[str, float]
    together: float

    @property
    def effect(self) -> str:
        return next(iter(self.probabilities))

    @property
    def unique(self) -> bool:
        return len(self.probabilities) == 1


@dataclass(frozen=True)
class Unexplained:
    """An unmodelled part: its ``probability``, its likeliest ``kind``, and its size
    in that case, as an rms of |a| over the poses, in the unit of the reference."""

    probability: float
    kind: UnmodelledKind | None
    rms_g: float
    significant: bool
    """Whether its probability exceeds one half."""


@dataclass(frozen=True)
class ChangePoint:
    """Another unit, or another mounting, from this pose on."""

    pose: int
    probability: float


@dataclass(frozen=True)
class Findings:
    """The conclusions from a posterior. ``candidates`` are likely names that are not
    certain, with their probabilities; ``nothing`` is the probability of no effect, no
    outlier and no unmodelled part. ``outliers`` are indices among all given poses,
    each with its probability."""

    named: tuple[Named, ...]
    candidates: Mapping[str, float]
    outliers: Mapping[int, float]
    unexplained: Unexplained
    change_point: ChangePoint | None
    nothing: float


def stated(found: Findings, probabilities: Mapping[str, float]) -> dict[str, float | None]:
    """The ``probabilities`` of names, None for those that are not calibrated. The prior
    assumes that the catalogue contains the truth. If it does not, a likely but
    uncertain name is wrong (`benchmarks.components`)."""
    known = {named.effect for named in found.named if named.unique}
    least = Odds().reported
    return {name: p if name in known or not reaches(p, least) else None for name, p in probabilities.items()}


def findings(posterior: Posterior) -> Findings:
    """The findings of a posterior, by the thresholds of its `Odds`."""
    odds = posterior.evidence.odds
    certain = {name for group in posterior.certain for name in group}
    places = posterior.evidence.rows.places
    outliers = {
        int(places[i]): float(p) for i, p in enumerate(posterior.outlier_probabilities) if reaches(p, odds.reported)
    }
    # A change at any pose; the likeliest pose stands for all.
    change_pose = int(places[int(np.argmax(posterior.change_point_probabilities))])
    change_probability = float(posterior.change_point_probabilities.sum())
    return Findings(
        named=tuple(
            Named({name: posterior.effect_probabilities[name] for name in group}, posterior.any_of(group))
            for group in posterior.certain
        ),
        candidates={
            n: p for n, p in posterior.effect_probabilities.items() if reaches(p, odds.reported) and n not in certain
        },
        outliers=dict(sorted(outliers.items(), key=lambda item: -item[1])),
        unexplained=_unexplained(posterior),
        change_point=(
            ChangePoint(change_pose, change_probability) if reaches(change_probability, odds.reported) else None
        ),
        nothing=_nothing(posterior),
    )


def _unexplained(posterior: Posterior) -> Unexplained:
    """The unmodelled part, with its mean variance over the poses."""
    rows, total = posterior.evidence.rows, posterior.unmodelled_probability
    variance = 0.0
    for p, part in zip(posterior.part_probabilities, posterior.evidence.parts, strict=True):
        if part.kind is not None and part.kind.what is not UnmodelledKind.WITHIN_POSE:
            squares = part.kind.of_rows.variances[: rows.n] * rows.error[: rows.n] ** 2
            variance += float(p) * part.tau**2 * float(np.mean(squares))
    likeliest = next(
        (what for what in posterior.unmodelled_kind_probabilities if what is not UnmodelledKind.WITHIN_POSE), None
    )
    rms = float(np.sqrt(variance / total)) if total > 0 else 0.0
    return Unexplained(total, likeliest, rms, reaches(total, posterior.evidence.odds.reported))


def _nothing(posterior: Posterior) -> float:
    """Probability of the empty set without an unmodelled part; both are always
    included (`likely_sets`)."""
    weight, empty = next(
        pair for pair in zip(posterior.set_probabilities, posterior.sets, strict=True) if not pair[1].members
    )
    return float(weight * empty.part_probabilities[empty.parts.index(0)])


# Effects that the poses cannot show in full, with the reasons.

SAME = 0.1
"""Share of the largest combination of coefficients over the sphere. Combinations with a
smaller contribution to |a| differ by the misalignments of the axes alone, and are
equivalent."""


class Why(StrEnum):
    """The reason why poses do not show an effect."""

    NOT_LOGGED = "not_logged"
    SOMETIMES_LOGGED = "sometimes_logged"
    """The channel is missing in some poses."""
    RATE_UNKNOWN = "rate_unknown"
    NOT_KNOWN = "not_known"
    """These poses do not give a derived covariate."""
    STOOD_STILL = "stood_still"
    EVEN_RATE = "even_rate"
    """The channel changes no faster in one pose than in another."""
    EVEN_SCATTER = "even_scatter"
    MOVED_ALONG = "moved_along"
    """Too few poses, or the covariate changed together with their directions."""
    FEW_DIRECTIONS = "few_directions"


@dataclass(frozen=True)
class NotIdentifiable:
    """The reason why poses do not show an effect; ``channel`` is empty if it is not a
    channel."""

    why: Why
    channel: str = ""


def not_identifiable(evidence: Evidence, catalogue: Sequence[Effect]) -> Mapping[str, NotIdentifiable]:
    """Reasons by name, in the order of the ``catalogue``."""
    shown = {name for name in {term.name for term in evidence.terms} if name and _in_full(evidence, name)}
    return {effect.name: _why(evidence, effect) for effect in catalogue if effect.name not in shown}


def _in_full(evidence: Evidence, name: str) -> bool:
    """Whether, for some shape, no combination of all coefficients is equivalent to
    the nine parameters, except those that |a| never shows."""
    rows = evidence.rows
    for term in evidence.terms:
        if term.name == name and term.effect is not None and len(term.kept) == len(term.effect.coefficients):
            columns = np.asarray(term.columns) @ _shown_somewhere(evidence, term.effect)
            columns = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
            left = rows.beyond_linear(columns)
            if rows.residual_dof >= columns.shape[1] and np.linalg.svd(left, compute_uv=False)[-1] > VISIBLE:
                return True
    return False


def _shown_somewhere(evidence: Evidence, effect: Effect) -> Floats:
    """(p,r) combinations of the coefficients that |a| shows somewhere on the sphere.
    For an effect with a covariate these are all."""
    p = len(effect.coefficients)
    if effect.needs:
        return np.eye(p)
    rows = evidence.rows
    sensor = rows.state.sensor(rows.problem)
    geometry = reading_geometry(rows, sensor.output(spiral(4 * p) * rows.problem.reference, {}))
    shown = np.einsum("ni,nip->np", geometry.by_bias, effect.basis(geometry.along, {}))
    size, combinations = np.linalg.svd(shown, full_matrices=False)[1:]
    return np.asarray(combinations[size > SAME * size[0]].T)


def _why(evidence: Evidence, effect: Effect) -> NotIdentifiable:
    rows = evidence.rows
    known, still = rows.problem.channel_reference, static_covariates(rows.poses)
    for name in effect.needs:
        rate, channel = name.endswith(rate_of("")), channel_of(name.removesuffix(rate_of("")))
        logged = any(channel in p.channels for p in rows.poses)
        if name not in known and (rate or not is_derived(name)) and not (rate and logged):
            return NotIdentifiable(Why.SOMETIMES_LOGGED if logged else Why.NOT_LOGGED, channel)
        if name not in known:
            return NotIdentifiable(Why.RATE_UNKNOWN, channel) if rate else NotIdentifiable(Why.NOT_KNOWN, name)
        if name in still:
            if name in SCATTER:
                return NotIdentifiable(Why.EVEN_SCATTER)
            return NotIdentifiable(Why.EVEN_RATE if rate else Why.STOOD_STILL, channel)
    return NotIdentifiable(Why.MOVED_ALONG if effect.needs else Why.FEW_DIRECTIONS)
