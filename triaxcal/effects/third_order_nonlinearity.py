"""Output that bends with the cube of the input (IEEE Std 1293: K3)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from triaxcal.arrays import Floats
from triaxcal.effects.contract import Coefficient, Effect, Meaning, per_axis, per_axis_slope, xyz


@dataclass(frozen=True)
class ThirdOrderNonlinearity(Effect):
    """``e_i = q_i s_i³``."""

    name: str = "third_order_nonlinearity"
    coefficients: tuple[Coefficient, ...] = xyz("g/g³")
    needs: tuple[str, ...] = ()
    remedy: str = "Correct it with the third-order coefficients, in the device or in the host."
    meaning = Meaning(
        clause="the output bends with the cube of the input",
        because="The sensing element or its amplifier flattens towards both ends of its range; the unit keeps it.",
        formula="e = q s³",
        factors={"*": "s³"},
    )

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return per_axis(s**3)

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return per_axis_slope(3 * s**2)
