"""What a fit says of itself: the covariance of its parameters, the residuals of
its poses, and how far both may be trusted."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.errors import NotStill
from triaxcal.estimate.calibration import Calibration, Residual, pose_results, studentized
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
from triaxcal.estimate.initial_estimate import DILUTION_LIMIT
from triaxcal.estimate.likelihood import (
    Linearised,
    Problem,
    State,
    by_shape,
    linearise,
    linearise_all,
    parameters_by_theta,
    residual_chi2,
    solve,
)
from triaxcal.estimate.nonlinear_parameter_errors import shape_errors
from triaxcal.model.directions import dilution, in_range, linear_design, most_wanted
from triaxcal.poses.degrees_of_freedom import SIGNIFICANT, lack_of_fit_p, raised_dof, within_pose_dof
from triaxcal.poses.pose import Pose
from triaxcal.rounding import probability

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


def concluded(problem: Problem, state: State, poses: Sequence[Pose], judged: Problem | None) -> Calibration:
    """Of a fit at its minimum; ``judged`` as `_ResidualChi2` has it. Raises
    NotStill where the fit ran away."""
    linearised, n = _linearised(problem, state), len(poses)
    found = _ResidualChi2.of(linearised, problem, state, judged, within_pose_dof(poses))
    noise, birge_ratio = linearised[2][:n], found.excess.birge_ratio
    if found.excess.excess_g:
        problem = found.excess.added_to(problem, state)
        state = solve(problem, state, state.effects)
        linearised = linearise_all(problem, state)
    every_r, J, every_s = linearised
    r, s, p = every_r[:n], every_s[:n], J.shape[1]
    weighted = J / every_s[:, None]
    leverage = _leverage(weighted)[:n]
    sensor = state.sensor(problem)
    up = sensor.up(problem.u, problem.covariates)
    spread = _dilution(problem, up)
    shapes = by_shape(problem, state)
    covariance = _covariance(problem, state, np.concatenate([J, shapes], axis=1) / every_s[:, None]) * birge_ratio**2
    calibration = Calibration(
        sensor=sensor,
        covariance=covariance[:p, :p],
        reference=problem.reference,
        channel_reference={c: problem.channel_reference[c] for e in state.effects for c in e.needs},
        residual=Residual.of(
            r,
            noise,
            cross_validated_rms_g=cross_validated(problem, state),
            lack_of_fit_p=lack_of_fit_p(found.chi2, found.dof, within_pose_dof(poses)),
            left=n - p - sum(len(e.shape) for e in state.effects),
        ),
        poses=pose_results(poses, up, r, noise, studentized(r, s, leverage), leverage, total=s * birge_ratio),
        condition=_condition(weighted),
        dilution=spread,
        birge_ratio=birge_ratio,
        excess_g=found.excess.excess_g,
        dof=raised_dof(*found.with_doubtful, within_pose_dof(poses, leverage / leverage.sum())),
        shape_errors=shape_errors(problem, state, shapes, np.sqrt(np.diag(covariance)[p:]), birge_ratio),
        slopes=problem.slopes is not None,
    )
    return replace(calibration, cautions=tuple(_cautions(calibration)))


@dataclass(frozen=True)
class _ResidualChi2:
    """``chi2``, in units of the noise inside the poses, that a fit leaves in
    ``dof`` degrees of freedom; ``with_doubtful`` both with excluded poses whose
    residuals tell how well all come back, and the ``excess`` over the noise
    that these show."""

    chi2: float
    dof: int
    with_doubtful: tuple[float, int]
    excess: Excess

    @classmethod
    def of(
        cls, linearised: Linearised, problem: Problem, state: State, judged: Problem | None, pure: float
    ) -> _ResidualChi2:
        """``judged`` are the means of all those poses where they are more;
        ``pure`` the degrees of freedom of the noise inside them."""
        n = len(problem.u)
        # What the shape of an effect was chosen by is spent, though no column
        # of the Jacobian stands for it.
        spent = len(state.theta) + sum(len(e.shape) for e in state.effects)
        by_means = problem.slopes is None or n > spent
        r, J, s = linearised
        own = (r[:n], J[:n], s[:n]) if by_means else linearised
        chi2, dof = residual_chi2(own), len(own[0]) - spent
        if judged is None or not by_means:
            return cls(chi2, dof, (chi2, dof), Excess.estimated(own, n, dof, pure))
        others = linearise(judged, State.of(judged, state.sensor(problem)))
        with_doubtful = residual_chi2(others), dof + len(judged.u) - n
        return cls(chi2, dof, with_doubtful, Excess.estimated(others, len(judged.u), with_doubtful[1], pure))


def _linearised(problem: Problem, state: State) -> Linearised:
    with np.errstate(over="ignore", invalid="ignore"):
        r, J, s = linearise_all(problem, state)
    if not (np.isfinite(J).all() and np.isfinite(r).all()):
        raise NotStill("the fit ran away")
    return r, J, s


def _leverage(weighted: Floats) -> Floats:
    """(N,) the diagonal of the hat matrix, by the weighted Jacobian."""
    q, _ = np.linalg.qr(weighted)
    return np.asarray(np.clip((q**2).sum(axis=1), 0.0, 1.0))


def _condition(weighted: Floats) -> float:
    """Of the weighted Jacobian with columns of length one."""
    return float(np.linalg.cond(weighted / np.maximum(np.linalg.norm(weighted, axis=0), 1e-300)))


def _dilution(problem: Problem, up: Floats) -> float:
    spread = dilution(up, linear_design(up, in_range(problem.u)))
    if not spread < DILUTION_LIMIT:
        # No scale factor and a bias of one reference fit anything: |a| is right
        # everywhere and means nothing.
        raise NotStill(f"the fit ran away, to a dilution of {spread:.3g}")
    return spread


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
    p = probability(c.residual.lack_of_fit_p)
    if p is not None and p < SIGNIFICANT:
        yield ExcessVariance(c.excess_g / c.reference) if c.excess_g else BirgeRatio(c.birge_ratio)
    yield from too_small(c.residual)


def too_small(residual: Residual) -> Iterator[ResidualsTooSmall]:
    """Of residuals that noise and creep hardly ever leave so small."""
    p = probability(residual.lack_of_fit_p)
    if p is not None and p > 1 - SIGNIFICANT / 5:
        yield ResidualsTooSmall()
