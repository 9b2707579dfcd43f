"""Linear propagation at the solution of a fit: from errors of the residuals to the
parameters, and on to |a|."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import SINCE_START, TIME, Effect, reshaped
from triaxcal.estimate.calibration import Calibration, Caution, Unmodelled
from triaxcal.estimate.creep import with_slopes
from triaxcal.estimate.fit_assessment import Excess
from triaxcal.estimate.initial_estimate import problem_of, with_history
from triaxcal.estimate.likelihood import Problem, State, by_shape, linearise, linearise_all, parameters_by_theta
from triaxcal.model.directions import spiral
from triaxcal.model.sensor import Sensor
from triaxcal.poses.covariates import at_moment

SPHERE = 200
"""Number of directions in a mean over the sphere. The variance of the magnitude is a
polynomial of the fourth degree there."""


class SphereMean:
    """The sphere on which parameters are judged. ``by_parameters`` (m,p): derivative
    of |a| by the parameters."""

    by_parameters: Floats

    @classmethod
    def of(cls, calibration: Calibration) -> SphereMean:
        """The sphere under the covariates of use."""
        found, up = cls(), spiral(SPHERE) * calibration.reference
        covariates = at_moment(calibration.channel_reference, len(up), calibration.moment)
        u = calibration.sensor.output(up, covariates)
        found.by_parameters = calibration.sensor.radius_by_parameters(u, covariates)
        return found

    def magnitude(self, covariance: Floats) -> float:
        """Rms uncertainty of |a| over the sphere from a covariance (p,p) of the
        parameters: √(mean of diag(J C Jᵀ))."""
        return float(
            np.sqrt(max(np.einsum("mi,ij,mj->", *[self.by_parameters, covariance, self.by_parameters]), 0.0) / SPHERE)
        )


class ErrorPropagation(SphereMean):
    """The fit linearised at its solution, and the sphere on which its parameters are
    judged."""

    def __init__(self, calibration: Calibration) -> None:
        sensor = calibration.sensor
        poses = [p.pose for p in calibration.poses if p.used]
        signs = tuple(np.sign(sensor.scale_factor))
        effects = [effect for effect, _ in sensor.effects]
        problem = problem_of(poses, signs=signs, reference=calibration.reference, effects=effects)
        problem = with_history(problem, poses, sensor)
        # Channels of the model keep their rounded reference, others get their mean. The
        # mean is rounded to a millionth, since processors differ in the last digits.
        means = {n: round(float(np.mean(problem.channels[n])), 6) for n in problem.channel_reference}
        self.problem = replace(problem, channel_reference=means | dict(calibration.channel_reference))
        self.state = State.of(self.problem, sensor)
        self.effects = self.state.effects
        if calibration.slopes:
            self.problem = with_slopes(self.problem, poses, self.effects) or self.problem
        self.noise = linearise_all(self.problem, self.state)[2]
        """(n,) standard errors of the residuals from noise and creep of the poses."""
        self.problem = Excess(excess_g=calibration.excess_g).added_to(self.problem, self.state)
        _, J, self.error = linearise_all(self.problem, self.state)
        # The uncertainty of the shapes of effects adds to that of the parameters.
        self.weighted = np.concatenate([J, by_shape(self.problem, self.state)], axis=1) / self.error[:, None]
        # Generalised inverse of the weighted Jacobian, with the prior; then to
        # parameters.
        self.gain = gain_given_prior(self.weighted, calibration.prior_sd)
        self.G = parameters_by_theta(self.problem, self.state)
        self.by_residual = -self.G @ self.gain[: len(self.G)] / self.error
        """(p,n): change of the parameters for an error of each residual
        (`likelihood.linearise_all`)."""
        self.up = spiral(SPHERE) * calibration.reference
        """(m,3) specific force over the sphere."""
        self.sphere = self._sphere(calibration, {})
        _, J, _ = linearise(self.sphere, self.state)
        self.by_parameters = J @ np.linalg.inv(self.G)

    def _sphere(self, calibration: Calibration, shift: Mapping[str, float]) -> Problem:
        """Outputs of the unit over the sphere, under the covariates of use plus
        ``shift``."""
        reference = self.problem.channel_reference
        covariates = at_moment(reference, len(self.up), calibration.moment)
        u = calibration.sensor.output(self.up, covariates)
        channels = {n: covariates[n] + v + shift.get(n, 0.0) for n, v in reference.items()}
        none = np.zeros((len(u), 3, 3))
        return replace(self.problem, u=u, covariance=none, channels=channels, channel_reference=reference, slopes=None)

    def when_shifted(self, calibration: Calibration, channel: str, by: float) -> Floats:
        """(p,) change of the parameters that keeps |a| right if a channel is off by
        this value."""
        # Residuals of |a| with the shifted channel, fitted by the nine parameters.
        shifted = self._sphere(calibration, {channel: by})
        r, _, _ = linearise(shifted, self.state, jacobian=False)
        nine = self.by_parameters[:, :9]
        return np.concatenate([-np.linalg.lstsq(nine, r, rcond=None)[0], np.zeros(len(self.G) - 9)])


def gain_given_prior(weighted: Floats, spread: Floats | None) -> Floats:
    """(p,n) gain from weighted residuals to parameters, with normal priors of
    standard deviation ``spread`` on the coefficients. A coefficient of zero spread is
    fixed: its row is zero."""
    n, p = weighted.shape
    held_by = np.full(p, np.inf)
    if spread is not None:
        held_by[9 : 9 + len(spread)] = spread
    free = np.flatnonzero(held_by > 0)
    # Columns are scaled: those of a temperature and of a cube are decades apart.
    norms = np.maximum(np.linalg.norm(weighted[:, free], axis=0), 1e-300)
    # The prior as additional rows 1/σ of the regression (ridge).
    prior_rows = np.diag(1 / held_by[free])[np.isfinite(held_by[free])] / norms
    gain = np.zeros((p, n))
    gain[free] = np.linalg.pinv(np.concatenate([weighted[:, free] / norms, prior_rows]), rcond=1e-13)[:, :n]
    gain[free] /= norms[:, None]
    return gain


# Extrapolation: the uncertainty of effects of time after the end of the recording.

STEP = 1e-4
"""Relative step of the derivative by a shape, far above rounding and far below the
curvature of any effect."""
FACES = np.concatenate([np.eye(3), -np.eye(3)])
"""(6,3) up along each sensitive axis, both ways, where a bias shows in full."""


@dataclass(frozen=True)
class Extrapolated(Caution):
    """The calibration holds ``beyond_s`` after the last pose. Effects of time then
    add this standard uncertainty to the readings (axis and face with the largest), in
    the unit of the reference vector."""

    beyond_s: float
    uncertainty_g: float


def extrapolated(c: Calibration) -> Extrapolated | None:
    """None where the moment lies within the recording, or no effect depends on
    time."""
    if c.holds_at is None or not c.poses:
        return None
    last = max(p.pose.run.index for p in c.poses)
    beyond_s = c.holds_at.t_s - max(p.pose.end_s for p in c.poses if p.pose.run.index == last)
    # Sum over the effects of time: B C Bᵀ on each face, and the error of the shapes.
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
    """(18,p) basis of an effect at the moment, on each face and axis, with all other
    covariates at their references."""
    needed = {name: c.channel_reference[name] for name in effect.needs}
    basis = effect.basis(c.reference * FACES, at_moment(needed, len(FACES), c.moment))
    return np.asarray(basis.reshape(-1, basis.shape[-1]))


def _by_shapes(effect: Effect, q: Floats, c: Calibration) -> Floats:
    """(18,) standard uncertainty from the errors of the effect's shapes."""
    parts: Sequence[Floats] = [
        (_basis(reshaped(effect, name, value * (1 + STEP)), c) - _basis(effect, c)) @ q / (STEP * value) * error
        for name, (value, _) in effect.shape.items()
        if value and (error := c.shape_errors.get(f"{effect.name}.{name}"))
    ]
    return np.asarray(np.linalg.norm(np.array(parts).reshape(-1, len(FACES) * 3), axis=0))


