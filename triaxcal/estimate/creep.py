"""Poses that creep: an error of their means as long as nobody knows why, none
once an effect explains it.

The mean of the outputs over a pose goes with the mean of the time and of the
channels over it, so an effect that follows them is not disturbed by their
moving inside the pose; a model that lacks the effect is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import DURATION, SINCE_START, TIME, channel_of, is_derived, lag_in
from triaxcal.effects.plugins import EffectFault
from triaxcal.estimate.calibration import Calibration
from triaxcal.poses.covariates import covariates_elsewhere, rate_of_lag
from triaxcal.poses.pose import Pose

ASLANT = 0.05
"""How far the direction of the measured vector that poses know of themselves is
off, at most."""


def without_creep(poses: Sequence[Pose]) -> list[Pose]:
    """The same poses with the scatter about their creep alone in their
    covariance."""
    return [_with(p, np.zeros(3)) if p.creep.any() else p for p in poses]


def with_unexplained_creep(poses: Sequence[Pose], model: Calibration, *, elsewhere: bool = False) -> list[Pose]:
    """The same poses with so much of their creep as the model's effects do not
    explain. ``elsewhere``: they are of another recording than the model, of
    whose clocks it knows nothing.
    """
    if not any(p.creep.any() for p in poses) or not model.sensor.effects:
        return list(poses)
    covariates = _covariates(poses, model, elsewhere)
    try:
        change = _change(poses, model, covariates, elsewhere)
    except EffectFault:  # known in the middle of the poses alone
        return list(poses)
    left = [_beside(p.creep, c, g) for p, c, g in zip(poses, change, _outward(poses, model, covariates), strict=True)]
    return [
        _with(p, rest) if p.creep.any() and rest @ rest < p.creep @ p.creep else p
        for p, rest in zip(poses, left, strict=True)
    ]


def _beside(creep: Floats, change: Floats, outward: Floats) -> Floats:
    """What ``change`` leaves of a pose's creep. Of a pose that only turns,
    whose |a| stays within its noise, only the turn was taken for creep
    (`triaxcal.poses.pose`), and so is what is left."""
    left = creep - change
    turns = abs(creep @ outward) <= ASLANT * np.linalg.norm(creep)
    return np.asarray(left - (left @ outward) * outward if turns else left)


def _outward(poses: Sequence[Pose], model: Calibration, covariates: Mapping[str, Floats]) -> Floats:
    """(n,3) unit gradients of |a| by the outputs."""
    _, by_u = model.sensor.magnitude(np.array([p.mean for p in poses]), covariates)
    return np.asarray(by_u / np.linalg.norm(by_u, axis=1, keepdims=True))


def _covariates(poses: Sequence[Pose], model: Calibration, elsewhere: bool) -> dict[str, Floats]:
    sensor = model.sensor
    if elsewhere:
        return covariates_elsewhere(poses, model.channel_reference, sensor.scale_factor, sensor.bias, model.moment)
    return dict(model.covariates_of(poses))


def _change(poses: Sequence[Pose], model: Calibration, covariates: Mapping[str, Floats], elsewhere: bool) -> Floats:
    """(n,3) by how much the model's effects change the outputs from the
    beginning of each pose to its end."""
    sensor = model.sensor
    length = np.array([p.end_s - p.start_s for p in poses])
    ends = []
    for half in (-length / 2, length / 2):
        at = dict(covariates)
        if DURATION in covariates:
            at[DURATION] = np.zeros(len(poses))  # moments, not means
        for name in covariates:
            if name in (TIME, SINCE_START):
                at[name] = covariates[name] if elsewhere else covariates[name] + half
                continue
            lag = lag_in(name)
            channel = channel_of(lag[0] if lag else name)
            if (lag is None and is_derived(name)) or any(channel not in p.rates for p in poses):
                continue
            rate = np.array([p.rates[channel] for p in poses])
            at[name] = covariates[name] + half * (rate if lag is None else rate_of_lag(covariates[name], rate, lag[1]))
        ends.append(at)
    s = sensor.along_axes(np.array([p.mean for p in poses]), covariates)
    first, last = (sensor.departure(s, at) for at in ends)
    return np.asarray(sensor.scale_factor * (last - first))


def _with(pose: Pose, creep: Floats) -> Pose:
    change = (np.outer(creep, creep) - np.outer(pose.creep, pose.creep)) / 12
    return replace(pose, covariance=pose.covariance + change, creep=creep)
