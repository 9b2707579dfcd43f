"""Bias that settles exponentially after the start, as a unit that warms up
does."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import SINCE_START, Coefficient, Effect, Meaning, no_slope, on_each_axis, span_of, xyz

CONSTANTS = 8
"""Time constants tried, evenly in the logarithm: a factor of 1.8 apart in 27
poses. More cost time for each hypothesis; fewer leave gaps between the
shapes."""
SLOWEST = 4.0
"""Lengths of the recording. Over a quarter of its time constant an exponential
is off its chord by 3 % of its change: what is slower is a straight drift."""


@dataclass(frozen=True)
class WarmUp(Effect):
    """``e_i = q_i exp(−t/τ)`` at t after the start of the recording; the
    settled unit is the reference."""

    time_constant_s: float = 300.0
    name: str = "warm_up"
    coefficients: tuple[Coefficient, ...] = xyz("g")
    needs: tuple[str, ...] = (SINCE_START,)
    remedy: str = "Switch the unit on and wait before the first pose, until the bias has settled."
    meaning = Meaning(
        clause="the bias settles after the start, as while a unit warms up",
        because="The unit was switched on shortly before. It belongs to this recording, not to the unit.",
        formula="e = q exp(−t / τ)",
        factors={"*": "exp(−t / τ)", "time_constant": "τ"},
        symbols="t: seconds since the recording began",
    )

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return on_each_axis(np.exp(-covariates[SINCE_START] / self.time_constant_s))

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return no_slope(s)

    def advice(self, largest: float, floor: float) -> str:
        """After how long no more than the floor is left. Whoever records from
        the moment of switching on waits as long; who began later has waited
        before."""
        if not 0 < floor < abs(largest):
            return self.remedy
        wait_s = self.time_constant_s * math.log(abs(largest) / floor)
        wait = f"{math.ceil(wait_s)} s" if wait_s < 120 else f"{math.ceil(wait_s / 60)} minutes"
        return f"{self.remedy} What is left of it is below the noise floor from {wait} after the first sample on."

    @property
    def shape(self) -> Mapping[str, tuple[float, str]]:
        return {"time_constant": (self.time_constant_s, "s")}

    def variants(self, covariates: Mapping[str, Floats]) -> Sequence[Effect]:
        """From what three poses show to what is straight over the recording but
        for a few per cent."""
        shortest, whole = span_of(covariates[SINCE_START])
        return tuple(
            self.shaped({"time_constant": float(c)}) for c in np.geomspace(shortest, SLOWEST * whole, CONSTANTS)
        )

    def shaped(self, values: Mapping[str, float]) -> Self:
        return replace(self, time_constant_s=values["time_constant"])
