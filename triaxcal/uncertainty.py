"""The uncertainty of a calibration by the GUM, term by term (JCGM 100:2008, clauses 4, 5 and annex G).

Every source is an error of the poses' residuals, or of the parameters themselves; the fit's own linearisation carries
it to the parameters, and these to the magnitude that a calibrated unit reports in any orientation at the reference
conditions. That last figure, its rms over the sphere, is what the sources are weighed by.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.calibration import Calibration
from triaxcal.conditions import at_reference
from triaxcal.distributions import t_ppf
from triaxcal.effects import CATALOGUE, Effect
from triaxcal.errors import InvalidData
from triaxcal.figures import micro_g
from triaxcal.gravity import local_gravity_g
from triaxcal.plan.directions import directions
from triaxcal.problem import Problem, State, by_shape, everything, linearise, parameters_by_theta
from triaxcal.pure_error import DOF_MOST, pure_error_dof
from triaxcal.start import problem_of, with_history
from triaxcal.trends import with_trends

LEVEL = 0.95
TEMPERATURE = "temp_c"
SENSITIVITY_PER_K = {"temperature_bias": 5e-4, "temperature_scale_factor": 3e-4}
"""Standard deviation, before any data, of a coefficient that the fit has not taken up: in references per kelvin, and
per kelvin. Typical of a mass-market MEMS accelerometer's data sheet; a navigation unit is ten times better."""
SPHERE = 200
NOTHING = 1e-12
"""Share of a variance that is none."""


UNEXPLAINED = 0.01
"""p of the lack of fit below which more than noise is left in single readings."""


@dataclass(frozen=True)
class Stated:
    """What no recording can tell, as standard uncertainties; None where nobody stated it.

    ``reference`` in the reference's unit, with words on where it comes from; ``thermometer_k``; ``rounding`` the steps
    of the registers that take the result, by parameter (`Calibration.parameters`), in its unit.
    """

    reference: float | None = None
    reference_source: str = "as stated"
    thermometer_k: float | None = None
    rounding: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def at(
        cls,
        latitude_deg: float | None,
        height_m: float | None,
        reference: float | None = None,
        *,
        thermometer_k: float | None = None,
    ) -> Stated:
        """Where the reference is gravity by `triaxcal.gravity`: a stated uncertainty, in g, comes before that of the
        formula. Without a place, what is stated."""
        source = "as stated"
        if latitude_deg is not None and height_m is not None:
            source = f"normal gravity at latitude {latitude_deg:g}°, height {height_m:g} m; its uncertainty "
            source += "as stated" if reference is not None else "that of gravity anomalies over the Earth"
            if reference is None:
                reference = local_gravity_g(latitude_deg, height_m)[1]
        return cls(reference, source, thermometer_k)

    def __post_init__(self) -> None:
        for name, value in (("reference", self.reference), ("thermometer", self.thermometer_k)):
            if value is not None and not 0 <= value < np.inf:
                raise InvalidData(f"the uncertainty of the {name} must be a number of at least 0, not {value}")


@dataclass(frozen=True)
class Component:
    """One line of the budget.

    ``evaluation`` is A (from scatter) or B (otherwise); ``dof`` degrees of freedom behind it. ``parameters`` (p,)
    standard uncertainties of `Calibration.parameters`; ``magnitude`` of |a|, rms over the sphere. ``how`` it was found
    and what would halve it, in words.
    """

    source: str
    evaluation: str
    dof: float
    parameters: Floats
    magnitude: float
    how: str
    halved_by: str


@dataclass(frozen=True)
class Combined:
    """``standard`` uncertainty, Welch–Satterthwaite ``dof``, Student's ``coverage`` factor; arrays of one shape."""

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
    """Components, largest first; ``not_evaluated`` are sources that nothing is known of, in words."""

    components: tuple[Component, ...]
    parameters: Combined
    magnitude: Combined
    not_evaluated: tuple[str, ...]

    @property
    def dominant(self) -> Component:
        return self.components[0]

    @property
    def magnitude_if_halved(self) -> float:
        """Standard uncertainty of the magnitude if the dominant component were half as large."""
        least = float(self.magnitude.standard**2) - 0.75 * self.dominant.magnitude**2
        return float(np.sqrt(max(least, 0.0)))

    def share(self, component: Component) -> float:
        """Of the variance of the magnitude, 0…1."""
        whole = float(self.magnitude.standard**2)
        return component.magnitude**2 / whole if whole > 0 else 0.0


