"""The components of the budget, each from the linearised fit; those of temperature
among them."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.distributions import softmax
from triaxcal.effects import CATALOGUE, TEMPERATURE, Effect
from triaxcal.effects.odds import EFFECT_ODDS, SIZES, SMALLEST, on_axes
from triaxcal.estimate.calibration import BiasUpdate, Calibration
from triaxcal.estimate.likelihood import linearise_all
from triaxcal.poses.degrees_of_freedom import LACK_OF_FIT, noise_levels, within_pose_dof
from triaxcal.poses.noise_spectrum import NoiseLevels
from triaxcal.poses.pose import Pose
from triaxcal.uncertainty.propagation import ErrorPropagation, SphereMean
from triaxcal.uncertainty.statements import (
    AveragedModels,
    Basis,
    BirgeFactor,
    ChangedSince,
    CompleteModel,
    Creep,
    CreepHalved,
    Excess,
    FinerRegisters,
    FittedAnew,
    HostCorrects,
    KeptParameters,
    LongerOrMorePoses,
    ModelsDistinguished,
    NoParameter,
    NotHeld,
    PosesAtOtherTemperatures,
    ProbableTemperature,
    ReferenceKnown,
    RegisterSteps,
    Remedy,
    Stated,
    SteadierTemperature,
    TemperatureKnown,
    TemperatureModelled,
    ThermometerAt,
    UnmodelledTemperature,
    WithinPoseScatter,
)

CERTAIN = 0.99
"""Effects of this probability have no competing models."""
NOTHING = 1e-12
"""Share of a variance that is negligible."""


@dataclass(frozen=True)
class Component:
    """One line of the budget.

    ``evaluation`` is A (from scatter) or B (otherwise); ``dof`` its degrees of
    freedom. ``parameters`` (p,) are standard uncertainties of
    `Calibration.parameters`; ``magnitude`` that of |a|, rms over the sphere.
    """

    source: str
    evaluation: str
    dof: float
    parameters: Floats
    magnitude: float
    basis: Basis
    halved_by: Remedy

    @classmethod
    def of(
        cls,
        sphere: SphereMean,
        source: str,
        evaluation: str,
        dof: float,
        covariance: Floats,
        basis: Basis,
        by: Remedy,
    ) -> Component:
        """The component of a source from its ``covariance`` (p,p) of the parameters;
        ``by`` is the remedy that would halve it."""
        parameters = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        return cls(source, evaluation, dof, parameters, sphere.magnitude(covariance), basis, by)


def statistical(calibration: Calibration, linearised: ErrorPropagation, share: float) -> list[Component]:
    """Components of the scatter inside the poses, of their creep, and of the excess
    variance, of which ``share`` is not due to thermal effects."""
    poses = [p.pose for p in calibration.poses if p.used]
    # Variance of |a| by creep: gᵀ (c cᵀ/12) g.
    _, by_u = calibration.sensor.magnitude(linearised.problem.u, linearised.problem.covariates)
    creeping = np.array([p.creep_covariance for p in poses])
    S = linearised.by_residual
    creep = np.zeros(S.shape[1])
    creep[: len(poses)] = np.einsum("ni,nij,nj->n", by_u, creeping, by_u)
    # Ignore the rounding error of creep across the measured vector.
    creep = np.where(creep > NOTHING * linearised.noise**2, creep, 0.0)
    noise = np.maximum(linearised.noise**2 - creep, 0.0)
    # Propagate noise and creep: S diag(s²) Sᵀ, S = ∂parameters/∂residuals.
    out = [
        Component.of(
            linearised,
            "noise",
            "A",
            within_pose_dof(poses),
            (S * noise) @ S.T,
            WithinPoseScatter(len(poses), _median_duration_s(poses)),
            half_the_noise(poses),
        )
    ]
    if creep.any():
        basis = Creep(int(np.count_nonzero(creep)))
        out.append(Component.of(linearised, "creep", "B", np.inf, (S * creep) @ S.T, basis, CreepHalved()))
    if calibration.prior_sd is not None:
        return out + _between(calibration, linearised, (S * linearised.noise**2) @ S.T)
    # The remaining covariance of the fit is due to excess variance or Birge ratio.
    excess = share * (calibration.covariance - (S * linearised.noise**2) @ S.T)
    if np.max(np.diag(excess) / np.diag(calibration.covariance)) > 1e-6:
        raised: Basis = BirgeFactor(calibration.birge_ratio)
        if calibration.excess_g:
            raised = Excess(calibration.excess_g / calibration.reference)
        out.append(Component.of(linearised, "lack_of_fit", "A", calibration.dof, excess, raised, CompleteModel()))
    return out


def _between(calibration: Calibration, linearised: ErrorPropagation, noise: Floats) -> list[Component]:
    """The covariance of an average less the ``noise`` (p,p) of the poses and thermal
    effects, which have lines of their own."""
    thermal = 0.0 if calibration.thermal is None else calibration.thermal
    rest = positive_semidefinite(calibration.covariance - noise - thermal)
    names = tuple(name for name, p in calibration.weights.items() if p < CERTAIN)
    basis, by = AveragedModels(names), ModelsDistinguished()
    return [Component.of(linearised, "choice_of_effect", "B", np.inf, rest, basis, by)]


def positive_semidefinite(covariance: Floats) -> Floats:
    """The nearest positive semidefinite matrix: a difference of two covariances may
    not be one."""
    size, axes = np.linalg.eigh(covariance)
    return np.asarray((axes * np.maximum(size, 0.0)) @ axes.T)


def half_the_noise(poses: Sequence[Pose]) -> Remedy:
    """The remedy for a component due to the noise of the poses: four times as long,
    or four times as many."""
    return LongerOrMorePoses(4 * _median_duration_s(poses), 4 * len(poses))


def _median_duration_s(poses: Sequence[Pose]) -> float:
    return float(np.median([p.end_s - p.start_s for p in poses]))


def reference(linearised: ErrorPropagation, stated: Stated) -> list[Component]:
    if not stated.reference:
        return []
    # Slopes inside the poses do not depend on the reference.
    shift = linearised.by_residual[:, : len(linearised.problem.u)].sum(axis=1) * stated.reference
    by = ReferenceKnown(stated.reference / 2)
    return [Component.of(linearised, "reference", "B", np.inf, np.outer(shift, shift), stated.reference_basis, by)]


def of_update(calibration: Calibration, update: BiasUpdate, sphere: SphereMean) -> list[Component]:
    """Components of a bias update: those of its poses, and those of the kept
    parameters."""
    poses = [p.pose for p in calibration.poses if p.used]
    bases: Mapping[str, tuple[Basis, Remedy]] = {
        "noise": (WithinPoseScatter(len(poses), _median_duration_s(poses)), half_the_noise(poses)),
        "lack_of_fit": (BirgeFactor(calibration.birge_ratio), FittedAnew()),
        "scatter": (Excess(update.scatter_g / calibration.reference), FittedAnew()),
        "kept": (KeptParameters(), FittedAnew()),
        "since": (ChangedSince(update.measured), FittedAnew()),
    }
    of_noise = ("noise", "lack_of_fit")
    return [
        Component.of(
            sphere,
            source,
            "A" if source in of_noise else "B",
            calibration.dof if source in of_noise else np.inf,
            covariance,
            *bases[source],
        )
        for source, covariance in update.covariances.items()
    ]


def not_held(calibration: Calibration, stated: Stated) -> list[Component]:
    if not stated.not_held:
        return []
    none = np.zeros(len(calibration.parameters))
    return [Component("not_held", "B", np.inf, none, stated.not_held, NotHeld(), HostCorrects())]


def unmodelled(calibration: Calibration) -> list[Component]:
    """Unmodelled contribution to |a|, rms over the sphere."""
    part = calibration.unmodelled
    if part is None or not part.along:
        return []
    none = np.zeros(len(calibration.parameters))
    return [Component("unmodelled", "B", np.inf, none, part.along, NoParameter(), ModelsDistinguished())]


def rounding(calibration: Calibration, sphere: SphereMean, stated: Stated) -> list[Component]:
    if not stated.rounding:
        return []
    steps = np.array([stated.rounding.get(name, 0.0) for name in calibration.parameters])
    basis = RegisterSteps(int(np.count_nonzero(steps)))
    return [Component.of(sphere, "register_rounding", "B", np.inf, np.diag(steps**2 / 12), basis, FinerRegisters())]


# Uncertainty from temperature: effects that the model lacks, and the thermometer of
# those that it has.

SENSITIVITY_PER_K = {"temperature_bias": 5e-4, "temperature_scale_factor": 3e-4}
"""Prior standard deviation of a coefficient that the fit lacks: in references per
kelvin, and per kelvin. Typical of the data sheet of a mass-market MEMS accelerometer;
a navigation unit is ten times better."""
LARGEST = 3.0
"""In that standard deviation: a worse unit has another data sheet."""
NO_SENSITIVITY = 1e-12
"""In place of a sensitivity of zero, whose inverse is infinite; its effect is
negligible."""


def temperature(
    calibration: Calibration, linearised: ErrorPropagation, stated: Stated
) -> tuple[list[Component], float]:
    """Effect on the parameters of thermal effects that the fit lacks, and the share
    of the excess variance that they do not explain, 0…1, to avoid counting it twice.

    A coefficient that did not show is not zero. With a ``stated`` sensitivity of such
    units, its posterior mean and spread follow by Bayes' rule. Otherwise prior
    probability and size of an effect are those of a diagnosis, updated by the data.
    The parameters of a fit without the effect are biased by it.
    """
    if calibration.prior_sd is not None:
        return _as_probable(calibration, linearised), 1.0
    missing = _thermal_but(linearised.effects)
    if TEMPERATURE not in linearised.problem.channel_reference or not missing:
        return [], 1.0
    # Coefficients in units of their prior widths, and their posterior.
    widths = [[_sensitivity(e, calibration.reference, stated)] * len(e.coefficients) for e in missing]
    lacking = _Lacking.of(linearised, missing, np.concatenate(widths))
    known = stated.thermal_sensitivity is not None
    found = lacking.of_sensitivity if known else lacking.averaged(missing, _levels(calibration))
    # Second moments about zero, mapped to the parameters.
    covariances = np.eye(len(found.mean)), lacking.of_sensitivity.within, _posterior(lacking.of_means), found.second
    of_parameters = [lacking.through @ c @ lacking.through.T for c in covariances]
    moved = float(np.ptp(linearised.problem.channels[TEMPERATURE]))
    names = tuple(e.name for e in missing)
    by = _halved_by(calibration, names, *map(linearised.magnitude, of_parameters))
    identifiable = not isinstance(by, PosesAtOtherTemperatures)
    basis = UnmodelledTemperature(names, moved, identifiable, stated=known)
    component = Component.of(linearised, "temperature", "B", np.inf, of_parameters[-1], basis, by)
    return [component], lacking.unexplained(found, linearised.weighted.shape[1])


def _levels(calibration: Calibration) -> NoiseLevels:
    return noise_levels([p.pose for p in calibration.poses if p.used])


@dataclass(frozen=True, eq=False)
class _Coefficients:
    """``mean`` (q,), the posterior covariance ``within`` (q,q), and the ``second``
    moments (q,q) about zero; ``taken`` is the effective number of coefficients that
    the data determine."""

    mean: Floats
    within: Floats
    second: Floats
    taken: float


@dataclass(frozen=True, eq=False)
class _Lacking:
    """Effects that the model lacks, with coefficients (q,) in units of their prior
    widths. ``misses`` (N,) are the residuals of the fit in standard errors of their
    noise, ``columns`` (N,q) their derivatives, ``rest`` the part that the fitted
    parameters do not absorb; ``through`` (p,q) is the change of the ``fitted``
    parameters by a unit of each coefficient. The first ``n`` rows are means."""

    misses: Floats
    columns: Floats
    rest: Floats
    through: Floats
    n: int
    fitted: int

    @classmethod
    def of(cls, linearised: ErrorPropagation, effects: Sequence[Effect], widths: Floats) -> _Lacking:
        r, J, _ = linearise_all(linearised.problem, linearised.state.extended(effects))
        # Standard errors without the excess variance, which these effects may cause.
        s, p = linearised.noise, len(linearised.state.theta)
        columns = J[:, p:] * widths / s[:, None]
        # Change of the fitted parameters by a unit of each coefficient, and the
        # remainder.
        absorbed = linearised.gain @ (J[:, p:] * widths / linearised.error[:, None])
        rest = columns - linearised.weighted * (linearised.error / s)[:, None] @ absorbed
        return cls(r / s, columns, rest, linearised.G @ absorbed[:p], len(linearised.problem.u), p)

    @property
    def of_means(self) -> Floats:
        return self.columns[: self.n]

    @cached_property
    def of_sensitivity(self) -> _Coefficients:
        """Posterior under a normal prior of unit width. Means alone: slopes have no
        information on an effect whose coefficients, and with them its covariates'
        errors, are zero."""
        rest = self.rest[: self.n]
        # C = (1 + RᵀR)⁻¹ and mean = −C Rᵀ r.
        left = _posterior(rest)
        mean = -left @ rest.T @ self.misses[: self.n]
        # Fewer than coefficients where the data say little.
        taken = len(mean) - float(np.trace(left))
        return _Coefficients(mean, left, left + np.outer(mean, mean), taken)

    def averaged(self, effects: Sequence[Effect], levels: NoiseLevels) -> _Coefficients:
        """Posterior averaged over the hypotheses: which effects act, on which axes,
        how large; ``levels`` are those of the noise."""
        log_prior, widths = map(np.array, zip(*_hypotheses(effects, self.of_means), strict=True))
        rest, misses = self.rest[: self.n], self.misses[: self.n]
        # Eigenbasis of the information, in units of each hypothesis' widths.
        information, score = rest.T @ rest, -rest.T @ misses
        size, axes = np.linalg.eigh(widths[:, :, None] * information * widths[:, None])
        size = np.maximum(size, 0.0)
        axes = widths[:, :, None] * axes
        along = np.einsum("hqr,q->hr", axes, score) / (1 + size)
        # Chi-square at the posterior mean, evidence, and posterior probability.
        chi2 = float(misses @ misses) - np.sum(along**2 * (1 + size), axis=1)
        left = max(self.n - self.fitted, 1)
        log = log_prior + levels.log_likelihood(chi2, left) - 0.5 * np.log1p(size).sum(axis=1)
        share = softmax(log)
        # Law of total covariance over the hypotheses.
        mean = np.einsum("hqr,hr->hq", axes, along)
        within = np.einsum("h,hqr,hr,hpr->qp", share, axes, 1 / (1 + size), axes)
        second = within + np.einsum("h,hq,hp->qp", share, mean, mean)
        return _Coefficients(share @ mean, within, second, float(share @ np.sum(size / (1 + size), axis=1)))

    def unexplained(self, found: _Coefficients, fitted: int) -> float:
        """Share of the excess variance that these effects do not explain, 0…1;
        ``fitted`` parameters took their degrees of freedom."""
        before, after = (
            float(v @ v) / max(len(v) - fitted - dof, 1e-9)
            for v, dof in ((self.misses, 0.0), (self.misses + self.rest @ found.mean, found.taken))
        )
        return min(max(after - 1, 0.0) / (before - 1), 1.0) if before > 1 else 1.0


def _hypotheses(effects: Sequence[Effect], columns: Floats) -> Iterator[tuple[float, Floats]]:
    """Hypotheses: nothing, each effect on some axes with some size, and all effects
    on all axes. Each with its log prior and the widths (q,) of the coefficients in
    units of the typical sensitivity. ``columns`` (n,q) are their effects on the
    means, over the noise."""
    odds = EFFECT_ODDS / len(CATALOGUE)
    ends = np.cumsum([0, *(len(e.coefficients) for e in effects)])
    yield 0.0, np.zeros(ends[-1])
    whole: list[list[Floats]] = []
    for effect, first, last in zip(effects, ends, ends[1:], strict=False):
        shown = float(np.sqrt(np.mean(np.sum(columns[:, first:last] ** 2, axis=1))))
        sizes = np.geomspace(min(SMALLEST / max(shown, 1e-300), LARGEST), LARGEST, SIZES)
        whole.append([])
        for kept, share in on_axes([c.part for c in effect.coefficients]):
            for size in sizes:
                widths = np.zeros(ends[-1])
                widths[first + np.array(kept)] = size
                yield float(np.log(odds * share / SIZES)), widths
                if len(kept) == last - first:
                    whole[-1].append(widths)
    if len(effects) > 1:
        for each in itertools.product(*whole):
            yield len(effects) * float(np.log(odds / SIZES)), np.sum(each, axis=0)


def _as_probable(calibration: Calibration, linearised: ErrorPropagation) -> list[Component]:
    """The component from the posterior of a diagnosis: probabilities of the thermal
    effects and of their sizes."""
    if calibration.thermal is None or not calibration.thermal.any():
        return []
    present = {e.name for e in linearised.effects}
    names = tuple(e.name for e in CATALOGUE if TEMPERATURE in e.needs and e.name not in present)
    moved = float(np.ptp(linearised.problem.channels[TEMPERATURE]))
    basis, by = ProbableTemperature(names, moved), PosesAtOtherTemperatures(names)
    return [Component.of(linearised, "temperature", "B", np.inf, positive_semidefinite(calibration.thermal), basis, by)]


def _posterior(Z: Floats) -> Floats:
    """Posterior covariance (1 + ZᵀZ)⁻¹ of coefficients of unit prior width, for ``Z``
    (n,q) in standard errors of the residuals; by SVD, so that it is accurate for any
    ZᵀZ."""
    _, size, axes = np.linalg.svd(Z)
    left = np.ones(Z.shape[1])
    left[: len(size)] = (1 / np.hypot(1.0, size)) ** 2  # s² itself might overflow
    return np.asarray(axes.T * left @ axes)


def _halved_by(
    calibration: Calibration, names: tuple[str, ...], prior: float, left: float, apart: float, whole: float
) -> Remedy:
    """The remedy, from magnitudes: the ``prior`` one, the posterior one (``left``),
    the posterior one with known parameters (``apart``), and the ``whole`` component
    with the effects' means."""
    identifiable, p = 2 * left < prior, calibration.residual.lack_of_fit_p
    if identifiable and 2 * left < whole and p is not None and p < LACK_OF_FIT:
        return TemperatureModelled(names)
    if 2 * apart < left:
        return PosesAtOtherTemperatures(names)
    if identifiable:
        return half_the_noise([p.pose for p in calibration.poses if p.used])
    return SteadierTemperature(names)


