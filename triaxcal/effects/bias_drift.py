"""Bias that moves steadily with time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import TIME, Coefficient, per_axis, per_axis_slope, xyz


@dataclass(frozen=True)
class BiasDrift:
    """``e_i = q_i (t − t_ref)``."""

    name: str = "bias_drift"
    coefficients: tuple[Coefficient, ...] = xyz("g/s")
    needs: tuple[str, ...] = (TIME,)
    remedy: str = "Let the unit settle before the first pose, and repeat the first pose at the end."

    def basis(self, s: Floats, conditions: Mapping[str, Floats]) -> Floats:
        return per_axis(np.repeat(conditions[TIME][:, None], 3, axis=1))

    def slope(self, s: Floats, conditions: Mapping[str, Floats]) -> Floats:
        return per_axis_slope(np.zeros_like(s))
