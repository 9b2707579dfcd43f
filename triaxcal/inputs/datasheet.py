"""Refinement of datasheet values by a few still poses.

The paper's reference 3 adds increments to datasheet values until |a| is right in the
poses. Here the datasheet's values are observations with standard errors of their own
(JCGM 102; Bayes with normal priors): fewer poses than parameters suffice, each
parameter moves as far as the poses are more informative than the datasheet, and a
contradiction between both can be tested.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from triaxcal.arrays import Floats, rms
from triaxcal.errors import InvalidData, Refused
from triaxcal.estimate.calibration import (
    Calibration,
    Caution,
    PoseResult,
    ReferenceEpoch,
    Residual,
    pose_results,
    studentized,
)
from triaxcal.estimate.likelihood import Problem, State, linearise, parameters_by_theta
from triaxcal.model.directions import dilution, linear_design
from triaxcal.model.sensor import Sensor
from triaxcal.poses.covariates import covariates_elsewhere
from triaxcal.poses.degrees_of_freedom import lack_of_fit_p, within_pose_dof
from triaxcal.poses.pose import Pose

STEPS_MOST = 60
"""Largest number of steps; a search that has not converged then is refused."""
CONVERGED = 1e-12
"""Relative step at the end of the search, within rounding."""
CONFLICT = 0.01
"""Probability below which poses contradict the datasheet: one sound unit in a
hundred is called so. A higher level would blame more; a lower one let more
changed units pass."""
NAMED = 0.95
"""Probability with which the changed value is among those named."""
SHARE_LEAST = 1e-6
"""Share of the information on a parameter that is within rounding."""
FROM_POSES, FROM_DATASHEET = 0.9, 0.1
"""Shares of the information on a parameter from which on its source is the poses, or
the datasheet."""


class FarFromPoses(Refused):
    """The poses are too far from the datasheet's values."""

    def __init__(self) -> None:
        super().__init__("the refinement did not converge: the datasheet values are far from these poses")


@dataclass(frozen=True)
class Datasheet:
    """Prior values. ``standard_error`` (9+p,) in the order of
    `Calibration.parameters`: scale factors, misalignments, biases, effects'
    coefficients; zero fixes a value. ``correlation`` (9+p,9+p) of their errors, none
    where it is None."""

    sensor: Sensor
    standard_error: Floats
    channel_reference: Mapping[str, float]
    reference: float
    correlation: Floats | None = None
    holds_at: ReferenceEpoch | None = None

    @property
    def moment(self) -> tuple[float, float] | None:
        """As `Calibration.moment`."""
        return None if self.holds_at is None else self.holds_at.clocks

    def __post_init__(self) -> None:
        n = 9 + sum(len(e.coefficients) for e, _ in self.sensor.effects)
        error = self.standard_error
        if error.shape != (n,) or not (np.isfinite(error).all() and np.all(error >= 0)):
            raise InvalidData(f"a datasheet of {n} values needs as many standard errors of at least 0")
        if not np.any(error > 0):
            raise InvalidData("every datasheet value has a standard error of 0: nothing is left to refine")
        if self.correlation is not None and self.correlation.shape != (n, n):
            raise InvalidData(f"the correlation of a datasheet of {n} values is a matrix of as many rows")

    @property
    def values(self) -> Floats:
        s = self.sensor
        return np.concatenate([s.scale_factor, s.misalignment, s.bias, *(c for _, c in s.effects)])

    @property
    def root(self) -> Floats:
        """(9+p,q) square root of the covariance of the free values."""
        error = self.standard_error
        free = np.flatnonzero(error > 0)
        if self.correlation is None:
            return np.asarray(np.diag(error)[:, free])
        values, vectors = np.linalg.eigh(self.correlation[np.ix_(free, free)])
        out = np.zeros((len(error), len(free)))
        out[free] = error[free, None] * vectors * np.sqrt(np.maximum(values, 0.0))
        return out


@dataclass(frozen=True)
class DatasheetContradicted(Caution):
    """Poses and datasheet values contradict each other (probability ``p``). A change
    of one of ``parameters``, the likeliest first, would explain most of it; they
    moved by ``shifts`` standard errors. ``alone``: the change of one explains all of
    it; standard errors are ``raised`` so many times."""

    p: float
    parameters: tuple[str, ...]
    shifts: tuple[float, ...]
    alone: bool
    raised: float


@dataclass(frozen=True)
class StillOfDatasheet(Caution):
    """The poses have hardly any information on these ``parameters``."""

    parameters: tuple[str, ...]


