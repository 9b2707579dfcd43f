"""Output that gives way towards the ends of the range, beyond a knee, as one
that begins to saturate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import BEFORE, Coefficient, Effect, Meaning, per_axis, per_axis_slope, xyz

KINDS = {"odd": "", "even": "even_"}
KNEES = (0.5, 0.6, 0.7, 0.8, 0.9)
"""In parts of the reference. Below these it is a cube, and above them only
poses along the axis feel it."""
ROUNDED = 0.1
"""Width of the bend at the knee, in parts of it."""


@dataclass(frozen=True)
class Compression(Effect):
    """``e_i = −q_i (h(s_i) − h(−s_i))`` ("odd": both ends give way alike) or
    ``e_i = −q_i (h(s_i) + h(−s_i))`` ("even": the upper end gives way, and the
    lower one gains as much, beside what "odd" says of both).

    h(s) is s − κ beyond the knee κ and nothing below it, with a bend of the
    width w = κ/10 between: h(s) = w (ln(1 + exp((s − κ)/w)) − ln(1 +
    exp(−κ/w))). So q_i is the share of the slope that is lost beyond the knee,
    positive where the output falls behind: 0 none of it, 1 a stop. The scale
    factor is that below the knee.

    An amplifier whose output nears its supply, or a torquer whose current nears
    its limit, keeps its gain up to some load and loses it there within a short
    way, which a cube does not follow: that bends everywhere, and most in the
    middle between the ends. Where the range lies evenly about zero both ends
    give way (odd); bias, or a supply with unequal halves, brings one end nearer
    (odd and even by half each, where it is one alone). The bend's width is
    assumed, since poses that are few along any axis could not tell it.

    The knee is in units of the reference vector; the search tries some parts of
    it, whatever the unit.
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
        upper, lower = self._share_beyond(s), self._share_beyond(-s)
        return per_axis_slope(-upper - lower if self.kind == "odd" else lower - upper)

    def _hinge(self, s: Floats) -> Floats:
        width = ROUNDED * self.knee
        return np.asarray(width * (np.logaddexp(0.0, (s - self.knee) / width) - np.logaddexp(0.0, -1 / ROUNDED)))

    def _share_beyond(self, s: Floats) -> Floats:
        """The derivative of the hinge, 0…1."""
        return np.asarray((1 + np.tanh((s - self.knee) / (2 * ROUNDED * self.knee))) / 2)

    @property
    def shape(self) -> Mapping[str, tuple[float, str]]:
        return {"knee": (self.knee, "g")}

    @property
    def forms(self) -> tuple[Effect, ...]:
        return tuple(Compression(kind, self.knee) for kind in KINDS)

    def variants(self, covariates: Mapping[str, Floats]) -> Sequence[Effect]:
        """Both forms with every knee. How long the reference vector is, the
        poses before tell."""
        before = [covariates[n] for n in BEFORE if n in covariates]
        reference = float(np.median(np.linalg.norm(before, axis=0))) if len(before) == len(BEFORE) else 1.0
        return tuple(Compression(kind, float(f"{k * reference:.4g}")) for kind in KINDS for k in KNEES)

    def shaped(self, values: Mapping[str, float]) -> Self:
        return replace(self, knee=values["knee"])
