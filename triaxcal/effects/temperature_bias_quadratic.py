"""Bias that changes with temperature along a parabola."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import T_REFERENCE, Coefficient, Effect, Meaning, no_slope, on_each_axis, xyz


@dataclass(frozen=True)
class TemperatureBiasQuadratic(Effect):
    """``e_i = p_i (T − T_ref) + q_i (T − T_ref)²``; the linear part belongs to
    it, as a parabola has one."""

    name: str = "temperature_bias_quadratic"
    coefficients: tuple[Coefficient, ...] = (
        *xyz("g/K", "linear_{}"),
        *xyz("g/K²", "quadratic_{}"),
    )
    needs: tuple[str, ...] = ("temp_c",)
    remedy: str = "Correct the bias by a parabola in the logged temperature, or hold the temperature steadier."
    meaning = Meaning(
        clause="the bias follows temperature along a parabola",
        because="The zero changes with temperature, and not in a straight line.",
        formula="e = p (T − T₀) + q (T − T₀)²",
        factors={"linear_*": "T − T₀", "quadratic_*": "(T − T₀)²"},
        symbols="T: temp_c",
        reference=T_REFERENCE,
    )

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        deviation = covariates["temp_c"]
        return np.concatenate([on_each_axis(deviation), on_each_axis(deviation**2)], axis=2)

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return no_slope(s, 6)
