"""How well a calibration foretells another recording of the same unit: beside its own error, how units start."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.calibration import Calibration
from triaxcal.distributions import DOF_MOST, t_ppf
from triaxcal.effects.run_bias import BETWEEN_RUNS
from triaxcal.uncertainty import Budget

START_TO_START = 2e-3
"""In references, of |a| over the sphere, where one recording is all that is known: eight sensors of a mass-market board
(MIMU4444, runs 1 to 4) came back by 1.5, 0.5 and 3.4 mg on their three axes. A unit of another class says otherwise by
several recordings."""


class Source(StrEnum):
    ASSUMED = "assumed"
    MEASURED = "measured"


@dataclass(frozen=True)
class NextRecording:
    """``expanded_uncertainty`` of |a|, rms over the sphere, at the reference conditions and the moment for which the
    calibration holds; ``start_to_start`` the standard deviation of |a| from one recording to another. In the unit of
    the reference."""

    expanded_uncertainty: float
    start_to_start: float
    source: Source


def next_recording(c: Calibration, budget: Budget, start_to_start: float | None = None) -> NextRecording:
    """``start_to_start`` is known of the unit's type, in the unit of the reference; from several recordings it is
    measured."""
    measured = _between_runs(c)
    if measured is not None:
        start, dof, source = *measured, Source.MEASURED
    else:
        start = START_TO_START * c.reference if start_to_start is None else start_to_start
        dof, source = np.inf, Source.ASSUMED
    own = float(budget.magnitude.standard)
    whole = np.hypot(own, start)
    # Welch and Satterthwaite, JCGM 100, G.4.
    effective = whole**4 / (own**4 / float(budget.magnitude.dof) + start**4 / dof + 1e-300) if whole > 0 else DOF_MOST
    coverage = float(t_ppf((1 + budget.magnitude.level) / 2, np.asarray(min(effective, DOF_MOST))))
    return NextRecording(coverage * float(whole), start, source)


def _between_runs(c: Calibration) -> tuple[float, float] | None:
    """The standard deviation of |a| over the sphere that biases from run to run make, and its degrees of freedom; None
    of one recording."""
    poses = [p for p in c.poses if p.used]
    runs = sorted({p.pose.run.index for p in poses})
    if len(runs) < 2:
        return None
    names = {effect.name for effect in BETWEEN_RUNS}
    sensor = replace(c.sensor, effects=tuple((e, q) for e, q in c.sensor.effects if e.name not in names))
    held = c.conditions_of([p.pose for p in poses])
    found = sensor.radius(np.array([p.pose.mean for p in poses]), held)
    off, error = found.length - c.reference, np.array([p.error_g for p in poses])
    shifts, variances = [], []
    for run in runs:
        own = np.array([p.pose.run.index == run for p in poses])
        if own.sum() < 3:
            continue
        shift, variance = _shift(found.by_v[own], off[own], error[own])
        shifts.append(shift)
        variances.append(variance)
    if len(shifts) < 2:
        return None
    spread = np.var(shifts, axis=0, ddof=1) - np.mean(variances, axis=0)
    return float(np.sqrt(max(spread.sum(), 0.0) / 3)), 3.0 * (len(shifts) - 1)


def _shift(by_v: Floats, off: Floats, error: Floats) -> tuple[Floats, Floats]:
    """(3,) by how much the biases of a run are off, and the variances of that by noise."""
    weighted = by_v / error[:, None]
    inverse = np.linalg.pinv(weighted.T @ weighted)
    return inverse @ weighted.T @ (off / error), np.diag(inverse)
