"""From poses to a calibration: closed form, maximum likelihood, outliers,
cross-validation."""

from triaxcal.estimate.calibration import Calibration, Exclusion, PoseResult, Reduced, Residual, reduced
from triaxcal.estimate.creep import with_unexplained_creep
from triaxcal.estimate.hold_out import HoldOut, magnitude_errors
from triaxcal.estimate.pose_fit import fit, poses_of_means
from triaxcal.estimate.recordings import (
    gather,
    residuals_by_run,
    shape_by_poses,
    shape_in,
    shape_of,
    shape_without_effects,
)

__all__ = [
    "Calibration",
    "Exclusion",
    "HoldOut",
    "PoseResult",
    "Reduced",
    "Residual",
    "fit",
    "gather",
    "magnitude_errors",
    "poses_of_means",
    "reduced",
    "residuals_by_run",
    "shape_by_poses",
    "shape_in",
    "shape_of",
    "shape_without_effects",
    "with_unexplained_creep",
]