@dataclass(frozen=True)
class Refinement:
    """``share`` (9+p,) of the information on each parameter that came from the
    poses, 0…1: one less the ratio of its variance after to that before.
    ``shift`` (9+p,) of the values in standard errors of a shift by chance, 0
    where the poses say nothing. ``conflict_p`` is the probability of residuals
    and shifts as large as these together.

    ``changed`` are the parameters (indices) of which one has changed, if one
    has, the likeliest first, with the change in its standard errors by chance,
    given how the datasheet's errors go together; none where there is no
    conflict. ``changed_alone``: whether that explains it.
    """

    calibration: Calibration
    datasheet: Datasheet
    share: Floats
    shift: Floats
    conflict_p: float | None
    changed: Mapping[int, float] = field(default_factory=dict)
    changed_alone: bool = False

    @property
    def sources(self) -> tuple[str, ...]:
        """ "poses", "passport" or "both" for each parameter."""
        return tuple("poses" if s > FROM_POSES else "passport" if s < FROM_DATASHEET else "both" for s in self.share)


def refine(poses: Sequence[Pose], datasheet: Datasheet) -> Refinement:
    """Refine datasheet values by still poses, however few.

    Raises Refused where there is none, InvalidData where a channel that the
    datasheet's effects need is missing.
    """
    if not poses:
        raise Refused("no still pose: there is nothing to refine the datasheet values by")
    problem = _problem(poses, datasheet)
    free = datasheet.standard_error > 0
    root = datasheet.root
    # Maximum a posteriori: p = p₀ + L z with z ~ N(0, 1), C = L Lᵀ.
    z, information = _solved(problem, datasheet, root)
    p = datasheet.values + root @ z
    prior = datasheet.standard_error**2
    covariance = root @ np.linalg.inv(information) @ root.T
    state = _state(problem, datasheet, p)
    # Residuals and Jacobian there; chi-square of poses and prior together.
    r, J, s = linearise(problem, state)
    J = J @ _theta_by_parameters(problem, state)
    moved = p - datasheet.values
    chi2 = float(np.sum((r / s) ** 2) + z @ z)
    pure = within_pose_dof(poses)
    conflict_p = lack_of_fit_p(chi2, len(poses), pure if pure >= 1 else 1e6)
    raised = max(1.0, float(np.sqrt(chi2 / len(poses)))) if conflict_p is not None and conflict_p < CONFLICT else 1.0
    leverage = np.clip(np.einsum("ni,ij,nj->n", J, covariance, J) / s**2, 0.0, 1.0)
    # Share of the information, and shifts in their standard errors by chance.
    share = np.where(free, 1 - np.diag(covariance) / np.where(free, prior, 1.0), 0.0)
    by_chance = np.sqrt(np.maximum(prior * share, 0.0))
    shift = np.where(share > SHARE_LEAST, moved / np.where(share > SHARE_LEAST, by_chance, 1.0), 0.0)
    calibration = Calibration(
        sensor=state.sensor(problem),
        covariance=covariance * raised**2,
        reference=datasheet.reference,
        channel_reference=dict(datasheet.channel_reference),
        residual=_residual(r, s, leverage, conflict_p),
        poses=_results(problem, state, poses, r, s, leverage),
        condition=_condition(information),
        dilution=_dilution(problem, state),
        birge_ratio=raised,
        dof=float(max(len(poses), 1) if raised > 1 else max(pure, 1.0)),
        holds_at=datasheet.holds_at,
    )
    found = Refinement(calibration, datasheet, share, shift, conflict_p)
    # In a conflict, find the parameters whose change would explain it.
    if raised > 1:
        changed = _changed(datasheet, root, z, information)
        without = chi2 - next(iter(changed.values()), 0.0) ** 2
        rest = lack_of_fit_p(without, len(poses) - 1, pure if pure >= 1 else 1e6)
        found = replace(found, changed=changed, changed_alone=rest is None or rest >= CONFLICT)
    return replace(found, calibration=replace(calibration, cautions=tuple(_cautions(found))))


def _changed(datasheet: Datasheet, root: Floats, z: Floats, information: Floats) -> dict[int, float]:
    """`Refinement.changed`: the parameters one of which has changed with the
    probability `NAMED`.

    A change of unknown size in one value is ``effect / variance`` ± ``1/√variance``
    and lowers chi-square by ``effect²/variance``. The prior of its size in the
    datasheet's standard errors is a Cauchy distribution: any size is possible, and of
    two equal explanations the smaller is likelier. A single pose could be explained
    by any value, by most of them with a change a thousand times as large.
    """
    free = np.flatnonzero(datasheet.standard_error > 0)
    back = np.linalg.pinv(root[free])
    effect = back.T @ z
    variance = np.einsum("qi,qr,ri->i", back, np.eye(len(z)) - np.linalg.inv(information), back)
    error = datasheet.standard_error[free]
    felt = np.flatnonzero(variance * error**2 > SHARE_LEAST)
    if not len(felt):
        return {}
    shift = effect[felt] / np.sqrt(variance[felt])
    size = np.abs(effect[felt] / variance[felt]) / error[felt]
    width = 1 / np.sqrt(variance[felt]) / error[felt]
    log = shift**2 / 2 + np.log(width) - np.log1p(size**2)
    chance = np.exp(log - log.max())
    likeliest = np.argsort(-chance, kind="stable")
    count = int(np.searchsorted(np.cumsum(chance[likeliest]), NAMED * chance.sum())) + 1
    return {int(free[felt[i]]): float(shift[i]) for i in likeliest[:count]}


