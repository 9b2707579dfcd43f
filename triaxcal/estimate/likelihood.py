"""The likelihood of still poses under a model, its derivatives, and the search
for its maximum.

Every pose constrains ``|a| = reference``; its attitude is a nuisance
parameter. With the attitude profiled out, the log-likelihood of a pose is
``−r²/(2s²)`` with ``r = |a(u)| − reference`` and ``s² = gᵀ Σ g``: Σ is the
covariance of the pose mean, g the gradient of r by the outputs u. The neglected
terms are of second order in the noise.

The parameters of the search are ``v = D x − w`` (x the outputs scaled to the
range of the data), the three angles and the effects' coefficients; all
derivatives are exact.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, Self

import numpy as np

from triaxcal.arrays import Floats, Ints
from triaxcal.effects.contract import Effect, reshaped
from triaxcal.errors import NotStill, Refused
from triaxcal.model.sensor import Radius, Sensor
from triaxcal.poses.covariates import covariates, references

Linearised = tuple[Floats, Floats, Floats]
"""Residuals (n,), their derivatives by theta (n, 9+p), their standard errors
(n,)."""
STEPS_MOST = 60
"""The closed form needs three or four steps; so many mean divergence."""
FAR = 1e6
"""Bound of bias and half range, in units of the reference vector: no real unit
comes near."""
HALVES = 0.5 ** np.arange(13)
"""Shares of a step that the line search tries, until chi-square does not grow."""
NEARBY = 1e-6
"""Relative change of a shape for its difference quotient."""
CONVERGED = 1e-12
"""Relative step at which the search ends; the noise of any real pose is a
million times larger."""


class SlopeData(Protocol):
    """Data of the poses besides their means: a residual for each pose, zero under
    the true model."""

    @property
    def inside(self) -> Problem:
        """The poses at all places where the model is evaluated, place by place."""
        ...

    def along(self, values: Floats) -> Floats:
        """(n,…) of each pose, from ``values`` (k·n,…) `inside`."""
        ...

    def linearise(self, state: State, jacobian: bool = True) -> Linearised:
        """As `triaxcal.estimate.likelihood.linearise` does for the means."""
        ...

    def only(self, rows: Ints | slice) -> Self: ...

    def asked_at(self, inside: Problem) -> Self:
        """The same slopes with other outputs at the places of evaluation."""
        ...

    def widened(self, factor: Floats) -> Self:
        """The same slopes with their errors multiplied by ``factor`` (n,)."""
        ...


@dataclass(frozen=True)
class Problem:
    """Poses as arrays, scaled. ``u`` (n,3) in output units, ``covariance``
    (n,3,3) of the means, ``channels`` (n,) each. ``middle`` and ``half`` (3,)
    scale the outputs to their range: ``x = (u − middle) / half``. ``slopes`` is
    fitted along with the means. ``excess`` is a standard deviation of |a| in
    units of the reference, added in quadrature to the noise of every pose."""

    u: Floats
    covariance: Floats
    channels: Mapping[str, Floats]
    channel_reference: Mapping[str, float]
    middle: Floats
    half: Floats
    signs: Floats
    reference: float
    slopes: SlopeData | None = None
    excess: float = 0.0

    @cached_property
    def covariates(self) -> dict[str, Floats]:
        return covariates(self.channels, self.channel_reference)

    def with_channels(self, channels: Mapping[str, Floats]) -> Problem:
        """The same problem with more covariates."""
        return replace(self, channels=channels, channel_reference=references(channels) | dict(self.channel_reference))

    def only(self, rows: Ints | slice) -> Problem:
        """The same problem with some of its poses."""
        channels = {n: v[rows] for n, v in self.channels.items()}
        slopes = self.slopes and self.slopes.only(rows)
        return replace(self, u=self.u[rows], covariance=self.covariance[rows], channels=channels, slopes=slopes)


@dataclass(frozen=True)
class State:
    """A point of the search: ``theta`` (9 + p,) as D (3), w (3), angles (3),
    effects' coefficients."""

    theta: Floats
    effects: tuple[Effect, ...]

    @classmethod
    def of(cls, problem: Problem, sensor: Sensor) -> State:
        """The point of the search that describes ``sensor``: the inverse of
        `State.sensor`."""
        k = sensor.scale_factor
        coefficients = [c for _, c in sensor.effects]
        # D = h / k and w = b − m / k, with h and m the half range and its middle.
        theta = np.concatenate([problem.half / k, sensor.bias - problem.middle / k, sensor.misalignment, *coefficients])
        return cls(theta, tuple(e for e, _ in sensor.effects))

    def extended(self, effects: Sequence[Effect]) -> State:
        """The same point with further effects, whose coefficients are zero."""
        zeros = np.zeros(sum(len(e.coefficients) for e in effects))
        return State(np.concatenate([self.theta, zeros]), (*self.effects, *effects))

    def sensor(self, problem: Problem) -> Sensor:
        D, w, angles = self.theta[:3], self.theta[3:6], self.theta[6:9]
        # Hand each effect its own stretch of theta, after the nine linear parameters.
        pairs = []
        at = 9
        for effect in self.effects:
            pairs.append((effect, self.theta[at : at + len(effect.coefficients)]))
            at += len(effect.coefficients)
        # k = h / D and b = w + m D / h.
        return Sensor(problem.half / D, angles, w + problem.middle * D / problem.half, tuple(pairs))


