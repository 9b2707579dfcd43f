"""What a set of poses can show of an effect: the part of it that the model cannot absorb."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects import CATALOGUE
from triaxcal.effects.contract import TIME, Effect
from triaxcal.plan.clock import in_plan
from triaxcal.plan.design import combinations, profile_times, radial
from triaxcal.plan.directions import linear_design
from triaxcal.problem import Problem, State, linearise

VISIBLE = 0.02
"""An effect is visible when the part of it that the model cannot absorb is at least this share of it."""


def is_visible(problem: Problem, state: State, effect: Effect, given: Sequence[Effect] = ()) -> bool:
    """Whether every coefficient of an effect shows beside the model and the effects given."""
    return len(projected(problem, state, effect, given)) == len(effect.coefficients)


def _columns(problem: Problem, state: State, effects: Sequence[Effect]) -> tuple[Floats, Floats, Floats]:
    """Weighted residuals, weighted linear columns, and those of the effects, all at ``state``."""
    r, J, s = linearise(problem, state.extended(effects))
    at = len(state.theta)
    return r / s, J[:, :at] / s[:, None], J[:, at:] / s[:, None]


def projected(problem: Problem, state: State, effect: Effect, given: Sequence[Effect] = ()) -> Floats:
    """Orthonormal rows (q,n): the part of an effect that the model, with the effects given, cannot absorb."""
    if any(n not in problem.channel_reference for n in effect.needs):
        return np.empty((0, len(problem.u)))
    _, J, Z = _columns(problem, state, (*given, effect))
    own = len(effect.coefficients)
    J, Z = np.concatenate([J, Z[:, :-own]], axis=1), Z[:, -own:]
    size = np.linalg.norm(Z, axis=0)
    Z = Z[:, size > 1e-9]  # a coefficient whose column is zero does not show; others of its effect may
    if not Z.size:
        return np.empty((0, len(problem.u)))
    size = size[size > 1e-9]
    norms = np.maximum(np.linalg.norm(J, axis=0), 1e-300)
    rest = Z / size - J / norms @ np.linalg.lstsq(J / norms, Z / size, rcond=1e-12)[0]
    _, singular, rows = np.linalg.svd(rest.T @ rest)
    kept = np.sqrt(singular) > VISIBLE
    basis = rest @ rows[kept].T
    return np.asarray((basis / np.sqrt(singular[kept])).T)


@dataclass(frozen=True)
class Sight:
    """What a plan shows of one effect: ``visible`` of its ``of`` independent coefficients.

    ``hidden`` are the combinations of coefficients that do not show, name → weight, unit vectors.
    """

    visible: int
    of: int
    hidden: tuple[Mapping[str, float], ...]


def sight(directions: Floats, effect: Effect, held: Mapping[str, Floats] | None = None) -> Sight:
    """What poses in these directions (n,3), in this order and evenly in time, show of an effect by itself.

    Every channel is taken to move freely, but for those ``held`` (n,).
    """
    n, effect = len(directions), in_plan(effect)
    rng = np.random.default_rng(0)
    conditions = {TIME: profile_times(n)} | {c: rng.standard_normal(n) for c in effect.needs if c != TIME}
    conditions |= {c: v for c, v in (held or {}).items() if c in conditions}
    seen, hidden = combinations(
        linear_design(directions, directions), radial([effect], directions, conditions), VISIBLE
    )
    names = [c.name for c in effect.coefficients]
    named = tuple({k: float(w) for k, w in zip(names, v, strict=True) if abs(w) > 1e-9} for v in _plainly(hidden.T))
    return Sight(seen.shape[1], len(names), named)


def _plainly(hidden: Floats) -> Floats:
    """The same space of combinations (k,p), with as many weights zero as the reduced echelon form has."""
    rows = hidden.copy()
    pivots = 0
    for column in range(rows.shape[1]):
        rest = np.abs(rows[pivots:, column])
        if pivots == len(rows) or rest.max(initial=0.0) < 1e-6:
            continue
        k = pivots + int(np.argmax(rest))
        rows[[pivots, k]] = rows[[k, pivots]]
        rows[pivots] /= rows[pivots, column]
        others = np.arange(len(rows)) != pivots
        rows[others] -= np.outer(rows[others, column], rows[pivots])
        pivots += 1
    return np.asarray(rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-300))


def unseen_effects(directions: Floats, catalogue: Sequence[Effect] = CATALOGUE) -> list[str]:
    """Names of the effects that poses in these directions (n,3) cannot show in full, were every channel moving
    freely."""
    sights = [sight(directions, e) for e in catalogue]
    return [e.name for e, s in zip(catalogue, sights, strict=True) if s.visible < s.of]
