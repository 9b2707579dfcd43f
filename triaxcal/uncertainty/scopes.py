"""Three uncertainties of |a|, each of other readings, under one name each
everywhere: this fit, this session's poses, another day."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from triaxcal.estimate.calibration import Calibration
from triaxcal.uncertainty.budget import Budget
from triaxcal.uncertainty.next_recording import NextRecording

NAMES = ("this fit", "this session's poses", "another day")


@dataclass(frozen=True)
class Scopes:
    """Expanded, of |a|, rms over the sphere, in the unit of the reference.

    ``this_fit``: of the calibration itself, by its budget. ``this_session``: of
    one more pose of the recording, with its noise and whatever the residuals
    show. ``another_day``: of the next recording, with how the unit starts.
    """

    this_fit: float
    this_session: float
    another_day: float

    @classmethod
    def of(cls, c: Calibration, budget: Budget, following: NextRecording) -> Scopes:
        """A pose that the fit has not seen is as far off as the cross-validated
        ones, and by no less than what the fit and its residuals make."""
        standard, k = float(budget.magnitude.standard), float(budget.magnitude.coverage)
        crossed = c.residual.cross_validated_rms_g
        pose = max(float(np.hypot(standard, c.residual.rms_g)), crossed or 0.0)
        return cls(float(budget.magnitude.expanded), k * pose, following.expanded_uncertainty)

    @property
    def named(self) -> dict[str, float]:
        return dict(zip(NAMES, (self.this_fit, self.this_session, self.another_day), strict=True))