def budget(calibration: Calibration, stated: Stated | None = None, level: float = LEVEL) -> Budget:
    """The budget of a calibration fitted to still poses (`triaxcal.fit.fit`)."""
    stated = stated or Stated()
    ground = _Ground(calibration)
    thermal, beyond = _temperature(calibration, ground)
    found = [*_statistical(calibration, ground, beyond), *_reference(ground, stated), *thermal]
    found += _thermometer(calibration, ground, stated)
    found += _rounding(calibration, ground, stated)
    found.sort(key=lambda c: -c.magnitude)
    return Budget(
        tuple(found),
        _combined([(c, c.parameters) for c in found], calibration.dof, level, calibration.standard_errors),
        _combined([(c, np.asarray(c.magnitude)) for c in found], calibration.dof, level, np.zeros(())),
        tuple(_not_evaluated(calibration, ground, stated)),
    )


class _Ground:
    """The fit linearised at its solution, and the sphere that its parameters are judged on."""

    def __init__(self, calibration: Calibration) -> None:
        sensor = calibration.sensor
        poses = [p.pose for p in calibration.poses if p.used]
        signs = tuple(np.sign(sensor.scale_factor))
        problem = with_history(problem_of(poses, signs=signs, reference=calibration.reference), poses, sensor)
        # A model without a channel holds at its mean; the reference of one that has it is rounded to read well. To a
        # millionth, since processors differ in the last digits, and a steady channel should not seem to move.
        means = {n: round(float(np.mean(problem.channels[n])), 6) for n in problem.channel_reference}
        self.problem = replace(problem, channel_reference=means | dict(calibration.channel_reference))
        self.state = State.of(self.problem, sensor)
        self.effects = self.state.effects
        if calibration.trends:
            self.problem = with_trends(self.problem, poses, self.effects) or self.problem
        _, J, self.error = everything(self.problem, self.state)
        # What the shapes of effects were chosen by blurs the parameters too.
        self.weighted = np.concatenate([J, by_shape(self.problem, self.state)], axis=1) / self.error[:, None]
        self.gain = _pinv(self.weighted)
        self.G = parameters_by_theta(self.problem, self.state)
        self.by_residual = -self.G @ self.gain[: len(self.G)] / self.error
        """(p,n): shift of the parameters for an error of each residual (`triaxcal.problem.everything`)."""
        self.sphere = self._sphere(calibration, {})
        _, J, _ = linearise(self.sphere, self.state)
        self.by_parameters = J @ np.linalg.inv(self.G)
        """(m,p): change of |a| over the sphere by the parameters."""

    def _sphere(self, calibration: Calibration, shift: Mapping[str, float]) -> Problem:
        """Outputs of the unit all over the sphere, at the reference conditions but for ``shift``."""
        up = np.array([v for _, v in directions(SPHERE)]) * calibration.reference
        reference = self.problem.channel_reference
        held = at_reference(reference, len(up))
        u = calibration.sensor.output(up, held)
        channels = {n: held[n] + v + shift.get(n, 0.0) for n, v in reference.items()}
        none = np.zeros((len(u), 3, 3))
        return replace(self.problem, u=u, covariance=none, channels=channels, channel_reference=reference, further=None)

    def magnitude(self, covariance: Floats) -> float:
        """rms over the sphere of the uncertainty of |a| that a covariance (p,p) of the parameters makes."""
        return float(
            np.sqrt(max(np.einsum("mi,ij,mj->", *[self.by_parameters, covariance, self.by_parameters]), 0.0) / SPHERE)
        )

    def component(
        self, source: str, evaluation: str, dof: float, covariance: Floats, how: str, halved_by: str
    ) -> Component:
        parameters = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        return Component(source, evaluation, dof, parameters, self.magnitude(covariance), how, halved_by)

    def when_shifted(self, calibration: Calibration, channel: str, by: float) -> Floats:
        """(p,) what the parameters would have to be for |a| to stay right were a channel off by so much."""
        shifted = self._sphere(calibration, {channel: by})
        r, _, _ = linearise(shifted, self.state, jacobian=False)
        nine = self.by_parameters[:, :9]
        return np.concatenate([-np.linalg.lstsq(nine, r, rcond=None)[0], np.zeros(len(self.G) - 9)])


