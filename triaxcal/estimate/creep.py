"""Creeping poses: an error of their means while no effect explains the creep,
none once an effect does.

The mean output over a pose follows the mean of the time and of the channels over
it. So a change of a covariate inside the pose does not disturb an effect of that
covariate; it does disturb a model that lacks the effect."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from triaxcal.arrays import Floats, Ints
from triaxcal.distributions import f_sf
from triaxcal.effects.catalogue import EffectFault
from triaxcal.effects.contract import DURATION, SINCE_START, TIME, Effect, channel_of, is_derived, lag_in, rate_of
from triaxcal.estimate.calibration import Calibration
from triaxcal.estimate.likelihood import Linearised, Problem, State, linearise, linearise_all, residual_chi2
from triaxcal.poses.covariates import covariates_elsewhere, rate_of_lag
from triaxcal.poses.pose import Pose

ASLANT = 0.05
"""Largest error, in radians, of the direction of the measured vector that the
poses themselves give."""


def without_creep(poses: Sequence[Pose]) -> list[Pose]:
    """The same poses with a covariance from the scatter about their creep alone."""
    return [_with(p, np.zeros(3)) if p.creep.any() else p for p in poses]


def with_unexplained_creep(poses: Sequence[Pose], model: Calibration, *, elsewhere: bool = False) -> list[Pose]:
    """The same poses with the part of their creep that the model's effects do not
    explain. ``elsewhere``: the poses are of another recording than the model, whose
    clocks the model does not know.
    """
    if not any(p.creep.any() for p in poses) or not model.sensor.effects:
        return list(poses)
    # Creep that the effects predict: outputs at the end less outputs at the beginning.
    covariates = _covariates(poses, model, elsewhere)
    try:
        change = _change(poses, model, covariates, elsewhere)
    except EffectFault:  # known in the middle of the poses alone
        return list(poses)
    # Keep the unexplained part, and only where it is smaller than the whole.
    left = [
        _unexplained_creep(p.creep, c, g)
        for p, c, g in zip(poses, change, _outward(poses, model, covariates), strict=True)
    ]
    return [
        _with(p, rest) if p.creep.any() and rest @ rest < p.creep @ p.creep else p
        for p, rest in zip(poses, left, strict=True)
    ]


def _unexplained_creep(creep: Floats, change: Floats, outward: Floats) -> Floats:
    """The part of a pose's creep that ``change`` does not explain. Where a pose only
    turns and its |a| stays within the noise, only the rotation counts as creep
    (`triaxcal.poses.pose`), and only that part is returned."""
    # Project out the radial part where the creep itself has none.
    left = creep - change
    rotates = abs(creep @ outward) <= ASLANT * np.linalg.norm(creep)
    return np.asarray(left - (left @ outward) * outward if rotates else left)


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
    """(n,3) change of the outputs by the model's effects from the beginning of each
    pose to its end."""
    sensor = model.sensor
    length = np.array([p.end_s - p.start_s for p in poses])
    ends = []
    # Covariates half a pose before and after the middle.
    for half in (-length / 2, length / 2):
        at = dict(covariates)
        if DURATION in covariates:
            at[DURATION] = np.zeros(len(poses))  # moments, not means
        for name in covariates:
            if name in (TIME, SINCE_START):
                # Clocks run inside the pose; those of another recording stand still.
                at[name] = covariates[name] if elsewhere else covariates[name] + half
                continue
            # Channels change at their own rate; a lagged channel at the rate of its
            # lag.
            lag = lag_in(name)
            channel = channel_of(lag[0] if lag else name)
            if (lag is None and is_derived(name)) or any(channel not in p.rates for p in poses):
                continue
            rate = np.array([p.rates[channel] for p in poses])
            at[name] = covariates[name] + half * (rate if lag is None else rate_of_lag(covariates[name], rate, lag[1]))
        ends.append(at)
    # Output change K (f(end) − f(beginning)), with f what the effects add in g.
    s = sensor.along_axes(np.array([p.mean for p in poses]), covariates)
    first, last = (sensor.departure(s, at) for at in ends)
    return np.asarray(sensor.scale_factor * (last - first))


def _with(pose: Pose, creep: Floats) -> Pose:
    # A straight line from end to end has the variance creep²/12 about its mean.
    change = (np.outer(creep, creep) - np.outer(pose.creep, pose.creep)) / 12
    return replace(pose, covariance=pose.covariance + change, creep=creep)


# How |a| goes inside the poses: data of its own beside the means.

PLACES = np.linspace(-0.5, 0.5, 6)
"""Where in a pose the model is asked, from its beginning to its end: enough to
follow a step or a steep decay."""


@dataclass(frozen=True)
class PoseSlopes:
    """``inside`` are the poses at all `PLACES`, one place after the other,
    ``middle`` as they are in the middle, both with the covariance of the
    slopes; ``errors`` (n,) by covariate those of the changes that the
    covariates are said to have gone through, and ``moving`` the covariates that
    go through any."""

    inside: Problem
    middle: Problem
    errors: Mapping[str, Floats]
    moving: frozenset[str]
    widening: Floats | float = 1.0
    """Times the errors that the noise makes, (n,) or all."""

    @classmethod
    def of(cls, problem: Problem, poses: Sequence[Pose]) -> PoseSlopes | None:
        """None where the poses do not know their slopes."""
        # Standard errors of the slopes; infinite where they are not known.
        error = np.array([p.slope_error for p in poses])
        if not np.isfinite(error).all() or not np.isfinite([p.slope for p in poses]).all():
            return None
        # Changes of the covariates along each pose, and their errors.
        length = np.array([p.end_s - p.start_s for p in poses])
        change, errors = _changes(problem, poses, length)
        moving = frozenset(change)
        change |= {n: np.zeros(len(poses)) for n in problem.channels.keys() - change.keys()}
        middle = replace(problem, excess=0.0, covariance=error[:, None, None] ** 2 * np.eye(3))
        # Outputs and covariates at PLACES from the beginning of a pose to its end.
        inside = replace(
            middle,
            u=_moved(problem.u, np.array([p.slope for p in poses])),
            covariance=np.concatenate([middle.covariance] * len(PLACES)),
            # A moment is asked for, not a mean over the pose.
            channels={n: _moved(v, change[n]) for n, v in problem.channels.items()}
            | {DURATION: np.zeros(len(PLACES) * len(poses))},
        )
        return cls(inside, middle, errors, moving)

    def linearise(self, state: State, jacobian: bool = True) -> Linearised:
        """Residuals: the slope of |a| along each pose, which should be zero;
        otherwise as `triaxcal.estimate.likelihood.linearise`."""
        # Regress |a| at PLACES on the place: its slope is the residual.
        everywhere, by_theta, _ = linearise(self.inside, state, jacobian)
        r = self.along(everywhere)
        if not jacobian:
            return r, by_theta, np.empty(0)
        J = self.along(by_theta)
        here, _, error = linearise(self.middle, state)
        # Add the errors of the covariates' changes, by a difference quotient.
        variance = error**2
        # In one order whatever the process, or audits would differ in the last
        # digits.
        for name in sorted({c for e in state.effects for c in e.needs} & self.errors.keys()):
            channels = dict(self.middle.channels) | {name: self.middle.channels[name] + self.errors[name]}
            there, _, _ = linearise(replace(self.middle, channels=channels), state, jacobian=False)
            variance = variance + (there - here) ** 2
        return r, J, self.widening * np.sqrt(variance)

    def along(self, values: Floats) -> Floats:
        """(n,…) least-squares slope of ``values`` (k·n,…) at all `PLACES` along each
        pose."""
        slope = PLACES / (PLACES @ PLACES)
        return np.tensordot(slope, values.reshape(len(slope), -1, *values.shape[1:]), 1)

    def asked_at(self, inside: Problem) -> PoseSlopes:
        return replace(self, inside=inside)

    def widened(self, factor: Floats) -> PoseSlopes:
        return replace(self, widening=self.widening * factor)

    def only(self, rows: Ints | slice) -> PoseSlopes:
        """Those of some of the poses."""
        n = len(self.middle.u)
        kept = np.arange(n)[rows]
        inside = self.inside.only(np.concatenate([kept + n * k for k in range(len(PLACES))]))
        errors = {name: error[rows] for name, error in self.errors.items()}
        widening: Floats = np.broadcast_to(self.widening, n)[rows]
        return replace(self, inside=inside, middle=self.middle.only(rows), errors=errors, widening=widening)

    def inform(self, effects: Sequence[Effect]) -> bool:
        """Whether any of the effects needs a covariate that changes inside the
        poses."""
        return any(n in self.moving for e in effects for n in e.needs)


def with_slopes(problem: Problem, poses: Sequence[Pose], effects: Sequence[Effect]) -> Problem | None:
    """The problem with the slopes added to the means; None where the slopes carry no
    information on the effects."""
    slopes = PoseSlopes.of(problem, poses) if effects else None
    return replace(problem, slopes=slopes) if slopes is not None and slopes.inform(effects) else None


def slopes_p(problem: Problem, state: State, pure: float) -> float:
    """p-value of the slopes' residuals against the noise inside the poses, of
    ``pure`` degrees of freedom; ``state`` is that of a fit to means and slopes."""
    left = len(problem.u) - max(len(state.theta) - len(problem.u), 0)
    if left <= 0:
        return 0.0
    return float(f_sf(left_by_slopes(problem, state) / left, left, max(pure, 1.0)))


def left_by_slopes(problem: Problem, state: State) -> float:
    """Chi-square of a fit to means and slopes, less that of a fit to the means
    alone."""
    r, _, s = linearise_all(problem, state)
    apart = float(np.sum((r / s) ** 2)) - residual_chi2(linearise(problem, state))
    return max(apart, 0.0) if np.isfinite(apart) else np.inf


def _moved(values: Floats, change: Floats) -> Floats:
    """(k·n,…) values at all `PLACES`, from ``values`` (n,…) in the middle of the
    poses and their ``change`` along them."""
    return np.concatenate([values + x * change for x in PLACES])


def _changes(problem: Problem, poses: Sequence[Pose], length: Floats) -> tuple[dict[str, Floats], dict[str, Floats]]:
    """By covariate, (n,) each: its change along each pose, and the standard error of
    the change."""
    # Clocks change by the length of the pose, without error.
    change = dict.fromkeys((TIME, SINCE_START), length)
    errors: dict[str, Floats] = {}
    # Logged channels: change of the channel by its rate, change of its rate by its
    # bend.
    for name in problem.channels:
        channel = channel_of(name)
        if is_derived(name) or any(channel not in p.bends for p in poses):
            continue
        known = [(p.rates[channel], p.rate_errors[channel], p.bends[channel], p.bend_errors[channel]) for p in poses]
        if not np.isfinite(known).all():
            continue
        change[name] = length * np.array([p.rates[channel] for p in poses])
        errors[name] = length * np.array([p.rate_errors[channel] for p in poses])
        change[rate_of(name)] = length * np.array([p.bends[channel] for p in poses])
        errors[rate_of(name)] = length * np.array([p.bend_errors[channel] for p in poses])
    # Lagged channels follow their channel with their own time constant.
    for name in problem.channels:
        lag = lag_in(name)
        if lag is not None and lag[0] in change:
            channel = channel_of(lag[0])
            rate = np.array([p.rates[channel] for p in poses])
            change[name] = length * rate_of_lag(problem.channels[name], rate, lag[1])
            # That of the rate counts with the channel itself.
            errors[name] = length / lag[1] * np.array([p.channel_errors.get(channel, 0.0) for p in poses])
    return {n: c for n, c in change.items() if n in problem.channels}, errors
