"""The components of the budget, each from the linearised fit; those of temperature
are in `thermal`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.estimate.calibration import BiasUpdate, Calibration
from triaxcal.poses.degrees_of_freedom import within_pose_dof
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
    ReferenceKnown,
    RegisterSteps,
    Remedy,
    Stated,
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