def _pinv(matrix: Floats) -> Floats:
    """Columns are scaled first: those of a temperature and of a cube are decades apart."""
    norms = np.maximum(np.linalg.norm(matrix, axis=0), 1e-300)
    return np.asarray(np.linalg.pinv(matrix / norms, rcond=1e-13) / norms[:, None])


def _statistical(calibration: Calibration, ground: _Ground, beyond: float) -> list[Component]:
    """What the scatter inside the poses, their creep, and residuals beyond both say, of which thermal effects leave the
    share ``beyond``."""
    poses = [p.pose for p in calibration.poses if p.used]
    _, by_u = calibration.sensor.magnitude(ground.problem.u, ground.problem.conditions)
    creeping = np.array([p.creep_covariance for p in poses])
    S = ground.by_residual
    creep = np.zeros(S.shape[1])
    creep[: len(poses)] = np.einsum("ni,nij,nj->n", by_u, creeping, by_u)
    # Creep across the measured vector, of which a processor's rounding leaves something, is none.
    creep = np.where(creep > NOTHING * ground.error**2, creep, 0.0)
    noise = np.maximum(ground.error**2 - creep, 0.0)
    held_s = float(np.median([p.end_s - p.start_s for p in poses]))
    out = [
        ground.component(
            "noise",
            "A",
            pure_error_dof(poses),
            (S * noise) @ S.T,
            f"scatter inside {len(poses)} poses of {held_s:.3g} s, with its autocorrelation",
            f"hold each pose for {4 * held_s:.2g} s, or record {4 * len(poses)} poses (against 1/f noise the latter)",
        )
    ]
    if creep.any():
        how = f"{np.count_nonzero(creep)} poses creep; rectangular over the change in each"
        by = "wait before each pose until the outputs creep by half as much"
        out.append(ground.component("creep", "B", np.inf, (S * creep) @ S.T, how, by))
    excess = beyond * (calibration.covariance - (S * ground.error**2) @ S.T)
    if np.max(np.diag(excess) / np.diag(calibration.covariance)) > 1e-6:
        how = f"residuals are {calibration.inflation:.2f} times what noise explains"
        by = "find what the model lacks: diagnose; more poses, some of them repeated"
        out.append(ground.component("lack_of_fit", "A", calibration.dof, excess, how, by))
    return out


def _reference(ground: _Ground, stated: Stated) -> list[Component]:
    if not stated.reference:
        return []
    # What |a| does inside the poses should be nothing, whatever the reference.
    shift = ground.by_residual[:, : len(ground.problem.u)].sum(axis=1) * stated.reference
    by = f"know the reference to {stated.reference / 2 * 1e6:.2g} µg"
    return [ground.component("reference", "B", np.inf, np.outer(shift, shift), stated.reference_source, by)]


def _temperature(calibration: Calibration, ground: _Ground) -> tuple[list[Component], float]:
    """What thermal effects that the fit has not taken up may have done to its parameters; and the share of the
    residuals' variance beyond noise that they do not explain, 0…1, lest it count twice.

    A coefficient that did not show is not zero: it is what the data leave of `SENSITIVITY_PER_K`, a mean and a spread
    by Bayes' rule, and the parameters of a fit without it are off by what it does to them.
    """
    missing = _thermal_but(ground.effects)
    if TEMPERATURE not in ground.problem.channel_reference or not missing:
        return [], 1.0
    extra = sum(len(e.coefficients) for e in missing)
    r, J, s = everything(ground.problem, ground.state.extended(missing))
    spread = np.concatenate([[_sensitivity(e, calibration.reference)] * len(e.coefficients) for e in missing])
    p = len(ground.state.theta)
    Z = J[:, p:] * spread / s[:, None]
    absorbed = ground.gain @ Z
    rest = Z - ground.weighted @ absorbed
    # With the prior's width as unit: what the poses do not show stays as wide as it was.
    # By the means alone: trends know nothing of an effect whose coefficients, and so its conditions' errors, are zero.
    told = rest[: len(ground.problem.u)]
    left = np.linalg.inv(np.eye(extra) + told.T @ told)
    mean = -left @ told.T @ (r / s)[: len(told)]
    through = ground.G @ absorbed[:p]
    after = r / s + rest @ mean
    taken = extra - float(np.trace(left))  # degrees of freedom, fewer than coefficients where the data say little
    before_ratio, after_ratio = (
        float(v @ v) / max(len(r) - ground.weighted.shape[1] - dof, 1e-9) for v, dof in ((r / s, 0.0), (after, taken))
    )
    beyond = min(max(after_ratio - 1, 0.0) / (before_ratio - 1), 1.0) if before_ratio > 1 else 1.0
    moved = float(np.ptp(ground.problem.channels[TEMPERATURE]))
    names = " and ".join(e.name for e in missing)
    how = f"{names} not in the model; the temperature moved by {moved:.2g} K from pose to pose"
    by = f"hold the temperature twice as steady, or let it swing until {names} can be fitted"
    covariance = through @ (left + np.outer(mean, mean)) @ through.T
    return [ground.component("temperature", "B", np.inf, covariance, how, by)], beyond


