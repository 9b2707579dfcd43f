"""What every effect states about itself.

An effect adds ``e`` to the reading: ``u = K (s + b + e(s, conditions))`` with ``s = R a`` the specific force
along each sensitive axis, in g. ``e`` is linear in the effect's coefficients: ``e = basis @ coefficients``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from triaxcal.arrays import Floats

TIME = "t_s"
"""The name under which time stands among the conditions, in seconds."""


@dataclass(frozen=True)
class Coefficient:
    """``unit`` uses g for the unit of the reference vector, whatever that is."""

    name: str
    unit: str


class Effect(Protocol):
    """One way in which a sensor departs from the linear model.

    ``needs`` names the conditions it depends on; each is given as the deviation from its reference, (n,).
    """

    @property
    def name(self) -> str: ...
    @property
    def coefficients(self) -> tuple[Coefficient, ...]: ...
    @property
    def needs(self) -> tuple[str, ...]: ...
    @property
    def remedy(self) -> str: ...

    def basis(self, s: Floats, conditions: Mapping[str, Floats]) -> Floats:
        """(n,3,p): what a unit of each coefficient adds to each axis, in g."""

    def slope(self, s: Floats, conditions: Mapping[str, Floats]) -> Floats:
        """(n,3,3,p): derivative of `basis` by s, as [n, axis, by axis, coefficient]."""


def per_axis(values: Floats) -> Floats:
    """(n,3) → (n,3,3): one coefficient an axis, each acting on its own axis alone."""
    out = np.zeros((*values.shape, 3))
    out[:, range(3), range(3)] = values
    return out


def per_axis_slope(values: Floats) -> Floats:
    """(n,3) → (n,3,3,3): likewise for a derivative that is diagonal in the axes."""
    out = np.zeros((*values.shape, 3, 3))
    out[:, range(3), range(3), range(3)] = values
    return out


def xyz(unit: str) -> tuple[Coefficient, ...]:
    return tuple(Coefficient(axis, unit) for axis in "xyz")
