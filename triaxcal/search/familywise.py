"""How many independent tests the candidates amount to, on data with nothing inside.

Candidates are alike: axes of one effect, steps at neighbouring moments, time constants. The probability of the best of
them under noise alone is simulated (Westfall and Young 1993, Resampling-Based Multiple Testing).
"""

from __future__ import annotations

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.distributions import f_logsf
from triaxcal.search.gains import Gains

DRAWS = 2000
LEVEL = 0.02
"""Of the best of all candidates: low, so as to be like the level of the test, but to be known from the draws."""
GRID = np.r_[0.0, np.geomspace(1e-3, 1e9, 2000)]


def independent_tests(gains: Gains, pure_dof: float) -> float:
    """The number m of independent tests whose smallest p is as small as that of the candidates: the probability of a
    false finding is 1 − (1 − p)^m. ``pure_dof`` are the degrees of freedom behind the poses' noise.
    """
    if not len(gains.ranks):
        return 1.0
    rng = np.random.default_rng(0)
    noise = rng.standard_normal((len(gains.y), DRAWS))
    size = rng.chisquare(pure_dof, DRAWS) / pure_dof
    found = gains.of_noise(noise) / size
    log_p = np.zeros(DRAWS)
    for rank in np.unique(gains.ranks):
        best = found[gains.ranks == rank].max(axis=0)
        log_p = np.minimum(log_p, np.interp(best, GRID, _log_p(int(rank), pure_dof)))
    smallest = float(np.exp(np.quantile(log_p, LEVEL)))
    return max(float(np.log1p(-LEVEL) / np.log1p(-smallest)), 1.0)


def _log_p(rank: int, pure_dof: float) -> Floats:
    return np.asarray(f_logsf(GRID / rank, rank, pure_dof))


def familywise(p: float, tests: float) -> float:
    """Probability that the best of so many tests on noise alone has a p this small."""
    return float(-np.expm1(tests * np.log1p(-min(p, 1 - 1e-16))))
