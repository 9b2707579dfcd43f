"""From poses to a calibration: closed form, maximum likelihood, outliers,
cross-validation."""

from triaxcal.estimate.calibration import Calibration, Exclusion, PoseResult, Reduced, Residual, reduced
from triaxcal.estimate.creep import with_unexplained_creep
from triaxcal.estimate.device_correction import DeviceCorrection, device_correction, uncorrected
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
from triaxcal.model.correction import LinearCorrection

__all__ = [
    "Calibration",
    "DeviceCorrection",
    "Exclusion",
    "HoldOut",
    "LinearCorrection",
    "PoseResult",
    "Reduced",
    "Residual",
    "device_correction",
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
    "uncorrected",
    "with_unexplained_creep",
]
