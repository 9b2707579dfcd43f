"""Output that changes with the product of two components of the input (IEEE Std
1293: Kip, Kio, Kpo)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import Coefficient, Effect, Meaning

PAIRS = ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))
"""(axis, other): the axis reads its own component times the other."""


@dataclass(frozen=True)
class CrossCoupling(Effect):
    """``e_i = q_ij s_i s_j + q_xyz s_j s_k``.

    The three products of the two other components change |a| in one way, by
    their sum, so no still pose tells them apart; they share one coefficient.
    """

    name: str = "cross_coupling"
    coefficients: tuple[Coefficient, ...] = (
        *(Coefficient(f"{'xyz'[i]}_{'xyz'[i]}{'xyz'[j]}", "g/g²", f"{i}{j}") for i, j in PAIRS),
        Coefficient("xyz", "g/g²", "xyz"),
    )
    needs: tuple[str, ...] = ()
    remedy: str = "Correct it with the cross-coupling coefficients, in the host."
    meaning = Meaning(
        clause="what one axis reads depends on the product of two components",
        because="A proof mass that moves along one axis changes how it answers along another; the unit keeps it.",
        formula="e = qⱼ s sⱼ + qₖ s sₖ + q sⱼ sₖ",
        factors={
            **{f"{a}_{a}{b}": f"s_{a} s_{b}" for a in "xyz" for b in "xyz" if a != b},
            "xyz": "product of the two other components, on each axis",
        },
        symbols="sⱼ, sₖ: the two other components; of the last product still poses show one coefficient for all axes",
    )

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        out = np.zeros((len(s), 3, 7))
        for k, (i, j) in enumerate(PAIRS):
            out[:, i, k] = s[:, i] * s[:, j]
        for i in range(3):
            out[:, i, 6] = s[:, (i + 1) % 3] * s[:, (i + 2) % 3]
        return out

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        out = np.zeros((len(s), 3, 3, 7))
        for k, (i, j) in enumerate(PAIRS):
            out[:, i, i, k] = s[:, j]
            out[:, i, j, k] = s[:, i]
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            out[:, i, j, 6] = s[:, k]
            out[:, i, k, 6] = s[:, j]
        return out
