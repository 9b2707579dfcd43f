"""A unit that turns and never rests: streaming moments, adjusted least squares,
the fit."""

from triaxcal.inputs.turning.moments import Moments
from triaxcal.inputs.turning.rotation import RotationFit, fit_rotation

__all__ = ["Moments", "RotationFit", "fit_rotation"]
