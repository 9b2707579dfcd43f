"""The effects of our own. A new one is one file and one line here, or an entry
point of another package."""

from __future__ import annotations

from triaxcal.effects.bias_drift import BiasDrift
from triaxcal.effects.bias_step import BiasStep
from triaxcal.effects.compression import Compression
from triaxcal.effects.contract import Effect
from triaxcal.effects.cross_coupling import CrossCoupling
from triaxcal.effects.fifth_order_nonlinearity import FifthOrderNonlinearity
from triaxcal.effects.hysteresis import Hysteresis
from triaxcal.effects.remanence import Remanence
from triaxcal.effects.scale_factor_asymmetry import ScaleFactorAsymmetry
from triaxcal.effects.scale_factor_drift import ScaleFactorDrift
from triaxcal.effects.second_order_nonlinearity import SecondOrderNonlinearity
from triaxcal.effects.temperature_bias import TemperatureBias
from triaxcal.effects.temperature_bias_quadratic import TemperatureBiasQuadratic
from triaxcal.effects.temperature_lag import TemperatureLag
from triaxcal.effects.temperature_scale_factor import TemperatureScaleFactor
from triaxcal.effects.thermal_gradient import ThermalGradient
from triaxcal.effects.third_order_nonlinearity import ThirdOrderNonlinearity
from triaxcal.effects.vibration_rectification import VibrationRectification
from triaxcal.effects.warm_up import WarmUp

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
