"""Output that remembers earlier poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import BEFORE, CHANGE, Coefficient, Effect, Meaning, no_slope, per_axis, signs, xyz

# Output that remembers the pose before.

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


# Bias that keeps the sign of the load in the pose before.

DRIVEN = 0.05
"""The specific force along an axis that leaves the whole offset, in parts of
its order of magnitude; below it the offset goes through zero in a straight
line. Bias and noise, which are far smaller, must not decide a sign."""


@dataclass(frozen=True)
class Remanence(Effect):
    """``e_i = q_i sign(p_i)`` of the specific force p_i in the pose before;
    positive where the reading stays on that side.

    What has been driven to one side and let go keeps an offset of that side,
    whose size hardly depends on how far it was driven once that was far enough:
    magnetised iron in the torquer of a servo accelerometer, a charged
    dielectric beside a capacitive proof mass, a spring or a joint that slipped.
    `Hysteresis` has the two neighbours of this: an offset in proportion to p_i,
    and one by the way on which the pose was reached.

    In the first pose p_i is that of the pose itself, as if the unit had rested
    there before, and the fit may leave it out
    (`triaxcal.poses.covariates.of_unknown_history`). A pose with next to no
    force along the axis leaves next to nothing, though what was before that one
    may still be there.
    """

    name: str = "remanence"
    coefficients: tuple[Coefficient, ...] = xyz("g")
    needs: tuple[str, ...] = BEFORE
    remedy: str = "Drive every axis to the same side before each pose, or to both sides by turns, less and less."
    meaning = Meaning(
        clause="the bias keeps the sign of the load in the pose before",
        because="Iron that was magnetised, a charge that was left, a joint that slipped.",
        formula="e = q sign(s′)",
        factors={"*": "sign(s′)"},
        symbols="s′: the specific force along the axis in the pose before",
    )

    @property
    def absent(self) -> str:
        return "after a pose with no specific force along the axis"

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return per_axis(signs(np.stack([covariates[n] for n in BEFORE], axis=1), s, DRIVEN))

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return no_slope(s)
