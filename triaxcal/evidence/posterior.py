"""The posterior: how probable each name, each outlier and an unmodelled part
are, over all likely sets of terms."""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.distributions import log_sum_exp, softmax
from triaxcal.effects import catalogue_for
from triaxcal.effects.contract import Effect
from triaxcal.effects.plugins import EffectFault
from triaxcal.errors import Refused
from triaxcal.estimate.calibration import Calibration
from triaxcal.estimate.likelihood import State, linearise_all
from triaxcal.estimate.recordings import by_run
from triaxcal.evidence.linearised_data import Rows
from triaxcal.evidence.marginal_likelihood import Evidence, SetEvidence
from triaxcal.evidence.model_search import likely_sets
from triaxcal.evidence.prior import Odds
from triaxcal.evidence.terms import Finer, Variant, terms_of, variant_of
from triaxcal.evidence.unmodelled_kernels import UnmodelledKind
from triaxcal.poses.covariates import channels_of, static_covariates
from triaxcal.poses.pose import Pose

ROUNDS = 4
"""Of linearising anew, each a step of Gauss and Newton, and of dividing shapes."""
PARTS = 3
"""Unmodelled parts beside which a name is asked about without a pose, the
likeliest beside the name."""
ALTERNATIVES = 8
"""Names at most among which alternatives are looked for, the likeliest."""


