"""Output that bends with the square of the input (IEEE Std 1293: K2)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from triaxcal.arrays import Floats
from triaxcal.effects.contract import Coefficient, Effect, Meaning, per_axis, per_axis_slope, xyz


@dataclass(frozen=True)
class SecondOrderNonlinearity(Effect):
    """``e_i = q_i s_i²``."""

    name: str = "second_order_nonlinearity"
    coefficients: tuple[Coefficient, ...] = xyz("g/g²")
    needs: tuple[str, ...] = ()
    remedy: str = "Correct it with the second-order coefficients, in the device or in the host."
    meaning = Meaning(
        clause="the output bends with the square of the input",
        because="The sensing element or its amplifier is not quite straight; the unit keeps it.",
        formula="e = q s²",
        factors={"*": "s²"},
    )

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return per_axis(s**2)

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return per_axis_slope(2 * s)
