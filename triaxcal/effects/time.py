"""Biases and scale factors that change with time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from triaxcal.arrays import Floats, evenly_spread
from triaxcal.effects.contract import (
    DURATION,
    SINCE_START,
    TIME,
    Coefficient,
    Effect,
    Meaning,
    no_slope,
    on_each_axis,
    per_axis,
    per_axis_slope,
    span_of,
    xyz,
)

# Bias that drifts with time along a polynomial.

DEGREES = (1, 2, 3)
"""A line, one bend, two bends. A higher degree would follow any slow change."""


@dataclass(frozen=True)
class BiasDrift(Effect):
    """``e_i = q_i (t − t_ref) + q2_i (t − t_ref)² + …`` up to ``degree``."""

    degree: int = 1
    name: str = "bias_drift"
    needs: tuple[str, ...] = (TIME,)
    remedy: str = "Let the unit settle before the first pose, and repeat the first pose at the end."
    meaning = Meaning(
        clause="the bias drifts with time",
        because=(
            "The unit had not settled, or something around it changed slowly. It belongs to this "
            "recording, not to the unit."
        ),
        formula="e = q (t − t₀) + q₂ (t − t₀)² + q₃ (t − t₀)³",
        factors={"*": "t − t₀", "*2": "(t − t₀)²", "*3": "(t − t₀)³"},
        symbols="t: time in s; powers without a coefficient are zero",
        reference=("t₀", "t_s"),
    )

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        higher = (c for d in range(2, self.degree + 1) for c in xyz(f"g/s{'²³'[d - 2]}", f"{{}}{d}"))
        return (*xyz("g/s"), *higher)

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        powers = [on_each_axis(covariates[TIME] ** d) for d in range(1, self.degree + 1)]
        return np.concatenate(powers, axis=2)

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return no_slope(s, 3 * self.degree)

    @property
    def forms(self) -> tuple[Effect, ...]:
        return tuple(BiasDrift(degree) for degree in DEGREES)


# Bias that steps once, at an unknown moment: a knock, a supply that switched, a loose
# part.

MOMENTS = 200
"""Maximum number of moments: those between and in up to 101 poses. In longer
recordings a diagnosis refines the likeliest moments afterwards."""


@dataclass(frozen=True)
class BiasStep(Effect):
    """``e_i = −q_i`` before the step, zero after it: the unit after the step is the
    reference.

    ``at_s`` counts from the start of the recording. A pose with the step inside has
    the share of its duration before the step.
    """

    at_s: float = 0.0
    name: str = "bias_step"
    coefficients: tuple[Coefficient, ...] = xyz("g")
    needs: tuple[str, ...] = (SINCE_START, DURATION)
    lasting: bool = True
    remedy: str = "Look for what happened then (a knock, a supply, a loose part) and record again."
    meaning = Meaning(
        clause="the bias jumps at one moment",
        because=(
            "A knock, a change of the supply, a part that came loose. It belongs to this recording, not to the unit."
        ),
        formula="e = −q before t₁, 0 after it",
        factors={"*": "−1 before t₁, 0 after", "at": "t₁"},
        symbols="t₁: seconds since the recording began",
        in_run="{by}, t₁ in recording {n}; all earlier ones are before it",
    )

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        duration = np.maximum(covariates[DURATION], 1e-9)
        begin = covariates[SINCE_START] - duration / 2
        return on_each_axis(-np.clip((self.at_s - begin) / duration, 0.0, 1.0))

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return no_slope(s)

    @property
    def absent(self) -> str:
        return f"after the step at {self.at_s:.1f} s"

    @property
    def shape(self) -> Mapping[str, tuple[float, str]]:
        return {"at": (self.at_s, "s")}

    def variants(self, covariates: Mapping[str, Floats]) -> Sequence[Effect]:
        """Moments between any two poses, and in the middle of any pose but the first
        and the last; at most `MOMENTS` of them, evenly spread."""
        t, duration = covariates[SINCE_START], covariates[DURATION]
        order = np.argsort(t)
        begin, end = (t - duration / 2)[order], (t + duration / 2)[order]
        moments = np.sort([*(end[:-1] + begin[1:]) / 2, *t[order][1:-1]])
        return tuple(self.shaped({"at": float(m)}) for m in evenly_spread(moments, MOMENTS))

    def shaped(self, values: Mapping[str, float]) -> Self:
        return replace(self, at_s=values["at"])


# Bias that settles exponentially after the start: warm-up.

CONSTANTS = 8
"""Number of time constants in the search, even in the logarithm: a factor of 1.8
apart in 27 poses. More cost time for each hypothesis; fewer leave gaps between the
shapes."""
SLOWEST = 4.0
"""The largest time constant, in durations of the recording. Over a quarter of its time
constant an exponential departs from its chord by 3 % of its change. A slower one is a
straight drift."""


@dataclass(frozen=True)
class WarmUp(Effect):
    """``e_i = q_i exp(−t/τ)`` at t after the start of the recording; the
    settled unit is the reference."""

    time_constant_s: float = 300.0
    name: str = "warm_up"
    coefficients: tuple[Coefficient, ...] = xyz("g")
    needs: tuple[str, ...] = (SINCE_START,)
    remedy: str = "Switch the unit on and wait before the first pose, until the bias has settled."
    meaning = Meaning(
        clause="the bias settles after the start, as while a unit warms up",
        because="The unit was switched on shortly before. It belongs to this recording, not to the unit.",
        formula="e = q exp(−t / τ)",
        factors={"*": "exp(−t / τ)", "time_constant": "τ"},
        symbols="t: seconds since the recording began",
    )

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return on_each_axis(np.exp(-covariates[SINCE_START] / self.time_constant_s))

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return no_slope(s)

    def advice(self, largest: float, floor: float) -> str:
        """The remedy with the time after which no more than ``floor`` is left, counted
        from the first sample. A recording that began later needs less."""
        if not 0 < floor < abs(largest):
            return self.remedy
        wait_s = self.time_constant_s * math.log(abs(largest) / floor)
        wait = f"{math.ceil(wait_s)} s" if wait_s < 120 else f"{math.ceil(wait_s / 60)} minutes"
        return f"{self.remedy} What is left of it is below the noise floor from {wait} after the first sample on."

    @property
    def shape(self) -> Mapping[str, tuple[float, str]]:
        return {"time_constant": (self.time_constant_s, "s")}

    def variants(self, covariates: Mapping[str, Floats]) -> Sequence[Effect]:
        """Time constants from the shortest that three poses show to one that is
        straight over the recording within a few per cent."""
        shortest, duration = span_of(covariates[SINCE_START])
        return tuple(
            self.shaped({"time_constant": float(c)}) for c in np.geomspace(shortest, SLOWEST * duration, CONSTANTS)
        )

    def shaped(self, values: Mapping[str, float]) -> Self:
        return replace(self, time_constant_s=values["time_constant"])


# Scale factor that drifts steadily with time.


@dataclass(frozen=True)
class ScaleFactorDrift(Effect):
    """``e_i = q_i (t − t_ref) s_i``: the scale factor changes by the share q_i per
    second, for example by a reference voltage or a magnet that warms or ages."""

    name: str = "scale_factor_drift"
    coefficients: tuple[Coefficient, ...] = xyz("1/s")
    needs: tuple[str, ...] = (TIME,)
    remedy: str = "Let the unit settle before the first pose, and repeat the first poses at the end."
    meaning = Meaning(
        clause="the scale factor drifts with time",
        because=(
            "The unit had not settled: a reference voltage or a magnet still warmed. It belongs to "
            "this recording, not to the unit."
        ),
        formula="e = q (t − t₀) s",
        factors={"*": "(t − t₀) s"},
        symbols="t: time in s",
        reference=("t₀", "t_s"),
    )

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return per_axis(s * covariates[TIME][:, None])

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return per_axis_slope(np.repeat(covariates[TIME][:, None], 3, axis=1))
