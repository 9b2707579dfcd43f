"""Combination of the components: root sum of squares, degrees of freedom by Welch and
Satterthwaite, and the dominant component."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.distributions import DOF_MOST, t_ppf
from triaxcal.effects import TEMPERATURE
from triaxcal.estimate.calibration import Calibration
from triaxcal.poses.degrees_of_freedom import LACK_OF_FIT
from triaxcal.uncertainty.components import Component, not_held, of_update, reference, rounding, statistical, unmodelled
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
from triaxcal.uncertainty.thermal import needs_temperature, temperature, thermometer

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
