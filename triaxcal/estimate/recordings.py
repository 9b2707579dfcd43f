"""Several recordings of one unit as one set of poses: one linear model, and
effects of the clocks run by run.

Every recording has its own clock, and the unit was switched on anew before it:
a drift, a warm-up or a step may be in one run alone, alike in all, or in each
its own; and the bias may come back a little different at every start.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import RUN, Effect
from triaxcal.effects.runs import BETWEEN_RUNS, InRuns, longest, of_clocks
from triaxcal.effects.wrapped import Wrapped
from triaxcal.errors import InvalidData
from triaxcal.estimate.calibration import Calibration
from triaxcal.poses.pose import Pose, Run

POSES_A_COEFFICIENT = 4.0
"""Forms with more coefficients of a run than one for so many of its poses are
not tried."""


def together(recordings: Sequence[Sequence[Pose]]) -> list[Pose]:
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
    """The effects to look for: of several runs, those of the clocks run by run,
    and what differs between runs; else as they are."""
    runs = poses[0].run.of if poses else 1
    if runs == 1:
        return tuple(catalogue)
    return (*(ByRun(e, runs) if of_clocks(e) else e for e in catalogue), *(replace(e, runs=runs) for e in BETWEEN_RUNS))


@dataclass(frozen=True)
class ByRun(Wrapped):
    """An effect of the clocks, of which the search tries: alike in all
    ``runs``; in one alone; in each, and in all but one, by coefficients of
    their own. One that lasts begins in one run.
    """

    runs: int

    @property
    def needs(self) -> tuple[str, ...]:
        return (*self.whole.needs, RUN)

    def variants(self, covariates: Mapping[str, Floats]) -> Sequence[Effect]:
        out: list[Effect] = []
        if not self.whole.lasting:
            out += self.whole.variants(longest(covariates, range(self.runs)))
        for runs in self._sets():
            fewest = min(int(np.sum(covariates[RUN] == run)) for run in runs)
            most = len(runs) * fewest / POSES_A_COEFFICIENT
            out += [e for e in InRuns(self.whole, runs).variants(covariates) if len(e.coefficients) <= most]
        return tuple(out)

    def _sets(self) -> list[tuple[int, ...]]:
        every = tuple(range(self.runs))
        sets: list[tuple[int, ...]] = [(run,) for run in every]
        if self.whole.lasting:
            return sets
        if self.runs > 2:
            sets += [tuple(other for other in every if other != run) for run in every]
        return [*sets, every]


@dataclass(frozen=True)
class RunResidual:
    """How well the magnitude comes out in the poses of one run, before and
    after, rms in units of the reference."""

    poses: int
    before_rms_g: float
    after_rms_g: float
    noise_floor_g: float


def residuals_by_run(before: Calibration, after: Calibration) -> list[RunResidual]:
    """Of the poses that the fits used, by run. ``before`` and ``after`` are of
    the same poses."""
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
