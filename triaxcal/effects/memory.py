"""Output that remembers earlier poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import BEFORE, CHANGE, Coefficient, Effect, Meaning, no_slope, per_axis, signs, xyz

KINDS = {"memory": "", "reversal": "sign_"}
REVERSAL = 1e-3
"""The change along an axis from which on its sign is certain, as a share of the order
of magnitude of the specific force. Below, the effect is linear."""


@dataclass(frozen=True)
class Hysteresis(Effect):
    """``e_i = q_i p_i`` with the specific force p_i in the previous pose ("memory"), or
    ``q_i sign(Δ_i)`` with the change Δ_i since then, the direction from which the unit
    reached the pose ("reversal").
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


# Bias that keeps the sign of the load in the previous pose.

DRIVEN = 0.05
"""The specific force along an axis that leaves the full offset, as a share of the
order of magnitude of the specific force. Below, the offset is linear: bias and noise,
which are far smaller, must not decide a sign."""


@dataclass(frozen=True)
class Remanence(Effect):
    """``e_i = q_i sign(p_i)`` with the specific force p_i in the previous pose;
    positive if the reading stays on that side.

    A load on one side leaves an offset of that side. Its size hardly depends on the
    load, once that is large enough. Examples are magnetised iron in the torquer of a
    servo accelerometer, a charged dielectric at a capacitive proof mass, a spring or
    a joint that slipped. `Hysteresis` has two related effects: an offset in
    proportion to p_i, and one by the direction of approach.

    The first pose has its own force as p_i, as if the unit had rested there before;
    the fit may exclude it (`triaxcal.poses.covariates.of_unknown_history`). A pose
    with almost no force along the axis leaves almost no offset in this model; a real
    unit may keep an older one.
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
