"""By how much each candidate, and each pair of them, lowers chi-square, where the model is linear."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats, Ints
from triaxcal.search.candidates import Candidate
from triaxcal.visibility import VISIBLE


@dataclass(frozen=True)
class Gains:
    """``bases`` (c,n,q) of all candidates, filled up with zeros, and ``y`` (n,) the weighted residuals."""

    bases: Floats
    ranks: Ints
    y: Floats

    @classmethod
    def of(cls, candidates: Sequence[Candidate], y: Floats) -> Gains:
        ranks = np.array([c.rank for c in candidates], dtype=np.int64)
        bases = np.zeros((len(candidates), len(y), int(ranks.max(initial=1))))
        for row, c in zip(bases, candidates, strict=True):
            row[:, : c.rank] = c.basis
        return cls(bases, ranks, y)

    def single(self) -> Floats:
        """(c,)"""
        return self.of_noise(self.y[:, None])[:, 0]

    def of_noise(self, y: Floats) -> Floats:
        """(c,m) for m vectors (n,m) of residuals."""
        out = np.empty((len(self.ranks), y.shape[1]))
        for rank in np.unique(self.ranks):
            bases = self.bases[self.ranks == rank, :, :rank].transpose(0, 2, 1)
            parts = bases.reshape(-1, len(y)) @ y
            out[self.ranks == rank] = (parts.reshape(-1, rank, y.shape[1]) ** 2).sum(axis=1)
        return out

    def pairs(self, first: Ints) -> Floats:
        """(f,c) of the candidates ``first`` (f,) with every candidate together.

        What two have in common counts once: directions of the second less than `VISIBLE` beside the first do not.
        """
        c, n, q = self.bases.shape
        flat = self.bases.transpose(0, 2, 1).reshape(c * q, n)
        h = (flat @ self.y).reshape(c, q)
        out = np.empty((len(first), c))
        for row, i in enumerate(first):
            common = (flat @ self.bases[i]).reshape(c, q, q)
            rest = h - common @ h[i]
            own = np.eye(q) * (1 + VISIBLE**2) - common @ common.transpose(0, 2, 1)
            out[row] = h[i] @ h[i] + np.einsum("cq,cq->c", rest, np.linalg.solve(own, rest[..., None])[..., 0])
        return out
