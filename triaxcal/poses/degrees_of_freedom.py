"""What the noise inside the poses counts beside the residuals: degrees of
freedom, and which of the two to believe.

The scatter inside a pose gives its standard error without any model of the
sensor. Residuals beyond it come from what is not the same in every pose: an
effect the model lacks, a stand that does not come back, a drift.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.distributions import DOF_MOST, f_sf
from triaxcal.poses.noise_spectrum import NoiseLevels
from triaxcal.poses.pose import Pose

LACK_OF_FIT = 0.01
"""Residuals of less probability (`Residual.lack_of_fit_p`) contradict what was
assumed, and it is told: a report speaks of an unexplained error, `frame` of
units that disagree (exit code 1), and errors that were those of the noise alone
are multiplied. One sound recording in a hundred is blamed so."""
SIGNIFICANT = 0.05
"""Residuals of less probability are reason to be careful: a warning, a variance
of its own, a factor on the errors that is kept. It is larger than `LACK_OF_FIT`
since the mistakes cost otherwise: to widen the intervals of one recording in
twenty for nothing costs little, to leave them too short is not seen."""
RESIDUALS_ONLY_P = 0.2
"""Where residuals like these have less than this probability, the residuals
alone say how large the noise is."""


def pose_dof(poses: Sequence[Pose]) -> Floats:
    """(n,) degrees of freedom behind each pose's own noise; zero where it is
    not known."""
    return np.array([min(p.dof, DOF_MOST) for p in poses])


def within_pose_dof(poses: Sequence[Pose], part: Floats | None = None) -> float:
    """Effective degrees of freedom of a variance of which pose i makes up
    ``part`` (n,), equal parts where None.

    Welch and Satterthwaite's formula (JCGM 100, G.4.1), where what the
    estimates of all poses have in common does not average out. Zero where a
    pose does not know its noise.
    """
    dof = pose_dof(poses)
    if not np.all(dof > 0):
        return 0.0
    w = np.full(len(poses), 1 / len(poses)) if part is None else part
    common = np.array([1 / p.shared_dof for p in poses])
    own = np.maximum(1 / dof - common, 0.0)
    return min(float(1 / (np.sum(w**2 * own) + (w @ np.sqrt(common)) ** 2 + 1e-300)), DOF_MOST)


def combined_dof(share: Floats, left: int, dof: Floats | float) -> Floats:
    """Degrees of freedom of variances of which a ``share`` is what residuals
    show beyond noise, in ``left`` degrees of freedom, and the rest noise known
    by ``dof``, zero where it is not."""
    with np.errstate(divide="ignore"):
        return np.asarray(1 / ((1 - share) ** 2 / dof + share**2 / left))


def noise_levels(poses: Sequence[Pose]) -> NoiseLevels:
    """How large the noise of all poses together may be: by the degrees of
    freedom alone where they are of several recordings."""
    first, dof = poses[0], max(within_pose_dof(poses), 1.0)
    common = first.noise_levels
    if common is None or any(p.noise_levels is not common for p in poses):
        return NoiseLevels.known_by(dof)
    return common.blurred(max(1 / dof - 1 / first.shared_dof, 0.0))


def lack_of_fit_p(chi2: float, left: float, pure_dof: float) -> float | None:
    """Probability of a sum of squares at least this large in ``left`` degrees of
    freedom, from the poses' own noise.

    None where nothing is left, or where the noise is not known.
    """
    return float(f_sf(chi2 / left, left, pure_dof)) if left > 0 and pure_dof >= 1 else None


def raised_dof(chi2: float, left: int, pure_dof: float) -> float:
    """Degrees of freedom of standard errors that residuals raise wherever they
    exceed the noise inside the poses.

    ``chi2`` is the sum of squares in ``left`` degrees of freedom, ``pure_dof``
    those of the noise. However little the residuals exceed it they raise the
    errors, and step by step the degrees of freedom become those of the
    residuals: a test that decides between the two would leave intervals too
    short where the excess is too small for it.
    """
    if left <= 0:
        return max(pure_dof, 1.0)
    ratio = chi2 / left
    if pure_dof < 1:
        return float(left)
    if ratio <= 1:
        return pure_dof + left
    p, at_one = float(f_sf(ratio, left, pure_dof)), float(f_sf(1.0, left, pure_dof))
    doubt = max(0.0, (p - RESIDUALS_ONLY_P) / (at_one - RESIDUALS_ONLY_P))
    return float(1 / (doubt / (pure_dof + left) + (1 - doubt) / left))
