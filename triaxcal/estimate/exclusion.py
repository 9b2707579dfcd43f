"""The poses that a fit excludes: which these are, and what the calibration of
the others says of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from triaxcal.arrays import Ints
from triaxcal.estimate.calibration import Calibration, Exclusion, PoseResult
from triaxcal.estimate.caution import (
    Caution,
    ExcludedPose,
    FaultyPosesExcluded,
    OutlierSetsTied,
    OutliersExcluded,
    PosesExcludedByCaller,
    UnknownHistoryExcluded,
)
from triaxcal.estimate.excess import Excess
from triaxcal.estimate.likelihood import Problem, State, linearise, solve
from triaxcal.estimate.outliers import OutlierSet, not_as_predicted, outlier_set
from triaxcal.poses.covariates import of_unknown_history
from triaxcal.poses.degrees_of_freedom import combined_dof, pose_dof, within_pose_dof
from triaxcal.poses.pose import Pose

OUTLIER_ROUNDS = 4
"""The search is repeated without the outliers found, since large ones bend the
fit beyond linear reckoning; it ends sooner once the set stays the same. The
last set stands."""


def outliers_among(problem: Problem, state: State, poses: Sequence[Pose]) -> OutlierSet:
    """Indices of outliers, from the fit to all. Sought anew without those
    found, until the same are found again: a pose off by a thousand times its
    noise bends the fit so far that linear reckoning is off.

    What the others show beside their noise, all are taken to have: by the noise
    alone the quietest would look like outliers.
    """
    own, together = pose_dof(poses), within_pose_dof(poses)
    dof, pure, judged, found = own, together, problem, OutlierSet()
    for _ in range(OUTLIER_ROUNDS):
        r, J, s = linearise(judged, state)
        again = outlier_set(r / s, J / s[:, None], dof, pure)
        if again.rows == found.rows:
            return again
        found = again
        rest: Ints = np.delete(np.arange(len(poses)), found.rows)
        others, left = problem.only(rest), len(rest) - len(state.theta)
        state = solve(others, state, state.effects)
        judged = replace(problem, excess=Excess.estimated(linearise(others, state), len(rest), left, together).excess_g)
        share = judged.excess**2 / linearise(judged, state)[2] ** 2
        dof, pure = combined_dof(share, left, own), float(combined_dof(share.mean(), left, together))
    return found


def with_unknown_history(
    problem: Problem, state: State, poses: Sequence[Pose], excluded: tuple[int, ...]
) -> tuple[int, ...]:
    """Poses, besides those ``excluded``, that are not as if the unit had rested
    there before; what was is not known."""
    if not (unknown := set(of_unknown_history(poses, state.effects)) - set(excluded)):
        return ()
    rest: Ints = np.delete(np.arange(len(poses)), excluded)
    problem = problem.only(rest)
    r, J, s = linearise(problem, solve(problem, state, state.effects))
    rows = [k for k, i in enumerate(rest) if i in unknown]
    found = not_as_predicted(r / s, J / s[:, None], within_pose_dof([poses[i] for i in rest]), rows)
    return tuple(int(rest[k]) for k in found)


def with_faulty(calibration: Calibration, poses: Sequence[Pose]) -> Calibration:
    """A calibration from the sound ones of ``poses`` with the faulty ones among
    its results, and a caution."""
    faulty = [i for i, p in enumerate(poses) if p.fault]
    if not faulty:
        return calibration
    caution = FaultyPosesExcluded(tuple((poses[i].began, poses[i].fault) for i in faulty))
    results, _ = _among(calibration, poses, dict.fromkeys(faulty, Exclusion.FAULT))
    return replace(calibration, poses=results, cautions=(caution, *calibration.cautions))


def _among(
    calibration: Calibration, poses: Sequence[Pose], reasons: Mapping[int, Exclusion]
) -> tuple[tuple[PoseResult, ...], list[PoseResult]]:
    """The results of a calibration with those of further, excluded poses among
    them, by rows of all; and these."""
    u = np.array([p.mean for p in poses])
    covariates = calibration.covariates_of(poses)
    length, by_u = calibration.sensor.magnitude(u, covariates)
    a = calibration.sensor.specific_force(u, covariates)
    results, added = list(calibration.poses), []
    for i, reason in sorted(reasons.items()):
        noise = float(np.sqrt(by_u[i] @ poses[i].covariance @ by_u[i]))
        error = float(np.hypot(noise, calibration.excess_g))
        miss = float(length[i] - calibration.reference)
        added.append(PoseResult(poses[i], a[i] / np.linalg.norm(a[i]), miss, noise, miss / error, 0.0, reason, error))
        results.insert(i, added[-1])
    return tuple(results), added


def with_excluded(
    calibration: Calibration, poses: Sequence[Pose], rows: Sequence[int], verdict: OutlierSet, why: Exclusion
) -> Calibration:
    """The calibration with the excluded poses among its results, in order of
    time, and cautions that name them: those that an effect knows no history of,
    and else as ``why`` says."""
    unknown = of_unknown_history(poses, [e for e, _ in calibration.sensor.effects]) if why != Exclusion.CALLER else ()
    results, added = _among(calibration, poses, {i: Exclusion.UNKNOWN_HISTORY if i in unknown else why for i in rows})

    def those(reason: Exclusion) -> tuple[ExcludedPose, ...]:
        return tuple(ExcludedPose(p.pose.began, p.studentized) for p in added if p.excluded == reason)

    cautions: list[Caution] = []
    if excused := those(Exclusion.UNKNOWN_HISTORY):
        cautions.append(UnknownHistoryExcluded(excused))
    if wanted := those(Exclusion.CALLER):
        cautions.append(PosesExcludedByCaller(wanted))
    if outliers := those(Exclusion.OUTLIER):
        cautions.append(OutliersExcluded(outliers, verdict.doubtful, calibration.excess_g / calibration.reference))
    return replace(calibration, poses=results, cautions=(*cautions, *calibration.cautions))


def with_tied_sets(calibration: Calibration, poses: Sequence[Pose], verdict: OutlierSet) -> Calibration:
    """The calibration with a caution of sets of poses one of which may hold the
    outliers, where the data do not tell which."""
    if not verdict.tied:
        return calibration
    tied = OutlierSetsTied(tuple(tuple(poses[i].began for i in rows) for rows in verdict.tied))
    return replace(calibration, cautions=(tied, *calibration.cautions))
