"""How much of an effect still poses can show, and how often the test that was told the effect sees it.

The nine parameters are k, the angles and b of u = K (R a + b); a pose shows |a| and nothing else. Derivatives are
numerical, projections are by QR: nothing is shared with the package under test.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from tests.undeclared.scene import Triad

FALSE_ALARM = 0.01
SEEN = 1e-3
"""Share of a column that has to be left beside the nine parameters for it to count."""


def magnitude(u: np.ndarray, nine: np.ndarray) -> np.ndarray:
    """|a| (n,) of outputs u (n,3) under k, ax, ay, az, b (9,)."""
    ax, ay, az = nine[3:6]
    R = np.array([[1, az, ay], [0, 1, ax], [0, 0, 1]])
    return np.asarray(np.linalg.norm(np.linalg.solve(R, (u / nine[:3] - nine[6:]).T), axis=0))


def nine_of(triad: Triad) -> np.ndarray:
    return np.concatenate([triad.scale, triad.angles, triad.bias])


def _differences(f, at: np.ndarray, step: np.ndarray) -> np.ndarray:  # type: ignore[no-untyped-def]
    moved = np.eye(len(at)) * step
    return np.stack([(f(at + m) - f(at - m)) / (2 * s) for m, s in zip(moved, step, strict=True)], axis=-1)


def standard_errors(triad: Triad, u: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """(n,) of |a|, for variances (n,3) of the pose means, g² along the axes."""
    nine = nine_of(triad)
    slope = np.stack(
        [
            (magnitude(u + d * triad.scale, nine) - magnitude(u - d * triad.scale, nine)) / 2e-5
            for d in 1e-5 * np.eye(3)
        ],
        axis=1,
    )
    return np.asarray(np.sqrt(np.sum(slope**2 * variance, axis=1)))


@dataclass(frozen=True)
class Linear:
    """What nine parameters can absorb in n poses whose |a| has standard errors (n,): ``basis`` (n,9) orthonormal, of
    the ``jacobian`` (n,9) of |a| in units of the errors.
    """

    error: np.ndarray
    jacobian: np.ndarray
    basis: np.ndarray

    @classmethod
    def of(cls, triad: Triad, u: np.ndarray, error: np.ndarray) -> Linear:
        nine = nine_of(triad)
        step = 1e-6 * np.r_[np.abs(triad.scale), np.ones(6)]
        jacobian = _differences(lambda p: magnitude(u, p), nine, step) * np.r_[np.abs(triad.scale), np.ones(6)]
        return cls(error, jacobian, np.linalg.qr(jacobian / error[:, None])[0])

    def left(self, miss: np.ndarray) -> np.ndarray:
        """Of misses of |a| (n,…) in g: what the nine cannot absorb, in standard errors."""
        scaled = (miss.T / self.error).T
        return np.asarray(scaled - self.basis @ (self.basis.T @ scaled))

    def size(self, miss: np.ndarray) -> float:
        """s"""
        return float(np.linalg.norm(self.left(miss)))

    def rank(self, columns: np.ndarray) -> int:
        """Of columns (n,c) beside the nine."""
        columns = columns[:, np.linalg.norm(columns, axis=0) > 0]
        if not columns.shape[1]:
            return 0
        whole = np.linalg.norm(columns.T / self.error, axis=1)
        return int(np.sum(np.linalg.svd(self.left(columns) / whole, compute_uv=False) > SEEN))

    def beside(self, columns: np.ndarray) -> Linear:
        """With columns (n,c) of another effect among what can be absorbed."""
        left = self.left(columns)
        whole = np.linalg.norm((columns.T / self.error).T, axis=0)
        U, d, _ = np.linalg.svd(left / np.maximum(whole, 1e-300), full_matrices=False)
        return Linear(self.error, self.jacobian, np.concatenate([self.basis, U[:, d > SEEN]], axis=1))


def told_power(s: float, rank: int) -> float:
    """How often the χ² test on the effect's own columns, with the noise known, sees it at 1 % false alarms."""
    if rank == 0:
        return FALSE_ALARM
    return float(stats.ncx2.sf(stats.chi2.isf(FALSE_ALARM, rank), rank, s**2))
