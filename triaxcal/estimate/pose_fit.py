"""The weighted maximum-likelihood fit of a triad's model to still poses, and
how far it may be trusted."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import Effect, lag_in
from triaxcal.effects.plugins import EffectFault
from triaxcal.errors import InvalidData, NotStill, Refused
from triaxcal.estimate.calibration import Calibration, Exclusion, HoldsAt, PoseResult, Residual
from triaxcal.estimate.caution import (
    BirgeRatio,
    Caution,
    ExcessVariance,
    FewPoses,
    HighLeverage,
    PoorSpread,
    ResidualsTooSmall,
)
from triaxcal.estimate.cross_validation import cross_validated
from triaxcal.estimate.excess import Excess
from triaxcal.estimate.exclusion import outliers_among, with_excluded, with_faulty, with_tied_sets, with_unknown_history
from triaxcal.estimate.initial_estimate import DILUTION_LIMIT, started_problem
from triaxcal.estimate.likelihood import (
    Linearised,
    Problem,
    State,
    by_shape,
    linearise,
    linearise_all,
    parameters_by_theta,
    solve,
)
from triaxcal.estimate.outliers import OutlierSet
from triaxcal.estimate.pose_slopes import residual_chi2, slopes_p, with_slopes
from triaxcal.estimate.shape_errors import shape_errors
from triaxcal.model.directions import dilution, in_range, linear_design, most_wanted
from triaxcal.poses.covariates import of_unknown_history
from triaxcal.poses.pose import Pose
from triaxcal.poses.pure_error import SIGNIFICANT, lack_of_fit_p, pure_error_dof, raised_dof

DILUTION_WARNING = 10.0
"""A tenth of `DILUTION_LIMIT`, at which a fit is refused: errors still hold,
but are large."""
SPREAD_WARNING = 15.0
"""Dilution times the root of the number of poses: about 5 where they are all
over the sphere, 25 over half of it."""
LEFT_LEAST = 3
"""Degrees of freedom below which a residual proves little: its standard
deviation is known to about 40 % by three."""
LEVERAGE_WARNING = 0.95
"""Such a pose shows no more than a twentieth of its own error as a residual."""
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
    missing = {n for e in effects for n in e.needs if n not in whole.channel_reference and lag_in(n) is None}
    if missing:
        raise InvalidData(f"the poses have no channel {', '.join(sorted(missing))}, which the effects need")
    verdict = OutlierSet(tuple(sorted(excluded))) if excluded is not None else OutlierSet()
    by_means = None
    unknown: tuple[int, ...] = ()
    if excluded is None and len(poses) > 9 + sum(len(e.coefficients) for e in effects):
        by_means = solve(whole, begin, tuple(effects))
        verdict = outliers_among(whole, by_means, poses)
        unknown = with_unknown_history(whole, by_means, poses, verdict.rows)
        if set(verdict.rows) <= set(of_unknown_history(poses, effects)):
            verdict = replace(verdict, doubtful=False)  # that it is off says nothing of how well poses come back
    found = tuple(sorted((*verdict.rows, *unknown)))
    kept, problem = list(poses), whole
    if found:
        kept = [p for i, p in enumerate(poses) if i not in found]
        problem, begin = started_problem(kept, signs=signs, reference=reference, effects=effects)
        by_means = None
    # What may be no worse than the others shows by how much all come back less
    # well than their noise.
    judged = whole.only(np.setdiff1d(np.arange(len(poses)), unknown)) if verdict.doubtful else None
    calibration = _conclude(*_solved(problem, kept, begin, effects, by_means), kept, judged)
    if found:
        calibration = with_excluded(calibration, poses, found, verdict, Exclusion.OUTLIER if excluded is None else why)
    return replace(with_tied_sets(calibration, poses, verdict), holds_at=HoldsAt.of(poses))


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
        contradicted = state is not None and slopes_p(both, state, pure_error_dof(poses)) < CONTRADICTED
        if state is not None and not contradicted:
            return both, state
    state = by_means or solve(problem, begin, tuple(effects))
    # Means that leave nothing agree with any model: what speaks against it is
    # all that there is to judge it by.
    if len(state.theta) > len(poses) - contradicted:
        raise Refused(f"{len(poses)} poses cannot carry {len(state.theta)} parameters")
    return problem, state


@dataclass(frozen=True)
class _ResidualChi2:
    """``chi2``, in units of the noise inside the poses, that a fit leaves in
    ``left`` degrees of freedom; ``with_doubtful`` the same with excluded poses
    whose residuals tell how well all come back, and what these show ``excess``
    noise."""

    chi2: float
    left: int
    with_doubtful: tuple[float, int]
    excess: Excess

    @classmethod
    def of(
        cls, everything_left: Linearised, problem: Problem, state: State, judged: Problem | None, pure: float
    ) -> _ResidualChi2:
        """``judged`` are the means of all those poses where they are more;
        ``pure`` the degrees of freedom of the noise inside them."""
        n = len(problem.u)
        # What the shape of an effect was chosen by is spent, though no column
        # of the Jacobian stands for it.
        spent = len(state.theta) + sum(len(e.shape) for e in state.effects)
        by_means = problem.slopes is None or n > spent
        r, J, s = everything_left
        own = (r[:n], J[:n], s[:n]) if by_means else everything_left
        chi2, left = residual_chi2(own), len(own[0]) - spent
        if judged is None or not by_means:
            return cls(chi2, left, (chi2, left), Excess.estimated(own, n, left, pure))
        others = linearise(judged, State.of(judged, state.sensor(problem)))
        with_doubtful = residual_chi2(others), left + len(judged.u) - n
        return cls(chi2, left, with_doubtful, Excess.estimated(others, len(judged.u), with_doubtful[1], pure))


def _conclude(problem: Problem, state: State, poses: Sequence[Pose], judged: Problem | None) -> Calibration:
    with np.errstate(over="ignore", invalid="ignore"):
        every_r, J, every_s = linearise_all(problem, state)
    if not (np.isfinite(J).all() and np.isfinite(every_r).all()):
        raise NotStill("the fit ran away")
    n, p = len(poses), J.shape[1]
    found = _ResidualChi2.of((every_r, J, every_s), problem, state, judged, pure_error_dof(poses))
    noise, birge_ratio = every_s[:n], found.excess.birge_ratio
    if found.excess.excess_g:
        problem = found.excess.added_to(problem, state)
        state = solve(problem, state, state.effects)
        every_r, J, every_s = linearise_all(problem, state)
    r, s = every_r[:n], every_s[:n]
    weighted = J / every_s[:, None]
    q, _ = np.linalg.qr(weighted)
    leverage = np.clip((q**2).sum(axis=1), 0.0, 1.0)[:n]
    free = np.sqrt(np.maximum(1 - leverage, 0.0))
    studentized = np.where(free > 1e-6, r / s / np.maximum(free, 1e-6), 0.0)
    dof = raised_dof(*found.with_doubtful, pure_error_dof(poses, leverage / leverage.sum()))
    sensor = state.sensor(problem)
    direction = sensor.specific_force(problem.u, problem.covariates)
    direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    design = linear_design(direction, in_range(problem.u))
    spread = dilution(direction, design)
    if not spread < DILUTION_LIMIT:
        # No scale factor and a bias of one reference fit anything: |a| is right
        # everywhere and means nothing.
        raise NotStill(f"the fit ran away, to a dilution of {spread:.3g}")
    norms = np.linalg.norm(weighted, axis=0)
    shapes = by_shape(problem, state)
    covariance = _covariance(problem, state, np.concatenate([J, shapes], axis=1) / every_s[:, None]) * birge_ratio**2
    residual = Residual(
        rms_g=float(np.sqrt(np.mean(r**2))),
        max_abs_g=float(np.max(np.abs(r))),
        cross_validated_rms_g=cross_validated(problem, state),
        noise_floor_g=float(np.sqrt(np.mean(noise**2))),
        lack_of_fit_p=lack_of_fit_p(found.chi2, found.left, pure_error_dof(poses)),
    )
    calibration = Calibration(
        sensor=sensor,
        covariance=covariance[:p, :p],
        reference=problem.reference,
        channel_reference={c: problem.channel_reference[c] for e in state.effects for c in e.needs},
        residual=residual,
        poses=tuple(
            PoseResult(
                pose,
                direction[i],
                float(r[i]),
                float(noise[i]),
                float(studentized[i]),
                float(leverage[i]),
                total_standard_error_g=float(s[i]) * birge_ratio,
            )
            for i, pose in enumerate(poses)
        ),
        condition=float(np.linalg.cond(weighted / np.maximum(norms, 1e-300))),
        dilution=spread,
        birge_ratio=birge_ratio,
        excess_g=found.excess.excess_g,
        dof=dof,
        shape_errors=shape_errors(problem, state, shapes, np.sqrt(np.diag(covariance)[p:]), birge_ratio),
        slopes=problem.slopes is not None,
    )
    return replace(calibration, cautions=tuple(_cautions(calibration)))


def _covariance(problem: Problem, state: State, weighted: Floats) -> Floats:
    """Of scale factor, misalignment, bias and the effects' coefficients, from
    the weighted Jacobian; further columns are of what was estimated beside
    them."""
    norms = np.linalg.norm(weighted, axis=0)
    norms = np.where(norms > 0, norms, 1.0)
    inverse = np.linalg.pinv((weighted / norms).T @ (weighted / norms), rcond=1e-14)
    theta = inverse / np.outer(norms, norms)
    G = np.eye(len(theta))
    G[: len(state.theta), : len(state.theta)] = parameters_by_theta(problem, state)
    return np.asarray(G @ theta @ G.T)


def _cautions(c: Calibration) -> Iterator[Caution]:
    if c.dilution > DILUTION_WARNING or c.dilution * np.sqrt(len(c.poses)) > SPREAD_WARNING:
        up, enough = np.array([p.direction for p in c.poses]), min(2.0, c.dilution / 4)
        yield PoorSpread(c.dilution, tuple(label for label, _ in most_wanted(up, enough)))
    if len(c.poses) - len(c.parameters) < LEFT_LEAST:
        yield FewPoses(len(c.poses), len(c.parameters))
    worst = max(c.poses, key=lambda p: p.leverage)
    if worst.leverage > LEVERAGE_WARNING:
        yield HighLeverage(worst.pose.began, worst.leverage)
    p = c.residual.lack_of_fit_p
    if p is not None and p < SIGNIFICANT:
        yield ExcessVariance(c.excess_g / c.reference) if c.excess_g else BirgeRatio(c.birge_ratio)
    if p is not None and p > 1 - SIGNIFICANT / 5:
        yield ResidualsTooSmall()
