"""Scale factor that moves steadily with time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import TIME, Coefficient, Effect, Meaning, per_axis, per_axis_slope, xyz


@dataclass(frozen=True)
class ScaleFactorDrift(Effect):
    """``e_i = q_i (t − t_ref) s_i``: the scale factor grows by the share q_i a
    second, as a reference voltage or a magnet that warms or ages makes it."""

    name: str = "scale_factor_drift"
    coefficients: tuple[Coefficient, ...] = xyz("1/s")
    needs: tuple[str, ...] = (TIME,)
    remedy: str = "Let the unit settle before the first pose, and repeat the first poses at the end."
    meaning = Meaning(
        clause="the scale factor drifts with time",
        because=(
            "The unit had not settled: a reference voltage or a magnet still warmed. It belongs to "
            "this recording, not to the unit."
        ),
        formula="e = q (t − t₀) s",
        factors={"*": "(t − t₀) s"},
        symbols="t: time in s",
        reference=("t₀", "t_s"),
    )

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return per_axis(s * covariates[TIME][:, None])

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return per_axis_slope(np.repeat(covariates[TIME][:, None], 3, axis=1))
