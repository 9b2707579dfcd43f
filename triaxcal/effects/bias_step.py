"""Bias that jumps once, at a moment that nobody knows: a knock, a supply that
switched, a loose part."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from triaxcal.arrays import Floats, evenly_spread
from triaxcal.effects.contract import DURATION, SINCE_START, Coefficient, Effect, Meaning, no_slope, on_each_axis, xyz

MOMENTS = 200
"""At most: between the poses and in them, up to 101 poses. Of longer recordings
a diagnosis divides the likeliest moments afterwards."""


@dataclass(frozen=True)
class BiasStep(Effect):
    """``e_i = −q_i`` before the step, zero after it: what the unit is after the
    step is the reference.

    ``at_s`` counts from the start of the recording. In a pose that the step
    falls into the part before it counts.
    """

    at_s: float = 0.0
    name: str = "bias_step"
    coefficients: tuple[Coefficient, ...] = xyz("g")
    needs: tuple[str, ...] = (SINCE_START, DURATION)
    lasting: bool = True
    remedy: str = "Look for what happened then (a knock, a supply, a loose part) and record again."
    meaning = Meaning(
        clause="the bias jumps at one moment",
        because=(
            "A knock, a change of the supply, a part that came loose. It belongs to this recording, not to the unit."
        ),
        formula="e = −q before t₁, 0 after it",
        factors={"*": "−1 before t₁, 0 after", "at": "t₁"},
        symbols="t₁: seconds since the recording began",
        in_run="{by}, t₁ in recording {n}; all earlier ones are before it",
    )

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        held = np.maximum(covariates[DURATION], 1e-9)
        begin = covariates[SINCE_START] - held / 2
        return on_each_axis(-np.clip((self.at_s - begin) / held, 0.0, 1.0))

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return no_slope(s)

    @property
    def absent(self) -> str:
        return f"after the step at {self.at_s:.1f} s"

    @property
    def shape(self) -> Mapping[str, tuple[float, str]]:
        return {"at": (self.at_s, "s")}

    def variants(self, covariates: Mapping[str, Floats]) -> Sequence[Effect]:
        """Between any two poses, and in the middle of any but the first and the
        last; `MOMENTS` of these, evenly spread, where they are more."""
        t, held = covariates[SINCE_START], covariates[DURATION]
        order = np.argsort(t)
        begin, end = (t - held / 2)[order], (t + held / 2)[order]
        moments = np.sort([*(end[:-1] + begin[1:]) / 2, *t[order][1:-1]])
        return tuple(self.shaped({"at": float(m)}) for m in evenly_spread(moments, MOMENTS))

    def shaped(self, values: Mapping[str, float]) -> Self:
        return replace(self, at_s=values["at"])
