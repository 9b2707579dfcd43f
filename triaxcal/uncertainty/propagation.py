"""The fit linearised at its solution: from errors of the poses' residuals to
parameters, and from these to |a|."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.estimate.calibration import Calibration
from triaxcal.estimate.excess import Excess
from triaxcal.estimate.initial_estimate import problem_of, with_history
from triaxcal.estimate.likelihood import Problem, State, by_shape, linearise, linearise_all, parameters_by_theta
from triaxcal.estimate.pose_slopes import with_slopes
from triaxcal.model.directions import spiral
from triaxcal.poses.covariates import at_moment

SPHERE = 200
"""Directions in a mean over the sphere. The variance of the magnitude is a
polynomial of the fourth degree there, which so many average well."""


class SphereMean:
    """The sphere that parameters are judged on. ``by_parameters`` (m,p): change
    of |a| over the sphere by the parameters."""

    by_parameters: Floats

    @classmethod
    def of(cls, calibration: Calibration) -> SphereMean:
        """At the conditions of its use."""
        found, up = cls(), spiral(SPHERE) * calibration.reference
        covariates = at_moment(calibration.channel_reference, len(up), calibration.moment)
        u = calibration.sensor.output(up, covariates)
        found.by_parameters = calibration.sensor.radius_by_parameters(u, covariates)
        return found

    def magnitude(self, covariance: Floats) -> float:
        """rms over the sphere of the uncertainty of |a| that a covariance (p,p)
        of the parameters makes."""
        return float(
            np.sqrt(max(np.einsum("mi,ij,mj->", *[self.by_parameters, covariance, self.by_parameters]), 0.0) / SPHERE)
        )


class ErrorPropagation(SphereMean):
    """The fit linearised at its solution, and the sphere that its parameters
    are judged on."""

    def __init__(self, calibration: Calibration) -> None:
        sensor = calibration.sensor
        poses = [p.pose for p in calibration.poses if p.used]
        signs = tuple(np.sign(sensor.scale_factor))
        effects = [effect for effect, _ in sensor.effects]
        problem = problem_of(poses, signs=signs, reference=calibration.reference, effects=effects)
        problem = with_history(problem, poses, sensor)
        # A model without a channel holds at its mean; the reference of one that
        # has it is rounded to read well. To a millionth, since processors
        # differ in the last digits, and a steady channel should not seem to
        # move.
        means = {n: round(float(np.mean(problem.channels[n])), 6) for n in problem.channel_reference}
        self.problem = replace(problem, channel_reference=means | dict(calibration.channel_reference))
        self.state = State.of(self.problem, sensor)
        self.effects = self.state.effects
        if calibration.slopes:
            self.problem = with_slopes(self.problem, poses, self.effects) or self.problem
        self.noise = linearise_all(self.problem, self.state)[2]
        """(n,) standard errors of the residuals by the noise and creep of the
        poses."""
        self.problem = Excess(excess_g=calibration.excess_g).added_to(self.problem, self.state)
        _, J, self.error = linearise_all(self.problem, self.state)
        # What the shapes of effects were chosen by blurs the parameters too.
        self.weighted = np.concatenate([J, by_shape(self.problem, self.state)], axis=1) / self.error[:, None]
        self.gain = gain_given_prior(self.weighted, calibration.prior_sd)
        self.G = parameters_by_theta(self.problem, self.state)
        self.by_residual = -self.G @ self.gain[: len(self.G)] / self.error
        """(p,n): shift of the parameters for an error of each residual
        (`likelihood.linearise_all`)."""
        self.up = spiral(SPHERE) * calibration.reference
        """(m,3) specific force all over the sphere."""
        self.sphere = self._sphere(calibration, {})
        _, J, _ = linearise(self.sphere, self.state)
        self.by_parameters = J @ np.linalg.inv(self.G)

    def _sphere(self, calibration: Calibration, shift: Mapping[str, float]) -> Problem:
        """Outputs of the unit all over the sphere, under the conditions of its
        use but for ``shift``."""
        reference = self.problem.channel_reference
        covariates = at_moment(reference, len(self.up), calibration.moment)
        u = calibration.sensor.output(self.up, covariates)
        channels = {n: covariates[n] + v + shift.get(n, 0.0) for n, v in reference.items()}
        none = np.zeros((len(u), 3, 3))
        return replace(self.problem, u=u, covariance=none, channels=channels, channel_reference=reference, slopes=None)

    def when_shifted(self, calibration: Calibration, channel: str, by: float) -> Floats:
        """(p,) what the parameters would have to be for |a| to stay right were
        a channel off by so much."""
        shifted = self._sphere(calibration, {channel: by})
        r, _, _ = linearise(shifted, self.state, jacobian=False)
        nine = self.by_parameters[:, :9]
        return np.concatenate([-np.linalg.lstsq(nine, r, rcond=None)[0], np.zeros(len(self.G) - 9)])


def gain_given_prior(weighted: Floats, spread: Floats | None) -> Floats:
    """(p,n) of parameters by weighted residuals, where coefficients are held by
    their ``prior_sd``. One of zero spread is fixed: its row is zero."""
    n, p = weighted.shape
    held_by = np.full(p, np.inf)
    if spread is not None:
        held_by[9 : 9 + len(spread)] = spread
    free = np.flatnonzero(held_by > 0)
    # Columns are scaled: those of a temperature and of a cube are decades apart.
    norms = np.maximum(np.linalg.norm(weighted[:, free], axis=0), 1e-300)
    prior_rows = np.diag(1 / held_by[free])[np.isfinite(held_by[free])] / norms
    gain = np.zeros((p, n))
    gain[free] = np.linalg.pinv(np.concatenate([weighted[:, free] / norms, prior_rows]), rcond=1e-13)[:, :n]
    gain[free] /= norms[:, None]
    return gain
