"""Sequential design: the next pose is the one that lowers the uncertainty of |a|
most."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.model.directions import Direction, cube_directions, linear_design
from triaxcal.model.sensor import LINEAR

LEBEDEV = {1: 1 / 21, 2: 4 / 105, 3: 9 / 280}
"""Weight of a face, an edge and a vertex of the cube in the mean over the sphere of a
polynomial up to the seventh degree (Lebedev 1976). The variance of |a| is one of the
fourth, and equal candidates stay equal."""
WEAK = 1e-6
"""Weight of the prior of the nine parameters, in poses: fewer than nine poses leave
some of them open, and the design is regular all the same."""
EQUAL = 6
"""Decimals of the logarithm to which two uncertainties are equal: the last digits
depend on the processor."""


def magnitude_error(up: Floats) -> float:
    """Standard error of |a| by the nine parameters, rms over the sphere, in standard
    errors of one pose, for poses of equal noise in the directions ``up`` (n,3).

    It is the component `noise` of a budget. Infinite for a singular set.
    """
    rows = linear_design(up, up)
    if len(rows) < LINEAR or np.linalg.svd(rows, compute_uv=False)[-1] < 1e-6:
        return float("inf")
    return float(np.sqrt(np.trace(_sphere() @ np.linalg.inv(rows.T @ rows))))


def best_first(up: Floats, candidates: Sequence[Direction]) -> list[Direction]:
    """The candidates in the order in which they suit as the next pose after those in
    the directions ``up`` (n,3): by the uncertainty of |a| with each of them, rms over
    the sphere; equal ones in the given order.

    All poses count as equally noisy. Neither readings nor residuals enter.
    """
    if not candidates:
        return []
    taken, rows = linear_design(up, up), _rows(candidates)
    inverse = np.linalg.inv(taken.T @ taken + WEAK * np.eye(LINEAR))
    # Rank-one update: tr S (M + x xᵀ)⁻¹ = tr S M⁻¹ − xᵀ M⁻¹ S M⁻¹ x / (1 + xᵀ M⁻¹ x).
    spread = inverse @ _sphere() @ inverse
    lowered = np.einsum("ci,ij,cj->c", rows, spread, rows) / (1 + np.einsum("ci,ij,cj->c", rows, inverse, rows))
    left = float(np.trace(_sphere() @ inverse)) - lowered
    order = np.argsort(np.round(np.log(np.maximum(left, 1e-300)), EQUAL), kind="stable")
    return [candidates[i] for i in order]


def _rows(candidates: Sequence[Direction]) -> Floats:
    up = np.array([v for _, v in candidates])
    return linear_design(up, up)


@cache
def _sphere() -> Floats:
    """(9,9) mean over the sphere of x xᵀ, for the derivatives x of |a| by the nine
    parameters."""
    up = np.array([v for _, v in cube_directions()])
    weights = np.array([LEBEDEV[int(np.count_nonzero(v))] for v in up])
    rows = linear_design(up, up)
    return np.asarray((rows * weights[:, None]).T @ rows)
