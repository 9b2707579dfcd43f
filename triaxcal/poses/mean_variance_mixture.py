"""How large the noise of a pose's mean may be: every model of its spectrum that
the poses leave possible.

Whether there is slow noise below what a pose can show is often open: most
likely there is none, perhaps there is much. An effective number of degrees of
freedom says how far intervals must reach for that. The likelihood of residuals
is averaged over the noise models: one number of degrees of freedom does not
suffice there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import special

from triaxcal.arrays import Floats
from triaxcal.distributions import DOF_MOST, t_isf

DOF_LEVEL = 0.99
"""Coverage at which the reach of the mixture is taken: far enough out for
improbable levels to count, not so far that only they do."""
DOF_GRID = np.geomspace(1.0, 1e5, 200)
"""Degrees of freedom between which it is interpolated, 6 % apart; beyond the
last Student's t is the normal distribution."""
LEAST_WEIGHT = 1e-6
"""Models less probable than this are none."""
GRID = 4000
"""Places at which the likelihood is reckoned, between which it is interpolated:
it is smooth, and is asked for hundreds of thousands of sums of squares."""
CHI2_LEAST = 1e-3
"""Below it the likelihood does not change any more."""


@dataclass(frozen=True, eq=False)
class NoiseLevels:
    """A mixture of m: the probability ``share`` (m,) of each, the ``variance``
    (m,) that a mean then has over the one stated, which is their mean, and the
    degrees of freedom ``dof`` (m,) behind it."""

    share: Floats
    variance: Floats
    dof: Floats

    @classmethod
    def of(cls, share: Floats, variance: Floats, dof: Floats) -> NoiseLevels:
        """Of models (m,) with these weights and variances in any unit."""
        kept = (share > LEAST_WEIGHT) & (variance > 0)
        if not kept.any():
            return cls.known_by(1.0)
        share, variance = share[kept] / share[kept].sum(), variance[kept]
        return cls(share, variance / float(share @ variance), np.clip(dof[kept], 1.0, DOF_MOST))

    @classmethod
    def known_by(cls, dof: float) -> NoiseLevels:
        """One level, known by so many degrees of freedom."""
        return cls(np.ones(1), np.ones(1), np.array([dof]))

    def blurred(self, variance: float) -> NoiseLevels:
        """Each level known less well: by an independent relative error of
        variance 2 ``variance``."""
        return replace(self, dof=1 / (1 / self.dof + variance))

    @cached_property
    def students_dof(self) -> float:
        """Degrees of freedom of Student's t that reaches as far as the mixture
        of such, at `DOF_LEVEL`, when both are expressed in units of the
        mixture's own standard deviation.

        By moments a model of small share and large variance would count as much
        as if every interval had to allow for it.
        """
        low, high = 0.0, 100.0 * float(np.sqrt(self.variance.max()))
        for _ in range(40):
            middle = (low + high) / 2
            beyond = float(self.share @ (2 * special.stdtr(self.dof, -middle / np.sqrt(self.variance))))
            low, high = (middle, high) if beyond > 1 - DOF_LEVEL else (low, middle)
        reach = t_isf((1 - DOF_LEVEL) / 2, DOF_GRID)
        return float(np.interp(-low, -reach, DOF_GRID))

    @property
    def _known(self) -> Floats:
        """(m,) degrees of freedom, none below those of all together: an
        unlikely level that is hardly known would have the longest tail of all,
        and account for residuals of any size."""
        return np.maximum(self.dof, min(self.students_dof, float(self.dof.max())))

    def log_likelihood(self, chi2: Floats, left: int) -> Floats:
        """Of residuals in ``left`` degrees of freedom whose sum of squares, by
        the stated variance, is ``chi2`` (any shape), but for a constant:
        Student's distribution in so many dimensions for every level."""
        chi2 = np.log(np.maximum(chi2, CHI2_LEAST))
        # As a function of one number it is reckoned once, and looked up for the
        # hundred thousands, by even steps.
        grid, step = np.linspace(chi2.min(), chi2.max() + 1e-9, GRID, retstep=True)
        dof = self._known
        constant = special.gammaln((dof + left) / 2) - special.gammaln(dof / 2) - left / 2 * np.log(dof * self.variance)
        each = constant - (dof + left) / 2 * np.log1p(np.exp(grid)[:, None] / (dof * self.variance))
        known = special.logsumexp(each, axis=1, b=self.share)
        place = (chi2 - grid[0]) / step
        below = np.minimum(place.astype(np.int64), GRID - 2)
        return np.asarray(known[below] + (place - below) * np.diff(known)[below])
