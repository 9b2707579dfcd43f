"""Bias that changes with temperature along a parabola."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import Coefficient


@dataclass(frozen=True)
class TemperatureBiasQuadratic:
    """``e_i = p_i (T − T_ref) + q_i (T − T_ref)²``; the linear part belongs to it, as a parabola has one."""

    name: str = "temperature_bias_quadratic"
    coefficients: tuple[Coefficient, ...] = (
        *(Coefficient(f"linear_{axis}", "g/K") for axis in "xyz"),
        *(Coefficient(f"quadratic_{axis}", "g/K²") for axis in "xyz"),
    )
    needs: tuple[str, ...] = ("temp_c",)
    remedy: str = "Correct the bias by a parabola in the logged temperature, or hold the temperature steadier."

    def basis(self, s: Floats, conditions: Mapping[str, Floats]) -> Floats:
        deviation = conditions["temp_c"]
        out = np.zeros((len(s), 3, 6))
        for axis in range(3):
            out[:, axis, axis] = deviation
            out[:, axis, 3 + axis] = deviation**2
        return out

    def slope(self, s: Floats, conditions: Mapping[str, Floats]) -> Floats:
        return np.zeros((len(s), 3, 3, 6))
