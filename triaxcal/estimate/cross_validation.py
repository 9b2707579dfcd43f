"""How well a fit predicts the poses that it did not see."""

from __future__ import annotations

import numpy as np

from triaxcal.arrays import Ints, rms
from triaxcal.estimate.likelihood import Problem, State, linearise, linearise_all, solve

STRAIGHT = 1e-4
"""Steps of the scaled parameters up to which the fit is straight, to about this
share of the step."""


def cross_validated(problem: Problem, state: State) -> float | None:
    """rms of each pose's |a| − reference under a fit to all the others; None
    where a pose alone carries a parameter.

    ``state`` is at the minimum. What leaving a pose out moves is exact for a
    linear problem; where that is so far that the curvature could show, the rest
    is fitted again from there.
    """
    r, J, s = linearise_all(problem, state)
    n = len(problem.u)
    if len(r) <= len(state.theta):
        return None
    norms = np.maximum(np.linalg.norm(J / s[:, None], axis=0), 1e-300)
    weighted = J / s[:, None] / norms
    gain = np.linalg.pinv(weighted, rcond=1e-14)
    # By pose (n,k): its mean, and what else it tells, which is excluded with
    # it.
    of_pose = np.arange(len(r)).reshape(-1, n).T
    hat = np.einsum("nkp,pnl->nkl", weighted[of_pose], gain[:, of_pose])
    free = np.eye(of_pose.shape[1]) - hat
    if np.linalg.eigvalsh(free).min() < 1e-6:
        return None
    misses = np.linalg.solve(free, (r / s)[of_pose][..., None])[..., 0]
    moved = np.einsum("pnk,nk->np", gain[:, of_pose] / norms[:, None, None], misses)
    misses = misses[:, 0] * s[:n]
    for i in np.flatnonzero(np.abs(moved).max(axis=1) > STRAIGHT):
        rest: Ints = np.delete(np.arange(n), i)
        without = solve(problem.only(rest), State(state.theta + moved[i], state.effects), state.effects, steps=2)
        misses[i] = linearise(problem.only(slice(i, i + 1)), without, jacobian=False)[0][0]
    return rms(misses)
