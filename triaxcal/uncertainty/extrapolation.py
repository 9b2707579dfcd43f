"""A calibration that is to hold for a moment after its recording: how well
effects of time are known there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import SINCE_START, TIME, Effect, reshaped
from triaxcal.estimate.calibration import Calibration
from triaxcal.estimate.caution import Caution
from triaxcal.poses.covariates import at_moment

STEP = 1e-4
"""Relative step of the derivative by a shape, far above rounding and far below
the curvature of any effect."""
FACES = np.concatenate([np.eye(3), -np.eye(3)])
"""(6,3) up along each sensitive axis, both ways, where a bias shows whole."""


@dataclass(frozen=True)
class Extrapolated(Caution):
    """It holds ``beyond_s`` after the last pose; what effects of time make of
    the readings there has this standard uncertainty (of the axis and the face
    where it is largest), in the unit of the reference vector."""

    beyond_s: float
    uncertainty_g: float


def extrapolated(c: Calibration) -> Extrapolated | None:
    """None where the moment lies within the recording, or no effect goes with
    time."""
    if c.holds_at is None or not c.poses:
        return None
    last = max(p.pose.run.index for p in c.poses)
    beyond_s = c.holds_at.t_s - max(p.pose.end_s for p in c.poses if p.pose.run.index == last)
    at, variance = 9, np.zeros(len(FACES) * 3)
    for effect, q in c.sensor.effects:
        own = slice(at, at + len(q))
        at += len(q)
        if {TIME, SINCE_START} & set(effect.needs):
            B = _basis(effect, c)
            variance += np.einsum("ap,pq,aq->a", B, c.covariance[own, own], B)
            if c.prior_sd is None:  # what an average does not know of a shape is in its covariance
                variance += _by_shapes(effect, q, c) ** 2
    if beyond_s <= 0 or not variance.any():
        return None
    return Extrapolated(float(beyond_s), float(np.sqrt(variance.max())))


def _basis(effect: Effect, c: Calibration) -> Floats:
    """(18,p) at the moment, on each face and axis, with everything else at its
    reference."""
    needed = {name: c.channel_reference[name] for name in effect.needs}
    basis = effect.basis(c.reference * FACES, at_moment(needed, len(FACES), c.moment))
    return np.asarray(basis.reshape(-1, basis.shape[-1]))


def _by_shapes(effect: Effect, q: Floats, c: Calibration) -> Floats:
    """(18,) what the standard errors of its shapes make of it."""
    parts: Sequence[Floats] = [
        (_basis(reshaped(effect, name, value * (1 + STEP)), c) - _basis(effect, c)) @ q / (STEP * value) * error
        for name, (value, _) in effect.shape.items()
        if value and (error := c.shape_errors.get(f"{effect.name}.{name}"))
    ]
    return np.asarray(np.linalg.norm(np.array(parts).reshape(-1, len(FACES) * 3), axis=0))
