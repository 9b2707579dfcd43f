"""Standard errors of what the fit holds fixed: the shapes of effects (`Effect.shape`), which the search has chosen."""

from __future__ import annotations

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.part import whole
from triaxcal.problem import Problem, State, everything

NODES = 8
"""Between two of the values that the search tries the likelihood is looked at so often."""
UNLIKELY = 25.0
"""Chi-square over its minimum beyond which a value, and what is next to it, needs no closer look."""


def shape_errors(
    problem: Problem, state: State, columns: Floats, thousandths: Floats, inflation: float
) -> dict[str, float]:
    """By "effect.name"; none of a shape that moves nothing at all.

    ``columns`` (n,m) are the derivatives of the residuals by the shapes, ``thousandths`` (m,) the standard errors by
    these, in thousandths of the shapes' values, raised by the ``inflation`` already.
    """
    out = {}
    named = [(i, name, value) for i, e in enumerate(state.effects) for name, (value, _) in e.shape.items()]
    for (i, name, value), column, thousandth in zip(named, columns.T, thousandths, strict=True):
        error = _by_likelihood(problem, state, i, name, inflation)
        if error is None and np.any(column):
            error = 1e-3 * abs(value) * float(thousandth)
        if error is not None:
            out[f"{state.effects[i].name}.{name}"] = error
    return out


def _by_likelihood(problem: Problem, state: State, i: int, name: str, inflation: float) -> float | None:
    """The rms distance from the shape's value to what it may be, by its profile likelihood over all that the search
    tries: of a step between two poses the rectangular distribution over the time between them (JCGM 100, 4.3.7), with
    shoulders where it may have been inside a pose, and other gaps where the directions of the poses hide it. None where
    the likelihood is nowhere flat: there its curvature tells."""
    effect = state.effects[i]
    value = effect.shape[name][0]
    grid = np.unique([value, *(v.shape[name][0] for v in whole(effect).variants(problem.conditions))])
    coarse = np.array([_left(problem, state, i, name, float(v)) for v in grid]) / inflation**2
    likely = coarse < np.nanmin(coarse) + UNLIKELY
    cells = [k for k in range(len(grid) - 1) if likely[k] or likely[k + 1]]
    if not cells:
        return None
    # The middles of equal parts, so that each stands for as much time as any other of its cell.
    middles = (np.arange(NODES) + 0.5) / NODES
    x = np.concatenate([grid[k] + (grid[k + 1] - grid[k]) * middles for k in cells])
    stands_for = np.concatenate([np.full(NODES, (grid[k + 1] - grid[k]) / NODES) for k in cells])
    chi2 = np.array([_left(problem, state, i, name, float(v)) for v in x]) / inflation**2
    if len(np.unique(chi2)) == len(chi2):
        return None
    weight = stands_for * np.exp((np.nanmin(chi2) - chi2) / 2)
    return float(np.sqrt(np.nansum(weight * (x - value) ** 2) / np.nansum(weight)))


def _left(problem: Problem, state: State, i: int, name: str, value: float) -> float:
    """Chi-square with another value of a shape, everything else fitted again, in linear reckoning."""
    effect = state.effects[i]
    other = effect.shaped({k: v for k, (v, _) in effect.shape.items()} | {name: value})
    with np.errstate(over="ignore", invalid="ignore"):
        r, J, s = everything(problem, State(state.theta, (*state.effects[:i], other, *state.effects[i + 1 :])))
        y = r / s
        q, _ = np.linalg.qr(J / s[:, None])
        return float(np.sum((y - q @ (q.T @ y)) ** 2))
