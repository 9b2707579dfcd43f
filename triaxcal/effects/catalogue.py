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
"""Our own effects that need no channel, or temperature alone."""


# Effects of other packages: entry points of the group ``triaxcal.effects``, each an
# `Effect` or a class that returns one without arguments.

GROUP = "triaxcal.effects"
LINEAR = "linear"
"""The name of the nine parameters in documents, among the names of effects."""
UNKNOWN = "another package"
"""The name of a package without metadata."""
LARGEST = 1e100
"""Limit of an effect's contribution: its square must be a finite number, too."""

T = TypeVar("T")


class EffectFault(InvalidData):
    """An effect of another ``package`` is unusable, for this ``reason``."""

    def __init__(self, name: str, package: str, reason: str) -> None:
        super().__init__(f"the effect {name} of {package}: {reason}")
        self.reason = reason


@dataclass(frozen=True)
class PluginEffect(Wrapped):
    """An effect of another package. Raises EffectFault alone, whenever the effect
    raises or returns no finite numbers."""

    package: str = UNKNOWN

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return self._array(lambda: self.inner.basis(s, covariates), (len(s), 3, len(self.coefficients)))

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return self._array(lambda: self.inner.slope(s, covariates), (len(s), 3, 3, len(self.coefficients)))

    @property
    def needs(self) -> tuple[str, ...]:
        return tuple(self.inner.needs)

    def advice(self, largest: float, floor: float) -> str:
        try:
            return str(self._guarded(lambda: self.inner.advice(largest, floor)))
        except EffectFault:  # words only
            return self.remedy

    @property
    def meaning(self) -> Meaning | None:
        try:
            meaning = self._guarded(lambda: self.inner.meaning)
        except EffectFault:  # words only
            return None
        return meaning if isinstance(meaning, Meaning) else None

    @property
    def absent(self) -> str:
        try:
            return str(self._guarded(lambda: self.inner.absent))
        except EffectFault:
            return ""

    @property
    def lasting(self) -> bool:
        return self.inner.lasting

    @property
    def forms(self) -> tuple[Effect, ...]:
        return tuple(PluginEffect(e, self.package) for e in self._guarded(lambda: tuple(self.inner.forms)))

    def variants(self, covariates: Mapping[str, Floats]) -> Sequence[Effect]:
        return tuple(
            PluginEffect(e, self.package) for e in self._guarded(lambda: tuple(self.inner.variants(covariates)))
        )

    def shaped(self, values: Mapping[str, float]) -> Self:
        return replace(self, inner=self._guarded(lambda: self.inner.shaped(values)))

    def _array(self, call: Callable[[], Floats], shape: tuple[int, ...]) -> Floats:
        got = self._guarded(lambda: np.asarray(call(), dtype=float))
        if got.shape != shape or not (np.abs(got) < LARGEST).all():
            seen = f"{got.shape}" if got.shape != shape else "infinite ones or none"
            raise EffectFault(self.name, self.package, f"expected finite numbers of shape {shape}, not {seen}")
        return got

    def _guarded(self, call: Callable[[], T]) -> T:
        try:
            with np.errstate(all="ignore"):  # `_array` checks the result
                return call()
        except Exception as e:  # code of another package may raise anything
            raise EffectFault(self.name, self.package, _reason(e)) from e


def is_plugin(effect: Effect) -> bool:
    """Whether an effect is another package's, also inside wrappers."""
    while isinstance(effect, Wrapped) and not isinstance(effect, PluginEffect):
        effect = effect.inner
    return isinstance(effect, PluginEffect)


@cache
def plugins() -> tuple[tuple[Effect, ...], tuple[tuple[str, str], ...]]:
    """The usable effects of other packages, and (name, reason) of the broken ones."""
    found: dict[str, Effect] = {}
    broken = []
    for point in sorted(entry_points(group=GROUP), key=lambda p: (p.name, p.value)):
        effect, why = _load(point, found)
        if effect is None:
            broken.append((point.name, why))
        else:
            found[effect.name] = effect
    return tuple(found.values()), tuple(broken)


def _load(point: EntryPoint, others: Collection[str]) -> tuple[Effect | None, str]:
    """The effect of an entry point, or None and the reason."""
    try:
        target = point.load()
        effect: Any = target() if isinstance(target, type) else target
        _check(effect)
        _try_out(PluginEffect(effect, _package(point)))
        if effect.name in others:
            raise ValueError(f"the name {effect.name} is taken by another effect of another package")
    except EffectFault as e:
        return None, e.reason
    except Exception as e:  # noqa: BLE001 - code of another package may raise anything
        return None, _reason(e)
    return PluginEffect(effect, _package(point)), ""


def package_of(name: str) -> str:
    """The package of an effect, or of a broken entry point, by its name."""
    effect = next((e for e in plugins()[0] if e.name == name), None)
    if isinstance(effect, PluginEffect):
        return effect.package
    point = next((p for p in entry_points(group=GROUP) if p.name == name), None)
    return _package(point) if point else UNKNOWN


def _package(point: EntryPoint) -> str:
    return f"the package {point.dist.name}" if point.dist else UNKNOWN


def _check(effect: Any) -> None:
    """Raises TypeError, ValueError or any other error of an effect's declarations."""
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


def _try_out(effect: PluginEffect) -> None:
    """Evaluates an effect in a recording and at its reference. Raises EffectFault."""
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
