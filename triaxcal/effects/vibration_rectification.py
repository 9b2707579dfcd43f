"""Bias that vibration makes, as nonlinearity turns its variance into a mean
(IEEE Std 1293: VRE)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import SCATTER, Coefficient, Effect, Meaning, no_slope, per_axis, xyz


@dataclass(frozen=True)
class VibrationRectification(Effect):
    """``e_i = q_i v_i`` with the variance v_i of the readings inside the pose."""

    name: str = "vibration_rectification"
    coefficients: tuple[Coefficient, ...] = xyz("g/g²")
    needs: tuple[str, ...] = SCATTER
    remedy: str = "Stop what shakes the stand while poses are held, or stand the fixture on something that damps."
    meaning = Meaning(
        clause="vibration shifts the bias",
        because="The element is not straight, so that shaking it does not average to zero.",
        formula="e = q v",
        factors={"*": "v"},
        symbols="v: variance of the readings inside the pose, in g²",
    )

    @property
    def absent(self) -> str:
        return "with readings that do not scatter"

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return per_axis(np.stack([covariates[n] for n in SCATTER], axis=1))

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return no_slope(s)
