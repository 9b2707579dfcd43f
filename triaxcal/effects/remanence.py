"""Bias that keeps the sign of the load in the pose before."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import BEFORE, Coefficient, Effect, Meaning, no_slope, per_axis, signs, xyz

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
