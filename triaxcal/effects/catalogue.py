"""The effects that are known by name: our own, and those of other packages.

A new effect of our own is one file and one line here. Another package registers its
effects by an entry point.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Self, TypeVar

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.channel import BIAS, SCALE_FACTOR
from triaxcal.effects.contract import DERIVED, RUN, SINCE_START, Effect, Meaning
from triaxcal.effects.empirical import Empirical
from triaxcal.effects.memory import Hysteresis, Remanence
from triaxcal.effects.nonlinear import (
    Compression,
    CrossCoupling,
    FifthOrderNonlinearity,
    ScaleFactorAsymmetry,
    SecondOrderNonlinearity,
    ThirdOrderNonlinearity,
    VibrationRectification,
)
from triaxcal.effects.runs import BETWEEN_RUNS, Wrapped
from triaxcal.effects.thermal import (
    TemperatureBias,
    TemperatureBiasQuadratic,
    TemperatureLag,
    TemperatureScaleFactor,
    ThermalGradient,
)
from triaxcal.effects.time import BiasDrift, BiasStep, ScaleFactorDrift, WarmUp
from triaxcal.errors import InvalidData

CATALOGUE: tuple[Effect, ...] = (
    SecondOrderNonlinearity(),
    ThirdOrderNonlinearity(),
    ScaleFactorAsymmetry(),
    CrossCoupling(),
    TemperatureBias(),
    TemperatureBiasQuadratic(),
    TemperatureScaleFactor(),
    ThermalGradient(),
    BiasDrift(),
    WarmUp(),
    BiasStep(),
    Hysteresis(),
    VibrationRectification(),
    FifthOrderNonlinearity(),
    Compression(),
    ScaleFactorDrift(),
    TemperatureLag(),
    Remanence(),
)
"""Those that need no channel but the temperature."""


# Effects of other packages: entry points of the group ``triaxcal.effects``, each an
# `Effect` or a class that makes one without arguments.

GROUP = "triaxcal.effects"
LINEAR = "linear"
"""What documents call the nine parameters, among the names of effects."""
UNKNOWN = "another package"
"""What a package is called that does not say its name."""
LARGEST = 1e100
"""Squares of what an effect adds have to be numbers too."""

T = TypeVar("T")


class EffectFault(InvalidData):
    """An effect of another ``package`` cannot be used as it is, for this
    ``reason``."""

    def __init__(self, name: str, package: str, reason: str) -> None:
        super().__init__(f"the effect {name} of {package}: {reason}")
        self.reason = reason


@dataclass(frozen=True)
class Foreign(Wrapped):
    """An effect of another package. Raises EffectFault, and nothing else, where
    that fails or gives no numbers."""

    package: str = UNKNOWN

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return self._array(lambda: self.whole.basis(s, covariates), (len(s), 3, len(self.coefficients)))

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return self._array(lambda: self.whole.slope(s, covariates), (len(s), 3, 3, len(self.coefficients)))

    @property
    def needs(self) -> tuple[str, ...]:
        return tuple(self.whole.needs)

    def advice(self, largest: float, floor: float) -> str:
        try:
            return str(self._asked(lambda: self.whole.advice(largest, floor)))
        except EffectFault:  # words only
            return self.remedy

    @property
    def meaning(self) -> Meaning | None:
        try:
            meaning = self._asked(lambda: self.whole.meaning)
        except EffectFault:  # words only
            return None
        return meaning if isinstance(meaning, Meaning) else None

    @property
    def absent(self) -> str:
        try:
            return str(self._asked(lambda: self.whole.absent))
        except EffectFault:
            return ""

    @property
    def lasting(self) -> bool:
        return self.whole.lasting

    @property
    def forms(self) -> tuple[Effect, ...]:
        return tuple(Foreign(e, self.package) for e in self._asked(lambda: tuple(self.whole.forms)))

    def variants(self, covariates: Mapping[str, Floats]) -> Sequence[Effect]:
        return tuple(Foreign(e, self.package) for e in self._asked(lambda: tuple(self.whole.variants(covariates))))

    def shaped(self, values: Mapping[str, float]) -> Self:
        return replace(self, whole=self._asked(lambda: self.whole.shaped(values)))

    def _array(self, ask: Callable[[], Floats], shape: tuple[int, ...]) -> Floats:
        got = self._asked(lambda: np.asarray(ask(), dtype=float))
        if got.shape != shape or not (np.abs(got) < LARGEST).all():
            seen = f"{got.shape}" if got.shape != shape else "infinite ones or none"
            raise EffectFault(self.name, self.package, f"expected finite numbers of shape {shape}, not {seen}")
        return got

    def _asked(self, ask: Callable[[], T]) -> T:
        try:
            with np.errstate(all="ignore"):  # what comes of it is looked at
                return ask()
        except Exception as e:  # whatever somebody else's code raises is the reason that is reported
            raise EffectFault(self.name, self.package, _reason(e)) from e


def is_foreign(effect: Effect) -> bool:
    """Whether an effect is another package's, in whatever guise."""
    while isinstance(effect, Wrapped) and not isinstance(effect, Foreign):
        effect = effect.whole
    return isinstance(effect, Foreign)


