"""Nonlinear output (IEEE Std 1293)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import (
    BEFORE,
    SCATTER,
    Coefficient,
    Effect,
    Meaning,
    no_slope,
    per_axis,
    per_axis_slope,
    xyz,
)

# Second-order nonlinearity (IEEE Std 1293: K2).


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


# Third-order nonlinearity (IEEE Std 1293: K3).


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


# Fifth-order nonlinearity, the next odd term of a balanced element after the cube.


@dataclass(frozen=True)
class FifthOrderNonlinearity(Effect):
    """``e_i = q_i s_i⁵``, in units of the reference vector, as the second and third
    order. IEEE Std 1293 ends its model equation with K3; this term continues it.

    The term is a plain power: the coefficients of the three orders are those of one
    polynomial, and mean the same at any full scale. So it is not orthogonal to the
    cube. Faces and vertices of a cube have the components 0, 1/√3 and 1 alone, where
    s⁵ is (4 s³ − s)/3, third order and a scale factor. With the edges each order is
    fully observable by itself, and four of six combinations of both. Directions in
    between show the others.
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


# Scale factor that differs between positive and negative input (IEEE Std 1293:
# scale-factor asymmetry).


@dataclass(frozen=True)
class ScaleFactorAsymmetry(Effect):
    """``e_i = q_i |s_i|``: the scale factor is 1 + q for positive and 1 − q for
    negative input."""

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


# Compression towards the ends of the range, beyond a knee: the onset of saturation.

KINDS = {"odd": "", "even": "even_"}
KNEES = (0.5, 0.6, 0.7, 0.8, 0.9)
"""Knees as shares of the reference. With a lower knee the effect is a cube; a higher
one affects poses along the axis alone."""
ROUNDED = 0.1
"""Width of the bend, as a share of the knee."""


@dataclass(frozen=True)
class Compression(Effect):
    """``e_i = −q_i (h(s_i) − h(−s_i))`` ("odd": equal compression at both ends) or
    ``e_i = −q_i (h(s_i) + h(−s_i))`` ("even": compression at the upper end and as
    much expansion at the lower one, in addition to "odd").

    h(s) is s − κ beyond the knee κ and zero below it, with a bend of the width
    w = κ/10 between: h(s) = w (ln(1 + exp((s − κ)/w)) − ln(1 + exp(−κ/w))). So q_i is
    the lost share of the slope beyond the knee, positive for compression: 0 is no
    loss, 1 a stop. The scale factor is that below the knee.

    An amplifier near its supply, or a torquer near its current limit, keeps its gain
    up to some load and loses it there over a short range. A cube does not follow this,
    as it bends everywhere. With a range that is symmetric about zero both ends are
    compressed (odd). A bias, or a supply with unequal halves, brings one end nearer:
    compression at one end alone is odd and even by half each. The width of the bend is
    assumed, as few poses along an axis do not determine it.

    The knee is in units of the reference vector. The search tries fixed shares of the
    reference, in any unit.
    """

    kind: str = "odd"
    knee: float = 0.7
    name: str = "compression"
    needs: tuple[str, ...] = ()
    remedy: str = "Use the unit, or set its range, so that readings stay below the knee; else correct it in the host."
    meaning = Meaning(
        clause="the output gives way towards the ends of the range",
        because="An amplifier nears its supply, or a torquer the end of its current; the unit keeps it.",
        formula="e = −q (h(s) − h(−s))  or  e = −q (h(s) + h(−s))",
        factors={"*": "h(−s) − h(s)", "even_*": "−h(s) − h(−s)", "knee": "κ"},
        symbols="h(s): s − κ beyond the knee κ and zero below it, with a bend as wide as κ/10 between",
    )

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return xyz("1", KINDS[self.kind] + "{}")

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        upper, lower = self._hinge(s), self._hinge(-s)
        return per_axis(lower - upper if self.kind == "odd" else -upper - lower)

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        upper, lower = self._hinge_slope(s), self._hinge_slope(-s)
        return per_axis_slope(-upper - lower if self.kind == "odd" else lower - upper)

    def _hinge(self, s: Floats) -> Floats:
        """h(s)."""
        width = ROUNDED * self.knee
        return np.asarray(width * (np.logaddexp(0.0, (s - self.knee) / width) - np.logaddexp(0.0, -1 / ROUNDED)))

    def _hinge_slope(self, s: Floats) -> Floats:
        """The derivative of h, 0…1."""
        return np.asarray((1 + np.tanh((s - self.knee) / (2 * ROUNDED * self.knee))) / 2)

    @property
    def shape(self) -> Mapping[str, tuple[float, str]]:
        return {"knee": (self.knee, "g")}

    @property
    def forms(self) -> tuple[Effect, ...]:
        return tuple(Compression(kind, self.knee) for kind in KINDS)

    def variants(self, covariates: Mapping[str, Floats]) -> Sequence[Effect]:
        """Both forms with every knee. The specific forces of the previous poses give
        the magnitude of the reference."""
        before = [covariates[n] for n in BEFORE if n in covariates]
        reference = float(np.median(np.linalg.norm(before, axis=0))) if len(before) == len(BEFORE) else 1.0
        return tuple(Compression(kind, float(f"{k * reference:.4g}")) for kind in KINDS for k in KNEES)

    def shaped(self, values: Mapping[str, float]) -> Self:
        return replace(self, knee=values["knee"])


