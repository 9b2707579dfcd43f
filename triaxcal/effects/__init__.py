"""The catalogue of effects. A new effect is one file and one line here."""

from __future__ import annotations

from triaxcal.effects.bias_drift import BiasDrift
from triaxcal.effects.contract import TIME, Coefficient, Effect
from triaxcal.effects.second_order_nonlinearity import SecondOrderNonlinearity
from triaxcal.effects.temperature_bias import TemperatureBias
from triaxcal.effects.temperature_bias_quadratic import TemperatureBiasQuadratic
from triaxcal.effects.temperature_scale_factor import TemperatureScaleFactor
from triaxcal.effects.third_order_nonlinearity import ThirdOrderNonlinearity

CATALOGUE: tuple[Effect, ...] = (
    SecondOrderNonlinearity(),
    ThirdOrderNonlinearity(),
    TemperatureBias(),
    TemperatureBiasQuadratic(),
    TemperatureScaleFactor(),
    BiasDrift(),
)


def effect_named(name: str) -> Effect:
    """Raises KeyError."""
    return {effect.name: effect for effect in CATALOGUE}[name]


__all__ = ["CATALOGUE", "TIME", "Coefficient", "Effect", "effect_named"]
