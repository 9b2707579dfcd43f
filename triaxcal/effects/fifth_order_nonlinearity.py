"""Output that bends with the fifth power of the input, the next odd term of a
balanced element after the cube."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from triaxcal.arrays import Floats
from triaxcal.effects.contract import Coefficient, Effect, Meaning, per_axis, per_axis_slope, xyz


@dataclass(frozen=True)
class FifthOrderNonlinearity(Effect):
    """``e_i = q_i s_i⁵``, in units of the reference vector as those of second
    and third order (IEEE Std 1293 ends its model equation with K3; this goes on
    with it).

    A plain power, so that coefficients of the three orders are those of one
    polynomial, and mean the same at any full scale. So it is not at right
    angles to the cube: faces and vertices of a cube have the components 0, 1/√3
    and 1 alone, where s⁵ is (4 s³ − s)/3, third order and a scale factor. With
    the edges each shows in full by itself, but of the two together four
    combinations out of six; directions in between tell the rest.
    """

    name: str = "fifth_order_nonlinearity"
    coefficients: tuple[Coefficient, ...] = xyz("g/g⁵")
    needs: tuple[str, ...] = ()
    remedy: str = "Correct it with the fifth-order coefficients, in the host."
    meaning = Meaning(
        clause="the output bends with the fifth power of the input",
        because=(
            "The sensing element or its amplifier flattens towards both ends of its range, more "
            "steeply than a cube; the unit keeps it."
        ),
        formula="e = q s⁵",
        factors={"*": "s⁵"},
    )

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return per_axis(s**5)

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return per_axis_slope(5 * s**4)
