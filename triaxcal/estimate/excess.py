"""What residuals show beyond the noise inside the poses, and what it makes of
the errors.

Residuals that are more than noise come from an effect that the model lacks, a
stand that does not come back, a room that acts on the unit. None of these asks
how noisy a pose was, nor how much it crept. To multiply all errors by a factor
would keep the weights as they are: a pose that was quieter than others, or did
not creep because what moves the unit just turned back, would then carry a fit
that is off for another reason. So it is one standard deviation that all poses
have beside their noise. Where residuals exceed the noise by no more than chance
may bring about, it is a factor, and the noise keeps the weights.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy

from triaxcal.arrays import Floats
from triaxcal.errors import NotStill
from triaxcal.estimate.likelihood import Linearised, Problem, State, linearise, residual_chi2
from triaxcal.poses.degrees_of_freedom import lack_of_fit_p
from triaxcal.rounding import probability

NO_CHANCE = 1e-4
"""Lack-of-fit p below which an excess variance is added, which changes the
weights. Above it, a Birge ratio multiplies all errors. It is small because
other weights cost a hundredfold in variance where poses differ much in noise
and no excess was there."""
EXACT = 1e-10
"""To which share the excess is sought."""


@dataclass(frozen=True)
class Excess:
    """``birge_ratio`` is a factor on all errors, or ``excess_g`` a standard
    deviation of |a|, in units of the reference vector, that all poses have
    beside their noise."""

    birge_ratio: float = 1.0
    excess_g: float = 0.0

    @classmethod
    def estimated(cls, linearised: Linearised, n: int, residual_dof: int, pure_dof: float) -> Excess:
        """That with which the sum of squares that a fit leaves is its
        ``residual_dof``, in linear reckoning from residuals, derivatives and
        errors near its minimum, of which the first ``n`` are the means of the
        poses. ``pure_dof`` are the degrees of freedom of the noise inside the
        poses.

        The excess is that of Mandel and Paule (1970, Anal. Chem. 42:1194), here
        for a fit of several parameters; the factor that of Birge (1932, Phys.
        Rev. 40:207), at least 1 unless no pose knows its noise. Raises Refused
        where the fit ran away.
        """
        r, J, s = linearised

        def ratio(excess: float) -> float:
            error = s * np.tile(_widened(s[:n], excess), len(s) // n)
            return residual_chi2((r, J, error)) / residual_dof

        whole = ratio(0.0) if residual_dof > 0 else 1.0
        if not np.isfinite(whole):
            raise NotStill("the fit ran away")
        p = probability(lack_of_fit_p(whole * residual_dof, residual_dof, pure_dof))
        if p is None or p >= NO_CHANCE:
            return cls(float(np.sqrt(whole if pure_dof < 1 else max(whole, 1.0))))
        high = float(np.linalg.norm(r[:n])) / np.sqrt(residual_dof) + float(np.max(s[:n]))
        while ratio(high) > 1:
            high *= 2
        return cls(excess_g=float(scipy.optimize.brentq(lambda e: ratio(e) - 1, 0.0, high, xtol=EXACT * high)))

    def added_to(self, problem: Problem, state: State) -> Problem:
        """The problem with the excess; ``state`` is near its minimum. What else
        a pose tells is widened as its mean is: what acts between poses may act
        inside them as well."""
        if not self.excess_g:
            return problem
        slopes = problem.slopes and problem.slopes.widened(_widened(linearise(problem, state)[2], self.excess_g))
        return replace(problem, excess=self.excess_g, slopes=slopes)


def _widened(error: Floats, excess: float) -> Floats:
    """(n,) by what an excess widens errors (n,)."""
    return np.asarray(np.hypot(1.0, excess / error))
