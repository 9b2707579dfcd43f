"""Adjusted least squares for an ellipsoid: moments corrected for noise, and the
noise at which they fit one exactly.

Markovsky, Kukush and Van Huffel 2004, Numer. Math. 98:177. Everything here is
in the scaled units of `triaxcal.inputs.turning.moments.Summary`, whose
monomials have values of the order of one.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import scipy

from triaxcal.arrays import Floats
from triaxcal.errors import Refused
from triaxcal.estimate.ellipsoid import coefficients
from triaxcal.inputs.turning.moments import MONOMIALS, Summary

ARITHMETIC = 1e-15
"""Variance that the arithmetic leaves uncertain."""


class NoEllipsoid(Refused):
    """The samples lie on none."""

    def __init__(self) -> None:
        super().__init__(
            "the samples lie on no ellipsoid: the unit felt accelerations besides gravity, or turned about too few "
            "axes; turn it more slowly, so that every side is up at some time"
        )


class DirectionsLacking(Refused):
    """They cannot carry nine parameters; ``dilution`` by how much, where that
    is known, and its limit."""

    def __init__(self, dilution: tuple[float, float] | None = None) -> None:
        by = "" if dilution is None else " (dilution {:.3g}, limit {:g})".format(*dilution)
        super().__init__(
            f"the directions of the turning unit cannot carry nine parameters{by}: turn the unit about more axes, so "
            "that every side is up at some time"
        )


@dataclass(frozen=True)
class Ellipsoid:
    """``|T x − o| = 1``, T (3,3) upper triangular with positive diagonal;
    ``variance`` (3,) of the noise of x."""

    T: Floats
    o: Floats
    variance: Floats

    def coefficients(self, held: Summary, reference: float) -> tuple[Floats, Floats, Floats]:
        """Scale factor, misalignment and bias in the units of output and
        reference, all signs plus."""
        return coefficients_of(self.T, self.o, held, reference)


def coefficients_of(T: Floats, o: Floats, held: Summary, reference: float) -> tuple[Floats, Floats, Floats]:
    return coefficients(T / held.half * reference, held.middle + held.half * np.linalg.solve(T, o))


# Hermite polynomials undo what Gaussian noise of variance v does to a power:
# coefficients of x^(n-2m) v^m.
_UNDO = {0: (1.0,), 1: (1.0,), 2: (1.0, -1.0), 3: (1.0, -3.0), 4: (1.0, -6.0, 3.0)}


def _undoing() -> list[tuple[tuple[int, int], tuple[int, int], tuple[int, ...], float]]:
    """Terms of the correction: entry corrected, entry that holds the lower
    moment, powers of the variances, factor."""
    at: dict[tuple[int, ...], tuple[int, int]] = {}
    for (i, left), (j, right) in itertools.product(enumerate(MONOMIALS), repeat=2):
        at.setdefault(tuple(p + q for p, q in zip(left, right, strict=True)), (i, j))
    out = []
    for (i, left), (j, right) in itertools.product(enumerate(MONOMIALS), repeat=2):
        powers = tuple(p + q for p, q in zip(left, right, strict=True))
        for m in itertools.product(*(range(len(_UNDO[p])) for p in powers)):
            factor = float(np.prod([_UNDO[p][n] for p, n in zip(powers, m, strict=True)]))
            out.append(((i, j), at[tuple(p - 2 * n for p, n in zip(powers, m, strict=True))], m, factor))
    return out


_TERMS = _undoing()
_TO = tuple(np.array([t[0] for t in _TERMS]).T)  # entries that are corrected
_FROM = tuple(np.array([t[1] for t in _TERMS]).T)  # entries that hold the lower moments
_POWERS = np.array([t[2] for t in _TERMS])  # of the variances of the axes
_FACTOR = np.array([t[3] for t in _TERMS])  # products of the coefficients of `_UNDO`


def corrected(moments: Floats, variance: Floats) -> Floats:
    """Moments (…,10,10) of the noiseless samples, for noise of ``variance``
    (3,)."""
    terms = _FACTOR * np.prod(variance**_POWERS, axis=1) * moments[..., _FROM[0], _FROM[1]]
    out = np.zeros(moments.shape)
    np.add.at(out, (..., *_TO), terms)
    return out


def fitted(held: Summary, shape: Floats) -> Ellipsoid:
    """The ellipsoid for noise whose variances are as ``shape`` (3,); how large,
    follows.

    Raises Refused where there is none.
    """
    mean = held.mean()
    return _ellipsoid(mean, noise(mean, shape) * shape)


def noise(mean: Floats, shape: Floats) -> float:
    """The noise at which the corrected moments first become singular, as a
    multiple of ``shape`` (3,); 0 where the arithmetic cannot tell it from
    none."""
    unit = shape / np.max(shape)
    none = corrected(mean, 0 * unit)
    once, twice = corrected(mean, unit) - none, corrected(mean, 2 * unit) - none
    second = twice / 2 - once  # the correction is a polynomial of the second degree
    first = once - second

    def smallest(variance: float) -> float:
        return float(np.linalg.eigvalsh(none + variance * first + variance**2 * second)[0])

    if smallest(0.0) <= ARITHMETIC:
        return 0.0
    low, high = 0.0, ARITHMETIC
    while smallest(high) > 0:
        low, high = high, high * 4
        if high > 1:
            raise NoEllipsoid
    return float(scipy.optimize.brentq(smallest, low, high, xtol=1e-18, rtol=1e-12)) / float(np.max(shape))


def _ellipsoid(mean: Floats, variance: Floats) -> Ellipsoid:
    values, vectors = np.linalg.eigh(corrected(mean, variance))
    if values[1] < 1e-9 * values[-1]:
        raise DirectionsLacking
    q = dict(zip(MONOMIALS, vectors[:, 0], strict=True))
    B = np.array(
        [
            [q[2, 0, 0], q[1, 1, 0] / 2, q[1, 0, 1] / 2],
            [q[1, 1, 0] / 2, q[0, 2, 0], q[0, 1, 1] / 2],
            [q[1, 0, 1] / 2, q[0, 1, 1] / 2, q[0, 0, 2]],
        ]
    )
    linear = np.array([q[1, 0, 0], q[0, 1, 0], q[0, 0, 1]])
    try:
        centre = -0.5 * np.linalg.solve(B, linear)
        T = np.linalg.cholesky(B / (centre @ B @ centre - q[0, 0, 0])).T
    except np.linalg.LinAlgError:
        raise NoEllipsoid from None
    return Ellipsoid(T, T @ centre, variance)


def as_monomials(Q: Floats) -> Floats:
    """(10,): the quadratic form ``(x, 1)ᵀ Q (x, 1)``, Q (4,4), as coefficients
    of the monomials."""
    out = np.zeros(len(MONOMIALS))
    for row, powers in enumerate(MONOMIALS):
        axes = [axis for axis in range(3) for _ in range(powers[axis])]
        i, j = (*axes, 3, 3)[:2]
        out[row] = Q[i, j] if i == j else Q[i, j] + Q[j, i]
    return out


def design(e: Ellipsoid) -> Floats:
    """(9,10): derivative of |T x − o|²/2 by the entries of T (row by row) and
    o, as coefficients of the monomials."""
    forms = np.zeros((9, 4, 4))
    for n, (i, j) in enumerate(itertools.combinations_with_replacement(range(3), 2)):
        forms[n, j] = *e.T[i], -e.o[i]  # a_i x_j
    for i in range(3):
        forms[6 + i, 3] = *-e.T[i], e.o[i]  # −a_i
    return np.array([as_monomials(form) for form in forms])


def coefficients_by_entries(e: Ellipsoid, held: Summary, reference: float) -> Floats:
    """(9,9) derivative of scale factor, misalignment and bias by the entries of
    T and o, by differences."""
    rows, columns = np.triu_indices(3)
    start = np.concatenate([e.T[rows, columns], e.o])

    def of(p: Floats) -> Floats:
        T = np.zeros((3, 3))
        T[rows, columns] = p[:6]
        return np.concatenate(coefficients_of(T, p[6:], held, reference))

    step = 1e-6
    return np.stack([(of(start + h) - of(start - h)) / (2 * step) for h in step * np.eye(9)], axis=1)
