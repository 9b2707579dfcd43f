"""Bias that changes in proportion to temperature."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from triaxcal.arrays import Floats
from triaxcal.effects.contract import (
    T_REFERENCE,
    Coefficient,
    Effect,
    Meaning,
    no_slope,
    on_each_axis,
    steady_within,
    xyz,
)


@dataclass(frozen=True)
class TemperatureBias(Effect):
    """``e_i = q_i (T − T_ref)``."""

    name: str = "temperature_bias"
    coefficients: tuple[Coefficient, ...] = xyz("g/K")
    needs: tuple[str, ...] = ("temp_c",)
    remedy: str = "Correct the bias by the logged temperature, or hold the temperature steadier."
    meaning = Meaning(
        clause="the bias goes with temperature",
        because="The zero of the element or of its electronics changes as they warm.",
        formula="e = q (T − T₀)",
        factors={"*": "T − T₀"},
        symbols="T: temp_c",
        reference=T_REFERENCE,
    )

    def advice(self, largest: float, floor: float) -> str:
        return steady_within(self.remedy, largest, floor, "K")

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return on_each_axis(covariates["temp_c"])

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return no_slope(s)
