"""Shapes of effects (a time constant, the moment of a step) by the minimum of chi-square, between those tried."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import scipy

from triaxcal.effects.contract import Effect, reshaped
from triaxcal.effects.part import whole
from triaxcal.problem import Problem
from triaxcal.search.candidates import Candidate, Ground

LOWER = 0.1
"""By how much chi-square has to fall for another shape than the grid's."""
DIGITS = 4
"""A shape is known to a few per cent at best; more digits would only hang on the processor."""


def refined(
    effects: Sequence[Effect], problem: Problem, cost: Callable[[Sequence[Effect]], float]
) -> tuple[Effect, ...]:
    """The same effects, each shape at the minimum of ``cost`` between its neighbours on the grid."""
    out = list(effects)
    for i in range(len(out)):
        out[i] = _best_shape(out[i], problem, lambda e, i=i: cost([*out[:i], e, *out[i + 1 :]]))  # type: ignore[misc]
    return tuple(out)


def sharpened(ground: Ground, candidate: Candidate) -> Candidate | None:
    """The candidate with its shape where it gains most, in linear reckoning; None where the grid has it already."""

    def cost(effect: Effect) -> float:
        basis, _ = ground.shown(ground.columns(effect))
        return -float(np.sum((basis.T @ ground.y) ** 2))

    effect = _best_shape(candidate.effect, ground.problem, cost)
    if effect is candidate.effect:
        return None
    basis, _ = ground.shown(ground.columns(effect))
    return Candidate(effect, basis, candidate.tries) if basis.shape[1] == candidate.rank else None


def _best_shape(effect: Effect, problem: Problem, cost: Callable[[Effect], float]) -> Effect:
    for name, (value, _) in effect.shape.items():
        grid = sorted({v.shape[name][0] for v in whole(effect).variants(problem.conditions) if name in v.shape})
        low = max((g for g in grid if g < value * (1 - 1e-9)), default=value)
        high = min((g for g in grid if g > value * (1 + 1e-9)), default=value)
        if not low < high:
            continue

        def of(x: float, name: str = name, effect: Effect = effect) -> Effect:
            return reshaped(effect, name, x)

        found = scipy.optimize.minimize_scalar(
            lambda x, of=of: cost(of(x)), bounds=(low, high), method="bounded", options={"xatol": 1e-3 * high}
        )
        # A step between two poses is anywhere between them; its middle is as good as any, and reads better.
        if found.fun < cost(effect) - LOWER:
            effect = of(float(f"{found.x:.{DIGITS}g}"))
    return effect
