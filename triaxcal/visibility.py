"""What a set of poses can show of an effect: the part of it that the model cannot absorb."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects import CATALOGUE
from triaxcal.effects.contract import TIME, Effect
from triaxcal.problem import Problem, State, linearise, solve
from triaxcal.sensor import Sensor
from triaxcal.start import problem_of, start
from triaxcal.synthetic import noisy_poses

VISIBLE = 0.02
"""An effect is visible when the part of it that the model cannot absorb is at least this share of it."""


def is_visible(problem: Problem, state: State, effect: Effect, given: Sequence[Effect] = ()) -> bool:
    """Whether every coefficient of an effect shows beside the model and the effects given."""
    return len(projected(problem, state, effect, given)) == len(effect.coefficients)


def _columns(problem: Problem, state: State, effects: Sequence[Effect]) -> tuple[Floats, Floats, Floats]:
    """Weighted residuals, weighted linear columns, and those of the effects, all at ``state``."""
    extended = State(np.concatenate([state.theta, np.zeros(_count(effects))]), (*state.effects, *effects))
    r, J, s = linearise(problem, extended)
    at = len(state.theta)
    return r / s, J[:, :at] / s[:, None], J[:, at:] / s[:, None]


def _count(effects: Sequence[Effect]) -> int:
    return sum(len(e.coefficients) for e in effects)


def projected(problem: Problem, state: State, effect: Effect, given: Sequence[Effect] = ()) -> Floats:
    """Orthonormal rows (q,n): the part of an effect that the model, with the effects given, cannot absorb."""
    if any(n not in problem.channel_reference for n in effect.needs):
        return np.empty((0, len(problem.u)))
    _, J, Z = _columns(problem, state, (*given, effect))
    own = len(effect.coefficients)
    J, Z = np.concatenate([J, Z[:, :-own]], axis=1), Z[:, -own:]
    size = np.linalg.norm(Z, axis=0)
    if not np.all(size > 1e-9):
        return np.empty((0, len(problem.u)))
    norms = np.maximum(np.linalg.norm(J, axis=0), 1e-300)
    rest = Z / size - J / norms @ np.linalg.lstsq(J / norms, Z / size, rcond=1e-12)[0]
    _, singular, rows = np.linalg.svd(rest.T @ rest)
    kept = np.sqrt(singular) > VISIBLE
    basis = rest @ rows[kept].T
    return np.asarray((basis / np.sqrt(singular[kept])).T)


def unseen_effects(directions: Floats, catalogue: Sequence[Effect] = CATALOGUE) -> list[str]:
    """Names of the effects that poses in these directions (n,3) cannot show, were every channel moving freely."""
    rng = np.random.default_rng(0)
    ideal = Sensor(np.ones(3), np.zeros(3), np.zeros(3))
    channels = {n: rng.standard_normal(len(directions)) for e in catalogue for n in e.needs if n != TIME}
    poses = noisy_poses(ideal, directions, 1e-9, rng, channels=channels)
    problem = problem_of(poses)
    state = solve(problem, start(problem, poses, (1, 1, 1)), ())
    return [e.name for e in catalogue if not is_visible(problem, state, e)]
