"""An effect that stands for another: what it does not say anew is the other's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Self

from triaxcal.arrays import Floats
from triaxcal.effects.contract import Coefficient, Effect, Meaning


@dataclass(frozen=True, eq=False)
class Wrapped(Effect):
    """``whole`` in another guise. It comes in no other forms than this, unless
    said otherwise."""

    whole: Effect

    @property
    def name(self) -> str:
        return self.whole.name

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return self.whole.coefficients

    @property
    def needs(self) -> tuple[str, ...]:
        return self.whole.needs

    @property
    def remedy(self) -> str:
        return self.whole.remedy

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return self.whole.basis(s, covariates)

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return self.whole.slope(s, covariates)

    def advice(self, largest: float, floor: float) -> str:
        return self.whole.advice(largest, floor)

    @property
    def meaning(self) -> Meaning | None:
        return self.whole.meaning

    @property
    def absent(self) -> str:
        return self.whole.absent

    @property
    def shape(self) -> Mapping[str, tuple[float, str]]:
        return self.whole.shape

    def shaped(self, values: Mapping[str, float]) -> Self:
        return replace(self, whole=self.whole.shaped(values))
