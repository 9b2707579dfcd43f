"""The search for the likeliest sets of effects, and the refinement of their shapes."""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.distributions import log_sum_exp, softmax
from triaxcal.effects import catalogue_for
from triaxcal.effects.catalogue import EffectFault
from triaxcal.effects.contract import Effect
from triaxcal.errors import Refused
from triaxcal.estimate.calibration import Calibration
from triaxcal.estimate.likelihood import State, linearise_all
from triaxcal.estimate.recordings import by_run
from triaxcal.evidence.covariances import inverse_of
from triaxcal.evidence.likelihood import Evidence, SetEvidence
from triaxcal.evidence.linearised_data import LinearisedData
from triaxcal.evidence.posterior import Posterior
from triaxcal.evidence.prior import Odds
from triaxcal.evidence.terms import Finer, Variant, change_points, terms_of, variant_of
from triaxcal.poses.covariates import channels_of, static_covariates
from triaxcal.poses.pose import Pose
from triaxcal.progress import Progress, Stage, unreported
from triaxcal.rounding import reaches

# One unit's evidence with a further term and without a name: the factors of the
# pooled analysis.

BASE_SETS = 3
"""Number of a unit's likeliest sets to which an effect is added."""
NEGLIGIBLE_LOG_RATIO = 14.0
"""Parts with a log evidence lower by more than this are neglected."""


@dataclass(frozen=True, eq=False)
class BaseModel:
    """A set to which a further term is added: ``found``, the ``names`` in it, and
    ``with_each`` (T,R), the log evidence of the set with each term at each size."""

    found: SetEvidence
    names: frozenset[str]
    with_each: Floats


def base_models(unit: Posterior, acting: frozenset[str]) -> list[BaseModel]:
    """The likeliest sets, and all subsets of the likeliest; all contain the
    ``acting`` effects. Where none is acting, the empty set is included."""
    evidence = unit.evidence
    best = unit.sets[0].members
    less = [kept for k in range(len(best) + 1) for kept in itertools.combinations(best, k)]
    some = [*less, *(found.members for found in unit.sets[:BASE_SETS])]
    sets = [m for m in dict.fromkeys(some) if acting <= {evidence.terms[i].name for i in m}]
    known = {found.members: found for found in unit.sets}
    # Every part that is likely with some set: an effect may replace a part.
    likely = [
        row
        for row, part in enumerate(unit.sets[0].parts)
        if unit.part_probabilities[part] > np.exp(-NEGLIGIBLE_LOG_RATIO)
    ]
    out = []
    for members in sets:
        # Log evidence with each further term, summed over the parts; the prior of the
        # sizes is taken out.
        found = known.get(members) or evidence.of_set(members, unit.sets[0].parts)
        rows = {*likely, *np.flatnonzero(found.by_part >= found.by_part.max() - NEGLIGIBLE_LOG_RATIO).tolist()}
        whole = log_sum_exp([evidence.with_each_further(found, row) for row in sorted(rows)], axis=0)
        whole = whole + np.log(len(evidence.sizes))
        out.append(BaseModel(found, unit.names_of(found), np.asarray(whole)))
    return out


def log_ratios(unit: Posterior, bases: Sequence[BaseModel], name: str) -> Floats:
    """(T,R) log evidence of the unit with each term at each size, over that of the
    unit by itself."""
    others = [base for base in bases if name not in base.names]
    with_each = log_sum_exp([base.with_each for base in others], axis=0)
    without = log_sum_exp([base.found.total for base in others])
    return np.asarray(with_each - without + log_ratio_without(unit, bases, name))


def log_ratio_without(unit: Posterior, bases: Sequence[BaseModel], name: str) -> float:
    """Log evidence of the unit without that name, over that of the unit by itself."""
    every = {found.members: found for found in (*(base.found for base in bases), *unit.sets)}.values()
    others = [found.total for found in every if name not in unit.names_of(found)]
    return float(log_sum_exp(others) - log_sum_exp([found.total for found in every]))


# The search for likely sets: all single terms, larger sets grown from the best
# (Occam's window; Madigan and Raftery 1994).

SINGLES, LARGER = 0.3, 0.8
"""Approximate shares of the work after which the single terms, and all rough scores,
are done."""
Scores = dict[tuple[int, ...], float]
LEADERS = (12, 6)
"""Numbers of single terms, and of larger sets, that are grown: two, then one, for
each choice of names."""
GROWN = 60
"""Number of the best terms that are added to one leader."""
MOST = 260
"""Number of sets with exact evidence. More sets than this within the window share
what a few leave."""
ROUGH = 4.0
"""Log error of the rough score of a larger set: it is computed at the best sizes and
parts of the smaller set."""
NO_PART = 1e-3
"""Parts with a smaller share in every leading set are neglected."""


