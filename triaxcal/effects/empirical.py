"""Non-parametric residual model; no physical meaning."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from math import factorial

import numpy as np

from triaxcal.arrays import Floats, Ints
from triaxcal.effects.contract import TIME, Coefficient, Effect, Meaning

KINDS = {"odd": 3, "even": 4, "time": 4}
"""Degree of each kind: the lowest odd and even ones that the nine parameters do not
absorb; for time a curve with three bends. Higher degrees would follow the noise."""
SMOOTH = "smooth"
DEGREES = (3, 4, 5, 6)
"""Degrees of a smooth function of the direction, without those of the nine
parameters. 26 poses do not show finer ones."""
Terms = tuple[tuple[float, int, int, int], ...]
"""A polynomial: (factor, powers of x, y, z) of each monomial."""
Table = tuple[Ints, Floats]
"""Several polynomials: the powers (m,3) of their monomials, and the factors (m,p) of
each polynomial."""


@dataclass(frozen=True)
class Empirical(Effect):
    """``e = s f``: the magnitude has a relative error f, a smooth function of the
    direction ("odd" and "even": the solid harmonics of degree 3 and 4 on
    the unit sphere, the lowest that the nine parameters do not absorb; "smooth":
    those of degree 3 to 6), or of time ("time": a polynomial of degree 4 in
    thousands of seconds).
    """

    kind: str = "odd"
    name: str = "empirical"
    remedy: str = "This describes the poses that it was fitted to, and no others: find the cause."
    meaning = Meaning(
        clause="a smooth pattern is left that no known effect explains",
        because="It describes what is left in these poses and does not say what makes it.",
        formula="e = s f",
        factors={
            **{f"odd_{k}": "s × harmonic of degree 3" for k in range(1, 8)},
            **{f"even_{k}": "s × harmonic of degree 4" for k in range(1, 10)},
            **{f"degree_{d}_{k}": f"s × harmonic of degree {d}" for d in DEGREES for k in range(1, 2 * d + 2)},
            **{f"time_{d}": f"s ((t − t₀) / 1000 s){p}" for d, p in ((1, ""), (2, "²"), (3, "³"), (4, "⁴"))},
        },
        symbols="f: a smooth function of the direction or of the time",
        reference=("t₀", "t_s"),
    )

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        if self.kind == "time":
            return tuple(Coefficient(f"time_{d}", f"1/ks{'⁰¹²³⁴'[d]}" if d > 1 else "1/ks") for d in range(1, 5))
        if self.kind == SMOOTH:
            return tuple(Coefficient(f"degree_{d}_{k}", "1") for d in DEGREES for k in range(1, 2 * d + 2))
        return tuple(Coefficient(f"{self.kind}_{k + 1}", "1") for k in range(len(harmonics(KINDS[self.kind]))))

    @property
    def needs(self) -> tuple[str, ...]:
        return (TIME,) if self.kind == "time" else ()

    @property
    def forms(self) -> tuple[Effect, ...]:
        return tuple(Empirical(kind) for kind in (*KINDS, SMOOTH))

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        if self.kind == "time":
            powers = (covariates[TIME][:, None] / 1000) ** np.arange(1, 5)
            return np.asarray(s[:, :, None] * powers[:, None, :])
        values, _ = self._of_direction(s)
        return np.asarray(s[:, :, None] * values[:, None, :])

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        if self.kind == "time":
            powers = (covariates[TIME][:, None] / 1000) ** np.arange(1, 5)
            return np.asarray(np.eye(3)[None, :, :, None] * powers[:, None, None, :])
        values, gradient = self._of_direction(s)
        return np.asarray(
            np.eye(3)[None, :, :, None] * values[:, None, None, :] + s[:, :, None, None] * gradient[:, None]
        )

    def _of_direction(self, s: Floats) -> tuple[Floats, Floats]:
        """Harmonics (n,p) of the direction of s, and their gradient (n,3,p) by
        s."""
        degrees = DEGREES if self.kind == SMOOTH else (KINDS[self.kind],)
        each = [_on_sphere(s, degree) for degree in degrees]
        return np.concatenate([v for v, _ in each], axis=1), np.concatenate([g for _, g in each], axis=2)


def _on_sphere(s: Floats, degree: int) -> tuple[Floats, Floats]:
    """Harmonics (n,p) of one degree on the unit sphere at the direction of s (n,3),
    and their gradient (n,3,p) by s."""
    length = np.linalg.norm(s, axis=1)
    # The solid harmonics and their gradient, from the powers of the coordinates.
    value_table, gradient_table = _tables(degree)
    powers = np.cumprod(np.insert(np.repeat(s[:, :, None], degree, axis=2), 0, 1.0, axis=2), axis=2)
    values = _evaluate(value_table, powers)
    gradient = _evaluate(gradient_table, powers).reshape(len(s), 3, -1)
    # Divided by |s| to the degree, which adds a part along s to the gradient.
    scale = length[:, None] ** degree
    inward = degree * values[:, None, :] * s[:, :, None] / (length[:, None] ** (degree + 2))[:, :, None]
    return values / scale, gradient / scale[:, :, None] - inward


@cache
def harmonics(degree: int) -> tuple[Terms, ...]:
    """The 2d + 1 harmonic polynomials of a degree: Σ (−1)^k z^2k Δ^k p / (2k)! of each
    p = x^i y^j, and likewise of each z p."""
    out = []
    for first in (0, 1):  # the power of z in the first monomial
        for i in range(degree - first + 1):
            plane: dict[tuple[int, int], float] = {(i, degree - first - i): 1.0}
            terms = []
            for k in range(degree // 2 + 1):
                power = 2 * k + first
                terms += [((-1) ** k * c / factorial(power), a, b, power) for (a, b), c in plane.items() if c]
                plane = _laplacian(plane)
            out.append(tuple(terms))
    return tuple(out)


def _laplacian(plane: Mapping[tuple[int, int], float]) -> dict[tuple[int, int], float]:
    """Δ of a polynomial in x and y, by powers."""
    out: dict[tuple[int, int], float] = {}
    for (a, b), c in plane.items():
        if a > 1:
            out[a - 2, b] = out.get((a - 2, b), 0.0) + c * a * (a - 1)
        if b > 1:
            out[a, b - 2] = out.get((a, b - 2), 0.0) + c * b * (b - 1)
    return out


@cache
def _tables(degree: int) -> tuple[Table, Table]:
    """The tables of the harmonics, and of their derivatives by x, by y, by z."""
    polynomials = harmonics(degree)
    return _table(polynomials), _table([_derivative(p, axis) for axis in range(3) for p in polynomials])


def _table(polynomials: Sequence[Terms]) -> Table:
    rows = sorted({(i, j, k) for terms in polynomials for _, i, j, k in terms})
    factors = np.zeros((len(rows), len(polynomials)))
    for column, terms in enumerate(polynomials):
        for c, i, j, k in terms:
            factors[rows.index((i, j, k)), column] += c
    return np.array(rows), factors


def _evaluate(table: Table, powers: Floats) -> Floats:
    """Values (n,p) of polynomials at the ``powers`` (n,3,d+1) of the coordinates."""
    (i, j, k), factors = table[0].T, table[1]
    return np.asarray((powers[:, 0, i] * powers[:, 1, j] * powers[:, 2, k]) @ factors)


def _derivative(terms: Terms, axis: int) -> Terms:
    """The derivative of a polynomial by a coordinate."""
    out = []
    for c, *powers in terms:
        if powers[axis]:
            lower = [p - (n == axis) for n, p in enumerate(powers)]
            out.append((c * powers[axis], lower[0], lower[1], lower[2]))
    return tuple(out)