def _thermal_but(effects: tuple[Effect, ...]) -> list[Effect]:
    present = {e.name for e in effects}
    return [e for e in CATALOGUE if e.name in SENSITIVITY_PER_K and e.name not in present]


def _sensitivity(effect: Effect, reference: float) -> float:
    per_reference = reference if effect.coefficients[0].unit.startswith("g") else 1.0
    return SENSITIVITY_PER_K[effect.name] * per_reference


def _thermometer(calibration: Calibration, ground: _Ground, stated: Stated) -> list[Component]:
    """With thermal effects in the model its values hold at a temperature that somebody has to measure."""
    if not stated.thermometer_k or not _needs_temperature(ground.effects):
        return []
    shift = ground.when_shifted(calibration, TEMPERATURE, stated.thermometer_k)
    how = f"thermal effects, reckoned from {calibration.channel_reference[TEMPERATURE]:.4g} °C"
    by = f"know the temperature to {stated.thermometer_k / 2:.2g} K"
    return [ground.component("thermometer", "B", np.inf, np.outer(shift, shift), how, by)]


def _needs_temperature(effects: tuple[Effect, ...]) -> bool:
    return any(TEMPERATURE in e.needs for e in effects)


def _rounding(calibration: Calibration, ground: _Ground, stated: Stated) -> list[Component]:
    if not stated.rounding:
        return []
    steps = np.array([stated.rounding.get(name, 0.0) for name in calibration.parameters])
    how = f"steps of {np.count_nonzero(steps)} registers; rectangular"
    by = "registers with one bit more"
    return [ground.component("register_rounding", "B", np.inf, np.diag(steps**2 / 12), how, by)]


def _combined(lines: list[tuple[Component, Floats]], dof: float, level: float, least: Floats) -> Combined:
    """Root sum of squares, and degrees of freedom by annex G.4. Noise and what residuals add to it are one source, of
    the ``dof`` that the fit gives them, since the one is judged by the other. Never below what the fit by itself states
    (``least``), though thermal effects may be why its residuals are so large.
    """
    variance = sum((u**2 for _, u in lines), start=np.zeros_like(lines[0][1]))
    variance = np.maximum(variance, least**2)
    scatter = sum((u**2 for c, u in lines if c.evaluation == "A"), start=np.zeros_like(lines[0][1]))
    effective = variance**2 / np.maximum(scatter**2 / dof, 1e-300)
    return Combined(np.sqrt(variance), np.where(variance > 0, np.minimum(effective, DOF_MOST), DOF_MOST), level)


def _not_evaluated(calibration: Calibration, ground: _Ground, stated: Stated) -> list[str]:
    out = []
    if stated.reference is None:
        out.append("reference: taken as exact; state its uncertainty, or a latitude and height")
    if TEMPERATURE not in ground.problem.channel_reference:
        out.append(f"temperature: there is no channel {TEMPERATURE}")
    elif stated.thermometer_k is None and _needs_temperature(ground.effects):
        out.append("thermometer: its uncertainty was not stated")
    p, crossed = calibration.residual.lack_of_fit_p, calibration.residual.cross_validated_rms_g
    if p is not None and p < UNEXPLAINED and crossed is not None:
        out.append(
            f"lack of fit of a single reading: {micro_g(crossed)} cross-validated, of which only what it does to the "
            "parameters is above"
        )
    if any(p.pose.dof <= 0 for p in calibration.poses):
        out.append("noise: some poses have no scatter inside to tell it from")
    return out
