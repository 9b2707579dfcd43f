"""Bias and scale factor in proportion to any other logged channel: a supply voltage,
a magnetic field, humidity."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import (
    Coefficient,
    Effect,
    Meaning,
    covariate_of,
    no_slope,
    on_each_axis,
    per_axis,
    per_axis_slope,
    steady_within,
    xyz,
)

BIAS, SCALE_FACTOR = "channel_bias:", "channel_scale_factor:"


@dataclass(frozen=True)
class ChannelBias(Effect):
    """``e_i = q_i (c − c_ref)`` of a channel c."""

    channel: str
    meaning = Meaning(
        clause="the bias goes with {c}",
        because="What {c} measures acts on the zero of the unit, or moves together with something that does.",
        formula="e = q (c − c₀)",
        factors={"*": "c − c₀"},
        symbols="c: {c}, as logged",
        reference=("c₀", "{c}"),
    )

    @property
    def name(self) -> str:
        return BIAS + self.channel

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return xyz(f"g/[{self.channel}]")

    @property
    def needs(self) -> tuple[str, ...]:
        return (covariate_of(self.channel),)

    @property
    def remedy(self) -> str:
        return f"Hold {self.channel} steadier, or correct the bias by it, in the host."

    def advice(self, largest: float, floor: float) -> str:
        return steady_within(self.remedy, largest, floor, f"[{self.channel}]")

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return on_each_axis(covariates[covariate_of(self.channel)])

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return no_slope(s)


@dataclass(frozen=True)
class ChannelScaleFactor(Effect):
    """``e_i = q_i (c − c_ref) s_i`` of a channel c."""

    channel: str
    meaning = Meaning(
        clause="the scale factor goes with {c}",
        because="What {c} measures acts on the scale of the unit, or moves together with something that does.",
        formula="e = q (c − c₀) s",
        factors={"*": "(c − c₀) s"},
        symbols="c: {c}, as logged",
        reference=("c₀", "{c}"),
    )

    @property
    def name(self) -> str:
        return SCALE_FACTOR + self.channel

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return xyz(f"1/[{self.channel}]")

    @property
    def needs(self) -> tuple[str, ...]:
        return (covariate_of(self.channel),)

    @property
    def remedy(self) -> str:
        return f"Hold {self.channel} steadier, or correct the scale factor by it, in the host."

    def advice(self, largest: float, floor: float) -> str:
        return steady_within(self.remedy, largest, floor, f"[{self.channel}]")

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return per_axis(s * covariates[covariate_of(self.channel)][:, None])

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return per_axis_slope(np.repeat(covariates[covariate_of(self.channel)][:, None], 3, axis=1))
