"""Effects of the recording's clock as a plan sees them, whose time runs from
−1, the first pose, to 1, the last."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import DURATION, SINCE_START, TIME, Effect
from triaxcal.effects.runs import of_clocks
from triaxcal.effects.wrapped import Wrapped
from triaxcal.model.directions import FULL

PLANS_CLOCK = "plans_clock"
"""`TIME` from −1 to 1, where that itself is in seconds."""
POSES = FULL + 1
"""Of the plan that shapes are chosen for: the one of 26, its first pose
repeated."""
HELD_SHARE = 0.01
"""How long a pose is held, where the plan is two long: an eighth of the time
from pose to pose, so that a step falls between poses as a rule."""


@dataclass(frozen=True)
class OnPlansClock(Wrapped):
    """``whole`` with a shape that suits a recording two units long, by
    `PLANS_CLOCK`, or `TIME` where that is one."""

    needs: tuple[str, ...] = (TIME,)

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return self.whole.basis(s, _clocks(_plans(covariates)))

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return self.whole.slope(s, _clocks(_plans(covariates)))


def in_plan(effect: Effect) -> Effect:
    """The effect as a plan can show it: of a time constant or a moment, the
    middle one that would be tried."""
    if not of_clocks(effect) or effect.needs == (TIME,):
        return effect
    variants = effect.variants(_clocks(np.linspace(-1, 1, POSES)))
    return OnPlansClock(variants[len(variants) // 2])


def _plans(covariates: Mapping[str, Floats]) -> Floats:
    return covariates[PLANS_CLOCK] if PLANS_CLOCK in covariates else covariates[TIME]


def _clocks(time: Floats) -> dict[str, Floats]:
    return {TIME: time, SINCE_START: time + 1, DURATION: np.full(len(time), HELD_SHARE)}
