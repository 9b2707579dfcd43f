"""The posterior of what acts in some poses: linearised anew, and with finer
shapes, until neither changes it, or `ROUNDS` times."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from triaxcal.effects import catalogue_for
from triaxcal.effects.contract import Effect
from triaxcal.effects.plugins import EffectFault
from triaxcal.errors import Refused
from triaxcal.estimate.calibration import Calibration
from triaxcal.estimate.likelihood import State, linearise_all
from triaxcal.estimate.recordings import by_run
from triaxcal.evidence.linearised_data import LinearisedData
from triaxcal.evidence.marginal_likelihood import Evidence
from triaxcal.evidence.model_search import likely_sets
from triaxcal.evidence.posterior import Posterior
from triaxcal.evidence.prior import Odds
from triaxcal.evidence.row_covariance import inverse_of
from triaxcal.evidence.terms import Finer, Variant, change_points, terms_of, variant_of
from triaxcal.poses.covariates import channels_of, static_covariates
from triaxcal.poses.pose import Pose
from triaxcal.progress import Progress, Stage, untold
from triaxcal.rounding import reaches

ROUNDS = 4
"""Of linearising anew, each a step of Gauss and Newton, and of dividing shapes."""


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
    progress: Progress = untold,
) -> Posterior:
    """Of what acts beside the ``linear`` fit of these poses."""
    odds = odds or Odds()
    effects = considered(poses, catalogue)
    rows, finer = LinearisedData.of(poses, linear, signs, effects), list[Finer]()
    near: int | None = None
    suspects: list[int] | None = None
    done = 0

    def told(share: float) -> None:
        progress(Stage.EFFECTS, (done + share) / ROUNDS)

    while True:
        told(0.0)
        evidence = Evidence(rows, terms_of(rows, effects, odds, finer, near), odds, suspects)
        posterior = Posterior(evidence, likely_sets(evidence, told))
        done += 1
        point, split = _point_of(posterior), finer_shapes(posterior)
        seen, near = near, coarse_change_point(posterior, near)
        asked, suspects = suspects, _suspects(posterior) if suspects is None else suspects
        if done == ROUNDS or (point is None and not split and near == seen and asked == suspects):
            return posterior
        del posterior, evidence  # of a thousand poses it holds much memory, and so will the next
        rows, finer = rows if point is None else rows.relinearised_at(point), [*finer, split]


def _suspects(posterior: Posterior) -> list[int] | None:
    """Poses that are outliers, or none of them where another unit is likely:
    then something that acts there alone is an alternative, which is asked about
    no sooner. None where neither is likely."""
    outliers, least = posterior.outlier_probabilities, posterior.evidence.odds.reported
    found = [i for i, p in enumerate(outliers) if reaches(p, least)]
    return found if found or reaches(posterior.change_point_probabilities.sum(), least) else None


def coarse_change_point(posterior: Posterior, near: int | None) -> int | None:
    """How many poses are before the likeliest change, if one is likely and not
    all poses about it are looked at; else the one that was ``near`` before."""
    rows, p = posterior.evidence.rows, posterior.change_point_probabilities
    if not reaches(p.sum(), posterior.evidence.odds.reported):
        return near
    cut = int(np.argmax(p[rows.order]))
    coarse = change_points(rows.n)
    return cut if cut in coarse and np.ptp(coarse) >= len(coarse) else near


def finer_shapes(posterior: Posterior) -> Finer:
    """Where two neighbouring values of a shape hold nearly all of the
    probability of a likely effect, what to divide each into: where the effect
    is strong, the values of the grid are further apart than the poses tell
    them."""
    out: dict[Variant, Sequence[Effect]] = {}
    terms, odds = posterior.evidence.terms, posterior.evidence.odds
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
    """The parameters of the likeliest model; None where the linearisation holds
    for them, where that model has no effect, or where it fits no better there
    than nothing does: so far the linearisation does not reach."""
    evidence, best = posterior.evidence, posterior.sets[0]
    rows, terms = evidence.rows, [evidence.terms[i] for i in best.members]
    if any(term.change_point >= 0 for term in terms) or not posterior.names_of(best):
        return None
    scaled = best.coefficients
    inverse = evidence.precision(best.parts[int(np.argmax(best.by_part))])
    left = inverse @ (rows.y - evidence.columns.at(evidence.places(best.members)) @ scaled)
    linear = inverse_of(rows.linear.T @ inverse @ rows.linear) @ (rows.linear.T @ left)
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
        with np.errstate(over="ignore", invalid="ignore"):  # a step too far is none
            found = linearise_all(rows.problem, point, jacobian=False)[0] / rows.error
            if not found @ (inverse @ found) < rows.y @ (inverse @ rows.y):
                return None
    except Refused:
        return None
    curved = rows.beyond_linear(found - predicted)
    return point if curved @ curved > evidence.odds.relinearise_chi2 else None
