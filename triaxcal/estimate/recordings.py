"""Several recordings of one unit as one set of poses: one linear model, and effects
of the clocks run by run.

Every recording has its own clock, and the unit was switched on anew before it. A
drift, a warm-up or a step may act in one run alone, in all alike, or in each
differently; the bias may differ from one start to the next.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.distributions import f_sf
from triaxcal.effects.contract import RUN, Effect
from triaxcal.effects.runs import BETWEEN_RUNS, InRuns, Wrapped, longest_run, of_clocks
from triaxcal.errors import InvalidData, Refused
from triaxcal.estimate.calibration import Calibration
from triaxcal.estimate.pose_fit import fit
from triaxcal.poses.covariates import covariates_elsewhere
from triaxcal.poses.pose import Pose, Run

POSES_A_COEFFICIENT = 4.0
"""A form has at most one coefficient of a run for so many of its poses."""


def gather(recordings: Sequence[Sequence[Pose]]) -> list[Pose]:
    """The poses of several recordings of one unit, in that order, each with its
    `Run`. One recording's as they are.

    Raises InvalidData where a recording of several has no pose.
    """
    if len(recordings) == 1:
        return list(recordings[0])
    empty = [str(i + 1) for i, poses in enumerate(recordings) if not poses]
    if empty:
        raise InvalidData(f"recording {', '.join(empty)} of {len(recordings)} has no still pose")
    out = []
    for i, poses in enumerate(recordings):
        run = Run(i, len(recordings), round(float(np.mean([p.t_s for p in poses])), 1))
        out += [replace(p, run=run) for p in poses]
    return out


def by_run(catalogue: Sequence[Effect], poses: Sequence[Pose]) -> tuple[Effect, ...]:
    """The effects of the search. For several runs: effects of the clocks run by run,
    and effects between runs; for one run the ``catalogue``."""
    runs = poses[0].run.of if poses else 1
    if runs == 1:
        return tuple(catalogue)
    return (*(ByRun(e, runs) if of_clocks(e) else e for e in catalogue), *(replace(e, runs=runs) for e in BETWEEN_RUNS))


@dataclass(frozen=True)
class ByRun(Wrapped):
    """An effect of the clocks. The search tries: the same in all ``runs``; in one
    alone; with coefficients of its own in each, and in all but one. An effect that
    lasts begins in one run."""

    runs: int

    @property
    def needs(self) -> tuple[str, ...]:
        return (*self.inner.needs, RUN)

    def variants(self, covariates: Mapping[str, Floats]) -> Sequence[Effect]:
        out: list[Effect] = []
        # The same in all runs, on the clock of the longest run.
        if not self.inner.lasting:
            out += self.inner.variants(longest_run(covariates, range(self.runs)))
        # With coefficients of their own, as far as the runs have poses enough.
        for runs in self._sets():
            fewest = min(int(np.sum(covariates[RUN] == run)) for run in runs)
            most = len(runs) * fewest / POSES_A_COEFFICIENT
            out += [e for e in InRuns(self.inner, runs).variants(covariates) if len(e.coefficients) <= most]
        return tuple(out)

    def _sets(self) -> list[tuple[int, ...]]:
        every = tuple(range(self.runs))
        sets: list[tuple[int, ...]] = [(run,) for run in every]
        if self.inner.lasting:
            return sets
        if self.runs > 2:
            sets += [tuple(other for other in every if other != run) for run in every]
        return [*sets, every]


@dataclass(frozen=True)
class RunResidual:
    """Residuals of |a| in the poses of one run, before and after: rms in units of the
    reference."""

    poses: int
    before_rms_g: float
    after_rms_g: float
    noise_floor_g: float


def residuals_by_run(before: Calibration, after: Calibration) -> list[RunResidual]:
    """Residuals by run, of the poses that both fits used. ``before`` and ``after``
    are of the same poses."""
    used: Mapping[int, list[int]] = {i: [] for i in range(after.poses[0].pose.run.of)}
    for i, (old, new) in enumerate(zip(before.poses, after.poses, strict=True)):
        if old.used and new.used:
            used[new.pose.run.index].append(i)

    def rms(values: Sequence[float]) -> float:
        return float(np.sqrt(np.mean(np.square(np.array(values, dtype=float))))) if values else float("nan")

    return [
        RunResidual(
            len(rows),
            rms([before.poses[i].residual_g for i in rows]),
            rms([after.poses[i].residual_g for i in rows]),
            rms([after.poses[i].standard_error_g for i in rows]),
        )
        for rows in used.values()
    ]


# Unit identity: the shape of the triad, which age and temperature hardly change.

MISALIGNMENT_RAD, SCALE_FACTOR = 1e-3, 6e-3
"""Standard deviations of a misalignment [rad] and of a scale factor (relative)
between two recordings of one mass-market unit: the latter is the effect of 20 K
without correction (`triaxcal.uncertainty`, 3e-4/K)."""
POSES_LEAST = 12
"""With fewer poses, unmodelled effects go into the nine parameters."""
BY_CHANCE = 1e-4
"""Probability of a false alarm for one unit."""
RATIOS = np.array([[1.0, -1.0, 0.0], [0.0, 1.0, -1.0]])
"""(2,3) differences of the logarithms of the scale factors: two ratios."""
RATIOS.flags.writeable = False


@dataclass(frozen=True)
class Shape:
    """Logarithms of two ratios of scale factors, and the misalignments [rad]:
    (5,), with their covariance (5,5) and the degrees of freedom behind it."""

    values: Floats
    covariance: Floats
    dof: float

    @classmethod
    def of(cls, scale_factor: Floats, misalignment: Floats, covariance: Floats, dof: float) -> Shape:
        """``covariance`` (6,6) of both, in that order."""
        # Linear propagation: d ln k = dk / k, and the angles unchanged.
        to_shape = np.zeros((5, 6))
        to_shape[:2, :3] = RATIOS / scale_factor
        to_shape[2:, 3:] = np.eye(3)
        values = np.concatenate([RATIOS @ np.log(np.abs(scale_factor)), misalignment])
        return cls(values, to_shape @ covariance @ to_shape.T, dof)


def shape_of(c: Calibration) -> Shape:
    return Shape.of(c.sensor.scale_factor, c.sensor.misalignment, c.covariance[:6, :6], c.dof)


def shape_by_poses(poses: Sequence[Pose], signs: Sequence[float], reference: float) -> Shape | None:
    """The shape from a linear fit to these poses alone; None where they do not carry
    one, or are few."""
    try:
        found = fit(poses, signs=signs, reference=reference)
    except (Refused, InvalidData):
        return None
    return shape_of(found) if sum(p.used for p in found.poses) >= POSES_LEAST else None


def shape_without_effects(held: Calibration, poses: Sequence[Pose]) -> Shape | None:
    """The shape from these poses after subtraction of the effects of ``held``."""
    sensor = held.sensor
    if sensor.effects:
        try:
            # Outputs without the effects: u = K (s + b).
            at = covariates_elsewhere(poses, held.channel_reference, sensor.scale_factor, sensor.bias, held.moment)
            s = sensor.along_axes(np.array([p.mean for p in poses]), at)
        except Refused:
            return None
        poses = [replace(p, mean=mean) for p, mean in zip(poses, sensor.scale_factor * (s + sensor.bias), strict=True)]
    return shape_by_poses(poses, np.sign(sensor.scale_factor).tolist(), held.reference)


def shape_in(calibration: Mapping[str, Any]) -> Shape | None:
    """The shape in a `triaxcal.calibration/1` document; None where it has no usable
    values and standard errors."""
    try:
        k, m = (np.array(calibration[name], dtype=float) for name in ("scale_factor", "misalignment"))
        errors = [calibration["standard_error"][name] for name in ("scale_factor", "misalignment")]
        error = np.concatenate([np.array(e, dtype=float).reshape(3) for e in errors])
    except (KeyError, TypeError, ValueError, OverflowError):
        return None
    with np.errstate(all="ignore"):  # numbers out of a file may be any
        shape = Shape.of(k, m, np.diag(error**2), np.inf)
    return shape if np.isfinite([*shape.values, *shape.covariance.flat]).all() else None


@dataclass(frozen=True)
class ShapesDiffer:
    """Two shapes that probably belong to two units: they differ by up to
    ``angle_rad`` in the misalignments and by up to ``ratio`` in the logarithm of the
    ratios of scale factors."""

    angle_rad: float
    ratio: float


def difference_of_shapes(one: Shape | None, another: Shape | None) -> ShapesDiffer | None:
    """None where both may belong to one unit, or where one of the shapes is not
    known."""
    if one is None or another is None:
        return None
    # Covariance of the difference: both fits, and the spread of one unit.
    apart = one.values - another.values
    of_one_unit = np.zeros((5, 5))
    of_one_unit[:2, :2] = SCALE_FACTOR**2 * RATIOS @ RATIOS.T
    of_one_unit[2:, 2:] = MISALIGNMENT_RAD**2 * np.eye(3)
    weight = one.covariance + another.covariance + of_one_unit
    # Mahalanobis distance of the shapes.
    squares = float(apart @ np.linalg.solve(weight, apart))
    # Welch–Satterthwaite: the spread of one unit is known, the errors of the
    # fits are estimated.
    shares = [(np.trace(np.linalg.solve(weight, s.covariance)) / len(apart), s.dof) for s in (one, another)]
    dof = 1 / max(sum(share**2 / dof for share, dof in shares), 1e-9)
    # F-test of the mean square with five degrees of freedom.
    if not f_sf(squares / len(apart), len(apart), dof) < BY_CHANCE:
        return None
    ratio, angle = (float(np.max(np.abs(v))) for v in ([*apart[:2], apart[:2].sum()], apart[2:]))
    return ShapesDiffer(angle, ratio)
