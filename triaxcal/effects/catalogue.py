"""The effects of our own. A new one is one file and one line here, or an entry
point of another package."""

from __future__ import annotations

from triaxcal.effects.contract import Effect
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
from triaxcal.effects.thermal import (
    TemperatureBias,
    TemperatureBiasQuadratic,
    TemperatureLag,
    TemperatureScaleFactor,
    ThermalGradient,
)
from triaxcal.effects.time import BiasDrift, BiasStep, ScaleFactorDrift, WarmUp

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
