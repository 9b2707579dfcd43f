"""The closed form: the ellipsoid on which a resting unit's outputs lie.

Paper, eq. 11–20; Li and Griffiths 2004.

Written after the corrections of the printed formulas: undoubled cross terms
with the constraint matrix that goes with them, normalisation by ``cᵀBc − β₁₀``,
the upper Cholesky factor, and each axis scaled first, so that axes of very
different sensitivity are fitted too.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg

from triaxcal.arrays import Floats
from triaxcal.errors import Refused

# 4 J − I² = 1 for β₁ = (a, b, c, d, e, f) of a x² + b y² + c z² + d xy + e yz +
# f xz.
_CONSTRAINT = np.zeros((6, 6))
_CONSTRAINT[:3, :3] = 1.0 - 2.0 * np.eye(3)
_CONSTRAINT[range(3, 6), range(3, 6)] = -1.0


def closed_form(u: Floats) -> tuple[Floats, Floats]:
    """``A`` (3,3) upper triangular with positive diagonal and ``c`` (3,) such
    that ``|A (u − c)| = 1``.

    ``u`` (n,3), at least nine. Raises Refused where the outputs lie on no
    ellipsoid.
    """
    middle = (u.max(axis=0) + u.min(axis=0)) / 2
    half = (u.max(axis=0) - u.min(axis=0)) / 2
    if len(u) < 9 or not np.all(half > 0):
        raise Refused(f"{len(u)} poses cannot carry nine parameters: at least nine that differ in every axis")
    x, y, z = ((u - middle) / half).T
    D1 = np.stack([x * x, y * y, z * z, x * y, y * z, x * z], axis=1)
    D2 = np.stack([x, y, z, np.ones_like(x)], axis=1)
    S12, S22 = D1.T @ D2, D2.T @ D2
    try:
        T = np.linalg.solve(S22, S12.T)
        values, vectors = scipy.linalg.eig(np.linalg.solve(_CONSTRAINT, D1.T @ D1 - S12 @ T))
    except np.linalg.LinAlgError:
        raise Refused("the poses lie in one plane or on one point; no ellipsoid goes through them") from None
    beta1 = vectors[:, int(np.argmax(values.real))].real
    beta2 = -T @ beta1
    a, b, c, d, e, f = beta1
    B = np.array([[a, d / 2, f / 2], [d / 2, b, e / 2], [f / 2, e / 2, c]])
    try:
        centre = -0.5 * np.linalg.solve(B, beta2[:3])
        H = B / (centre @ B @ centre - beta2[3])
        A = np.linalg.cholesky(H).T
    except np.linalg.LinAlgError:
        raise Refused("the poses lie on no ellipsoid: too few, in one plane or hemisphere, or not still") from None
    return A / half, middle + half * centre


def coefficients(A: Floats, c: Floats) -> tuple[Floats, Floats, Floats]:
    """Scale factor (3,), misalignment (ax, ay, az), bias (3,) from ``A`` and
    ``c`` (eq. 4, 5)."""
    KR = np.linalg.inv(A)
    k = np.diag(KR).copy()
    return k, np.array([KR[1, 2] / k[1], KR[0, 2] / k[0], KR[0, 1] / k[0]]), c / k