def likely_sets(evidence: Evidence, report: Callable[[float], None] = lambda done: None) -> list[SetEvidence]:
    """The sets within Occam's window, the best first, and the empty set. ``report`` is
    called with the approximate share of the work that is done."""
    # Evidence of the empty set and of each single term, summed over parts and sizes.
    singles = []
    for part in range(len(evidence.parts)):
        singles.append(evidence.log_evidence_with_each(part))
        report(SINGLES * part / len(evidence.parts))
    of_each = log_sum_exp([of_terms for of_terms, _ in singles], axis=(0, 2)) + evidence.log_prior
    level: Scores = {(i,): float(score) for i, score in enumerate(of_each)}
    scores: Scores = {(): float(log_sum_exp([alone for _, alone in singles]))} | level
    # Grow sets term by term, with rough scores.
    for depth in range(1, evidence.odds.together):
        level = _grown(evidence, level, depth)
        scores |= level
        report(SINGLES + (LARGER - SINGLES) * depth / (evidence.odds.together - 1))
    # Keep the sets within the window of the best.
    window = max(scores.values()) - np.log(evidence.odds.window)
    ranked = sorted(scores, key=lambda members: -scores[members])
    kept = [m for m in ranked if scores[m] > window - (ROUGH if len(m) > 1 else 0.0)][:MOST]
    # Exact evidence of these.
    parts = _parts_that_matter(evidence, kept[: LEADERS[0]])
    exact = [evidence.of_set(m, parts) for m in dict.fromkeys([*kept, ()])]
    return sorted(exact, key=lambda found: -found.total)


def _grown(evidence: Evidence, level: Mapping[tuple[int, ...], float], depth: int) -> Scores:
    """Sets of one more term, each with its rough score: the best terms added to each
    leader."""
    out: Scores = {}
    for members in _leaders(evidence, level, depth):
        scores = _scores_with_each_term(evidence, members)
        for other in np.argsort(-scores)[:GROWN]:
            if _go_together(evidence, members, int(other)):
                grown = tuple(sorted((*members, int(other))))
                out[grown] = max(out.get(grown, -np.inf), float(scores[other]))
    return out


def _leaders(evidence: Evidence, level: Mapping[tuple[int, ...], float], depth: int) -> Iterator[tuple[int, ...]]:
    """The best sets of this size, within the window of the best of them."""
    best = max(level.values(), default=0.0) - np.log(evidence.odds.window)
    count_by_kinds: dict[tuple[str, ...], int] = {}
    most, alike = (LEADERS[0], 2) if depth == 1 else (LEADERS[1], 1)
    # At most `alike` sets for each choice of names.
    for members in sorted(level, key=lambda m: -level[m]):
        if level[members] < best - ROUGH or sum(count_by_kinds.values()) == most:
            return
        kinds = tuple(sorted(evidence.terms[i].kind for i in members))
        if count_by_kinds.get(kinds, 0) < alike:
            count_by_kinds[kinds] = count_by_kinds.get(kinds, 0) + 1
            yield members


def _scores_with_each_term(evidence: Evidence, members: tuple[int, ...]) -> Floats:
    """(T,) approximate log evidence of the members with each term, with all priors:
    at the best sizes of the members, without an unmodelled part and with its three
    likeliest parts."""
    alone = evidence.of_set(members, range(len(evidence.parts)))
    likely = np.argsort(-alone.by_part)[:3]
    rows = dict.fromkeys([0, *map(int, likely)])
    each = [log_sum_exp(evidence.with_each_further(alone, row), axis=1) for row in rows]
    return np.asarray(log_sum_exp(each, axis=0) + evidence.log_prior)


def _go_together(evidence: Evidence, members: tuple[int, ...], other: int) -> bool:
    kind = evidence.terms[other].kind
    return all(evidence.terms[i].kind != kind and not _nested(evidence.terms[i].kind, kind) for i in members)


def _nested(one: str, other: str) -> bool:
    """Whether one effect contains the columns of the other: temperature, linear and
    quadratic."""
    return {one, other} == {"temperature_bias", "temperature_bias_quadratic"}


def _parts_that_matter(evidence: Evidence, leaders: list[tuple[int, ...]]) -> list[int]:
    share = np.zeros(len(evidence.parts))
    for members in leaders:
        by_part = evidence.of_set(members, range(len(evidence.parts))).by_part
        share = np.maximum(share, softmax(by_part))
    return [part for part in range(len(share)) if part == 0 or share[part] > NO_PART]


# The posterior: linearise anew and refine the shapes, until neither changes it, or
# `ROUNDS` times.

ROUNDS = 4
"""Rounds of linearisation (each a Gauss–Newton step) and of refinement of shapes."""


