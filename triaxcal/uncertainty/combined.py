"""Combination of the components: root sum of squares, degrees of freedom by Welch and
Satterthwaite, and the dominant component; the uncertainty in another recording of the
same unit.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.distributions import DOF_MOST, t_ppf
from triaxcal.effects import TEMPERATURE
from triaxcal.effects.contract import RUN
from triaxcal.estimate.calibration import Calibration
from triaxcal.poses.covariates import at_moment
from triaxcal.poses.degrees_of_freedom import LACK_OF_FIT
from triaxcal.uncertainty.components import (
    Component,
    needs_temperature,
    not_held,
    of_update,
    reference,
    rounding,
    statistical,
    temperature,
    thermometer,
    unmodelled,
)
from triaxcal.uncertainty.propagation import ErrorPropagation, SphereMean
from triaxcal.uncertainty.statements import (
    NotEvaluated,
    PosesWithoutScatter,
    ReferenceTakenAsExact,
    SingleReading,
    Stated,
    TemperatureNotLogged,
    ThermometerNotStated,
)

LEVEL = 0.95
"""Coverage of expanded uncertainties: the usual one (JCGM 100, annex G)."""


@dataclass(frozen=True)
class Combined:
    """``standard`` uncertainty, Welch–Satterthwaite ``dof``, Student's
    ``coverage`` factor; arrays of one shape."""

    standard: Floats
    dof: Floats
    level: float

    @property
    def coverage(self) -> Floats:
        return np.asarray(t_ppf((1 + self.level) / 2, self.dof))

    @property
    def expanded(self) -> Floats:
        return self.standard * self.coverage


@dataclass(frozen=True)
class Budget:
    """Components, largest first; ``not_evaluated`` are sources without
    information."""

    components: tuple[Component, ...]
    parameters: Combined
    magnitude: Combined
    not_evaluated: tuple[NotEvaluated, ...]

    @property
    def dominant(self) -> Component:
        return self.components[0]

    @property
    def magnitude_if_halved(self) -> float:
        """Standard uncertainty of the magnitude with the dominant component
        halved."""
        least = float(self.magnitude.standard**2) - 0.75 * self.dominant.magnitude**2
        return float(np.sqrt(max(least, 0.0)))

    def share(self, component: Component) -> float:
        """Share of a component in the variance of the magnitude, 0…1."""
        whole = float(self.magnitude.standard**2)
        return component.magnitude**2 / whole if whole > 0 else 0.0


def budget(calibration: Calibration, stated: Stated | None = None, level: float = LEVEL) -> Budget:
    """The budget of a calibration fitted to still poses
    (`triaxcal.estimate.pose_fit.fit`), or with biases from them
    (`triaxcal.inputs.bias_update`), at coverage ``level``."""
    stated = stated or Stated()
    if calibration.update is not None:
        sphere = SphereMean.of(calibration)
        found = of_update(calibration, calibration.update, sphere)
        found += [*not_held(calibration, stated), *rounding(calibration, sphere, stated)]
        return _budget(calibration, found, level, [ReferenceTakenAsExact()] if stated.reference is None else [])
    linearised = ErrorPropagation(calibration)
    thermal, excess = temperature(calibration, linearised, stated)
    found = [*statistical(calibration, linearised, excess), *reference(linearised, stated), *thermal]
    found += thermometer(calibration, linearised, stated)
    found += unmodelled(calibration)
    found += not_held(calibration, stated)
    found += rounding(calibration, linearised, stated)
    return _budget(calibration, found, level, _not_evaluated(calibration, linearised, stated))


def _budget(
    calibration: Calibration, found: list[Component], level: float, not_evaluated: Iterable[NotEvaluated]
) -> Budget:
    found.sort(key=lambda c: -c.magnitude)
    return Budget(
        tuple(found),
        _combined([(c, c.parameters) for c in found], calibration.dof, level, calibration.standard_errors),
        _combined([(c, np.asarray(c.magnitude)) for c in found], calibration.dof, level, np.zeros(())),
        tuple(not_evaluated),
    )


def _combined(lines: list[tuple[Component, Floats]], dof: float, level: float, least: Floats) -> Combined:
    """Root sum of squares, with degrees of freedom by JCGM 100, G.4. Noise and excess
    variance are one source with the ``dof`` of the fit, since one is judged by the
    other. Never below the standard error of the fit itself (``least``), even if
    thermal effects cause its residuals."""
    # Sum of squares of all lines, and of those of type A.
    variance = sum((u**2 for _, u in lines), start=np.zeros_like(lines[0][1]))
    variance = np.maximum(variance, least**2)
    scatter = sum((u**2 for c, u in lines if c.evaluation == "A"), start=np.zeros_like(lines[0][1]))
    # Welch–Satterthwaite: ν = u⁴ / (u_A⁴ / ν_A); type B has infinite degrees of
    # freedom.
    effective = variance**2 / np.maximum(scatter**2 / dof, 1e-300)
    return Combined(np.sqrt(variance), np.where(variance > 0, np.minimum(effective, DOF_MOST), DOF_MOST), level)


def _not_evaluated(calibration: Calibration, linearised: ErrorPropagation, stated: Stated) -> Iterator[NotEvaluated]:
    if stated.reference is None:
        yield ReferenceTakenAsExact()
    if TEMPERATURE not in linearised.problem.channel_reference:
        yield TemperatureNotLogged(TEMPERATURE)
    elif stated.thermometer_k is None and needs_temperature(linearised.effects):
        yield ThermometerNotStated()
    p, crossed = calibration.residual.lack_of_fit_p, calibration.residual.cross_validated_rms_g
    if p is not None and p < LACK_OF_FIT and crossed is not None:
        yield SingleReading(crossed)
    if any(p.pose.dof <= 0 for p in calibration.poses):
        yield PosesWithoutScatter()


# Uncertainty of a calibration in another recording of the same unit: its own error
# and the start-to-start bias.

START_TO_START = 2e-3
"""In references, of |a| over the sphere, for a single recording: eight sensors of a
mass-market board (MIMU4444, runs 1 to 4) repeated within 1.5, 0.5 and 3.4 mg on their
three axes. Several recordings of a unit replace the assumption."""

FEWEST = 3
"""Number of poses of a run that determine its bias."""


class Source(StrEnum):
    ASSUMED = "assumed"
    MEASURED = "measured"


@dataclass(frozen=True)
class NextRecording:
    """``standard`` and ``expanded_uncertainty`` of |a|, rms over the sphere, at the
    reference conditions and the epoch of the calibration; ``start_to_start`` is the
    standard deviation of |a| from one recording to another. In the unit of the
    reference."""

    standard: float
    expanded_uncertainty: float
    start_to_start: float
    source: Source


def next_recording(c: Calibration, budget: Budget, start_to_start: float | None = None) -> NextRecording:
    """``start_to_start`` is a known value of the unit's type, in the unit of the
    reference; several recordings determine it."""
    measured = _between_runs(c)
    if c.update is not None:  # how many recordings told the earlier one is not known
        start, dof = c.update.start_to_start, np.inf
        source = Source.MEASURED if c.update.measured else Source.ASSUMED
    elif measured is not None:
        start, dof, source = *measured, Source.MEASURED
    else:
        start = START_TO_START * c.reference if start_to_start is None else start_to_start
        dof, source = np.inf, Source.ASSUMED
    # Combine both, with Welch–Satterthwaite degrees of freedom.
    own = float(budget.magnitude.standard)
    whole = np.hypot(own, start)
    # Welch and Satterthwaite, JCGM 100, G.4.
    effective = whole**4 / (own**4 / float(budget.magnitude.dof) + start**4 / dof + 1e-300) if whole > 0 else DOF_MOST
    coverage = float(t_ppf((1 + budget.magnitude.level) / 2, np.asarray(min(effective, DOF_MOST))))
    return NextRecording(float(whole), coverage * float(whole), start, source)


def _between_runs(c: Calibration) -> tuple[float, float] | None:
    """Standard deviation of |a| over the sphere by the biases of the runs, at the
    epoch of the calibration, and its degrees of freedom; None for one recording."""
    poses = [p for p in c.poses if p.used]
    runs = sorted({p.pose.run.index for p in poses})
    if len(runs) < 2:
        return None
    found = c.sensor.radius(np.array([p.pose.mean for p in poses]), c.covariates_of([p.pose for p in poses]))
    off, error = found.length - c.reference, np.array([p.error_g for p in poses])
    # Bias shift of every run, and its variance by noise.
    biases, variances = [], []
    for run in runs:
        own = np.array([p.pose.run.index == run for p in poses])
        if own.sum() >= FEWEST:
            left, variance = _shift(found.by_v[own], off[own], error[own])
            biases.append(left + _in_run(c, run))
            variances.append(variance)
    if len(biases) < 2:
        return None
    # Variance between runs, less that of the noise.
    by_noise = np.mean(variances, axis=0).sum()
    spread = np.var(biases, axis=0, ddof=1).sum() - by_noise
    # Starts that agree within their noise may differ by as much as their mean
    # is uncertain.
    return float(np.sqrt(max(spread, by_noise / len(biases)) / 3)), 3.0 * (len(biases) - 1)


def _in_run(c: Calibration, run: int) -> Floats:
    """(3,) contribution to the bias of effects of the clocks, and of single runs, in
    a run at the epoch."""
    held = at_moment(c.channel_reference, 1, c.moment)
    if RUN in held:
        held[RUN] = np.array([run - c.channel_reference[RUN]])
    return np.asarray(c.sensor.departure(np.zeros((1, 3)), held)[0])


def _shift(by_v: Floats, off: Floats, error: Floats) -> tuple[Floats, Floats]:
    """(3,) error of the biases of a run by weighted least squares, and its variances
    by noise."""
    weighted = by_v / error[:, None]
    inverse = np.linalg.pinv(weighted.T @ weighted)
    return inverse @ weighted.T @ (off / error), np.diag(inverse)


# Three uncertainties of |a| for different readings, each with one name everywhere:
# this fit, this session's poses, another day.

NAMES = ("this fit", "this session's poses", "another day")


@dataclass(frozen=True)
class Scopes:
    """Expanded uncertainties of |a|, rms over the sphere, in the unit of the
    reference.

    ``this_fit``: of the calibration itself, by its budget. ``this_session``: of one
    more pose of the recording, with its noise and the residual error.
    ``another_day``: of the next recording, with the start-to-start bias.
    """

    this_fit: float
    this_session: float
    another_day: float

    @classmethod
    def of(cls, c: Calibration, budget: Budget, following: NextRecording) -> Scopes:
        """A pose that the fit has not seen has the cross-validated error, but no less
        than fit and residuals together."""
        standard, k = float(budget.magnitude.standard), float(budget.magnitude.coverage)
        crossed = c.residual.cross_validated_rms_g
        pose = float(np.hypot(standard, c.residual.rms_g))
        if crossed is not None:
            pose = max(pose, crossed)
        return cls(float(budget.magnitude.expanded), k * pose, following.expanded_uncertainty)

    @property
    def named(self) -> dict[str, float]:
        return dict(zip(NAMES, (self.this_fit, self.this_session, self.another_day), strict=True))
