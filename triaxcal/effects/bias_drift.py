"""Bias that moves with time, along a polynomial."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import TIME, Coefficient, Effect, Meaning, no_slope, on_each_axis, xyz

DEGREES = (1, 2, 3)
"""Straight, bent once, bent twice; a higher degree would follow anything that
is slow."""


@dataclass(frozen=True)
class BiasDrift(Effect):
    """``e_i = q_i (t − t_ref) + q2_i (t − t_ref)² + …`` up to ``degree``."""

    degree: int = 1
    name: str = "bias_drift"
    needs: tuple[str, ...] = (TIME,)
    remedy: str = "Let the unit settle before the first pose, and repeat the first pose at the end."
    meaning = Meaning(
        clause="the bias drifts with time",
        because=(
            "The unit had not settled, or something around it changed slowly. It belongs to this "
            "recording, not to the unit."
        ),
        formula="e = q (t − t₀) + q₂ (t − t₀)² + q₃ (t − t₀)³",
        factors={"*": "t − t₀", "*2": "(t − t₀)²", "*3": "(t − t₀)³"},
        symbols="t: time in s; powers without a coefficient are zero",
        reference=("t₀", "t_s"),
    )

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        higher = (c for d in range(2, self.degree + 1) for c in xyz(f"g/s{'²³'[d - 2]}", f"{{}}{d}"))
        return (*xyz("g/s"), *higher)

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        powers = [on_each_axis(covariates[TIME] ** d) for d in range(1, self.degree + 1)]
        return np.concatenate(powers, axis=2)

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return no_slope(s, 3 * self.degree)

    @property
    def forms(self) -> tuple[Effect, ...]:
        return tuple(BiasDrift(degree) for degree in DEGREES)