# Cross-coupling: products of two components of the input (IEEE Std 1293: Kip, Kio,
# Kpo), and squares of a component across the axis.

PAIRS = ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))
"""(axis, other): the output of an axis has its own component times the other."""
OTHERS = ((0, 1, 2), (1, 0, 2), (2, 0, 1))
"""Each axis, and the two others."""
Product = tuple[int, int, int]
"""(axis, one, other): the output of an axis has the product of two components."""


def _products() -> dict[str, tuple[str, Product]]:
    """All products except the square of the axis's own component: name → (part,
    product). Products of one part make the same contribution to |a|."""
    letters = "xyz"
    out = {f"{letters[i]}_{letters[i]}{letters[j]}": (f"{i}{j}", (i, i, j)) for i, j in PAIRS}
    out |= {f"{letters[j]}_{2 * letters[i]}": (f"{i}{j}", (j, i, i)) for i, j in PAIRS}
    return out | {f"{letters[i]}_{letters[j]}{letters[k]}": ("xyz", (i, j, k)) for i, j, k in OTHERS}


PRODUCTS = _products()


@dataclass(frozen=True)
class CrossCoupling(Effect):
    """``e_i = q_ij s_i s_j + q_xyz s_j s_k``, or all quadratic forms across the
    axes (``whole``): ``e_i = q_ij s_i s_j + r_ij s_j² + p_i s_j s_k``.

    Still poses show |a| alone. There s_i s_j on axis i is equivalent to s_i² on axis j,
    and the products of the two other components appear as their sum. The first form
    has one coefficient for each function that |a| shows, and is the one to fit. The
    whole form has all coefficients of a unit, which only a prior distinguishes, and is
    the one to average over.
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
        """The whole form: the first alone would select one of several equivalent
        models."""
        return (CrossCoupling(whole=True),)

    @property
    def _products_by_column(self) -> list[tuple[int, Product]]:
        """The column of the coefficient of every product."""
        products = [product for _, product in PRODUCTS.values()]
        if self.whole:
            return list(enumerate(products))
        own = [product for product in products if product[0] == product[1]]
        last = [product for product in products if len(set(product)) == len(product)]
        return [*enumerate(own), *((len(own), product) for product in last)]

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        out = np.zeros((len(s), 3, len(self.coefficients)))
        for k, (axis, one, other) in self._products_by_column:
            out[:, axis, k] = s[:, one] * s[:, other]
        return out

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        out = np.zeros((len(s), 3, 3, len(self.coefficients)))
        for k, (axis, one, other) in self._products_by_column:
            out[:, axis, one, k] += s[:, other]
            out[:, axis, other, k] += s[:, one]
        return out


# Vibration rectification: nonlinearity turns the variance of vibration into a bias
# (IEEE Std 1293: VRE).


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
