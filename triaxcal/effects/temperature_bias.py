"""Bias that changes in proportion to temperature."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import Coefficient, per_axis, per_axis_slope, xyz


@dataclass(frozen=True)
class TemperatureBias:
    """``e_i = q_i (T − T_ref)``."""

    name: str = "temperature_bias"
    coefficients: tuple[Coefficient, ...] = xyz("g/K")
    needs: tuple[str, ...] = ("temp_c",)
    remedy: str = "Correct the bias by the logged temperature, or hold the temperature steadier."

    def basis(self, s: Floats, conditions: Mapping[str, Floats]) -> Floats:
        return per_axis(np.repeat(conditions["temp_c"][:, None], 3, axis=1))

    def slope(self, s: Floats, conditions: Mapping[str, Floats]) -> Floats:
        return per_axis_slope(np.zeros_like(s))
