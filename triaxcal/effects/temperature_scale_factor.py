"""Scale factor that changes in proportion to temperature."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import (
    T_REFERENCE,
    Coefficient,
    Effect,
    Meaning,
    per_axis,
    per_axis_slope,
    steady_within,
    xyz,
)


@dataclass(frozen=True)
class TemperatureScaleFactor(Effect):
    """``e_i = q_i (T − T_ref) s_i``."""

    name: str = "temperature_scale_factor"
    coefficients: tuple[Coefficient, ...] = xyz("1/K")
    needs: tuple[str, ...] = ("temp_c",)
    remedy: str = "Correct the scale factor by the logged temperature, or hold the temperature steadier."
    meaning = Meaning(
        clause="the scale factor goes with temperature",
        because="A spring, a gap or a reference voltage changes as it warms.",
        formula="e = q (T − T₀) s",
        factors={"*": "(T − T₀) s"},
        symbols="T: temp_c",
        reference=T_REFERENCE,
    )

    def advice(self, largest: float, floor: float) -> str:
        return steady_within(self.remedy, largest, floor, "K")

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return per_axis(s * covariates["temp_c"][:, None])

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return per_axis_slope(np.repeat(covariates["temp_c"][:, None], 3, axis=1))
