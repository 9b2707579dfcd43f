"""The model of a triad and its inverse: ``u = K (R a + b + e(R a))`` (paper,
eq. 1; METHOD notation).

``a`` (n,3) specific force in g, in the sensor's own orthogonal frame; ``u``
(n,3) output units; ``R = [[1, az, ay], [0, 1, ax], [0, 0, 1]]`` (eq. 5) with
``misalignment = (ax, ay, az)`` in radians.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import Effect
from triaxcal.errors import Refused

LINEAR = 9
"""Number of linear parameters: scale factor, misalignment and bias, three of each."""

SOLVE_TOLERANCE = 1e-13
"""Relative step, of the reference vector, at which the inverse of a nonlinear model
has converged."""


class Radius(NamedTuple):
    """The magnitude |a| (n,), with ``s`` = R a and ``a`` (n,3) in g.

    ``by_s`` (n,3) is its gradient by s, ``by_v`` (n,3) that by the reading in g
    without the bias, v = K⁻¹ u − b.
    """

    length: Floats
    s: Floats
    a: Floats
    by_s: Floats
    by_v: Floats

    @property
    def by_misalignment(self) -> Floats:
        """(n,3) derivatives by the three angles."""
        by_s, a = self.by_s, self.a
        return -np.stack([by_s[:, 1] * a[:, 2], by_s[:, 0] * a[:, 2], by_s[:, 0] * a[:, 1]], axis=1)

    def by_coefficients(self, effect: Effect, covariates: Mapping[str, Floats]) -> Floats:
        """(n,p) derivatives by the coefficients of an effect, also of one that the
        sensor lacks."""
        return np.asarray(-np.einsum("ni,nip->np", self.by_v, effect.basis(self.s, covariates)))


@dataclass(frozen=True)
class Sensor:
    """Coefficients of one triad.

    ``scale_factor`` (3,) output/g, signed; ``misalignment`` (3,) rad; ``bias``
    (3,) g; ``effects`` pairs each effect with its coefficients (p,), in the
    effect's own order.
    """

    scale_factor: Floats
    misalignment: Floats
    bias: Floats
    effects: Sequence[tuple[Effect, Floats]] = ()

    @property
    def axes(self) -> Floats:
        """R (3,3)."""
        ax, ay, az = self.misalignment
        return np.array([[1.0, az, ay], [0.0, 1.0, ax], [0.0, 0.0, 1.0]])

    @property
    def matrix(self) -> Floats:
        """A = (K R)⁻¹ (3,3), upper triangular: ``a = A (u − c)`` without effects
        (eq. 4)."""
        return np.linalg.inv(self.scale_factor[:, None] * self.axes)

    @property
    def centre(self) -> Floats:
        """c = K b (3,), output units."""
        return self.scale_factor * self.bias

    def moved(self, by: Floats) -> Sensor:
        """The sensor with ``by`` (9+p,) added to scale factors, misalignments, biases
        and the effects' coefficients."""
        at, effects = 9, []
        for effect, q in self.effects:
            effects.append((effect, q + by[at : at + len(q)]))
            at += len(q)
        return Sensor(self.scale_factor + by[:3], self.misalignment + by[3:6], self.bias + by[6:9], tuple(effects))

    def output(self, a: Floats, covariates: Mapping[str, Floats]) -> Floats:
        """u (n,3) for specific force (n,3); ``covariates`` are deviations from
        their references, each (n,)."""
        s = a @ self.axes.T
        return self.scale_factor * (s + self.bias + self.departure(s, covariates))

    def departure(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        """e (n,3) in g."""
        e = np.zeros_like(s)
        for effect, coefficients in self.effects:
            e += effect.basis(s, covariates) @ coefficients
        return e

    def departure_slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        """∂e/∂s (n,3,3)."""
        slope = np.zeros((*s.shape, 3))
        for effect, coefficients in self.effects:
            slope += effect.slope(s, covariates) @ coefficients
        return slope

    def along_axes(self, u: Floats, covariates: Mapping[str, Floats]) -> Floats:
        """s = R a (n,3): the inverse except for the axes, with effects by Newton's
        method.

        Raises Refused if the model has no inverse at a reading. The methods that call
        this one raise it, too.
        """
        v = u / self.scale_factor - self.bias
        if not self.effects:
            return v
        s = v.copy()
        with np.errstate(over="ignore", invalid="ignore"):  # far outside the model it may diverge
            for _ in range(50):
                residual = s + self.departure(s, covariates) - v
                step = _solved(self.departure_slope(s, covariates), residual)
                s -= step
                if np.max(np.abs(step), initial=0.0) <= SOLVE_TOLERANCE * np.max(np.abs(v), initial=1.0):
                    break
        return s

    def specific_force(self, u: Floats, covariates: Mapping[str, Floats]) -> Floats:
        """a (n,3) in g, sensor frame."""
        return np.linalg.solve(self.axes, self.along_axes(u, covariates).T).T

    def up(self, u: Floats, covariates: Mapping[str, Floats]) -> Floats:
        """(n,3) direction of the specific force, unit vectors."""
        a = self.specific_force(u, covariates)
        return np.asarray(a / np.linalg.norm(a, axis=1, keepdims=True))

    def radius(self, u: Floats, covariates: Mapping[str, Floats]) -> Radius:
        """The magnitude of the specific force and its gradients."""
        s = self.along_axes(u, covariates)
        inverse = np.linalg.inv(self.axes)
        a = s @ inverse.T
        length = np.linalg.norm(a, axis=1)
        by_s = by_v = (a / length[:, None]) @ inverse
        if self.effects:
            by_v = _solved(self.departure_slope(s, covariates).transpose(0, 2, 1), by_s)
        return Radius(length, s, a, by_s, by_v)

    def specific_force_and_derivatives(
        self, u: Floats, covariates: Mapping[str, Floats]
    ) -> tuple[Floats, Floats, Floats]:
        """a (n,3), its derivatives by the outputs (n,3,3), and by scale
        factors, misalignments, biases and coefficients (n,3,9+p)."""
        s = self.along_axes(u, covariates)
        inverse = np.linalg.inv(self.axes)
        a = s @ inverse.T
        by_v = inverse @ np.linalg.inv(np.eye(3) + self.departure_slope(s, covariates))
        by_u = by_v / self.scale_factor
        angles = -np.stack([inverse[:, 1] * a[:, 2:3], inverse[:, 0] * a[:, 2:3], inverse[:, 0] * a[:, 1:2]], axis=2)
        effects = [-by_v @ effect.basis(s, covariates) for effect, _ in self.effects]
        by_scale_factor = -by_u * (u / self.scale_factor)[:, None, :]
        return a, by_u, np.concatenate([by_scale_factor, angles, -by_v, *effects], axis=2)

    def radius_by_parameters(self, u: Floats, covariates: Mapping[str, Floats]) -> Floats:
        """(n,9+p) derivatives of |a| by scale factors, misalignments, biases
        and coefficients."""
        radius = self.radius(u, covariates)
        effects = [radius.by_coefficients(effect, covariates) for effect, _ in self.effects]
        by_scale_factor = -radius.by_v * u / self.scale_factor**2
        return np.concatenate([by_scale_factor, radius.by_misalignment, -radius.by_v, *effects], axis=1)

    def magnitude(self, u: Floats, covariates: Mapping[str, Floats]) -> tuple[Floats, Floats]:
        """|a| (n,) and its gradient by the outputs (n,3)."""
        radius = self.radius(u, covariates)
        return radius.length, radius.by_v / self.scale_factor


_UNITY = np.eye(3)
"""The derivative of a reading without effects."""


def _solved(slopes: Floats, right: Floats) -> Floats:
    """(n,3) solutions x of (1 + slopes) x = right, with the slopes (n,3,3) of a
    departure."""
    if not slopes.any():  # effects on the bias alone
        return right
    try:
        return np.asarray(np.linalg.solve(_UNITY + slopes, right[..., None])[..., 0])
    except np.linalg.LinAlgError:
        raise Refused("the model has no inverse at these readings: they lie far beyond what it holds for") from None