@dataclass(frozen=True, eq=False)
class Posterior:
    """``sets`` are all likely sets of terms, the best first."""

    evidence: Evidence
    sets: Sequence[SetEvidence]

    @cached_property
    def weight(self) -> Floats:
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
        """The same sets with sizes that begin elsewhere, as `posterior_of` has
        them."""
        evidence = self.evidence.resized(smallest_g)
        sets = [evidence.of_set(found.members, found.parts) for found in self.sets]
        return Posterior(evidence, sorted(sets, key=lambda found: -found.total))

    def conditional_on(self, name: str) -> Posterior:
        """If this effect acts."""
        return Posterior(self.evidence, [found for found in self.sets if name in self.names_of(found)])

    @cached_property
    def effect_probabilities(self) -> Mapping[str, float]:
        """The probability that each effect acts, whatever acts beside it, the
        likeliest first."""
        out: dict[str, float] = defaultdict(float)
        for w, found in zip(self.weight, self.sets, strict=True):
            for name in self.names_of(found):
                out[name] += float(w)
        return dict(sorted(out.items(), key=lambda item: -item[1]))

    @cached_property
    def effect_set_probabilities(self) -> Mapping[frozenset[str], float]:
        """The probability that these effects act and no other, the likeliest
        first."""
        out: dict[frozenset[str], float] = defaultdict(float)
        for w, found in zip(self.weight, self.sets, strict=True):
            out[self.names_of(found)] += float(w)
        return dict(sorted(out.items(), key=lambda item: -item[1]))

    @cached_property
    def of_terms(self) -> Floats:
        """(T,) the probability of each term of the evidence."""
        out = np.zeros(len(self.evidence.terms))
        for w, found in zip(self.weight, self.sets, strict=True):
            out[list(found.members)] += w
        return out

    @cached_property
    def outlier_probabilities(self) -> Floats:
        """(n,) the probability that each pose is an outlier."""
        out = np.zeros(self.evidence.rows.n)
        for p, term in zip(self.of_terms, self.evidence.terms, strict=True):
            if term.pose >= 0:
                out[term.pose] = p
        return out

    @cached_property
    def change_point_probabilities(self) -> Floats:
        """(n,) the probability that from each pose on there is another unit, or
        another mounting."""
        out = np.zeros(self.evidence.rows.n)
        for p, term in zip(self.of_terms, self.evidence.terms, strict=True):
            if term.change_point >= 0:
                out[term.change_point] = p
        return out

    @cached_property
    def part_probabilities(self) -> Floats:
        """(P,) the probability of each part of the evidence, the first that
        there is none."""
        out = np.zeros(len(self.evidence.parts))
        for found in self.sets:
            out[list(found.parts)] += np.exp(found.by_part - self._total)
        return out

    @property
    def unmodelled_probability(self) -> float:
        """The probability that something acts on the means which no name
        describes."""
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
        """Groups of names, in each of which one acts for certain. A name alone
        is known, whichever pose were an outlier; of several it is known that
        one of them acts."""
        level = self.evidence.odds.certain
        out: list[tuple[str, ...]] = []
        rest: list[str] = []
        for name, p in self.effect_probabilities.items():
            if p >= level and self.least_leave_one_out(name) >= level:
                out.append((name,))
            elif 1 - level <= p < level:
                rest.append(name)
        while group := self._alternatives(rest):
            out.append(group)
            rest = [name for name in rest if name not in group]
        return tuple(out)

    def _alternatives(self, names: Sequence[str]) -> tuple[str, ...]:
        """The fewest of these of which one acts for certain, the likeliest
        first; none where nothing is certain."""
        for size in range(2, min(len(names), ALTERNATIVES) + 1):
            groups = itertools.combinations(names[:ALTERNATIVES], size)
            best = max(groups, key=self.any_of)
            if self.any_of(best) >= self.evidence.odds.certain:
                return best
        return ()

    def least_leave_one_out(self, name: str) -> float:
        """The probability of a name if that pose were an outlier which it takes
        most to explain."""
        return float(self.leave_one_out(name).min())

    def leave_one_out(self, name: str) -> Floats:
        """(n,) the probability of a name if that pose were an outlier: beside
        the likeliest set with the name, less the name. As it is, where the pose
        is one of that set's outliers."""
        if name not in self._without:
            self._without[name] = self._leave_one_out_of(name)
        return self._without[name]

    @cached_property
    def _without(self) -> dict[str, Floats]:
        """What was asked before."""
        return {}

    def _leave_one_out_of(self, name: str) -> Floats:
        evidence = self.evidence
        out = np.full(evidence.rows.n, self.effect_probabilities.get(name, 0.0))
        best = next((found for found in self.sets if name in self.names_of(found)), None)
        if best is None:
            return out
        rest = tuple(i for i in best.members if evidence.terms[i].name != name)
        mine = np.array([term.name == name for term in evidence.terms])
        rows = np.argsort(-best.by_part)[:PARTS]
        parts = sorted({0, *(best.parts[row] for row in rows)})
        for i, term in enumerate(evidence.terms):
            if term.pose < 0 or i in rest:
                continue
            members = tuple(sorted((*rest, i)))
            base = evidence.of_set(members, parts)
            others = [other.kind not in {evidence.terms[k].kind for k in members} for other in evidence.terms]
            each = log_sum_exp(
                [evidence.with_each_further(base, row, cells=1) for row in range(len(parts))], axis=(0, 2)
            )
            each = np.where(others, each + evidence.log_prior, -np.inf)
            acts, none = log_sum_exp(each[mine]), log_sum_exp([base.total, *each[~mine]])
            out[term.pose] = np.exp(acts - np.logaddexp(acts, none))
        return out

    @cached_property
    def _total(self) -> float:
        return float(log_sum_exp([found.total for found in self.sets]))


def considered(poses: Sequence[Pose], catalogue: Sequence[Effect] | None = None) -> tuple[Effect, ...]:
    """The effects of a ``catalogue``, run by run where there are several; where
    it is None, of all that are known for the channels that move in these
    poses."""
    sound = [p for p in poses if not p.fault]
    if catalogue is None:
        catalogue = catalogue_for(set(channels_of(sound)) - static_covariates(sound))
    return by_run(catalogue, sound)


def posterior_of(
    poses: Sequence[Pose],
    linear: Calibration,
    *,
    signs: Sequence[float] = (1, 1, 1),
    catalogue: Sequence[Effect] | None = None,
    odds: Odds | None = None,
    smallest_g: float | None = None,
) -> Posterior:
    """Of what acts beside the ``linear`` fit of these poses. ``smallest_g`` is
    the least size of an effect that is asked about; several units that are
    compared have one."""
    odds = odds or Odds()
    effects = considered(poses, catalogue)
    rows, finer = Rows.of(poses, linear, signs, effects), list[Finer]()
    for _ in range(ROUNDS):
        evidence = Evidence(rows, terms_of(rows, effects, odds, finer), odds, smallest_g)
        posterior = Posterior(evidence, likely_sets(evidence))
        point, split = _point_of(posterior), finer_shapes(posterior)
        if point is None and not split:
            break
        rows, finer = rows if point is None else rows.relinearised_at(point), [*finer, split]
    return posterior


