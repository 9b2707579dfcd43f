"""The uncertainty of a calibration by the GUM, term by term (JCGM 100:2008,
clauses 4, 5 and annex G).

Every source is an error of the poses' residuals, or of the parameters
themselves; the fit's own linearisation carries it to the parameters, and these
to the magnitude that a calibrated unit reports in any orientation at the
reference conditions. That last figure, its rms over the sphere, is what the
sources are weighed by.
"""

from triaxcal.uncertainty.combined import Budget, Combined, budget, next_recording
from triaxcal.uncertainty.components import SENSITIVITY_PER_K, Component
from triaxcal.uncertainty.statements import Stated

__all__ = [
    "SENSITIVITY_PER_K",
    "Budget",
    "Combined",
    "Component",
    "Stated",
    "budget",
    "next_recording",
]
