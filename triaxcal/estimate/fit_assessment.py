"""The assessment of a fit: covariance of the parameters, residuals of the poses, and
warnings."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from triaxcal.arrays import Bools, Floats, Ints, rms
from triaxcal.effects.contract import DURATION, SINCE_START, Effect, reshaped
from triaxcal.errors import NotStill
from triaxcal.estimate.calibration import (
    BirgeRatio,
    Calibration,
    Caution,
    ExcessVariance,
    FewPoses,
    HighLeverage,
    PoorSpread,
    Residual,
    ResidualsTooSmall,
    pose_results,
    studentized,
)
from triaxcal.estimate.initial_estimate import DILUTION_LIMIT
from triaxcal.estimate.likelihood import (
    Linearised,
    Problem,
    State,
    by_shape,
    linearise,
    linearise_all,
    parameters_by_theta,
    residual_chi2,
    solve,
)
from triaxcal.model.directions import dilution, in_range, linear_design, most_wanted
from triaxcal.poses.degrees_of_freedom import SIGNIFICANT, lack_of_fit_p, raised_dof, within_pose_dof
from triaxcal.poses.pose import Pose
from triaxcal.rounding import probability

# Standard errors of the shapes of effects (`Effect.shape`), which the search has
# chosen and the fit holds fixed.

UNLIKELY = 16.0
"""Chi-square over its minimum beyond which a value and its neighbours need no
refinement."""
STRAIGHT = 1.0
"""Largest change of chi-square from one value of the profile to the next."""
HALVED_MOST = 8
"""Halvings of an interval, to 1/256: a steeper likelihood is an edge."""
PARTS = 20
"""Parts of an interval in the sum for an integral: chi-square changes by about
`STRAIGHT` over it, so the weight changes little over a part."""
NOTHING_LIKE = 1e300
"""In place of infinity, which cannot be interpolated."""


def shape_errors(
    problem: Problem, state: State, columns: Floats, thousandths: Floats, birge_ratio: float
) -> dict[str, float]:
    """Standard errors by "effect.name"; no entry for a shape without influence.

    ``columns`` (n,m) are the derivatives of the residuals by the shapes,
    ``thousandths`` (m,) the standard errors from these, in thousandths of the shapes'
    values, with the ``birge_ratio`` applied.
    """
    out = {}
    named = [(i, name, value) for i, e in enumerate(state.effects) for name, (value, _) in e.shape.items()]
    for (i, name, value), column, thousandth in zip(named, columns.T, thousandths, strict=True):
        # Effects with edges: integrate the profile likelihood. Others: curvature at the
        # minimum.
        error = _by_likelihood(problem, state, i, name, birge_ratio) if has_edges(state.effects[i]) else None
        if error is None and np.any(column):
            error = 1e-3 * abs(value) * float(thousandth)
        if error is not None:
            out[f"{state.effects[i].name}.{name}"] = error
    return out


def has_edges(effect: Effect) -> bool:
    """Whether the effect changes at the edges of poses, as a step does. The
    likelihood of its shape has kinks there and is flat between two poses, so its
    curvature is no measure of the error."""
    return DURATION in effect.needs


def spread(value: float, chi2_at: Callable[[float], float], tried: Sequence[float], edges: Floats) -> float | None:
    """Rms deviation from a shape's ``value`` under the profile likelihood exp(−χ²/2),
    over the range of the values ``tried``; ``edges`` are those of the poses. None
    where only one value was tried.

    For a step between two poses this is the rectangular distribution over the time
    between them (JCGM 100, 4.3.7), with shoulders inside the poses, and with other
    gaps where the directions of the poses hide the step.
    """
    # Evaluate the profile at the values tried, then at the likely edges, then refine.
    profile = _Profile(chi2_at)
    profile.look_at(np.unique([value, *tried]))
    if len(profile.x) < 2:
        return None
    profile.look_at(profile.where_likely(edges))
    profile.look_closer()
    return profile.spread_about(value)


def edges_of(problem: Problem) -> Floats:
    """Times (2n,) at which poses begin and end, in seconds since the start."""
    middle, half = problem.covariates[SINCE_START], problem.covariates[DURATION] / 2
    return np.concatenate([middle - half, middle + half])


def _by_likelihood(problem: Problem, state: State, i: int, name: str, birge_ratio: float) -> float | None:
    effect = state.effects[i]
    tried = [v.shape[name][0] for v in effect.variants(problem.covariates) if name in v.shape]

    def chi2_at(value: float) -> float:
        return _left(problem, state, i, name, value) / birge_ratio**2

    return spread(effect.shape[name][0], chi2_at, tried, edges_of(problem))


class _Profile:
    """Chi-square (m,) at ascending values ``x`` (m,) of a shape."""

    def __init__(self, chi2_at: Callable[[float], float]) -> None:
        self._chi2_at = chi2_at
        self.x, self.chi2 = np.empty(0), np.empty(0)

    def look_at(self, more: Floats) -> None:
        rows = np.searchsorted(self.x, more)
        self.chi2 = np.insert(self.chi2, rows, [min(self._chi2_at(float(v)), NOTHING_LIKE) for v in more])
        self.x = np.insert(self.x, rows, more)

    @property
    def _likely(self) -> Bools:
        """(m−1,) the intervals with a likely value at one end."""
        return np.asarray(np.minimum(self.chi2[:-1], self.chi2[1:]) < self.chi2.min() + UNLIKELY)

    def where_likely(self, more: Floats) -> Floats:
        """Those of further values that lie in likely intervals."""
        more = np.setdiff1d(more, self.x)
        more = more[(self.x[0] < more) & (more < self.x[-1])]
        return np.asarray(more[self._likely[np.searchsorted(self.x, more) - 1]])

    def look_closer(self) -> None:
        """Halve the likely intervals over which chi-square changes by more than
        `STRAIGHT`."""
        for _ in range(HALVED_MOST):
            coarse = self._likely & (np.abs(np.diff(self.chi2)) > STRAIGHT)
            if not coarse.any():
                return
            self.look_at((self.x[:-1] + self.x[1:])[coarse] / 2)

    def spread_about(self, value: float) -> float:
        """Rms deviation from a value, weighted by the likelihood; its logarithm is
        interpolated linearly."""
        # Midpoint rule: PARTS points in each interval.
        wide = np.diff(self.x)
        at = (self.x[:-1, None] + wide[:, None] * (np.arange(PARTS) + 0.5) / PARTS).ravel()
        # Weight exp(−(χ² − χ²min)/2) times the width of the interval.
        weight = np.repeat(wide, PARTS) * np.exp((self.chi2.min() - np.interp(at, self.x, self.chi2)) / 2)
        return float(np.sqrt(np.sum(weight * (at - value) ** 2) / np.sum(weight)))


def _left(problem: Problem, state: State, i: int, name: str, value: float) -> float:
    """Chi-square with another value of a shape and all else refitted, in linear
    approximation."""
    other = reshaped(state.effects[i], name, value)
    with np.errstate(over="ignore", invalid="ignore"):
        return residual_chi2(
            linearise_all(problem, State(state.theta, (*state.effects[:i], other, *state.effects[i + 1 :])))
        )


# Cross-validation: prediction of poses that the fit did not see.

STRAIGHT_STEP = 1e-4
"""Steps of the scaled parameters up to which the fit is linear, to about this share
of the step."""


def cross_validated(problem: Problem, state: State) -> float | None:
    """Leave-one-out rms of |a| − reference; None where a pose alone determines a
    parameter.

    ``state`` is at the minimum. Deletion is exact for a linear problem, r_(i) = (1 −
    H_ii)⁻¹ r_i; where the parameters move so far that curvature may matter, the rest
    is fitted again.
    """
    r, J, s = linearise_all(problem, state)
    n = len(problem.u)
    if len(r) <= len(state.theta):
        return None
    # Pseudo-inverse of the weighted Jacobian, with columns of length one.
    norms = np.maximum(np.linalg.norm(J / s[:, None], axis=0), 1e-300)
    weighted = J / s[:, None] / norms
    gain = np.linalg.pinv(weighted, rcond=1e-14)
    # Rows of a pose (n,k): its mean and its slope, which are deleted together.
    of_pose = np.arange(len(r)).reshape(-1, n).T
    # Diagonal blocks of the hat matrix: the leverage of each pose.
    hat = np.einsum("nkp,pnl->nkl", weighted[of_pose], gain[:, of_pose])
    free = np.eye(of_pose.shape[1]) - hat
    if np.linalg.eigvalsh(free).min() < 1e-6:
        return None
    # Deleted residuals, and the change of theta by the deletion of each pose.
    misses = np.linalg.solve(free, (r / s)[of_pose][..., None])[..., 0]
    moved = np.einsum("pnk,nk->np", gain[:, of_pose] / norms[:, None, None], misses)
    misses = misses[:, 0] * s[:n]
    # Fit again without those poses that move the parameters far.
    for i in np.flatnonzero(np.abs(moved).max(axis=1) > STRAIGHT_STEP):
        rest: Ints = np.delete(np.arange(n), i)
        without = solve(problem.only(rest), State(state.theta + moved[i], state.effects), state.effects, steps=2)
        misses[i] = linearise(problem.only(slice(i, i + 1)), without, jacobian=False)[0][0]
    return rms(misses)


# Excess variance of the residuals over the noise inside the poses.

NO_CHANCE = 1e-4
"""Lack-of-fit p below which an excess variance is added, which changes the weights.
Above it, a Birge ratio multiplies all errors. The limit is small because other
weights cost a hundredfold in variance where poses differ much in noise and there is
no excess."""
EXACT = 1e-10
"""Relative tolerance of the root for the excess."""


@dataclass(frozen=True)
class Excess:
    """``birge_ratio`` is a factor on all errors, or ``excess_g`` a standard deviation
    of |a|, in units of the reference vector, added in quadrature to the noise of
    every pose."""

    birge_ratio: float = 1.0
    excess_g: float = 0.0

    @classmethod
    def estimated(cls, linearised: Linearised, n: int, residual_dof: int, pure_dof: float) -> Excess:
        """The ratio or the excess with which chi-square equals ``residual_dof``.

        ``linearised`` are residuals, derivatives and errors near the minimum; the
        first ``n`` rows are the means of the poses. ``pure_dof`` are the degrees of
        freedom of the noise inside the poses. The excess is that of Mandel and Paule
        (1970, Anal. Chem. 42:1194), here for a fit of several parameters; the ratio
        that of Birge (1932, Phys. Rev. 40:207), at least 1 unless no pose knows its
        noise. Raises NotStill where the fit diverged.
        """
        r, J, s = linearised

        def ratio(excess: float) -> float:
            error = s * np.tile(_widened(s[:n], excess), len(s) // n)
            return residual_chi2((r, J, error)) / residual_dof

        # Lack-of-fit test against the noise inside the poses.
        whole = ratio(0.0) if residual_dof > 0 else 1.0
        if not np.isfinite(whole):
            raise NotStill("the fit ran away")
        p = probability(lack_of_fit_p(whole * residual_dof, residual_dof, pure_dof))
        if p is None or p >= NO_CHANCE:
            return cls(float(np.sqrt(whole if pure_dof < 1 else max(whole, 1.0))))
        # Bracket the excess, then solve χ²(excess) = residual_dof, by Brent's method.
        high = float(np.linalg.norm(r[:n])) / np.sqrt(residual_dof) + float(np.max(s[:n]))
        while ratio(high) > 1:
            high *= 2
        return cls(excess_g=float(scipy.optimize.brentq(lambda e: ratio(e) - 1, 0.0, high, xtol=EXACT * high)))

    def added_to(self, problem: Problem, state: State) -> Problem:
        """The problem with the excess; ``state`` is near its minimum. Slopes are
        widened by the same factor as the means: a disturbance between poses may act
        inside them too."""
        if not self.excess_g:
            return problem
        slopes = problem.slopes and problem.slopes.widened(_widened(linearise(problem, state)[2], self.excess_g))
        return replace(problem, excess=self.excess_g, slopes=slopes)


def _widened(error: Floats, excess: float) -> Floats:
    """(n,) factors by which an excess enlarges errors (n,): √(1 +
    (excess/error)²)."""
    return np.asarray(np.hypot(1.0, excess / error))


DILUTION_WARNING = 10.0
"""A tenth of `DILUTION_LIMIT`, at which a fit is refused: the errors are still valid,
but large."""
SPREAD_WARNING = 15.0
"""Dilution times the root of the number of poses: about 5 for poses all over the
sphere, 25 for half of it."""
LEFT_LEAST = 3
"""Degrees of freedom below which a residual proves little: with three, its standard
deviation is known to about 40 %."""
LEVERAGE_WARNING = 0.95
"""A pose of higher leverage shows less than a twentieth of its own error as a
residual."""


def concluded(problem: Problem, state: State, poses: Sequence[Pose], judged: Problem | None) -> Calibration:
    """The calibration from a fit at its minimum; ``judged`` as in `_ResidualChi2`.
    Raises NotStill where the fit diverged."""
    # Chi-square of the residuals, and the excess over the noise.
    linearised, n = _linearised(problem, state), len(poses)
    found = _ResidualChi2.of(linearised, problem, state, judged, within_pose_dof(poses))
    noise, birge_ratio = linearised[2][:n], found.excess.birge_ratio
    # An excess changes the weights: solve again.
    if found.excess.excess_g:
        problem = found.excess.added_to(problem, state)
        state = solve(problem, state, state.effects)
        linearised = linearise_all(problem, state)
    # Leverage, directions and their dilution.
    every_r, J, every_s = linearised
    r, s, p = every_r[:n], every_s[:n], J.shape[1]
    weighted = J / every_s[:, None]
    leverage = _leverage(weighted)[:n]
    sensor = state.sensor(problem)
    up = sensor.up(problem.u, problem.covariates)
    spread = _dilution(problem, up)
    # Covariance of parameters and shapes together, times the squared Birge ratio.
    shapes = by_shape(problem, state)
    covariance = _covariance(problem, state, np.concatenate([J, shapes], axis=1) / every_s[:, None]) * birge_ratio**2
    calibration = Calibration(
        sensor=sensor,
        covariance=covariance[:p, :p],
        reference=problem.reference,
        channel_reference={c: problem.channel_reference[c] for e in state.effects for c in e.needs},
        residual=Residual.of(
            r,
            noise,
            cross_validated_rms_g=cross_validated(problem, state),
            lack_of_fit_p=lack_of_fit_p(found.chi2, found.dof, within_pose_dof(poses)),
            left=n - p - sum(len(e.shape) for e in state.effects),
        ),
        poses=pose_results(poses, up, r, noise, studentized(r, s, leverage), leverage, total=s * birge_ratio),
        condition=_condition(weighted),
        dilution=spread,
        birge_ratio=birge_ratio,
        excess_g=found.excess.excess_g,
        dof=raised_dof(*found.with_doubtful, within_pose_dof(poses, leverage / leverage.sum())),
        shape_errors=shape_errors(problem, state, shapes, np.sqrt(np.diag(covariance)[p:]), birge_ratio),
        slopes=problem.slopes is not None,
    )
    return replace(calibration, cautions=tuple(_cautions(calibration)))


@dataclass(frozen=True)
class _ResidualChi2:
    """``chi2`` of a fit in units of the noise inside the poses, with ``dof`` degrees
    of freedom; ``with_doubtful``: both with the doubtful outliers included;
    ``excess`` from the latter."""

    chi2: float
    dof: int
    with_doubtful: tuple[float, int]
    excess: Excess

    @classmethod
    def of(
        cls, linearised: Linearised, problem: Problem, state: State, judged: Problem | None, pure: float
    ) -> _ResidualChi2:
        """``judged`` are the means of the poses with the doubtful outliers, or None;
        ``pure`` the degrees of freedom of the noise inside the poses."""
        n = len(problem.u)
        # Shapes of effects count as fitted parameters, though they have no column in
        # the Jacobian.
        spent = len(state.theta) + sum(len(e.shape) for e in state.effects)
        # Means alone decide where they have degrees of freedom; else means and slopes.
        by_means = problem.slopes is None or n > spent
        r, J, s = linearised
        own = (r[:n], J[:n], s[:n]) if by_means else linearised
        chi2, dof = residual_chi2(own), len(own[0]) - spent
        if judged is None or not by_means:
            return cls(chi2, dof, (chi2, dof), Excess.estimated(own, n, dof, pure))
        # The same with the doubtful outliers.
        others = linearise(judged, State.of(judged, state.sensor(problem)))
        with_doubtful = residual_chi2(others), dof + len(judged.u) - n
        return cls(chi2, dof, with_doubtful, Excess.estimated(others, len(judged.u), with_doubtful[1], pure))


def _linearised(problem: Problem, state: State) -> Linearised:
    with np.errstate(over="ignore", invalid="ignore"):
        r, J, s = linearise_all(problem, state)
    if not (np.isfinite(J).all() and np.isfinite(r).all()):
        raise NotStill("the fit ran away")
    return r, J, s


def _leverage(weighted: Floats) -> Floats:
    """(N,) the diagonal of the hat matrix, by the weighted Jacobian."""
    q, _ = np.linalg.qr(weighted)
    return np.asarray(np.clip((q**2).sum(axis=1), 0.0, 1.0))


def _condition(weighted: Floats) -> float:
    """Condition number of the weighted Jacobian with columns of length one."""
    return float(np.linalg.cond(weighted / np.maximum(np.linalg.norm(weighted, axis=0), 1e-300)))


def _dilution(problem: Problem, up: Floats) -> float:
    spread = dilution(up, linear_design(up, in_range(problem.u)))
    if not spread < DILUTION_LIMIT:
        # No scale factor and a bias of one reference fit anything: |a| is right
        # everywhere and means nothing.
        raise NotStill(f"the fit ran away, to a dilution of {spread:.3g}")
    return spread


def _covariance(problem: Problem, state: State, weighted: Floats) -> Floats:
    """Covariance of scale factor, misalignment, bias and coefficients from the
    weighted Jacobian; further columns belong to quantities estimated together with
    them."""
    # (JᵀJ)⁻¹ with columns of length one.
    norms = np.linalg.norm(weighted, axis=0)
    norms = np.where(norms > 0, norms, 1.0)
    inverse = np.linalg.pinv((weighted / norms).T @ (weighted / norms), rcond=1e-14)
    theta = inverse / np.outer(norms, norms)
    # Transform from theta to the reported parameters: G C Gᵀ.
    G = np.eye(len(theta))
    G[: len(state.theta), : len(state.theta)] = parameters_by_theta(problem, state)
    return np.asarray(G @ theta @ G.T)


def _cautions(c: Calibration) -> Iterator[Caution]:
    if c.dilution > DILUTION_WARNING or c.dilution * np.sqrt(len(c.poses)) > SPREAD_WARNING:
        up, enough = np.array([p.direction for p in c.poses]), min(2.0, c.dilution / 4)
        yield PoorSpread(c.dilution, tuple(label for label, _ in most_wanted(up, enough)))
    if len(c.poses) - len(c.parameters) < LEFT_LEAST:
        yield FewPoses(len(c.poses), len(c.parameters))
    worst = max(c.poses, key=lambda p: p.leverage)
    if worst.leverage > LEVERAGE_WARNING:
        yield HighLeverage(worst.pose.began, worst.leverage)
    p = probability(c.residual.lack_of_fit_p)
    if p is not None and p < SIGNIFICANT:
        yield ExcessVariance(c.excess_g / c.reference) if c.excess_g else BirgeRatio(c.birge_ratio)
    yield from too_small(c.residual)


def too_small(residual: Residual) -> Iterator[ResidualsTooSmall]:
    """A caution where residuals are smaller than noise and creep would leave with
    reasonable probability."""
    p = probability(residual.lack_of_fit_p)
    if p is not None and p > 1 - SIGNIFICANT / 5:
        yield ResidualsTooSmall()