def _thermal_but(effects: tuple[Effect, ...]) -> list[Effect]:
    present = {e.name for e in effects}
    return [e for e in CATALOGUE if e.name in SENSITIVITY_PER_K and e.name not in present]


def _sensitivity(effect: Effect, reference: float, stated: Stated) -> float:
    per_reference = reference if effect.coefficients[0].unit.startswith("g") else 1.0
    known = stated.thermal_sensitivity
    # A width of zero has no inverse; so little makes nothing.
    return (SENSITIVITY_PER_K[effect.name] if known is None else max(known, NO_SENSITIVITY)) * per_reference


def thermometer(calibration: Calibration, linearised: ErrorPropagation, stated: Stated) -> list[Component]:
    """With thermal effects in the model, its values hold at a temperature that has to
    be measured."""
    if not stated.thermometer_k or not needs_temperature(linearised.effects):
        return []
    shift = linearised.when_shifted(calibration, TEMPERATURE, stated.thermometer_k)
    basis, by = ThermometerAt(calibration.channel_reference[TEMPERATURE]), TemperatureKnown(stated.thermometer_k / 2)
    return [Component.of(linearised, "thermometer", "B", np.inf, np.outer(shift, shift), basis, by)]


def needs_temperature(effects: tuple[Effect, ...]) -> bool:
    return any(TEMPERATURE in e.needs for e in effects)