def _problem(poses: Sequence[Pose], datasheet: Datasheet) -> Problem:
    """The problem, scaled to the range that the datasheet predicts, since few poses
    have no range of their own."""
    sensor = datasheet.sensor
    held = covariates_elsewhere(poses, datasheet.channel_reference, sensor.scale_factor, sensor.bias, datasheet.moment)
    return Problem(
        u=np.array([p.mean for p in poses]),
        covariance=np.array([p.covariance for p in poses]),
        channels={name: held[name] + value for name, value in datasheet.channel_reference.items()},
        channel_reference=datasheet.channel_reference,
        middle=sensor.centre,
        half=np.abs(sensor.scale_factor) * datasheet.reference,
        signs=np.sign(sensor.scale_factor),
        reference=datasheet.reference,
    )


def _state(problem: Problem, datasheet: Datasheet, p: Floats) -> State:
    k, angles, b = p[:3], p[3:6], p[6:9]
    effects = tuple(e for e, _ in datasheet.sensor.effects)
    return State(np.concatenate([problem.half / k, b - problem.middle / k, angles, p[9:]]), effects)


def _theta_by_parameters(problem: Problem, state: State) -> Floats:
    return np.linalg.inv(parameters_by_theta(problem, state))


def _solved(problem: Problem, datasheet: Datasheet, root: Floats) -> tuple[Floats, Floats]:
    """Shifts z (q,) of the values along ``root`` (9+p,q), and the information (q,q)
    on them: Gauss–Newton with step halving."""
    z = np.zeros(root.shape[1])
    free = datasheet.standard_error > 0
    size = max(float(np.linalg.norm(datasheet.values[free] / datasheet.standard_error[free])), 1.0)

    def cost(z: Floats, s: Floats) -> float:
        p = datasheet.values + root @ z
        if np.any(p[:3] * datasheet.values[:3] <= 0):
            return float("inf")
        r, _, _ = linearise(problem, _state(problem, datasheet, p), jacobian=False)
        return float(np.sum((r / s) ** 2) + z @ z)

    for _ in range(STEPS_MOST):
        state = _state(problem, datasheet, datasheet.values + root @ z)
        r, J, s = linearise(problem, state)
        if not (np.isfinite(J).all() and np.isfinite(r).all() and np.all(s > 0)):
            raise FarFromPoses
        J = J @ _theta_by_parameters(problem, state) @ root / s[:, None]
        # Normal equations with the unit prior of z.
        information = J.T @ J + np.eye(len(z))
        if not np.isfinite(information).all():
            raise FarFromPoses
        step = -np.linalg.solve(information, J.T @ (r / s) + z)
        now, scale = cost(z, s), 1.0  # the weights follow the gradient from step to step
        # Halve the step until the posterior does not decrease.
        for _ in range(20):
            trial = z + scale * step
            if cost(trial, s) <= now * (1 + 1e-9) + 1e-12:
                break
            scale /= 2
        z = trial
        if np.linalg.norm(step) <= CONVERGED * size:
            return z, information
    if np.linalg.norm(step) > 1e-6:
        raise FarFromPoses
    return z, information


def _residual(r: Floats, s: Floats, leverage: Floats, p: float | None) -> Residual:
    alone = r / np.maximum(1 - leverage, 1e-9)  # of each pose under datasheet and all other poses
    crossed = rms(alone) if np.all(leverage < 1 - 1e-6) else None
    return Residual.of(r, s, cross_validated_rms_g=crossed, lack_of_fit_p=p)


def _results(
    problem: Problem, state: State, poses: Sequence[Pose], r: Floats, s: Floats, leverage: Floats
) -> tuple[PoseResult, ...]:
    direction = state.sensor(problem).up(problem.u, problem.covariates)
    return pose_results(poses, direction, r, s, studentized(r, s, leverage), leverage)


def _condition(information: Floats) -> float:
    norms = np.sqrt(np.diag(information))
    return float(np.sqrt(np.linalg.cond(information / np.outer(norms, norms))))


def _dilution(problem: Problem, state: State) -> float:
    """Dilution of the poses alone, without the datasheet."""
    up = state.sensor(problem).up(problem.u, problem.covariates)
    return dilution(up, linear_design(up, (problem.u - problem.middle) / problem.half))


def _cautions(found: Refinement) -> Iterator[Caution]:
    names = found.calibration.parameters
    if found.conflict_p is not None and found.conflict_p < CONFLICT:
        yield DatasheetContradicted(
            found.conflict_p,
            tuple(names[i] for i in found.changed),
            tuple(found.changed.values()),
            found.changed_alone,
            found.calibration.birge_ratio,
        )
    if kept := tuple(n for n, s in zip(names, found.sources, strict=True) if s == "passport"):
        yield StillOfDatasheet(kept)
