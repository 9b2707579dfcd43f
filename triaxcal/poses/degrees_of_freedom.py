"""Degrees of freedom of the noise inside the poses and of the residuals, and the
choice between both.

The scatter inside a pose gives its standard error without a model of the sensor.
Residuals in excess of it come from differences between the poses: an effect that the
model lacks, a stand of poor repeatability, a drift.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.distributions import DOF_MOST, f_sf
from triaxcal.poses.noise_spectrum import NoiseLevels
from triaxcal.poses.pose import Pose

LACK_OF_FIT = 0.01
"""Residuals of smaller probability (`Residual.lack_of_fit_p`) contradict the
assumptions: a report states an unexplained error, `frame` states that units disagree
(exit code 1), and errors from noise alone are multiplied. One sound recording in a
hundred is affected."""
SIGNIFICANT = 0.05
"""Residuals of smaller probability are a reason for caution: a warning, an excess
variance, a factor on the errors. It is larger than `LACK_OF_FIT` because the mistakes
differ in cost: wider intervals in one recording of twenty cost little, intervals that
are too short go unnoticed."""
RESIDUALS_ONLY_P = 0.2
"""For residuals of smaller probability, the residuals alone determine the noise."""


def pose_dof(poses: Sequence[Pose]) -> Floats:
    """(n,) degrees of freedom of each pose's own noise; zero where unknown."""
    return np.array([min(p.dof, DOF_MOST) for p in poses])


def within_pose_dof(poses: Sequence[Pose], part: Floats | None = None) -> float:
    """Effective degrees of freedom of a variance to which pose i contributes ``part``
    (n,), equal parts where None.

    Welch–Satterthwaite formula (JCGM 100, G.4.1), with the part that all poses share
    fully correlated. Zero where a pose does not know its noise.
    """
    dof = pose_dof(poses)
    if not np.all(dof > 0):
        return 0.0
    w = np.full(len(poses), 1 / len(poses)) if part is None else part
    # 1/ν of each pose is the sum of a common and an independent part.
    common = np.array([1 / p.shared_dof for p in poses])
    own = np.maximum(1 / dof - common, 0.0)
    # 1/ν = Σ wᵢ² / νᵢ + (Σ wᵢ / √ν_common)².
    return min(float(1 / (np.sum(w**2 * own) + (w @ np.sqrt(common)) ** 2 + 1e-300)), DOF_MOST)


def combined_dof(share: Floats, left: int, dof: Floats | float) -> Floats:
    """Degrees of freedom of variances with the share ``share`` of excess variance,
    known by ``left`` degrees of freedom, the rest noise of ``dof`` degrees of
    freedom; zero where the latter is not known."""
    with np.errstate(divide="ignore"):
        return np.asarray(1 / ((1 - share) ** 2 / dof + share**2 / left))


def noise_levels(poses: Sequence[Pose]) -> NoiseLevels:
    """Levels of the noise of all poses together; for several recordings from the
    degrees of freedom alone."""
    first, dof = poses[0], max(within_pose_dof(poses), 1.0)
    common = first.noise_levels
    if common is None or any(p.noise_levels is not common for p in poses):
        return NoiseLevels.known_by(dof)
    return common.blurred(max(1 / dof - 1 / first.shared_dof, 0.0))


def lack_of_fit_p(chi2: float, left: float, pure_dof: float) -> float | None:
    """Probability of a chi-square at least this large in ``left`` degrees of freedom,
    from the poses' own noise (F test).

    None where no degree of freedom is left, or where the noise is not known.
    """
    return float(f_sf(chi2 / left, left, pure_dof)) if left > 0 and pure_dof >= 1 else None


def raised_dof(chi2: float, left: int, pure_dof: float) -> float:
    """Degrees of freedom of standard errors that residuals raise where they exceed
    the noise inside the poses.

    ``chi2`` has ``left`` degrees of freedom, ``pure_dof`` are those of the noise.
    Even a small excess raises the errors, and the degrees of freedom change gradually
    to those of the residuals: a test that decides between the two would make
    intervals too short for an excess below its limit.
    """
    if left <= 0:
        return max(pure_dof, 1.0)
    ratio = chi2 / left
    if pure_dof < 1:
        return float(left)
    if ratio <= 1:
        return pure_dof + left
    # Weight of the pooled value: 1 at ratio 1, 0 at RESIDUALS_ONLY_P.
    p, at_one = float(f_sf(ratio, left, pure_dof)), float(f_sf(1.0, left, pure_dof))
    doubt = max(0.0, (p - RESIDUALS_ONLY_P) / (at_one - RESIDUALS_ONLY_P))
    return float(1 / (doubt / (pure_dof + left) + (1 - doubt) / left))