def finer_shapes(posterior: Posterior) -> Finer:
    """Where two neighbouring values of a shape hold nearly all of the
    probability of a likely effect, what to divide each into: where the effect
    is strong, the values of the grid are further apart than the poses tell
    them."""
    out: dict[Variant, Sequence[Effect]] = {}
    terms, odds = posterior.evidence.terms, posterior.evidence.odds
    for name in (name for name, p in posterior.effect_probabilities.items() if p >= odds.reported):
        forms: dict[tuple[str, ...], dict[Variant, list[int]]] = defaultdict(lambda: defaultdict(list))
        for i, term in enumerate(terms):
            if term.effect is not None and term.name == name and len(term.effect.shape) == 1:
                key = variant_of(term.effect)
                forms[key[1]][key].append(i)
        for of_form in forms.values():
            shapes = [(terms[index[0]].effect, float(posterior.of_terms[index].sum())) for index in of_form.values()]
            if sum(share for _, share in shapes) >= odds.reported * posterior.effect_probabilities[name]:
                out |= _divided([(effect, share) for effect, share in shapes if effect is not None], odds)
    return out


def _divided(of_shapes: Sequence[tuple[Effect, float]], odds: Odds) -> Finer:
    """By the probability of each variant of one form of an effect, whose shape
    is one number."""
    if len(of_shapes) < 2:
        return {}
    (shape,) = of_shapes[0][0].shape
    ascending = sorted(of_shapes, key=lambda one: one[0].shape[shape][0])
    value = np.array([effect.shape[shape][0] for effect, _ in ascending])
    share = np.array([p for _, p in ascending])
    first = int(np.argmax(share[1:] + share[:-1]))
    if share[first : first + 2].sum() < odds.refine_share * share.sum():
        return {}
    edges = np.concatenate([[1.5 * value[0] - 0.5 * value[1]], (value[1:] + value[:-1]) / 2, [value[-1]]])
    out: dict[Variant, Sequence[Effect]] = {}
    for k in (first, first + 1):
        effect = ascending[k][0]
        inside = edges[k] + (edges[k + 1] - edges[k]) * (np.arange(odds.refine_count) + 0.5) / odds.refine_count
        try:
            made = [effect.shaped({shape: float(v)}) for v in inside if v > 0 or value[0] <= 0]
        except EffectFault:  # one of another package knows no values but its own
            return {}
        if all(one.needs == effect.needs for one in made):  # a lag is known for some time constants alone
            out[variant_of(effect)] = (effect, *made)
    return out


def _point_of(posterior: Posterior) -> State | None:
    """Where the likeliest set says that the unit is; None where the
    linearisation holds there, or nothing does."""
    evidence, best = posterior.evidence, posterior.sets[0]
    rows, terms = evidence.rows, [evidence.terms[i] for i in best.members]
    if any(term.change_point >= 0 for term in terms) or not posterior.names_of(best):
        return None
    scaled = best.coefficients
    inverse = np.linalg.inv(evidence.covariance(best.parts[int(np.argmax(best.by_part))]))
    left = inverse @ (rows.y - evidence.columns[:, evidence.places(best.members)] @ scaled)
    linear = np.linalg.solve(rows.linear.T @ inverse @ rows.linear, rows.linear.T @ left)
    effects, coefficients, predicted = [], [], rows.linear @ linear - rows.y
    ends = np.cumsum([0, *(term.rank for term in terms)])
    for term, mine in zip(terms, np.split(scaled, ends[1:-1]), strict=True):
        if term.effect is not None:
            own = np.zeros(len(term.effect.coefficients))
            own[list(term.kept)] = term.combination * mine
            effects.append(term.effect)
            coefficients.append(own)
            predicted = predicted + rows.by_coefficients(term.effect) @ own
    point = State(np.concatenate([rows.state.theta + linear / rows.lengths, *coefficients]), tuple(effects))
    try:
        found, _, _ = linearise_all(rows.problem, point, jacobian=False)
    except Refused:
        return None
    curved = rows.complement.T @ (found / rows.error - predicted)
    return point if curved @ curved > evidence.odds.relinearise_chi2 else None
