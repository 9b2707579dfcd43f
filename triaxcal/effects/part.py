"""Part of an effect: on one axis alone, or what a set of poses can show of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import Coefficient, Effect
from triaxcal.effects.wrapped import Wrapped


@dataclass(frozen=True, eq=False)
class Part(Wrapped):
    """``whole`` with its p coefficients held to ``mix @ q`` of fewer, ``mix`` (p,q)."""

    mix: Floats

    @classmethod
    def of(cls, whole: Effect, *parts: str) -> Part:
        """The coefficients of some parts alone."""
        kept = [i for i, c in enumerate(whole.coefficients) if c.part in parts]
        return cls(whole, np.eye(len(whole.coefficients))[:, kept])

    @property
    def selects(self) -> bool:
        """Whether it is some of the coefficients, each by itself."""
        ones = np.array_equal(self.mix.sum(axis=0), np.ones(self.mix.shape[1]))
        return ones and set(np.unique(self.mix)) <= {0.0, 1.0}

    @property
    def formula(self) -> str:
        """The combinations of coefficients, in words."""
        names = [c.name for c in self.whole.coefficients]
        share = self.mix / np.maximum(np.abs(self.mix).max(axis=0), 1e-300)
        rows = ["".join(f" {w:+.2g} {n}" for w, n in zip(row, names, strict=True) if abs(w) > 0.005) for row in share.T]
        return " and ".join(row.strip() for row in rows)

    @cached_property
    def coefficients(self) -> tuple[Coefficient, ...]:
        own = self.whole.coefficients
        if self.selects:
            return tuple(own[int(i)] for i in np.argmax(self.mix, axis=0))
        largest = np.argmax(np.abs(self.mix), axis=0)
        return tuple(Coefficient(f"combination_{k + 1}", own[int(i)].unit) for k, i in enumerate(largest))

    def basis(self, s: Floats, conditions: Mapping[str, Floats]) -> Floats:
        return np.asarray(self.whole.basis(s, conditions) @ self.mix)

    def slope(self, s: Floats, conditions: Mapping[str, Floats]) -> Floats:
        return np.asarray(self.whole.slope(s, conditions) @ self.mix)


def whole(effect: Effect) -> Effect:
    """The effect that this is, or is part of."""
    return effect.whole if isinstance(effect, Part) else effect


def mix_of(effect: Effect) -> Floats:
    """(p,q) coefficients of the whole effect by those of this one."""
    return effect.mix if isinstance(effect, Part) else np.eye(len(effect.coefficients))
