"""Scale factor that differs between positive and negative input (IEEE Std 1293:
scale-factor asymmetry)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import Coefficient, Effect, Meaning, per_axis, per_axis_slope, xyz


@dataclass(frozen=True)
class ScaleFactorAsymmetry(Effect):
    """``e_i = q_i |s_i|``: the scale factor is 1 + q above zero and 1 − q below
    it."""

    name: str = "scale_factor_asymmetry"
    coefficients: tuple[Coefficient, ...] = xyz("1")
    needs: tuple[str, ...] = ()
    remedy: str = "Correct it with one scale factor for positive and one for negative outputs, in the host."
    meaning = Meaning(
        clause="the scale factor differs between positive and negative inputs",
        because="The two halves of a push-pull stage or of a differential element are unlike; the unit keeps it.",
        formula="e = q |s|",
        factors={"*": "|s|"},
    )

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return per_axis(np.abs(s))

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return per_axis_slope(np.sign(s))
