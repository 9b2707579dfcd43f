"""The weighted maximum-likelihood fit of a triad's model to still poses: which
poses it uses, and whether the slopes inside them count."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from triaxcal.effects.contract import Effect, lag_in
from triaxcal.effects.plugins import EffectFault
from triaxcal.errors import InvalidData, Refused
from triaxcal.estimate.calibration import Calibration, Exclusion, HoldsAt
from triaxcal.estimate.exclusion import outliers_among, with_excluded, with_faulty, with_tied_sets, with_unknown_history
from triaxcal.estimate.fit_assessment import concluded
from triaxcal.estimate.initial_estimate import started_problem
from triaxcal.estimate.likelihood import Problem, State, solve
from triaxcal.estimate.outliers import OutlierSet
from triaxcal.estimate.pose_slopes import slopes_p, with_slopes
from triaxcal.poses.covariates import of_unknown_history
from triaxcal.poses.degrees_of_freedom import within_pose_dof
from triaxcal.poses.pose import Pose

CONTRADICTED = 0.01
"""p of the slopes within the poses below which the coefficients are left to the
means."""


def fit(
    poses: Sequence[Pose],
    *,
    signs: Sequence[float] = (1, 1, 1),
    reference: float = 1.0,
    effects: Sequence[Effect] = (),
    excluded: Sequence[int] | None = None,
    why: Exclusion = Exclusion.CALLER,
) -> Calibration:
    """Fit the linear model, and the effects given, to still poses.

    ``signs`` (3,) of the scale factors, which |a| does not show. ``excluded``
    are indices of poses to exclude, and ``why``; where it is None, outliers are
    found and excluded (`triaxcal.estimate.outliers`), and where an effect goes
    with the pose before, a first pose in which the unit had not rested before.
    Poses with a fault are excluded in any case. Raises Refused where the poses
    cannot carry the parameters, InvalidData where a channel that an effect
    needs is not there.
    """
    sound = [i for i, p in enumerate(poses) if not p.fault]
    if len(sound) < len(poses):
        among = None if excluded is None else [k for k, i in enumerate(sound) if i in excluded]
        kept = [poses[i] for i in sound]
        sound_fit = fit(kept, signs=signs, reference=reference, effects=effects, excluded=among, why=why)
        return replace(with_faulty(sound_fit, poses), holds_at=HoldsAt.of(poses))
    whole, begin = started_problem(poses, signs=signs, reference=reference, effects=effects)
    _require_channels(whole, effects)
    if excluded is None:
        chosen = _found_by_residuals(whole, begin, poses, effects)
        why = Exclusion.OUTLIER
    else:
        chosen = _Excluded(OutlierSet(tuple(sorted(excluded))))
    kept, problem, by_means = list(poses), whole, chosen.by_means
    if chosen.rows:
        kept = [p for i, p in enumerate(poses) if i not in chosen.rows]
        problem, begin = started_problem(kept, signs=signs, reference=reference, effects=effects)
        by_means = None
    # What may be no worse than the others shows by how much all come back less
    # well than their noise.
    known = np.setdiff1d(np.arange(len(poses)), chosen.of_unknown_history)
    judged = whole.only(known) if chosen.outliers.doubtful else None
    calibration = concluded(*_solved(problem, kept, begin, effects, by_means), kept, judged)
    if chosen.rows:
        calibration = with_excluded(calibration, poses, chosen.rows, chosen.outliers, why)
    return replace(with_tied_sets(calibration, poses, chosen.outliers), holds_at=HoldsAt.of(poses))


def _require_channels(problem: Problem, effects: Sequence[Effect]) -> None:
    missing = {n for e in effects for n in e.needs if n not in problem.channel_reference and lag_in(n) is None}
    if missing:
        raise InvalidData(f"the poses have no channel {', '.join(sorted(missing))}, which the effects need")


@dataclass(frozen=True)
class _Excluded:
    """The poses that a fit excludes, by row: ``outliers``, and those
    ``of_unknown_history``. ``by_means`` is the fit to the means of all poses,
    where there was one."""

    outliers: OutlierSet
    of_unknown_history: tuple[int, ...] = ()
    by_means: State | None = None

    @property
    def rows(self) -> tuple[int, ...]:
        return tuple(sorted((*self.outliers.rows, *self.of_unknown_history)))


def _found_by_residuals(problem: Problem, begin: State, poses: Sequence[Pose], effects: Sequence[Effect]) -> _Excluded:
    if len(poses) <= 9 + sum(len(e.coefficients) for e in effects):  # nothing is left to tell them by
        return _Excluded(OutlierSet())
    by_means = solve(problem, begin, tuple(effects))
    outliers = outliers_among(problem, by_means, poses)
    unknown = with_unknown_history(problem, by_means, poses, outliers.rows)
    if set(outliers.rows) <= set(of_unknown_history(poses, effects)):
        outliers = replace(outliers, doubtful=False)  # that it is off says nothing of how well poses come back
    return _Excluded(outliers, unknown, by_means)


def _solved(
    problem: Problem, poses: Sequence[Pose], begin: State, effects: Sequence[Effect], by_means: State | None
) -> tuple[Problem, State]:
    """What was fitted, and the fit: to the means (``by_means``, where that is
    known already), and to the slopes inside the poses as far as these agree
    with them.

    Slopes that do not agree go with something else, or the effect acts later
    than its channel says.
    """
    both = with_slopes(problem, poses, effects)
    contradicted = False
    if both is not None:
        try:
            state = solve(both, begin, tuple(effects))
        except (Refused, EffectFault):  # an effect may be known at the means alone
            state = None
        contradicted = state is not None and slopes_p(both, state, within_pose_dof(poses)) < CONTRADICTED
        if state is not None and not contradicted:
            return both, state
    state = by_means or solve(problem, begin, tuple(effects))
    # Means that leave nothing agree with any model: what speaks against it is
    # all that there is to judge it by.
    if len(state.theta) > len(poses) - contradicted:
        raise Refused(f"{len(poses)} poses cannot carry {len(state.theta)} parameters")
    return problem, state