def solve(problem: Problem, state: State, effects: tuple[Effect, ...], steps: int = STEPS_MOST) -> State:
    """Maximum of the likelihood by Gauss–Newton with step halving; the weights
    1/s² are computed anew at each step.

    Raises NotStill where the search diverges, or does not converge within
    `STEPS_MOST` (a smaller ``steps`` returns the point reached).
    """
    # New effects start with coefficients of zero.
    extra = sum(len(e.coefficients) for e in effects) - (len(state.theta) - 9)
    theta = np.concatenate([state.theta, np.zeros(max(extra, 0))])
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # a step too far is taken back
        return _solved(problem, theta, effects, steps)


def _solved(problem: Problem, theta: Floats, effects: tuple[Effect, ...], steps: int) -> State:
    here: Linearised | None = None
    for left in reversed(range(steps)):
        r, J, s = here or linearise_all(problem, State(theta, effects))
        # A bias or a range far beyond the reference vector: the search diverges.
        if not (np.isfinite(J).all() and np.isfinite(r).all() and np.abs(theta[:6]).max() < FAR * problem.reference):
            raise NotStill("the fit ran away")
        # Solve the weighted normal equations, J step = −r, with columns of length one.
        norm = np.linalg.norm(J / s[:, None], axis=0)
        norm[norm == 0] = 1.0
        step = -np.linalg.lstsq(J / s[:, None] / norm, r / s, rcond=1e-14)[0] / norm
        # Converged when the step is small against theta in the same metric.
        size = np.linalg.norm(step * norm) / max(float(np.linalg.norm((theta + step) * norm)), 1e-300)
        if size < CONVERGED:
            return State(theta + step, effects)
        # Halve the step until chi-square, with the weights of this point, does not
        # grow.
        cost = float(np.sum((r / s) ** 2))
        for scale in HALVES:
            # Hardly any step is halved: a trial brings the derivatives along,
            # unless none are wanted after it.
            here = _tried(problem, State(theta + scale * step, effects), jacobian=left > 0)
            if here is not None and float(np.sum((here[0] / s) ** 2)) <= cost * (1 + 1e-9) + 1e-12:
                break
        theta = theta + scale * step
    if steps == STEPS_MOST and size > 1e-9:
        raise NotStill(f"the fit did not converge in {STEPS_MOST} steps (last relative step {size:.1e})")
    return State(theta, effects)


def _tried(problem: Problem, state: State, jacobian: bool) -> Linearised | None:
    """The linearisation at ``state``; None where the effects have no inverse there."""
    try:
        return linearise_all(problem, state, jacobian)
    except Refused:
        return None


def linearise_all(problem: Problem, state: State, jacobian: bool = True) -> Linearised:
    """`linearise` of the pose means, followed by the same of the slopes where the
    problem has them: (2n,) rows in place of (n,)."""
    means = linearise(problem, state, jacobian)
    if problem.slopes is None:
        return means
    # Stack the rows of the slopes below those of the means.
    r, J, s = (np.concatenate(both) for both in zip(means, problem.slopes.linearise(state, jacobian), strict=True))
    return r, J, s


