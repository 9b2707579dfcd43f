"""A smooth term that describes what no effect explains, and explains nothing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from math import factorial

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import TIME, Coefficient, Effect

KINDS = {"odd": 3, "even": 4, "time": 4}
Terms = tuple[tuple[float, int, int, int], ...]
"""A polynomial: (factor, powers of x, y, z)."""


@dataclass(frozen=True)
class Empirical(Effect):
    """``e = s f``: the magnitude is off by the share f, as a smooth function of the direction ("odd" and "even": the
    solid harmonics of degree 3 and 4 on the unit sphere, the lowest that the nine parameters do not absorb), or of the
    time ("time": a polynomial of degree 4 in thousands of seconds).
    """

    kind: str = "odd"
    name: str = "empirical"
    remedy: str = "This describes the poses that it was fitted to, and no others: find the cause."

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        if self.kind == "time":
            return tuple(Coefficient(f"time_{d}", f"1/ks{'⁰¹²³⁴'[d]}" if d > 1 else "1/ks") for d in range(1, 5))
        return tuple(Coefficient(f"{self.kind}_{k + 1}", "1") for k in range(len(harmonics(KINDS[self.kind]))))

    @property
    def needs(self) -> tuple[str, ...]:
        return (TIME,) if self.kind == "time" else ()

    @property
    def forms(self) -> tuple[Effect, ...]:
        return tuple(Empirical(kind) for kind in KINDS)

    def basis(self, s: Floats, conditions: Mapping[str, Floats]) -> Floats:
        if self.kind == "time":
            powers = (conditions[TIME][:, None] / 1000) ** np.arange(1, 5)
            return np.asarray(s[:, :, None] * powers[:, None, :])
        values, _ = self._on_sphere(s)
        return np.asarray(s[:, :, None] * values[:, None, :])

    def slope(self, s: Floats, conditions: Mapping[str, Floats]) -> Floats:
        if self.kind == "time":
            powers = (conditions[TIME][:, None] / 1000) ** np.arange(1, 5)
            return np.asarray(np.eye(3)[None, :, :, None] * powers[:, None, None, :])
        values, gradient = self._on_sphere(s)
        return np.asarray(
            np.eye(3)[None, :, :, None] * values[:, None, None, :] + s[:, :, None, None] * gradient[:, None]
        )

    def _on_sphere(self, s: Floats) -> tuple[Floats, Floats]:
        """Harmonics (n,p) of the direction of s, and their gradient (n,3,p) by s."""
        degree = KINDS[self.kind]
        length = np.linalg.norm(s, axis=1)
        values = np.stack([_value(p, s) for p in harmonics(degree)], axis=1)
        gradient = np.stack(
            [np.stack([_value(_derived(p, i), s) for i in range(3)], axis=1) for p in harmonics(degree)], axis=2
        )
        whole = length[:, None] ** degree
        inward = degree * values[:, None, :] * s[:, :, None] / (length[:, None] ** (degree + 2))[:, :, None]
        return values / whole, gradient / whole[:, :, None] - inward


@cache
def harmonics(degree: int) -> tuple[Terms, ...]:
    """The 2d + 1 harmonic polynomials that begin with p = x^i y^j, Σ (−1)^k z^2k Δ^k p / (2k)!, or with z p, alike."""
    out = []
    for first in (0, 1):
        for i in range(degree - first + 1):
            plane: dict[tuple[int, int], float] = {(i, degree - first - i): 1.0}
            terms = []
            for k in range(degree // 2 + 1):
                power = 2 * k + first
                terms += [((-1) ** k * c / factorial(power), a, b, power) for (a, b), c in plane.items() if c]
                plane = _laplace(plane)
            out.append(tuple(terms))
    return tuple(out)


def _laplace(plane: Mapping[tuple[int, int], float]) -> dict[tuple[int, int], float]:
    out: dict[tuple[int, int], float] = {}
    for (a, b), c in plane.items():
        if a > 1:
            out[a - 2, b] = out.get((a - 2, b), 0.0) + c * a * (a - 1)
        if b > 1:
            out[a, b - 2] = out.get((a, b - 2), 0.0) + c * b * (b - 1)
    return out


def _value(terms: Terms, s: Floats) -> Floats:
    return np.asarray(sum((c * s[:, 0] ** i * s[:, 1] ** j * s[:, 2] ** k for c, i, j, k in terms), np.zeros(len(s))))


def _derived(terms: Terms, axis: int) -> Terms:
    out = []
    for c, *powers in terms:
        if powers[axis]:
            lower = [p - (n == axis) for n, p in enumerate(powers)]
            out.append((c * powers[axis], lower[0], lower[1], lower[2]))
    return tuple(out)