@cache
def plugins() -> tuple[tuple[Effect, ...], tuple[tuple[str, str], ...]]:
    """The effects found, and (name, reason) of those that are broken."""
    found: dict[str, Effect] = {}
    broken = []
    for point in sorted(entry_points(group=GROUP), key=lambda p: (p.name, p.value)):
        effect, why = _loaded(point, found)
        if effect is None:
            broken.append((point.name, why))
        else:
            found[effect.name] = effect
    return tuple(found.values()), tuple(broken)


def _loaded(point: EntryPoint, others: Collection[str]) -> tuple[Effect | None, str]:
    try:
        thing = point.load()
        effect: Any = thing() if isinstance(thing, type) else thing
        _check(effect)
        _try(Foreign(effect, _package(point)))
        if effect.name in others:
            raise ValueError(f"the name {effect.name} is taken by another effect of another package")
    except EffectFault as e:
        return None, e.reason
    except Exception as e:  # noqa: BLE001 - whatever somebody else's code raises is the reason that is reported
        return None, _reason(e)
    return Foreign(effect, _package(point)), ""


def package_of(name: str) -> str:
    """The package that an effect is of, or an entry point that is broken, by
    its name."""
    effect = next((e for e in plugins()[0] if e.name == name), None)
    if isinstance(effect, Foreign):
        return effect.package
    point = next((p for p in entry_points(group=GROUP) if p.name == name), None)
    return _package(point) if point else UNKNOWN


def _package(point: EntryPoint) -> str:
    return f"the package {point.dist.name}" if point.dist else UNKNOWN


def _check(effect: Any) -> None:
    """Raises whatever keeps what an effect says of itself from being used."""
    if not (isinstance(effect.name, str) and effect.name and effect.coefficients and isinstance(effect.remedy, str)):
        raise TypeError("an effect has a name, coefficients and a remedy")
    if effect.name in (LINEAR, *(e.name for e in (*CATALOGUE, Empirical(), *BETWEEN_RUNS))):
        raise ValueError(f"the name {effect.name} is taken by triaxcal")
    if effect.name.startswith((BIAS, SCALE_FACTOR)):
        raise ValueError(f"the name {effect.name} is that of an effect of a channel")
    names = [c.name for c in effect.coefficients]
    if len({*names, *effect.shape}) < len(names) + len(effect.shape):
        raise ValueError(f"coefficients and shape have names of their own, not {', '.join([*names, *effect.shape])}")
    if not isinstance(effect.needs, tuple | list) or not all(isinstance(n, str) and n for n in effect.needs):
        raise TypeError(f"needs: expected a tuple of names, not {effect.needs!r}")


def _try(effect: Foreign) -> None:
    """Raises EffectFault where an effect cannot be reckoned with, in a
    recording or at its reference."""
    n = 4
    names = {*DERIVED, *effect.needs}
    recorded = {name: np.linspace(0.5, 1.5, n) for name in names}
    in_use = {name: np.full(n, np.inf if name in (SINCE_START, RUN) else 0.0) for name in names}
    s = np.linspace(-0.5, 0.5, 3 * n).reshape(n, 3)
    for covariates in (recorded, in_use):
        effect.basis(s, covariates)
        effect.slope(s, covariates)
    effect.variants(recorded)


def _reason(e: Exception) -> str:
    return f"{type(e).__name__}: {e}"