def considered(poses: Sequence[Pose], catalogue: Sequence[Effect] | None = None) -> tuple[Effect, ...]:
    """The effects of a ``catalogue``, run by run where there are several; by default
    all known effects of the channels that change in these poses."""
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
    progress: Progress = unreported,
) -> Posterior:
    """The posterior of effects, outliers and unmodelled parts, conditional on the
    ``linear`` fit of these poses."""
    odds = odds or Odds()
    effects = considered(poses, catalogue)
    rows, finer = LinearisedData.of(poses, linear, signs, effects), list[Finer]()
    near: int | None = None
    suspects: list[int] | None = None
    done = 0

    def report(share: float) -> None:
        progress(Stage.EFFECTS, (done + share) / ROUNDS)

    while True:
        report(0.0)
        # Terms, their evidence, and the likely sets about the present point.
        evidence = Evidence(rows, terms_of(rows, effects, odds, finer, near), odds, suspects)
        posterior = Posterior(evidence, likely_sets(evidence, report))
        done += 1
        # Next point, finer shapes, change points and suspects; stop when nothing
        # changes.
        point, split = _point_of(posterior), finer_shapes(posterior)
        seen, near = near, coarse_change_point(posterior, near)
        asked, suspects = suspects, _suspects(posterior) if suspects is None else suspects
        if done == ROUNDS or (point is None and not split and near == seen and asked == suspects):
            return posterior
        del posterior, evidence  # of a thousand poses it holds much memory, and so will the next
        rows, finer = rows if point is None else rows.relinearised_at(point), [*finer, split]


def _suspects(posterior: Posterior) -> list[int] | None:
    """Possible outliers, or no pose (an empty list) where another unit is likely:
    then local parts are competing models. None where neither is likely."""
    outliers, least = posterior.outlier_probabilities, posterior.evidence.odds.reported
    found = [i for i, p in enumerate(outliers) if reaches(p, least)]
    return found if found or reaches(posterior.change_point_probabilities.sum(), least) else None


def coarse_change_point(posterior: Posterior, near: int | None) -> int | None:
    """Number of poses before the likeliest change point, if one is likely and its
    neighbours are not all in the grid; else the previous ``near``."""
    rows, p = posterior.evidence.rows, posterior.change_point_probabilities
    if not reaches(p.sum(), posterior.evidence.odds.reported):
        return near
    cut = int(np.argmax(p[rows.order]))
    coarse = change_points(rows.n)
    return cut if cut in coarse and np.ptp(coarse) >= len(coarse) else near


def finer_shapes(posterior: Posterior) -> Finer:
    """The divisions of shapes: where two neighbouring values of a shape hold nearly
    all probability of a likely effect, the grid is coarser than the resolution of the
    poses."""
    out: dict[Variant, Sequence[Effect]] = {}
    terms, odds = posterior.evidence.terms, posterior.evidence.odds
    # Group the terms of each likely effect by form, then by variant.
    for name in (name for name, p in posterior.effect_probabilities.items() if reaches(p, odds.reported)):
        forms: dict[tuple[str, ...], dict[Variant, list[int]]] = defaultdict(lambda: defaultdict(list))
        for i, term in enumerate(terms):
            if term.effect is not None and term.name == name and len(term.effect.shape) == 1:
                key = variant_of(term.effect)
                forms[key[1]][key].append(i)
        for of_form in forms.values():
            shapes = [
                (terms[index[0]].effect, float(posterior.term_probabilities[index].sum())) for index in of_form.values()
            ]
            if sum(share for _, share in shapes) >= odds.reported * posterior.effect_probabilities[name]:
                out |= _divided([(effect, share) for effect, share in shapes if effect is not None], odds)
    return out


def _divided(of_shapes: Sequence[tuple[Effect, float]], odds: Odds) -> Finer:
    """The division of the variants of one form, with a one-number shape, by their
    probabilities."""
    if len(of_shapes) < 2:
        return {}
    (shape,) = of_shapes[0][0].shape
    ascending = sorted(of_shapes, key=lambda one: one[0].shape[shape][0])
    value = np.array([effect.shape[shape][0] for effect, _ in ascending])
    share = np.array([p for _, p in ascending])
    # The pair of neighbours with the largest probability.
    first = int(np.argmax(share[1:] + share[:-1]))
    if share[first : first + 2].sum() < odds.refine_share * share.sum():
        return {}
    # Split the cell of each of the two into equal parts; cells end half-way between
    # values.
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
    """The parameters of the likeliest model as the next point of linearisation. None
    where the present linearisation is accurate there, where the model has no effect,
    or where the exact fit there is no better than without effects."""
    evidence, best = posterior.evidence, posterior.sets[0]
    rows, terms = evidence.rows, [evidence.terms[i] for i in best.members]
    if any(term.change_point >= 0 for term in terms) or not posterior.names_of(best):
        return None
    # Coefficients of the likeliest set, and the nine parameters by generalised least
    # squares.
    scaled = best.coefficients
    inverse = evidence.precision(best.parts[int(np.argmax(best.by_part))])
    left = inverse @ (rows.y - evidence.columns.at(evidence.places(best.members)) @ scaled)
    linear = inverse_of(rows.linear.T @ inverse @ rows.linear) @ (rows.linear.T @ left)
    # Coefficients of each effect in its own units, and the linear prediction.
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
    # Exact residuals at that point must improve on those of the linear fit.
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # a step too far is none
            found = linearise_all(rows.problem, point, jacobian=False)[0] / rows.error
            if not found @ (inverse @ found) < rows.y @ (inverse @ rows.y):
                return None
    except Refused:
        return None
    # Linearise anew only if prediction and exact residuals differ beyond the nine
    # parameters.
    curved = rows.beyond_linear(found - predicted)
    return point if curved @ curved > evidence.odds.relinearise_chi2 else None
