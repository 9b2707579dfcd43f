"""The poses that a fit leaves out: which these are, and what the calibration of the others says of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from triaxcal.arrays import Ints
from triaxcal.beyond import Beyond, in_words
from triaxcal.calibration import SPOILED, UNKNOWN_HISTORY, Calibration, PoseResult
from triaxcal.conditions import of_unknown_history
from triaxcal.outliers import Spoiled, not_as_foretold, spoiled
from triaxcal.poses.pose import Pose
from triaxcal.problem import Problem, State, linearise, solve
from triaxcal.pure_error import of_both, pose_dof, pure_error_dof

SPOILED_ROUNDS = 4


def spoiled_among(problem: Problem, state: State, poses: Sequence[Pose]) -> Spoiled:
    """Indices of spoiled poses, from the fit to all. Sought anew without those found, until the same are found again:
    a pose spoiled by a thousand times its noise bends the fit so far that linear reckoning is off.

    What the others show beside their noise, all are taken to have: by the noise alone the quietest would look spoiled.
    """
    own, together = pose_dof(poses), pure_error_dof(poses)
    dof, pure, judged, found = own, together, problem, Spoiled()
    for _ in range(SPOILED_ROUNDS):
        r, J, s = linearise(judged, state)
        again = spoiled(r / s, J / s[:, None], dof, pure)
        if again.rows == found.rows:
            return again
        found = again
        rest: Ints = np.delete(np.arange(len(poses)), found.rows)
        others, left = problem.only(rest), len(rest) - len(state.theta)
        state = solve(others, state, state.effects)
        judged = replace(problem, excess=Beyond.shown(linearise(others, state), len(rest), left, together).excess_g)
        share = judged.excess**2 / linearise(judged, state)[2] ** 2
        dof, pure = of_both(share, left, own), float(of_both(share.mean(), left, together))
    return found


def of_another_history(
    problem: Problem, state: State, poses: Sequence[Pose], aside: tuple[int, ...]
) -> tuple[int, ...]:
    """Poses, besides those ``aside``, that are not as if the unit had rested there before; what was is not known."""
    if not (unknown := set(of_unknown_history(poses, state.effects)) - set(aside)):
        return ()
    rest: Ints = np.delete(np.arange(len(poses)), aside)
    problem = problem.only(rest)
    r, J, s = linearise(problem, solve(problem, state, state.effects))
    rows = [k for k, i in enumerate(rest) if i in unknown]
    found = not_as_foretold(r / s, J / s[:, None], pure_error_dof([poses[i] for i in rest]), rows)
    return tuple(int(rest[k]) for k in found)


def with_faulty(calibration: Calibration, poses: Sequence[Pose]) -> Calibration:
    """A calibration from the sound ones of ``poses`` with the faulty ones among its results, and a warning."""
    faulty = tuple(i for i, p in enumerate(poses) if p.fault)
    if not faulty:
        return calibration
    faults = ", ".join(f"the pose at {poses[i].at} ({poses[i].fault})" for i in faulty)
    warning = f"left out, as the outputs did not follow the acceleration: {faults}"
    results, _ = _among(calibration, poses, {i: poses[i].fault for i in faulty})
    return replace(calibration, poses=results, warnings=(warning, *calibration.warnings))


def _among(
    calibration: Calibration, poses: Sequence[Pose], reasons: Mapping[int, str]
) -> tuple[tuple[PoseResult, ...], list[PoseResult]]:
    """The results of a calibration with those of further poses left out among them, by rows of all; and these."""
    u = np.array([p.mean for p in poses])
    conditioned = calibration.conditions_of(poses)
    length, by_u = calibration.sensor.magnitude(u, conditioned)
    a = calibration.sensor.specific_force(u, conditioned)
    results, added = list(calibration.poses), []
    for i, reason in sorted(reasons.items()):
        noise = float(np.sqrt(by_u[i] @ poses[i].covariance @ by_u[i]))
        error = float(np.hypot(noise, calibration.excess_g))
        miss = float(length[i] - calibration.reference)
        added.append(PoseResult(poses[i], a[i] / np.linalg.norm(a[i]), miss, noise, miss / error, 0.0, reason, error))
        results.insert(i, added[-1])
    return tuple(results), added


def with_aside(calibration: Calibration, poses: Sequence[Pose], rows: Sequence[int], verdict: Spoiled) -> Calibration:
    """The calibration with the poses left out among its results, in order of time, and warnings that name them."""
    unknown = of_unknown_history(poses, [e for e, _ in calibration.sensor.effects])
    results, added = _among(calibration, poses, {i: UNKNOWN_HISTORY if i in unknown else SPOILED for i in rows})
    names = [(p.left_out, f"the pose at {p.pose.at} ({p.studentized:+.0f} standard errors)") for p in added]
    excused, others = (", ".join(n for why, n in names if why == reason) for reason in (UNKNOWN_HISTORY, SPOILED))
    warnings = [f"left out, as what was before it is not known: {excused}"] if excused else []
    warning = f"left out as spoiled: {others}"
    if verdict.doubtful:
        warning += (
            "; the noise inside the poses says so, while the other residuals leave it open whether all poses come "
            "back less well than that: the standard errors allow for both"
        )
        if calibration.excess_g:
            warning += f", {in_words(calibration)}"
    warnings += [warning] if others else []
    return replace(calibration, poses=results, warnings=(*warnings, *calibration.warnings))


def with_rivals(calibration: Calibration, poses: Sequence[Pose], verdict: Spoiled) -> Calibration:
    """The calibration with a warning of sets of poses one of which may be spoiled, where nobody can tell which."""
    if not verdict.rivals:
        return calibration
    sets = " or ".join(" and ".join(poses[i].at for i in rows) for rows in verdict.rivals)
    warning = (
        f"the residuals look as if poses were spoiled ({sets}: these cannot be told from each other), or as if "
        "something else acts; none is left out"
    )
    return replace(calibration, warnings=(warning, *calibration.warnings))
