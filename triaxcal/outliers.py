"""Poses that something spoiled: a knock, a hand on the table, a unit that was not at rest.

A pose's own weight in the fit is high (9/14 on average for the paper's plan), so a spoiled one bends the fit towards
itself, and its plain residual shrinks to a third. What a set of poses S takes out of the sum of squares when it is left
out is, exactly for a linear problem, ``r_Sᵀ (1 − H)_SS⁻¹ r_S``; that is compared with the noise inside the poses, and
with what is left of the residuals where that is more than noise. Every pose and every pair is tried, because two
spoiled poses can hide each other. Where other sets explain it as well, none is named.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from triaxcal.arrays import Floats, Ints

ALARM = 0.005
"""Probability that a clean set loses a pose, or a pair."""
LEFT_LEAST = 3
"""So many degrees of freedom must be left, or there is nothing to judge a pose by."""
RIVAL = 4.6
"""Sums of squares that differ by less than this (a likelihood ratio of 10) do not tell one set from another."""
CARRIES = 1e-6
"""Poses whose share of (1 − H) is below this alone carry a parameter, and cannot be judged."""


@dataclass(frozen=True)
class Spoiled:
    """``rows`` were spoiled; none where ``rivals``, sets of rows that explain it as well, cannot be told apart."""

    rows: tuple[int, ...] = ()
    rivals: tuple[tuple[int, ...], ...] = ()


@dataclass(frozen=True)
class _Judge:
    """Residuals ``rest`` (n,) after the fit, ``free`` (n,n) = 1 − H, both in units of the poses' standard errors."""

    rest: Floats
    free: Floats
    left: int
    pure_dof: float

    @property
    def chi2(self) -> float:
        return float(self.rest @ self.rest)

    def singles(self) -> tuple[Ints, Floats]:
        """Rows (n,1), and what each takes out of the sum of squares."""
        share = np.diag(self.free)
        taken = np.where(share > CARRIES, self.rest**2 / np.maximum(share, CARRIES), 0.0)
        return np.arange(len(self.rest))[:, None], taken

    def pairs(self) -> tuple[Ints, Floats]:
        """Likewise for pairs of rows, (m,2)."""
        i, j = np.triu_indices(len(self.rest), 1)
        a, b, c = self.free[i, i], self.free[j, j], self.free[i, j]
        r, s = self.rest[i], self.rest[j]
        determinant = a * b - c**2
        sound = determinant > CARRIES * np.maximum(a, b)
        taken = (b * r**2 - 2 * c * r * s + a * s**2) / np.where(sound, determinant, 1.0)
        return np.stack([i, j], axis=1), np.where(sound, taken, 0.0)

    def p(self, taken: float, size: int, before: float, left: int) -> float:
        """Of ``size`` rows that take so much of ``before``: against the noise, or what is left where that is more."""
        p = float(stats.f.sf(taken / size, size, self.pure_dof))
        after, left_after = max(before - taken, 0.0), left - size
        if stats.f.sf(after / left_after, left_after, self.pure_dof) < 0.01:
            p = max(p, float(stats.f.sf(taken / size / (after / left_after), size, left_after)))
        return max(p, 1e-300) * (1 + 1e-9 * after)  # of two that are beyond doubt, the one that leaves less


def spoiled(r: Floats, J: Floats, pure_dof: float) -> Spoiled:
    """Rows that were spoiled, at most two; often none.

    ``r`` (n,) residuals and ``J`` (n,p) their derivatives, both in units of each pose's standard error; ``pure_dof``
    degrees of freedom behind these.
    """
    n, parameters = J.shape
    left = n - parameters
    q, _ = np.linalg.qr(J)
    free = np.eye(n) - q @ q.T
    judge = _Judge(free @ r, free, left, pure_dof)
    best, best_p = Spoiled(), ALARM
    for size, (rows, taken) in enumerate((judge.singles(), judge.pairs()), 1):
        if left - size < LEFT_LEAST:
            break
        most = int(np.argmax(taken))
        p = min(1.0, judge.p(float(taken[most]), size, judge.chi2, left) * len(rows))
        if p < best_p and (size == 1 or _each_stands_alone(judge, rows[most], float(taken[most]))):
            best, best_p = _unless_rivalled(rows, taken, most), p
    return best


def _unless_rivalled(rows: Ints, taken: Floats, most: int) -> Spoiled:
    near = rows[taken > taken[most] - RIVAL]
    sets = tuple(tuple(int(i) for i in row) for row in near)
    return Spoiled(sets[0]) if len(sets) == 1 else Spoiled((), sets)


def _each_stands_alone(judge: _Judge, pair: Ints, both: float) -> bool:
    """Whether either of a pair would be suspect if the other had never been there."""
    _, singles = judge.singles()
    for other in pair:
        alone = float(singles[other])
        if judge.p(both - alone, 1, judge.chi2 - alone, judge.left - 1) * len(singles) > ALARM:
            return False
    return True
