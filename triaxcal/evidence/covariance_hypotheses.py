"""What may be assumed of an unmodelled part, and the data in the axes in which
the covariance under one such assumption is diagonal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from triaxcal.arrays import Floats, Ints
from triaxcal.evidence.linearised_data import LinearisedData
from triaxcal.evidence.prior import Odds
from triaxcal.evidence.unmodelled_kernels import UnmodelledCovariance, kinds_of, local_kinds_of


@dataclass(frozen=True, eq=False)
class UnmodelledPart:
    """The assumption on what no term describes: nothing, or one ``kind`` of
    size ``tau`` standard errors."""

    kind: UnmodelledCovariance | None
    tau: float
    log_prior: float


def parts_of(rows: LinearisedData, odds: Odds, suspects: Sequence[int] | None = None) -> list[UnmodelledPart]:
    """The first is that there is none. Parts that a few poses alone show are
    among them where some of these are ``suspects``: may be outliers."""
    kinds = kinds_of(rows)
    sizes = np.geomspace(odds.unmodelled_smallest, odds.unmodelled_largest, odds.unmodelled_sizes)
    share = float(np.log(odds.unmodelled_probability / len(kinds) / len(sizes)))
    none = UnmodelledPart(None, 0.0, float(np.log1p(-odds.unmodelled_probability)))
    parts = [none, *(UnmodelledPart(kind, float(tau), share) for kind in kinds for tau in sizes)]
    if suspects is None:
        return parts
    local = local_kinds_of(rows, suspects)
    share = float(np.log(odds.local_probability / max(len(local), 1) / len(sizes)))
    return [*parts, *(UnmodelledPart(kind, float(tau), share) for kind in local for tau in sizes)]


@dataclass(frozen=True, eq=False)
class DiagonalisedData:
    """The data less what the nine parameters take, in axes in which they are
    independent: the ``weight`` (m,) of each, one over its variance, terms'
    ``columns`` (m,C), misfits ``z`` (m,)."""

    weight: Floats
    columns: Floats
    z: Floats

    @cached_property
    def half_log_weight(self) -> float:
        """Half the logarithm of the determinant of their precision."""
        return 0.5 * float(np.log(self.weight).sum())

    @cached_property
    def chi2(self) -> float:
        """The sum of squares with no term."""
        return float(self.z @ (self.weight * self.z))

    @cached_property
    def score(self) -> Floats:
        """Of every scaled coefficient (C,), with no term."""
        return np.asarray(self.columns.T @ (self.weight * self.z))

    @cached_property
    def _information(self) -> dict[bytes, Floats]:
        return {}

    def information(self, places: Ints) -> Floats:
        """Of terms with coefficients at ``places`` (t,q), one by one: (t,q,q),
        or (t,) where each has one coefficient. Every set of a diagnosis asks
        for the same terms, so each answer is kept."""
        key = places.tobytes() + bytes(places.shape[1:])
        if key not in self._information:
            columns = self.columns[:, places]
            self._information[key] = (
                self.weight @ columns[:, :, 0] ** 2
                if places.shape[1] == 1
                else _squared(np.sqrt(self.weight)[:, None, None] * columns)
            )
        return self._information[key]

    def normal_equations(self, places: Ints) -> tuple[Floats, Floats]:
        """Information (q,q) and score (q,) of these scaled coefficients."""
        own = self.columns[:, places]
        weighted = (self.weight[:, None] * own).T
        return weighted @ own, weighted @ self.z

    def beside(self, places: Ints, scale: Floats) -> ConditionalData:
        """Given coefficients (q,) at these places, each normal with a standard
        deviation of its ``scale``."""
        own = self.columns[:, places] * scale
        lower = np.linalg.cholesky(np.eye(len(places)) + own.T @ (self.weight[:, None] * own))
        taken = np.linalg.solve(lower, (own * self.weight[:, None]).T @ self.columns)
        absorbed = np.linalg.solve(lower, own.T @ (self.weight * self.z))
        score = self.score - taken.T @ absorbed
        chi2 = self.chi2 - float(absorbed @ absorbed)
        return ConditionalData(self, score, chi2, taken, float(np.log(np.diag(lower)).sum()))


@dataclass(frozen=True, eq=False)
class ConditionalData:
    """What coefficients of given sizes leave: the ``score`` (C,) of all terms
    and the sum of squares, ``chi2``; ``taken`` (q,C), whose square is the
    information that they take; ``half_log_det``, half the logarithm of the
    determinant of their precision."""

    data: DiagonalisedData
    score: Floats
    chi2: float
    taken: Floats
    half_log_det: float

    def normal_equations(self, own: slice) -> tuple[Floats, Floats]:
        """Information (q,q) and score (q,) of further scaled coefficients."""
        columns, taken = self.data.columns[:, own], self.taken[:, own]
        return columns.T @ (self.data.weight[:, None] * columns) - taken.T @ taken, self.score[own]

    def in_own_axes(self, places: Ints) -> tuple[Floats, Floats]:
        """Of further terms, with coefficients at ``places`` (t,q), one by one:
        eigenvalues (t,q) of the information, and the squared scores along its
        axes."""
        matrix = self.data.information(places)
        if places.shape[1] == 1:
            information = matrix - np.sum(self.taken[:, places[:, 0]] ** 2, axis=0)
            return np.maximum(information, 0.0)[:, None], self.score[places] ** 2
        if len(self.taken):
            matrix = matrix - _squared(self.taken[:, places])
        information, axes = np.linalg.eigh(matrix)
        return np.maximum(information, 0.0), np.einsum("tqr,tq->tr", axes, self.score[places]) ** 2


def diagonalised(parts: Sequence[UnmodelledPart], columns: Floats, z: Floats) -> list[DiagonalisedData]:
    """Under each part, of ``columns`` (m,C) and misfits ``z`` (m,) less what
    the nine parameters take. Parts of one kind have the axes in common."""
    turned: dict[UnmodelledCovariance | None, tuple[Floats, Floats, Floats]] = {None: (np.zeros(len(z)), columns, z)}
    out = []
    for part in parts:
        if part.kind is not None and part.kind not in turned:
            turned[part.kind] = part.kind.variance, part.kind.axes.T @ columns, part.kind.axes.T @ z
        variance, own, misfits = turned[part.kind]
        out.append(DiagonalisedData(1 / (1 + part.tau**2 * variance), own, misfits))
    return out


def _squared(columns: Floats) -> Floats:
    """(t,q,q) of (m,t,q): the products of each term's columns."""
    return np.asarray(columns.transpose(1, 2, 0) @ columns.transpose(1, 0, 2))
