"""What no effect explains, described by a smooth term where that helps poses that it was not fitted to."""

from __future__ import annotations

from collections.abc import Sequence

from triaxcal.calibration import Calibration, Exclusion
from triaxcal.effects.empirical import Empirical
from triaxcal.errors import Refused
from triaxcal.figures import micro_g, probability
from triaxcal.pose_fit import fit
from triaxcal.unexplained import Unexplained

DESCRIBES = 1.4
"""A smooth term has to lower the cross-validated error by this factor: less is chance among so many coefficients."""


def described(after: Calibration, unexplained: Unexplained, signs: Sequence[float]) -> tuple[Calibration | None, str]:
    """The model with the smooth term that lowers the cross-validated error most; or None, and why there is none."""
    if unexplained.or_spoiled:
        return None, "not tried, as it is open whether poses were spoiled"
    if unexplained.or_named or unexplained.only_inside:
        return None, "not tried, as the means of the poses are explained"
    if not unexplained.significant:
        return None, f"not tried, as what is left is no more than noise explains (p {probability(unexplained.p_value)})"
    old = after.residual.cross_validated_rms_g
    best, new = _best(after, signs)
    if best is None or new is None or old is None:
        return None, "tried, but not in the model: the poses cannot carry a smooth term beside the rest"
    if new > old / DESCRIBES:
        return None, (
            "tried, but not in the model: with the best smooth term the cross-validated error goes from "
            f"{micro_g(old)} to {micro_g(new)}, and has to fall to {micro_g(old / DESCRIBES)} or less"
        )
    return best, ""


def _best(after: Calibration, signs: Sequence[float]) -> tuple[Calibration | None, float | None]:
    """The model with the best smooth term, and its cross-validated error."""
    poses = [p.pose for p in after.poses]
    aside = [i for i, p in enumerate(after.poses) if not p.used]
    effects = [e for e, _ in after.sensor.effects]
    trials = []
    for form in Empirical().forms:
        try:
            trial = fit(
                poses,
                signs=signs,
                reference=after.reference,
                effects=[*effects, form],
                aside=aside,
                why=Exclusion.OUTLIER,
            )
        except Refused:
            continue
        if (error := trial.residual.cross_validated_rms_g) is not None:
            trials.append((error, trial))
    error, best = min(trials, key=lambda t: t[0], default=(None, None))
    return best, error
