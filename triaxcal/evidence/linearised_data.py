"""The data: misfits of |a| in the pose means and slopes of |a| inside the
poses, linearised once for all hypotheses."""

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
"""Of the median: a pose without scatter (a logger's dead band) would weigh
without end."""
CHI2_LOG = np.linspace(-8.0, 70.0, 12000)
"""Where the likelihood of a sum of squares is looked up, by its logarithm."""


@dataclass(frozen=True, eq=False)
class LinearisedData:
    """N rows, first the n means, then the n slopes where the poses know theirs,
    each over its standard error.

    ``places`` (n,) are those of the poses among all that were given. ``y`` (N,)
    misfits, ``linear`` (N,9) derivatives by the nine parameters with columns of
    length one, ``lengths`` (9,) what they were divided by, ``error`` (N,)
    standard errors in units of the reference. ``basis`` (N,9) is an orthonormal
    basis of what the nine take, and ``left`` (N,) the misfits without that.
    ``run`` (n,) is the recording that each pose is of. ``point`` is where all
    was linearised, with effects where these are large, and ``state`` its nine
    parameters.
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
        """About the ``linear`` fit of these poses, which excludes outliers,
        with the covariates that these ``effects`` need. Poses with a fault are
        excluded. Raises as `triaxcal.estimate.initial_estimate.started_problem`
        does; Refused where no degree of freedom is left."""
        places = np.array([i for i, p in enumerate(poses) if not p.fault], dtype=int)
        sound = [poses[i] for i in places]
        poses = without_creep(sound) if np.isfinite([p.slope_error for p in sound]).all() else sound
        problem, _ = started_problem(poses, signs=signs, reference=linear.reference, effects=effects)
        slopes = PoseSlopes.of(problem, poses)
        problem = problem if slopes is None else replace(problem, slopes=slopes)
        return cls._about(State.of(problem, replace(linear.sensor, effects=())), poses, places, problem)

    def relinearised_at(self, point: State) -> LinearisedData:
        """The same rows, linearised elsewhere: coefficients count from zero
        there too."""
        return self._about(point, self.poses, self.places, self.problem)

    @classmethod
    def _about(cls, point: State, poses: Sequence[Pose], places: Ints, problem: Problem) -> LinearisedData:
        r, _, error = linearise_all(problem, point)
        _, J, _ = linearise_all(in_attitude(problem, point), point)
        r, J, n = r - J[:, LINEAR:] @ point.theta[LINEAR:], J[:, :LINEAR], len(poses)
        if len(r) <= LINEAR:
            raise Refused(f"{n} poses leave nothing over the nine parameters to judge effects by")
        error = np.concatenate([_not_too_quiet(error[:n]), _not_too_quiet(error[n:])])
        columns = J / error[:, None]
        lengths = np.linalg.norm(columns, axis=0)
        columns = columns / lengths
        basis = span(columns)
        y, noise = -r / error, noise_levels(poses)
        likelihood = noise.log_likelihood(np.exp(CHI2_LOG), len(y) - basis.shape[1])
        run, left = np.array([p.run.index for p in poses]), y - basis @ (basis.T @ y)
        return cls(poses, places, run, problem, point, y, columns, lengths, error, basis, left, noise, likelihood)

    def of_future_poses(self, poses: Sequence[Pose]) -> LinearisedData:
        """Of poses that nobody has taken, about the same point and in the same
        units: misfits are not known, and there is no ``basis``."""
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
        """(N,…) what the nine parameters leave of columns."""
        return np.asarray(columns - self.basis @ (self.basis.T @ columns))

    @property
    def residual_dof(self) -> int:
        """Degrees of freedom that the nine parameters leave."""
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
        """What was asked before, of effects that stay alive so long: those of
        other packages need not be equal to themselves."""
        return {}

    @cached_property
    def _radii(self) -> list[tuple[Problem, Radius]]:
        """Where effects are asked: in the means, and inside the poses where
        these know their slopes."""
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
        """(n,) the places of the poses as they were taken, recording by
        recording."""
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
        """The mean variance of the noise over the one stated, where a model
        leaves this sum of squares."""
        known = self.noise.students_dof
        return (known + chi2) / (known + self.residual_dof)

    def log_likelihood(self, chi2: Floats) -> Floats:
        """Of sums of squares in m degrees of freedom (any shape), but for a
        constant; the size of the noise is known as far as the poses tell it."""
        return np.interp(np.log(np.maximum(chi2, 1e-3)), CHI2_LOG, self.likelihood)


def in_attitude(problem: Problem, point: State) -> Problem:
    """The same poses, at all places, with the outputs that the model has in
    their attitudes, where |a| is the reference.

    Derivatives are those there. At the measured outputs they would know the
    misfits: a constant, which is no more than nine parameters make of it, would
    differ from that by what each pose is off, and terms that hold a little of
    one would seem to fit whatever there is.
    """

    def there(of: Problem) -> Problem:
        sensor = point.sensor(of)
        up = sensor.up(of.u, of.covariates)
        return replace(of, u=sensor.output(up * of.reference, of.covariates))

    slopes = problem.slopes
    return replace(there(problem), slopes=slopes and slopes.asked_at(there(slopes.inside)))


def span(columns: Floats) -> Floats:
    """(N,r) an orthonormal basis of what columns (N,p) span, but for what
    rounding makes of columns that depend on each other."""
    axes, size, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(axes[:, size > max(columns.shape) * np.finfo(float).eps * size[0]])


def _not_too_quiet(error: Floats) -> Floats:
    return np.maximum(error, QUIETEST * np.median(error)) if len(error) else error