# The standard uncertainty of readings to which a calibration is applied.

NOTHING = Unmodelled(0.0, 0.0)
"""No unmodelled contribution."""


def uncertainty_of_readings(
    sensor: Sensor,
    covariance: Floats,
    u: Floats,
    covariates: Mapping[str, Floats],
    unmodelled: Unmodelled | None = None,
) -> Floats:
    """(n,3) standard uncertainty of the specific force at outputs u (n,3), from the
    ``covariance`` (p,p) of the sensor's parameters and the unmodelled part; NaN where
    the covariance is not known."""
    unmodelled_part = unmodelled or NOTHING
    # Unmodelled part: σ_along² up² + σ_across² (1 − up²) by component.
    variance = np.zeros(u.shape)
    if unmodelled_part != NOTHING:
        square = sensor.up(u, covariates) ** 2
        variance += unmodelled_part.along**2 * square + unmodelled_part.across**2 * (1 - square)
    # Variance of the parameters: sum over the principal axes of their covariance.
    for step in _steps(sensor, covariance, u, covariates):
        variance += step**2
    return np.asarray(np.sqrt(variance))


def uncertainty_of_magnitude(
    sensor: Sensor,
    covariance: Floats,
    u: Floats,
    covariates: Mapping[str, Floats],
    unmodelled: Unmodelled | None = None,
) -> Floats:
    """(n,) the same for |a|."""
    up = sensor.up(u, covariates)
    variance = np.full(len(u), (unmodelled or NOTHING).along ** 2)
    for step in _steps(sensor, covariance, u, covariates):
        variance += np.sum(step * up, axis=1) ** 2
    return np.asarray(np.sqrt(variance))


def _steps(sensor: Sensor, covariance: Floats, u: Floats, covariates: Mapping[str, Floats]) -> Iterator[Floats]:
    """(n,3) each: change of the specific force by one standard deviation along each
    principal axis of the covariance."""
    if not np.isfinite(covariance).all():
        yield np.full(u.shape, np.nan)
        return
    size, axes = np.linalg.eigh(covariance)
    a = sensor.specific_force(u, covariates)
    for step in (axes * np.sqrt(np.maximum(size, 0.0))).T:
        yield sensor.moved(step).specific_force(u, covariates) - a
