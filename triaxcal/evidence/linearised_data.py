"""The data: misfits of |a| in the pose means and slopes of |a| inside the poses,
linearised once for all hypotheses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from triaxcal.arrays import Floats, Ints
from triaxcal.effects.contract import Effect
from triaxcal.errors import Refused
from triaxcal.estimate.calibration import Calibration
from triaxcal.estimate.creep import PoseSlopes, without_creep
from triaxcal.estimate.initial_estimate import started_problem
from triaxcal.estimate.likelihood import Problem, State, linearise_all
from triaxcal.model.sensor import LINEAR, Radius
from triaxcal.poses.covariates import channels_of, with_scale
from triaxcal.poses.degrees_of_freedom import noise_levels
from triaxcal.poses.noise_spectrum import NoiseLevels
from triaxcal.poses.pose import Pose

QUIETEST = 0.1
"""Smallest error as a share of the median: a pose without scatter (a logger's dead
band) would have infinite weight."""
CHI2_LOG = np.linspace(-8.0, 70.0, 12000)
"""Grid of the logarithm of chi-square on which the likelihood is tabulated."""


@dataclass(frozen=True, eq=False)
class LinearisedData:
    """N rows: the n means, then the n slopes where these are known, each divided by
    its standard error.

    ``places`` (n,) are the indices of the poses among all given. ``y`` (N,) are
    misfits, ``linear`` (N,9) derivatives by the nine parameters with columns of
    length one, ``lengths`` (9,) the divisors, ``error`` (N,) standard errors in units
    of the reference. ``basis`` (N,9) is an orthonormal basis of the linear columns,
    ``left`` (N,) the misfits after projection off it. ``run`` (n,) is the recording
    of each pose. ``point`` is the point of linearisation, with effects where these
    are large; ``state`` has its nine parameters.
    """

    poses: Sequence[Pose]
    places: Ints
    run: Ints
    problem: Problem
    point: State
    y: Floats
    linear: Floats
    lengths: Floats
    error: Floats
    basis: Floats
    left: Floats
    noise: NoiseLevels
    likelihood: Floats

    @classmethod
    def of(
        cls, poses: Sequence[Pose], linear: Calibration, signs: Sequence[float], effects: Sequence[Effect] = ()
    ) -> LinearisedData:
        """Rows about the ``linear`` fit of these poses, with the covariates of the
        ``effects``. Poses with a fault are excluded. Raises as
        `triaxcal.estimate.initial_estimate.started_problem`; Refused where no degree
        of freedom is left."""
        places = np.array([i for i, p in enumerate(poses) if not p.fault], dtype=int)
        sound = [poses[i] for i in places]
        # Creep is information in the slopes, and an error of the means without them.
        poses = without_creep(sound) if np.isfinite([p.slope_error for p in sound]).all() else sound
        problem, _ = started_problem(poses, signs=signs, reference=linear.reference, effects=effects)
        slopes = PoseSlopes.of(problem, poses)
        problem = problem if slopes is None else replace(problem, slopes=slopes)
        return cls._about(State.of(problem, replace(linear.sensor, effects=())), poses, places, problem)

    def relinearised_at(self, point: State) -> LinearisedData:
        """The same rows linearised at another point; coefficients still count from
        zero."""
        return self._about(point, self.poses, self.places, self.problem)

    @classmethod
    def _about(cls, point: State, poses: Sequence[Pose], places: Ints, problem: Problem) -> LinearisedData:
        # Residuals at the measured outputs; derivatives in the attitudes of the model.
        r, _, error = linearise_all(problem, point)
        _, J, _ = linearise_all(in_attitude(problem, point), point)
        # Refer the residuals to coefficients of zero.
        r, J, n = r - J[:, LINEAR:] @ point.theta[LINEAR:], J[:, :LINEAR], len(poses)
        if len(r) <= LINEAR:
            raise Refused(f"{n} poses leave nothing over the nine parameters to judge effects by")
        error = np.concatenate([_floored(error[:n]), _floored(error[n:])])
        # Divide by the errors, scale the columns, and project the misfits.
        columns = J / error[:, None]
        lengths = np.linalg.norm(columns, axis=0)
        columns = columns / lengths
        basis = span(columns)
        y, noise = -r / error, noise_levels(poses)
        # Tabulate the likelihood of chi-square, marginal over the noise level.
        likelihood = noise.log_likelihood(np.exp(CHI2_LOG), len(y) - basis.shape[1])
        run, left = np.array([p.run.index for p in poses]), y - basis @ (basis.T @ y)
        return cls(poses, places, run, problem, point, y, columns, lengths, error, basis, left, noise, likelihood)

    def of_future_poses(self, poses: Sequence[Pose]) -> LinearisedData:
        """Rows of hypothetical poses about the same point and in the same units:
        without misfits and ``basis``."""
        sensor = self.state.sensor(self.problem)
        every = channels_of([*self.poses, *poses], self.problem.channel_reference)
        channels = {name: values[self.n :] for name, values in every.items()}
        problem = replace(
            self.problem,
            u=np.array([p.mean for p in poses]),
            covariance=np.array([p.covariance for p in poses]),
            channels=with_scale(channels, poses, sensor.scale_factor, sensor.bias),
            slopes=None,
        )
        problem = replace(problem, slopes=PoseSlopes.of(problem, poses) if self.slopes else None)
        _, _, error = linearise_all(problem, self.point)
        _, J, _ = linearise_all(in_attitude(problem, self.point), self.point)
        nothing = np.empty((len(error), 0))
        return replace(
            self,
            poses=poses,
            places=np.full(len(poses), -1),
            run=np.array([p.run.index for p in poses]),
            problem=problem,
            y=np.full(len(error), np.nan),
            linear=J[:, :LINEAR] / error[:, None] / self.lengths,
            error=error,
            basis=nothing,
            left=np.empty(0),
        )

    def beyond_linear(self, columns: Floats) -> Floats:
        """(N,…) columns after projection off the nine parameters."""
        return np.asarray(columns - self.basis @ (self.basis.T @ columns))

    @property
    def residual_dof(self) -> int:
        """Degrees of freedom after the nine parameters."""
        return len(self.y) - int(self.basis.shape[1])

    def by_coefficients(self, effect: Effect) -> Floats:
        """(N,p) derivatives of the rows by the coefficients of an effect."""
        if id(effect) not in self._known:
            problems, slopes = self._radii, self.problem.slopes
            each = [radius.by_coefficients(effect, problem.covariates) for problem, radius in problems]
            both = each if slopes is None else [each[0], slopes.along(each[1])]
            self._known[id(effect)] = effect, np.concatenate(both) / self.error[:, None]
        return self._known[id(effect)][1]

    @cached_property
    def _known(self) -> dict[int, tuple[Effect, Floats]]:
        """Cached columns. The effects are kept alive with them, because foreign
        effects need not equal themselves."""
        return {}

    @cached_property
    def _radii(self) -> list[tuple[Problem, Radius]]:
        """The points of evaluation of effects: the means, and places inside the poses
        where slopes are known."""
        there = in_attitude(self.problem, self.point)
        problems = [there, *([] if there.slopes is None else [there.slopes.inside])]
        return [(p, self.point.sensor(p).radius(p.u, p.covariates)) for p in problems]

    @property
    def state(self) -> State:
        return State(self.point.theta[:LINEAR], ())

    @property
    def n(self) -> int:
        return len(self.poses)

    @property
    def slopes(self) -> bool:
        return len(self.y) > self.n

    @property
    def median_standard_error(self) -> float:
        """The median standard error of a pose's mean, in units of the
        reference."""
        return float(np.median(self.error[: self.n]))

    @property
    def order(self) -> Ints:
        """(n,) order of the poses by recording and time."""
        return np.lexsort((self.t_s, self.run))

    @property
    def t_s(self) -> Floats:
        """(n,)"""
        return np.array([p.t_s for p in self.poses])

    @property
    def duration_s(self) -> Floats:
        """(n,)"""
        return np.array([p.end_s - p.start_s for p in self.poses])

    def noise_variance_given(self, chi2: float) -> float:
        """Posterior mean of the noise variance over the stated one, for a model with
        this chi-square."""
        known = self.noise.students_dof
        return (known + chi2) / (known + self.residual_dof)

    def log_likelihood(self, chi2: Floats) -> Floats:
        """Log likelihood, up to a constant, of chi-squares in ``residual_dof``
        degrees of freedom (any shape), marginal over the noise level."""
        return np.interp(np.log(np.maximum(chi2, 1e-3)), CHI2_LOG, self.likelihood)


def in_attitude(problem: Problem, point: State) -> Problem:
    """The same poses with the model's outputs in their attitudes, where |a| is the
    reference.

    The derivatives are taken there. At the measured outputs they would depend on the
    misfits: a constant would differ from its projection onto the nine parameters by
    the misfit of each pose, and terms that contain a constant would seem to fit any
    data.
    """

    def there(of: Problem) -> Problem:
        sensor = point.sensor(of)
        up = sensor.up(of.u, of.covariates)
        return replace(of, u=sensor.output(up * of.reference, of.covariates))

    slopes = problem.slopes
    return replace(there(problem), slopes=slopes and slopes.asked_at(there(slopes.inside)))


def span(columns: Floats) -> Floats:
    """(N,r) orthonormal basis of the columns (N,p), of their numerical rank."""
    axes, size, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(axes[:, size > max(columns.shape) * np.finfo(float).eps * size[0]])


def _floored(error: Floats) -> Floats:
    return np.maximum(error, QUIETEST * np.median(error)) if len(error) else error
