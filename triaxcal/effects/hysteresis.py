"""Output that remembers the pose before."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import BEFORE, CHANGE, Coefficient, Effect, Meaning, no_slope, per_axis, signs, xyz

KINDS = {"memory": "", "reversal": "sign_"}
REVERSAL = 1e-3
"""The change along an axis at which its sign is certain, in parts of the
specific force's order of magnitude; below it the effect goes through zero in a
straight line."""


@dataclass(frozen=True)
class Hysteresis(Effect):
    """``e_i = q_i p_i``, of the specific force p_i in the pose before
    ("memory"), or ``q_i sign(Δ_i)``, of the change Δ_i since then, the way on
    which the pose was reached ("reversal").
    """

    kind: str = "memory"
    name: str = "hysteresis"
    remedy: str = "Approach every pose from the same side, or wait longer in it before it counts."
    meaning = Meaning(
        clause="the reading depends on the pose before",
        because="The element, its mounting or the fixture does not come all the way back.",
        formula="e = q s′  or  e = q sign(s − s′)",
        factors={"*": "s′", "sign_*": "sign(s − s′)"},
        symbols="s′: the specific force along the axis in the pose before",
    )

    @property
    def needs(self) -> tuple[str, ...]:
        return BEFORE if self.kind == "memory" else CHANGE

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return xyz("g/g" if self.kind == "memory" else "g", KINDS[self.kind] + "{}")

    @property
    def absent(self) -> str:
        if self.kind == "memory":
            return "after a pose with no specific force along the axis"
        return "with no change along the axis since the pose before"

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        values = np.stack([covariates[n] for n in self.needs], axis=1)
        if self.kind == "memory":
            return per_axis(values)
        return per_axis(signs(values, s, REVERSAL))

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return no_slope(s)

    @property
    def forms(self) -> tuple[Effect, ...]:
        return tuple(Hysteresis(kind) for kind in KINDS)
