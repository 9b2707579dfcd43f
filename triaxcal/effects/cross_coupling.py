"""Output that changes with the product of two components of the input (IEEE Std
1293: Kip, Kio, Kpo), or with the square of a component across the axis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import Coefficient, Effect, Meaning

PAIRS = ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))
"""(axis, other): the axis reads its own component times the other."""
OTHERS = ((0, 1, 2), (1, 0, 2), (2, 0, 1))
"""Each axis, and the two others."""
Product = tuple[int, int, int]
"""(axis, one, other): the axis reads the product of these two components."""


def _products() -> dict[str, tuple[str, Product]]:
    """Every product but the square of the axis's own component: name → (part,
    product). Products of one part add the same to |a|."""
    letters = "xyz"
    out = {f"{letters[i]}_{letters[i]}{letters[j]}": (f"{i}{j}", (i, i, j)) for i, j in PAIRS}
    out |= {f"{letters[j]}_{2 * letters[i]}": (f"{i}{j}", (j, i, i)) for i, j in PAIRS}
    return out | {f"{letters[i]}_{letters[j]}{letters[k]}": ("xyz", (i, j, k)) for i, j, k in OTHERS}


PRODUCTS = _products()


@dataclass(frozen=True)
class CrossCoupling(Effect):
    """``e_i = q_ij s_i s_j + q_xyz s_j s_k``, or all quadratic forms across the
    axes (``whole``): ``e_i = q_ij s_i s_j + r_ij s_j² + p_i s_j s_k``.

    Still poses show |a| alone. There s_i s_j on axis i is the same as s_i² on
    axis j, and the products of the two other components count by their sum. The
    first form has one coefficient for each function that |a| shows: the one to
    fit. The whole form has every coefficient that a unit may have, which only a
    prior distinguishes: the one to average over.
    """

    whole: bool = False
    name: str = "cross_coupling"
    needs: tuple[str, ...] = ()
    remedy: str = "Correct it with the cross-coupling coefficients, in the host."
    meaning = Meaning(
        clause="what one axis reads depends on the product of two components",
        because="A proof mass that moves along one axis changes how it answers along another; the unit keeps it.",
        formula="e = qⱼ s sⱼ + qₖ s sₖ + rⱼ sⱼ² + rₖ sₖ² + q sⱼ sₖ",
        factors={
            **{name: " ".join(f"s_{a}" for a in name[2:]) for name in PRODUCTS},
            "xyz": "product of the two other components, on each axis",
        },
        symbols="sⱼ, sₖ: the two other components; still poses show s sⱼ on one axis together with s² on the other, "
        "and the last products of all axes together",
    )

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        if self.whole:
            return tuple(Coefficient(name, "g/g²", part) for name, (part, _) in PRODUCTS.items())
        own = (Coefficient(name, "g/g²", part) for name, (part, (i, j, _)) in PRODUCTS.items() if i == j)
        return (*own, Coefficient("xyz", "g/g²", "xyz"))

    @property
    def forms(self) -> tuple[Effect, ...]:
        return CrossCoupling(), CrossCoupling(whole=True)

    def variants(self, covariates: Mapping[str, Floats]) -> Sequence[Effect]:
        """The whole form: a mean over the first alone would name one of many
        that look the same."""
        return (CrossCoupling(whole=True),)

    @property
    def _places(self) -> list[tuple[int, Product]]:
        """Of every product the place of its coefficient."""
        products = [product for _, product in PRODUCTS.values()]
        if self.whole:
            return list(enumerate(products))
        own = [product for product in products if product[0] == product[1]]
        last = [product for product in products if len(set(product)) == len(product)]
        return [*enumerate(own), *((len(own), product) for product in last)]

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        out = np.zeros((len(s), 3, len(self.coefficients)))
        for k, (axis, one, other) in self._places:
            out[:, axis, k] = s[:, one] * s[:, other]
        return out

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        out = np.zeros((len(s), 3, 3, len(self.coefficients)))
        for k, (axis, one, other) in self._places:
            out[:, axis, one, k] += s[:, other]
            out[:, axis, other, k] += s[:, one]
        return out
