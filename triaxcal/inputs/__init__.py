"""Other ways in: a turning unit, known attitudes, datasheet values."""

from triaxcal.inputs.attitude import AttitudeFit, fit_attitudes
from triaxcal.inputs.bias_update import Earlier, require_known, updated_biases
from triaxcal.inputs.datasheet import Datasheet, Refinement, refine
from triaxcal.inputs.moments import Moments
from triaxcal.inputs.rotation import RotationFit, fit_rotation

__all__ = [
    "AttitudeFit",
    "Datasheet",
    "Earlier",
    "Moments",
    "Refinement",
    "RotationFit",
    "fit_attitudes",
    "fit_rotation",
    "refine",
    "require_known",
    "updated_biases",
]