def linearise(problem: Problem, state: State, jacobian: bool = True) -> Linearised:
    """Residuals r (n,), their derivatives by theta (n, 9+p) and their standard
    errors (n,): the noise of the pose means along g and ``excess``, in quadrature."""
    sensor = state.sensor(problem)
    covariates = problem.covariates
    # The line search needs r alone.
    if not jacobian:
        length = np.linalg.norm(sensor.specific_force(problem.u, covariates), axis=1)
        return length - problem.reference, np.empty((0, 0)), np.empty(0)
    radius = sensor.radius(problem.u, covariates)
    # J = ∂|a|/∂theta: nine linear columns, then one for each coefficient.
    effects = [radius.by_coefficients(e, covariates) for e in state.effects]
    J = np.concatenate([radius_by_linear(problem, radius, problem.u), *effects], axis=1)
    # s² = gᵀ Σ g, with g = ∂|a|/∂u.
    by_u = radius.by_v / sensor.scale_factor
    variance = np.einsum("ni,nij,nj->n", by_u, problem.covariance, by_u)
    # Poses without any scatter (made up, or below the resolution) would
    # otherwise weigh infinitely.
    variance = np.maximum(variance, (1e-12 * problem.reference) ** 2) + problem.excess**2
    return radius.length - problem.reference, J, np.sqrt(variance)


def radius_by_linear(problem: Problem, radius: Radius, u: Floats) -> Floats:
    """(n,9) derivatives of |a| at outputs u (n,3) by D, w and the angles: the
    linear parameters of the search."""
    x = (u - problem.middle) / problem.half
    return np.concatenate([radius.by_v * x, -radius.by_v, radius.by_misalignment], axis=1)


def residual_chi2(linearised: Linearised) -> float:
    """Chi-square at the minimum, by one linear step from a point near it."""
    r, J, s = linearised
    return residual_sum_of_squares(J / s[:, None], r / s)


def residual_sum_of_squares(columns: Floats, misses: Floats) -> float:
    """Residual sum of squares of misses (n,) after regression on columns (n,p) of
    any size; infinite where either is not finite."""
    if not (np.isfinite(columns).all() and np.isfinite(misses).all()):
        return np.inf
    # Columns of length one, or the rank test would judge the units of the parameters.
    size = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    step = np.linalg.lstsq(columns / size, misses, rcond=1e-13)[0]
    return float(np.sum((misses - columns / size @ step) ** 2))


def by_shape(problem: Problem, state: State) -> Floats:
    """Derivatives (n,m) of all residuals (`linearise_all`) by the shapes of the
    effects (`Effect.shape`), for a change of a thousandth of each shape."""
    columns = []
    for i, effect in enumerate(state.effects):
        for name, (value, _) in effect.shape.items():
            # Central difference over a relative step of NEARBY to both sides.
            sides = []
            for sign in (1, -1):
                other = reshaped(effect, name, value * (1 + sign * NEARBY))
                effects = (*state.effects[:i], other, *state.effects[i + 1 :])
                sides.append(linearise_all(problem, State(state.theta, effects), jacobian=False)[0])
            columns.append((sides[0] - sides[1]) / (2000 * NEARBY))
    return np.array(columns).T if columns else np.empty((len(linearise_all(problem, state, jacobian=False)[0]), 0))


def parameters_by_theta(problem: Problem, state: State) -> Floats:
    """(9+p, 9+p) derivative of scale factor, misalignment, bias and the
    effects' coefficients by theta."""
    D = state.theta[:3]
    G = np.eye(len(state.theta))
    G[0:9, 0:9] = 0
    for i in range(3):
        G[i, i] = -problem.half[i] / D[i] ** 2  # k = h / D
        G[3 + i, 6 + i] = 1  # angles
        G[6 + i, 3 + i] = 1  # b = w + m D / h
        G[6 + i, i] = problem.middle[i] / problem.half[i]
    return G
