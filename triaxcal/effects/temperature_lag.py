"""Bias that follows the temperature late, as what makes it warms later than the
thermometer."""

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
    span_of,
    steady_within,
    xyz,
)

CHANNEL = "temp_c"
SLOWEST = 2.0
"""Lengths of the recording. The lag of such a time constant has followed an
early step by 39 % at the end; a slower one is a drift to these poses."""


@dataclass(frozen=True)
class TemperatureLag(Effect):
    """``e_i = q_i (θ − T_ref)`` of a temperature θ that follows that of the
    thermometer by a first-order lag, τ dθ/dt = T − θ.

    To the first order θ = T − τ dT/dt, which is a bias by temperature beside
    one by its rate (`ThermalGradient`); once the temperature changes within τ,
    θ depends on what it was before. A pose does not know that by itself, so θ −
    T is a covariate of the poses, derived from all of a recording for certain
    time constants (`triaxcal.effects.contract.lag_of`,
    `triaxcal.poses.covariates.lag_deviation`): the temperature goes straight
    from the middle of one pose to that of the next, and stood still before the
    first. What it did there, nobody knows; that goes out by exp(−t/τ), as a
    `WarmUp` of the same time constant would. In use, where no lag is given, the
    temperature counts as settled: θ = T.

    A time constant between two of those known has the mean of theirs, weighted
    by its logarithm, which is right within three per cent of the lag; beyond
    them it counts as the nearest.
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
        behind = sum(weight * covariates[lag_of(CHANNEL, c)] for c, weight in self._weights().items())
        return on_each_axis(covariates[CHANNEL] + behind)

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return no_slope(s)

    def _weights(self) -> dict[int, float]:
        """Of the time constants that are known, those next to its own."""
        nodes = np.log(LAGS_S)
        place = float(np.interp(np.log(max(self.time_constant_s, 1e-9)), nodes, np.arange(len(nodes))))
        low, share = int(place), place % 1
        return {LAGS_S[low]: 1 - share} | ({LAGS_S[low + 1]: share} if share > 0 else {})

    @property
    def shape(self) -> Mapping[str, tuple[float, str]]:
        return {"time_constant": (self.time_constant_s, "s")}

    def variants(self, covariates: Mapping[str, Floats]) -> Sequence[Effect]:
        """Those known, from what a few poses show to where the lag has hardly
        begun to follow at the end."""
        shortest, whole = span_of(covariates[SINCE_START])
        tried = [c for c in LAGS_S if shortest <= c <= SLOWEST * whole]
        return tuple(self.shaped({"time_constant": float(c)}) for c in tried) or (self,)

    def shaped(self, values: Mapping[str, float]) -> Self:
        return replace(self, time_constant_s=values["time_constant"])
