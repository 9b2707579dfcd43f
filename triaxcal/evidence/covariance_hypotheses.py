"""What may be assumed of an unmodelled part, and the data as they weigh under
one such assumption."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from triaxcal.arrays import Floats, Ints
from triaxcal.evidence.linearised_data import LinearisedData
from triaxcal.evidence.prior import Odds
from triaxcal.evidence.row_covariance import LowRank, RowPrecision
from triaxcal.evidence.term_columns import TermColumns, WeightedColumns
from triaxcal.evidence.unmodelled_kernels import OWN, UnmodelledCovariance, kinds_of, local_kinds_of


@dataclass(frozen=True, eq=False)
class UnmodelledPart:
    """The assumption on what no term describes: nothing, or one ``kind`` of
    size ``tau`` standard errors."""

    kind: UnmodelledCovariance | None
    tau: float
    log_prior: float


def parts_of(rows: LinearisedData, odds: Odds, suspects: Sequence[int] | None = None) -> list[UnmodelledPart]:
    """The first is that there is none. What goes through all poses is no larger
    over the sphere than an effect may be: poses that show little of it, as half
    a sphere does, leave it open whether it is there. Parts that a few poses
    alone show are among them where some of these are ``suspects``: may be
    outliers."""
    kinds = kinds_of(rows)
    sizes = np.geomspace(odds.unmodelled_smallest, odds.unmodelled_largest, odds.unmodelled_sizes)
    share = float(np.log(odds.unmodelled_probability / len(kinds) / len(sizes)))
    none = UnmodelledPart(None, 0.0, float(np.log1p(-odds.unmodelled_probability)))
    largest = odds.largest_g * rows.problem.reference

    def sized(kinds: Sequence[UnmodelledCovariance], share: float) -> list[UnmodelledPart]:
        some = ((kind, tau) for kind in kinds for tau in sizes if kind.what in OWN or tau * kind.whole <= largest)
        return [UnmodelledPart(kind, float(tau), share) for kind, tau in some]

    parts = [none, *sized(kinds, share)]
    if suspects is None:
        return parts
    local = local_kinds_of(rows, suspects)
    return [*parts, *sized(local, float(np.log(odds.local_probability / max(len(local), 1) / len(sizes))))]


@dataclass(frozen=True, eq=False)
class WeightedData:
    """The data under one part, less what the nine parameters take: the
    ``precision`` of the rows beyond these, the terms' ``columns`` by the
    weights of that, and the products (D,k) of their base ``along`` its axes,
    the misfits ``left`` (N,)."""

    precision: RowPrecision
    weighted: WeightedColumns
    along: Floats
    left: Floats

    @property
    def columns(self) -> TermColumns:
        return self.weighted.columns

    @property
    def half_log_weight(self) -> float:
        """Half the logarithm of the determinant of the precision."""
        return self.precision.half_log_det

    @cached_property
    def _weighted_left(self) -> Floats:
        return self.precision @ self.left

    @cached_property
    def chi2(self) -> float:
        """The sum of squares with no term."""
        return float(self.left @ self._weighted_left)

    @cached_property
    def score(self) -> Floats:
        """Of every scaled coefficient (C,), with no term."""
        return np.asarray(self.columns.against(self._weighted_left)[self.columns.place] * self.columns.factor)

    @cached_property
    def _block_products(self) -> Floats:
        whole, precision = self.weighted.block_products, self.precision
        return np.asarray(whole - self.columns.block_products(self.along, precision.axes, precision.taken))

    def _along(self, places: Ints) -> Floats:
        """(q,k) of these scaled coefficients' columns, unscaled."""
        return self.columns.along_of(self.columns.place[places], self.along, self.precision.axes)

    def information(self, places: Ints) -> Floats:
        """(t,q,q) of terms with coefficients at ``places`` (t,q), one by one."""
        return self.columns.of_blocks(self._block_products, places)

    def normal_equations(self, places: Ints) -> tuple[Floats, Floats]:
        """Information (q,q) and score (q,) of these scaled coefficients."""
        along = self._along(places) * self.columns.factor[places][:, None]
        return self.weighted.among(places) - (along * self.precision.taken) @ along.T, self.score[places]

    def crossed(self, places: Ints) -> Floats:
        """(q,C) the information that these scaled coefficients have in common
        with all."""
        place, factor = self.columns.place, self.columns.factor
        taken = self._along(places) * self.precision.taken
        whole = self.weighted.with_all(place[places])
        whole = whole - np.concatenate([taken @ self.along.T, taken @ self.precision.axes.T], axis=1)
        return np.asarray(factor[places][:, None] * whole[:, place] * factor)

    def beside(self, places: Ints, scale: Floats) -> ConditionalData:
        """Given coefficients (q,) at these places, each normal with a standard
        deviation of its ``scale``. Combinations of them that the data show no
        better than rounding keep that."""
        scaled = scale[:, None] * self.crossed(places)
        information, axes = np.linalg.eigh(scaled[:, places] * scale)
        information = shown(information)
        shrunk = 1 / np.sqrt(1 + information)
        taken = shrunk[:, None] * (axes.T @ scaled)
        absorbed = shrunk * (axes.T @ (scale * self.score[places]))
        score = self.score - taken.T @ absorbed
        chi2 = max(self.chi2 - float(absorbed @ absorbed), 0.0)
        return ConditionalData(self, score, chi2, taken, 0.5 * float(np.log1p(information).sum()))


