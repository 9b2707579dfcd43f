"""What a set of poses can show of an effect: the part of it that the model
cannot absorb."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects import CATALOGUE
from triaxcal.effects.contract import TIME, Effect
from triaxcal.model.directions import linear_design
from triaxcal.planning.clock import in_plan
from triaxcal.planning.design import VISIBLE, combinations, profile_times, radial


@dataclass(frozen=True)
class Sight:
    """What a plan shows of one effect: ``visible`` of its ``of`` independent
    coefficients.

    ``hidden`` are the combinations of coefficients that do not show, name →
    weight, unit vectors.
    """

    visible: int
    of: int
    hidden: tuple[Mapping[str, float], ...]


def sight(directions: Floats, effect: Effect, held: Mapping[str, Floats] | None = None) -> Sight:
    """What poses in these directions (n,3), in this order and evenly in time,
    show of an effect by itself.

    Every channel is taken to move freely, but for those ``held`` (n,).
    """
    n, effect = len(directions), in_plan(effect)
    rng = np.random.default_rng(0)
    covariates = {TIME: profile_times(n)} | {c: rng.standard_normal(n) for c in effect.needs if c != TIME}
    covariates |= {c: v for c, v in (held or {}).items() if c in covariates}
    seen, hidden = combinations(
        linear_design(directions, directions), radial([effect], directions, covariates), VISIBLE
    )
    names = [c.name for c in effect.coefficients]
    named = tuple({k: float(w) for k, w in zip(names, v, strict=True) if abs(w) > 1e-9} for v in _plainly(hidden.T))
    return Sight(seen.shape[1], len(names), named)


def _plainly(hidden: Floats) -> Floats:
    """The same space of combinations (k,p), with as many weights zero as the
    reduced echelon form has."""
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
    """Names of the effects that poses in these directions (n,3) cannot show in
    full, were every channel moving freely."""
    sights = [sight(directions, e) for e in catalogue]
    return [e.name for e, s in zip(catalogue, sights, strict=True) if s.visible < s.of]
