"""Bias that changes with the rate of temperature: gradients inside the unit
while it warms or cools."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from triaxcal.arrays import Floats
from triaxcal.effects.contract import Coefficient, Effect, Meaning, no_slope, on_each_axis, rate_of, steady_within, xyz

RATE = rate_of("temp_c")


@dataclass(frozen=True)
class ThermalGradient(Effect):
    """``e_i = q_i dT/dt``."""

    name: str = "thermal_gradient"
    coefficients: tuple[Coefficient, ...] = xyz("g/(K/s)")
    needs: tuple[str, ...] = (RATE,)
    remedy: str = "Let the temperature settle before each pose, or correct the bias by its rate, in the host."
    meaning = Meaning(
        clause="the bias goes with how fast the temperature changes",
        because="While the unit warms or cools, one side of it is warmer than the other.",
        formula="e = q dT/dt",
        factors={"*": "dT/dt"},
        symbols="T: temp_c, by the second",
    )

    def advice(self, largest: float, floor: float) -> str:
        return steady_within(self.remedy, largest, floor, "K/s")

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return on_each_axis(covariates[RATE])

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return no_slope(s)
