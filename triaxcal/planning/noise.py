"""The noise that a recording predicts: what its poses leave beside the effects
that a plan is for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import Coefficient, Effect
from triaxcal.errors import Refused
from triaxcal.estimate.calibration import Calibration
from triaxcal.estimate.initial_estimate import started_problem
from triaxcal.estimate.likelihood import Problem, State, linearise, residual_chi2, solve
from triaxcal.estimate.pose_fit import fit
from triaxcal.model.sensor import LINEAR
from triaxcal.planning.clock import OnPlansClock
from triaxcal.planning.design import VISIBLE, combinations
from triaxcal.poses.degrees_of_freedom import SIGNIFICANT, within_pose_dof
from triaxcal.poses.pose import Pose


@dataclass(frozen=True, eq=False)
class Estimable(Effect):
    """Those combinations ``seen`` (p,q) of the coefficients of ``effects``, all
    together, that poses can show."""

    effects: tuple[Effect, ...]
    seen: Floats = field(repr=False)
    name: str = "estimable"
    remedy: str = ""

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return tuple(Coefficient(f"combination_{k + 1}", "g") for k in range(self.seen.shape[1]))

    @property
    def needs(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(n for e in self.effects for n in e.needs))

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return np.concatenate([e.basis(s, covariates) for e in self.effects], axis=-1) @ self.seen

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return np.concatenate([e.slope(s, covariates) for e in self.effects], axis=-1) @ self.seen


def fitted_beside(
    poses: Sequence[Pose], effects: Sequence[Effect], *, signs: Sequence[float], reference: float
) -> Calibration:
    """The fit of the linear model with what the poses can show of ``effects``
    beside it, so that this is no misfit.

    An effect of a plan's clock has the shape that the poses show best. Raises
    Refused as `fit` does; InvalidData where a channel that an effect needs is
    not there.
    """
    sound = [p for p in poses if not p.fault]
    linear = fit(sound, signs=signs, reference=reference)
    if not effects:
        return linear
    problem, begin = started_problem(sound, signs=signs, reference=reference, effects=effects)
    state = solve(problem, begin, ())
    chosen = tuple(_shaped(problem, state, e) for e in effects)
    _, J, s = linearise(problem, state.extended(chosen))
    weighted = J / s[:, None]
    seen, _ = combinations(weighted[:, :LINEAR], weighted[:, LINEAR:], VISIBLE)
    if not seen.shape[1]:
        return linear
    try:
        return fit(sound, signs=signs, reference=reference, effects=[Estimable(chosen, seen)])
    except Refused:  # too far from the linear fit to be reckoned
        return linear


def _shaped(problem: Problem, state: State, effect: Effect) -> Effect:
    if not isinstance(effect, OnPlansClock):
        return effect
    variants = effect.whole.variants(problem.covariates)
    return min(variants, key=lambda e: residual_chi2(linearise(problem, state.extended([e]))))


def noise_of(calibration: Calibration) -> Floats | None:
    """(n,) standard errors of the poses used, as poses to come will have them,
    in the unit of the reference; None where nothing tells them.

    The noise inside the poses with the excess variance, and with a Birge ratio
    only where residuals are significantly more than noise: to raise it for less
    would on average promise too much, as no factor ever lowers it.
    """
    used = [p for p in calibration.poses if p.used]
    error = np.array([p.error_g for p in used])
    within = within_pose_dof([p.pose for p in used]) >= 1
    if not within:
        return error if len(used) > len(calibration.parameters) else None
    p = calibration.residual.lack_of_fit_p
    return error if p is not None and p < SIGNIFICANT else error / calibration.birge_ratio