@dataclass(frozen=True, eq=False)
class ConditionalData:
    """What coefficients of given sizes leave: the ``score`` (C,) of all terms
    and the sum of squares, ``chi2``; ``taken`` (q,C), whose square is the
    information that they take; ``half_log_det``, half the logarithm of the
    determinant of their precision."""

    data: WeightedData
    score: Floats
    chi2: float
    taken: Floats
    half_log_det: float

    def normal_equations(self, own: Ints) -> tuple[Floats, Floats]:
        """Information (q,q) and score (q,) of further scaled coefficients."""
        return self.information(own[None])[0], self.score[own]

    def information(self, places: Ints) -> Floats:
        """(t,q,q) of further terms with coefficients at ``places`` (t,q)."""
        matrix = self.data.information(places)
        return matrix - _squared(self.taken[:, places]) if len(self.taken) else matrix

    def crossed(self, places: Ints) -> Floats:
        """(q,C) the information that further coefficients have in common with
        all."""
        return self.data.crossed(places) - self.taken[:, places].T @ self.taken

    def in_own_axes(self, places: Ints) -> tuple[Floats, Floats]:
        """Of further terms, with coefficients at ``places`` (t,q), one by one:
        eigenvalues (t,q) of the information, and the squared scores along its
        axes."""
        matrix = self.information(places)
        if places.shape[1] == 1:
            return np.maximum(matrix[:, 0], 0.0), self.score[places] ** 2
        information, axes = np.linalg.eigh(matrix)
        return np.maximum(information, 0.0), np.einsum("tqr,tq->tr", axes, self.score[places]) ** 2


def weighted(parts: Sequence[UnmodelledPart], columns: TermColumns, rows: LinearisedData) -> list[WeightedData]:
    """Under each part. Those of one kind may have axes in common, and those
    that leave all rows alike their weights."""
    beyond = columns.with_base(rows.beyond_linear(columns.base))
    unweighted = WeightedColumns(beyond, np.ones(len(rows.y)))
    taus: dict[UnmodelledCovariance | None, list[float]] = defaultdict(list)
    for part in parts:
        taus[part.kind].append(part.tau)
    out: list[WeightedData] = []
    for kind, of_kind in taus.items():
        of_rows = LowRank(np.empty((len(rows.y), 0))) if kind is None else kind.of_rows
        alike = isinstance(of_rows, LowRank)
        along: Floats | None = None
        for precision in of_rows.precisions_beyond(rows.basis, of_kind):
            along = along if along is not None and alike else beyond.base.T @ precision.axes
            of_part = unweighted if alike else WeightedColumns(beyond, precision.weight)
            out.append(WeightedData(precision, of_part, along, rows.left))
    return out


def shown(information: Floats) -> Floats:
    """Eigenvalues, ascending, of one matrix, with zero for those that are none
    but for rounding."""
    least = information.shape[-1] * np.finfo(float).eps * information[..., -1:]
    return np.where(information > least, information, 0.0)


def _squared(columns: Floats) -> Floats:
    """(t,q,q) of (m,t,q): the products of each term's columns."""
    return np.asarray(columns.transpose(1, 2, 0) @ columns.transpose(1, 0, 2))
