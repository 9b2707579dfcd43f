"""Poses that something spoiled: a knock, a hand on the table, a unit that was not at rest.

A pose's own weight in the fit is high (9/14 on average for the paper's plan), so a spoiled one bends the fit towards
itself, and its plain residual shrinks to a third. What a set of poses S takes out of the sum of squares when it is left
out is, exactly for a linear problem, ``r_Sᵀ (1 − H)_SS⁻¹ r_S``; that is compared with the noise inside the poses, and
with what is left of the residuals where that is more than noise. One pose and all pairs are tried, because two spoiled
poses can hide each other.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from scipy import stats

from triaxcal.arrays import Floats

ALARM = 0.005
"""Probability that a clean set loses a pose, or a pair."""
POSES_MOST = 2
LEFT_LEAST = 3
"""So many degrees of freedom must be left, or there is nothing to judge a pose by."""


RIVAL = 4.6
"""Sums of squares that differ by less than this (a likelihood ratio of 10) do not tell one set from another."""


@dataclass(frozen=True)
class Spoiled:
    """``rows`` were spoiled; none where ``rivals``, sets of rows that explain it as well, cannot be told apart."""

    rows: tuple[int, ...] = ()
    rivals: tuple[tuple[int, ...], ...] = ()


@dataclass(frozen=True)
class _Suspect:
    rows: tuple[int, ...]
    p: float


def spoiled(r: Floats, J: Floats, pure_dof: float) -> Spoiled:
    """Rows that were spoiled, at most two; often none.

    ``r`` (n,) residuals and ``J`` (n,p) their derivatives, both in units of each pose's standard error; ``pure_dof``
    degrees of freedom behind these.
    """
    n, p = J.shape
    if n - p < LEFT_LEAST + 1:
        return Spoiled()
    q, _ = np.linalg.qr(J)
    free = np.eye(n) - q @ q.T
    rest = free @ r
    chi2 = float(rest @ rest)
    best = _Suspect((), ALARM)
    for size in range(1, POSES_MOST + 1):
        if n - p - size < LEFT_LEAST:
            break
        best = min(best, _most_suspect(rest, free, chi2, n - p, size, pure_dof), key=lambda s: s.p)
    if len(best.rows) == 2 and not _each_stands_alone(best.rows, rest, free, chi2, n - p, pure_dof):
        best = min(_Suspect((), ALARM), _most_suspect(rest, free, chi2, n - p, 1, pure_dof), key=lambda s: s.p)
    rivals = _rivals(best.rows, rest, free)
    return Spoiled((), (best.rows, *rivals)) if rivals else Spoiled(best.rows)


def _rivals(rows: tuple[int, ...], rest: Floats, free: Floats) -> tuple[tuple[int, ...], ...]:
    """Other sets of as many rows that take as much out of the sum of squares."""
    if not rows:
        return ()
    enough = _taken(rest, free, rows) - RIVAL
    groups = itertools.combinations(range(len(rest)), len(rows))
    return tuple(g for g in groups if g != rows and _taken(rest, free, g) > enough)


def _most_suspect(rest: Floats, free: Floats, chi2: float, left: int, size: int, pure_dof: float) -> _Suspect:
    groups = list(itertools.combinations(range(len(rest)), size))
    taken = [(_taken(rest, free, rows), rows) for rows in groups]
    most, rows = max(taken)
    return _Suspect(rows, min(1.0, _p(most, chi2, left, size, pure_dof) * len(groups)))


def _taken(rest: Floats, free: Floats, rows: tuple[int, ...]) -> float:
    """What leaving ``rows`` out takes from the sum of squares; nothing where they alone carry a parameter."""
    at = list(rows)
    block = free[np.ix_(at, at)]
    if np.linalg.eigvalsh(block)[0] < 1e-6:
        return 0.0
    return float(rest[at] @ np.linalg.solve(block, rest[at]))


def _p(taken: float, chi2: float, left: int, size: int, pure_dof: float) -> float:
    """Against the noise, and against what is left where that is more than noise makes."""
    p = float(stats.f.sf(taken / size, size, pure_dof))
    after, left_after = max(chi2 - taken, 0.0), left - size
    if stats.f.sf(after / left_after, left_after, pure_dof) < 0.01:
        p = max(p, float(stats.f.sf(taken / size / (after / left_after), size, left_after)))
    return max(p, 1e-300) * (1 + 1e-9 * after)  # of two that are beyond doubt, the one that leaves less


def _each_stands_alone(
    rows: tuple[int, ...], rest: Floats, free: Floats, chi2: float, left: int, pure_dof: float
) -> bool:
    """Whether either of a pair would be suspect if the other had never been there."""
    both = _taken(rest, free, rows)
    for other in rows:
        alone = _taken(rest, free, (other,))
        if _p(both - alone, chi2 - alone, left - 1, 1, pure_dof) * len(rest) > ALARM:
            return False
    return True
