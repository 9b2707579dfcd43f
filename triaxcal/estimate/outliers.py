"""Outliers among the poses: a knock, a hand on the table, a unit that was not
at rest.

A pose's own weight in the fit is high (9/14 on average for the paper's plan),
so an outlier bends the fit towards itself, and its plain residual shrinks to a
third. What a set of poses S takes out of the sum of squares when it is left out
is, exactly for a linear problem, ``r_Sᵀ (1 − H)_SS⁻¹ r_S``; that is compared
with the noise inside the poses, and with what is left of the residuals where
that is more than noise. Every pose and every pair is tried, because two
outliers can hide each other. Where other sets explain it as well, none is
named.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats, Ints
from triaxcal.distributions import f_sf

ALARM = 0.005
"""Probability that a clean set loses a pose, or a pair."""
LEFT_LEAST = 3
"""So many degrees of freedom must be left, or there is nothing to judge a pose
by."""
TIED = 2.2
"""Sums of squares that differ by less than this for each pose of a set (a
likelihood ratio of 3) do not tell one set from another."""
LEAST = 6.0
"""Poses that are off by less than so many standard errors stay: that may be a
stand that does not come back."""
EXCESS = 0.003
"""Where what is left of the residuals has less than this probability, it is
more than noise."""
DOUBT = 0.01
"""Probability above which a pose does not stand out from the others' residuals."""
PAIRED_MOST = 300
"""So many poses are tried in pairs; where there are more, hardly any hides
another."""
FREE_LEAST = 1e-6
"""Poses whose share of (1 − H) is below this alone carry a parameter, and
cannot be judged."""


@dataclass(frozen=True)
class OutlierSet:
    """``rows`` are outliers. Besides, one of ``tied`` is: sets of rows that
    explain it as well as each other.

    Where only the noise inside the poses says so, because the rows do not stand
    out from the other residuals, it is ``doubtful``: it may be that the poses
    come back less well than that.
    """

    rows: tuple[int, ...] = ()
    tied: tuple[tuple[int, ...], ...] = ()
    doubtful: bool = False


@dataclass(frozen=True)
class _DeletionDiagnostics:
    """Residuals ``residuals`` (n,) after the fit in units of the poses'
    standard errors, ``q`` (n,p) whose product with its transpose is the hat
    matrix H.

    ``dof`` (n,) behind each standard error, ``pure_dof`` behind them together;
    zero where the noise is not known.
    """

    residuals: Floats
    q: Floats
    residual_dof: int
    dof: Floats
    pure_dof: float

    @property
    def chi2(self) -> float:
        return float(self.residuals @ self.residuals)

    def singles(self) -> tuple[Ints, Floats]:
        """Rows (n,1), and what each takes out of the sum of squares."""
        share = 1 - (self.q**2).sum(axis=1)
        taken = np.where(share > FREE_LEAST, self.residuals**2 / np.maximum(share, FREE_LEAST), 0.0)
        return np.arange(len(self.residuals))[:, None], taken

    def pairs(self) -> tuple[Ints, Floats]:
        """Likewise for pairs of rows, (m,2), among those that take most alone."""
        rows = np.sort(np.argsort(-self.singles()[1], kind="stable")[:PAIRED_MOST])
        free = self.free(rows)
        first, second = np.triu_indices(len(rows), 1)
        a, b, c = free[first, first], free[second, second], free[first, second]
        i, j = rows[first], rows[second]
        r, s = self.residuals[i], self.residuals[j]
        determinant = a * b - c**2
        sound = determinant > FREE_LEAST * np.maximum(a, b)
        taken = (b * r**2 - 2 * c * r * s + a * s**2) / np.where(sound, determinant, 1.0)
        return np.stack([i, j], axis=1), np.where(sound, taken, 0.0)

    def deleted_residuals(self, rows: Ints) -> Floats:
        """By how much the poses in ``rows`` are off, from the fit to the
        others."""
        return np.linalg.solve(self.free(rows), self.residuals[rows])

    def free(self, rows: Ints) -> Floats:
        """(1 − H) among ``rows``."""
        return np.eye(len(rows)) - self.q[rows] @ self.q[rows].T

    def excess(self, after: float, left: int) -> float:
        """What is left, ``after`` in ``residual_dof`` degrees of freedom, over
        the noise; 1 where that explains it."""
        known = self.pure_dof >= 1
        return 1.0 if known and f_sf(after / left, left, self.pure_dof) >= EXCESS else after / left

    def by_rest(self, taken: float, size: int) -> float:
        """Probability that ``size`` rows take so much, against what is left
        without them alone."""
        after, left = max(self.chi2 - taken, 1e-300), self.residual_dof - size
        return float(f_sf(taken / size / (after / left), size, left))

    def p(self, taken: float, rows: Ints, before: float, left: int) -> float:
        """Of ``rows`` that take so much of ``before``: against the noise, or
        what is left where that is more."""
        size = len(rows)
        after, left_after = max(before - taken, 0.0), left - size
        excess = self.excess(after, left_after)
        dof = float(self.dof[rows].min())
        p = float(f_sf(taken / size, size, dof)) if dof >= 1 else 0.0
        if excess != 1.0:
            p = max(p, float(f_sf(taken / size / excess, size, left_after)))
        return max(p, 1e-300) * (1 + 1e-9 * after)  # of two that are beyond doubt, the one that leaves less


