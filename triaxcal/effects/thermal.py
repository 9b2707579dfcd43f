"""Biases and scale factors that change with the temperature."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import (
    LAGS_S,
    SINCE_START,
    T_REFERENCE,
    Coefficient,
    Effect,
    Meaning,
    lag_of,
    no_slope,
    on_each_axis,
    per_axis,
    per_axis_slope,
    rate_of,
    span_of,
    steady_within,
    xyz,
)

# Bias that changes in proportion to temperature.


@dataclass(frozen=True)
class TemperatureBias(Effect):
    """``e_i = q_i (T − T_ref)``."""

    name: str = "temperature_bias"
    coefficients: tuple[Coefficient, ...] = xyz("g/K")
    needs: tuple[str, ...] = ("temp_c",)
    remedy: str = "Correct the bias by the logged temperature, or hold the temperature steadier."
    meaning = Meaning(
        clause="the bias goes with temperature",
        because="The zero of the element or of its electronics changes as they warm.",
        formula="e = q (T − T₀)",
        factors={"*": "T − T₀"},
        symbols="T: temp_c",
        reference=T_REFERENCE,
    )

    def advice(self, largest: float, floor: float) -> str:
        return steady_within(self.remedy, largest, floor, "K")

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return on_each_axis(covariates["temp_c"])

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return no_slope(s)


# Bias that changes with temperature along a parabola.


@dataclass(frozen=True)
class TemperatureBiasQuadratic(Effect):
    """``e_i = p_i (T − T_ref) + q_i (T − T_ref)²``, a parabola with its linear part."""

    name: str = "temperature_bias_quadratic"
    coefficients: tuple[Coefficient, ...] = (
        *xyz("g/K", "linear_{}"),
        *xyz("g/K²", "quadratic_{}"),
    )
    needs: tuple[str, ...] = ("temp_c",)
    remedy: str = "Correct the bias by a parabola in the logged temperature, or hold the temperature steadier."
    meaning = Meaning(
        clause="the bias follows temperature along a parabola",
        because="The zero changes with temperature, and not in a straight line.",
        formula="e = p (T − T₀) + q (T − T₀)²",
        factors={"linear_*": "T − T₀", "quadratic_*": "(T − T₀)²"},
        symbols="T: temp_c",
        reference=T_REFERENCE,
    )

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        deviation = covariates["temp_c"]
        return np.concatenate([on_each_axis(deviation), on_each_axis(deviation**2)], axis=2)

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return no_slope(s, 6)


# Scale factor that changes in proportion to temperature.


@dataclass(frozen=True)
class TemperatureScaleFactor(Effect):
    """``e_i = q_i (T − T_ref) s_i``."""

    name: str = "temperature_scale_factor"
    coefficients: tuple[Coefficient, ...] = xyz("1/K")
    needs: tuple[str, ...] = ("temp_c",)
    remedy: str = "Correct the scale factor by the logged temperature, or hold the temperature steadier."
    meaning = Meaning(
        clause="the scale factor goes with temperature",
        because="A spring, a gap or a reference voltage changes as it warms.",
        formula="e = q (T − T₀) s",
        factors={"*": "(T − T₀) s"},
        symbols="T: temp_c",
        reference=T_REFERENCE,
    )

    def advice(self, largest: float, floor: float) -> str:
        return steady_within(self.remedy, largest, floor, "K")

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return per_axis(s * covariates["temp_c"][:, None])

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return per_axis_slope(np.repeat(covariates["temp_c"][:, None], 3, axis=1))


# Bias that lags behind the temperature, because its cause warms later than the
# thermometer.

CHANNEL = "temp_c"
SLOWEST = 2.0
"""The largest time constant, in durations of the recording. Such a lag has followed an
early step by 39 % at the end. A slower one is a drift in these poses."""


@dataclass(frozen=True)
class TemperatureLag(Effect):
    """``e_i = q_i (θ − T_ref)`` with a temperature θ that follows the thermometer by a
    first-order lag, τ dθ/dt = T − θ.

    To the first order θ = T − τ dT/dt: a bias by temperature and one by its rate
    (`ThermalGradient`). If the temperature changes within τ, θ depends on the earlier
    temperature, which one pose does not contain. So θ − T is a covariate of the poses,
    derived from the whole recording for fixed time constants
    (`triaxcal.effects.contract.lag_of`, `triaxcal.poses.covariates.lag_deviation`).
    The temperature is interpolated linearly between the middles of the poses, and is
    constant before the first. The error of this assumption decays by exp(−t/τ), as a
    `WarmUp` of the same time constant does. In use there is no lag, and the
    temperature counts as settled: θ = T.

    A time constant between two fixed ones has the mean of their lags, weighted by its
    logarithm, which is right within three per cent of the lag. Beyond them the nearest
    one counts.
    """

    time_constant_s: float = 330.0
    name: str = "temperature_lag"
    coefficients: tuple[Coefficient, ...] = xyz("g/K")
    remedy: str = (
        "Let the temperature settle before each pose, or correct the bias by a lagging temperature, in the host."
    )
    meaning = Meaning(
        clause="the bias follows the temperature late",
        because="What makes it warms and cools later than the thermometer.",
        formula="e = q (θ − T₀), τ dθ/dt = T − θ",
        factors={"*": "θ − T₀", "time_constant": "τ"},
        symbols="T: temp_c; θ: the same after a first-order lag of the time constant τ",
        reference=T_REFERENCE,
    )

    @property
    def needs(self) -> tuple[str, ...]:
        return (CHANNEL, *(lag_of(CHANNEL, constant_s) for constant_s in self._weights()))

    def advice(self, largest: float, floor: float) -> str:
        return steady_within(self.remedy, largest, floor, "K")

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        lag = sum(weight * covariates[lag_of(CHANNEL, c)] for c, weight in self._weights().items())
        return on_each_axis(covariates[CHANNEL] + lag)

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return no_slope(s)

    def _weights(self) -> dict[int, float]:
        """The neighbouring fixed time constants, and their weights."""
        nodes = np.log(LAGS_S)
        place = float(np.interp(np.log(max(self.time_constant_s, 1e-9)), nodes, np.arange(len(nodes))))
        low, share = int(place), place % 1
        return {LAGS_S[low]: 1 - share} | ({LAGS_S[low + 1]: share} if share > 0 else {})

    @property
    def shape(self) -> Mapping[str, tuple[float, str]]:
        return {"time_constant": (self.time_constant_s, "s")}

    def variants(self, covariates: Mapping[str, Floats]) -> Sequence[Effect]:
        """The fixed time constants from the shortest that a few poses show to `SLOWEST`
        durations."""
        shortest, duration = span_of(covariates[SINCE_START])
        tried = [c for c in LAGS_S if shortest <= c <= SLOWEST * duration]
        return tuple(self.shaped({"time_constant": float(c)}) for c in tried) or (self,)

    def shaped(self, values: Mapping[str, float]) -> Self:
        return replace(self, time_constant_s=values["time_constant"])


# Bias that changes with the rate of temperature: gradients inside the unit while it
# warms or cools.

RATE = rate_of("temp_c")


@dataclass(frozen=True)
class ThermalGradient(Effect):
    """``e_i = q_i dT/dt``."""

    name: str = "thermal_gradient"
    coefficients: tuple[Coefficient, ...] = xyz("g/(K/s)")
    needs: tuple[str, ...] = (RATE,)
    remedy: str = "Let the temperature settle before each pose, or correct the bias by its rate, in the host."
    meaning = Meaning(
        clause="the bias goes with how fast the temperature changes",
        because="While the unit warms or cools, one side of it is warmer than the other.",
        formula="e = q dT/dt",
        factors={"*": "dT/dt"},
        symbols="T: temp_c, by the second",
    )

    def advice(self, largest: float, floor: float) -> str:
        return steady_within(self.remedy, largest, floor, "K/s")

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return on_each_axis(covariates[RATE])

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return no_slope(s)