def outlier_set(r: Floats, J: Floats, dof: Floats, pure_dof: float) -> OutlierSet:
    """Rows that are outliers, at most two; often none.

    ``r`` (n,) residuals and ``J`` (n,p) their derivatives, both in units of
    each pose's standard error; ``dof`` (n,) degrees of freedom behind each of
    these, ``pure_dof`` behind them together.
    """
    n, parameters = J.shape
    left = n - parameters
    q, _ = np.linalg.qr(J)
    judge = _DeletionDiagnostics(r - q @ (q.T @ r), q, left, dof, pure_dof)
    best, best_p = OutlierSet(), ALARM
    for size, (rows, taken) in enumerate((judge.singles(), judge.pairs()), 1):
        if left - size < LEFT_LEAST:
            break
        most = int(np.argmax(taken))
        p = min(1.0, judge.p(float(taken[most]), rows[most], judge.chi2, left) * len(rows))
        if p < best_p and _each_stands_alone(judge, rows[most], float(taken[most])):
            best, best_p = _unless_tied(judge, rows, taken), p
    return best


def not_as_predicted(r: Floats, J: Floats, pure_dof: float, rows: Sequence[int]) -> tuple[int, ...]:
    """Those of a few ``rows`` of which something that they alone have is not
    known, and that show it: each takes more out of the sum of squares than a
    coefficient of its own costs. Arguments are those of `outlier_set`."""
    n, parameters = J.shape
    q, _ = np.linalg.qr(J)
    judge = _DeletionDiagnostics(r - q @ (q.T @ r), q, n - parameters, np.zeros(n), pure_dof)
    _, taken = judge.singles()
    if judge.residual_dof < 2:
        return ()
    return tuple(i for i in rows if taken[i] > np.log(n) * judge.excess(judge.chi2 - taken[i], judge.residual_dof - 1))


def _unless_tied(judge: _DeletionDiagnostics, rows: Ints, taken: Floats) -> OutlierSet:
    size = rows.shape[1]
    most = float(taken.max())
    excess = judge.excess(max(judge.chi2 - most, 0.0), judge.residual_dof - size)
    near = rows[taken >= most - TIED * size * excess]
    sets = tuple(tuple(int(i) for i in row) for row in near)
    certain = tuple(sorted(set.intersection(*map(set, sets))))
    tied = tuple(tuple(i for i in each if i not in certain) for each in sets) if len(sets) > 1 else ()
    doubtful = judge.by_rest(most, size) * len(rows) > DOUBT
    return OutlierSet(certain, tied, bool(certain) and doubtful)


def _each_stands_alone(judge: _DeletionDiagnostics, rows: Ints, both: float) -> bool:
    """Whether each is off by enough, and either of a pair would be suspect if
    the other had never been there."""
    excess = judge.excess(max(judge.chi2 - both, 0.0), judge.residual_dof - len(rows))
    if np.min(np.abs(judge.deleted_residuals(rows))) < LEAST * np.sqrt(excess):
        return False
    if len(rows) == 1:
        return True
    _, singles = judge.singles()
    for one, other in (rows, rows[::-1]):
        alone = float(singles[other])
        if judge.p(both - alone, np.array([one]), judge.chi2 - alone, judge.residual_dof - 1) * len(singles) > ALARM:
            return False
    return True
