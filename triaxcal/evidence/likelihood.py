"""The marginal likelihood of sets of effects, of outliers and of unmodelled parts."""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from triaxcal.arrays import Floats, Ints
from triaxcal.distributions import log_sum_exp, softmax
from triaxcal.evidence.linearised_data import LinearisedData
from triaxcal.evidence.prior import Odds
from triaxcal.evidence.row_covariance import LowRank, RowPrecision
from triaxcal.evidence.terms import Term, TermColumns, WeightedColumns
from triaxcal.evidence.unmodelled_kernels import OWN, UnmodelledCovariance, kinds_of, local_kinds_of

# What may be assumed of an unmodelled part, and the data as they weigh under one
# such assumption.


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


# How well a set of terms, beside an unmodelled part, accounts for the rows: the
# logarithm of its evidence.


@dataclass(frozen=True, eq=False)
class SetEvidence:
    """Of one set, by the ``parts`` (P,) reckoned and sizes (S,k) of its k
    terms: ``log`` (P,S) joint with the priors of part, sizes and members,
    ``mean`` (P,q) of the scaled coefficients of all members, over the sizes."""

    members: tuple[int, ...]
    parts: tuple[int, ...]
    sizes: Floats
    log: Floats
    mean: Floats

    @cached_property
    def total(self) -> float:
        return float(log_sum_exp(self.log))

    @cached_property
    def by_part(self) -> Floats:
        """(P,) logarithms."""
        return np.asarray(log_sum_exp(self.log, axis=1))

    @cached_property
    def part_probabilities(self) -> Floats:
        """(P,) of each part, if this set is the one."""
        return np.asarray(np.exp(self.by_part - self.total))

    @property
    def coefficients(self) -> Floats:
        """(q,) means of the scaled coefficients, over parts and sizes."""
        return np.asarray(self.part_probabilities @ self.mean)


class Evidence:
    """The rows, the ``terms`` a set may have with the ``columns`` (N,C) of them
    all, the ``parts`` (the first is none), and the grid of ``sizes`` (R,) of
    effects in g."""

    def __init__(
        self, rows: LinearisedData, terms: Sequence[Term], odds: Odds, suspects: Sequence[int] | None = None
    ) -> None:
        """Sizes begin at that share of the noise of a pose which the odds have;
        ``suspects`` as in `parts_of`."""
        self.rows, self.odds = rows, odds
        self.columns = TermColumns.of([term.columns for term in terms], len(rows.y))
        self.terms = [
            replace(term, columns=columns)
            for term, columns in zip(terms, self.columns.shared([term.columns for term in terms]), strict=True)
        ]
        self.parts = parts_of(rows, odds, suspects)
        self._begin_sizes(odds.smallest * rows.median_standard_error)
        self.log_prior = np.array([term.log_prior for term in terms])
        self._ends: Ints = np.cumsum([0, *(term.rank for term in terms)])
        self._data = weighted(self.parts, self.columns, rows)
        ranks = np.array([term.rank for term in terms], dtype=int)
        self._by_rank: list[tuple[Ints, Ints]] = []
        for rank in np.unique(ranks):
            index = np.flatnonzero(ranks == rank)
            self._by_rank.append((index, self._ends[index][:, None] + np.arange(rank)))

    def _begin_sizes(self, smallest_g: float) -> None:
        odds, reference = self.odds, self.rows.problem.reference
        self.sizes = np.geomspace(smallest_g, odds.largest_g * reference, odds.sizes)
        gross = np.geomspace(smallest_g, odds.largest_outlier * reference, odds.sizes)
        self._sizes_of = np.array([gross if term.effect is None else self.sizes for term in self.terms])

    def resized(self, smallest_g: float) -> Evidence:
        """The same, with sizes that begin elsewhere."""
        other = copy(self)
        other._begin_sizes(smallest_g)
        return other

    def precision(self, part: int) -> RowPrecision:
        """Of the rows over their errors: noise and unmodelled part."""
        assumed = self.parts[part]
        of_rows = LowRank(np.empty((len(self.rows.y), 0))) if assumed.kind is None else assumed.kind.of_rows
        return of_rows.precision(assumed.tau)

    def places(self, members: Sequence[int]) -> Ints:
        """Where the scaled coefficients of these terms stand among those of
        all, and their ``columns``."""
        ranges = [np.arange(self._ends[i], self._ends[i + 1]) for i in members]
        return np.concatenate([np.empty(0, dtype=int), *ranges])

    def log_evidence_with_each(
        self, part: int, members: Sequence[int] = (), sizes: Sequence[float] = ()
    ) -> tuple[Floats, float]:
        """Logarithms (T,R) of the evidence of each term at each size beside
        ``members`` of given sizes, and that of these alone; with the priors of
        the part and of the term's size, without those of names."""
        given = self._conditional_on(part, members, sizes)
        base = self.parts[part].log_prior + self._data[part].half_log_weight - given.half_log_det
        out = np.empty((len(self.terms), len(self.sizes)))
        for index, places in self._by_rank:
            information, along = given.in_own_axes(places)
            squared = self._sizes_of[index][:, :, None] ** 2
            spread = 1 + squared * information[:, None, :]
            gain = np.sum(squared / spread * along[:, None, :], axis=2)
            out[index] = self.rows.log_likelihood(given.chi2 - gain) - 0.5 * np.log(spread).sum(axis=2)
        alone = float(self.rows.log_likelihood(np.array(given.chi2))) + base
        return out + base - np.log(len(self.sizes)), alone

    def explained_without(
        self,
        part: int,
        members: Sequence[int],
        sizes: Sequence[float],
        term: tuple[int, float],
        outliers: Sequence[int],
    ) -> Floats:
        """(o,) by how much a term of this size lowers the sum of squares beside
        ``members`` of given sizes, without the rows of each of the
        ``outliers``."""
        given = self._conditional_on(part, members, sizes)
        own, rows = self.places([term[0]]), np.array([self.places([i]) for i in outliers])
        crossed = given.crossed(own)[:, rows].transpose(1, 0, 2)
        rest = np.linalg.pinv(given.information(rows), hermitian=True)
        through = crossed @ rest
        information, score = given.normal_equations(own)
        information = information - through @ crossed.transpose(0, 2, 1)
        score = score - np.einsum("oqr,or->oq", through, given.score[rows])
        shrunk = np.linalg.inv(np.eye(len(own)) / term[1] ** 2 + information)
        return np.asarray(np.einsum("oq,oqp,op->o", score, shrunk, score))

    def normal_equations(
        self, part: int, members: Sequence[int], sizes: Sequence[float], each: Sequence[int]
    ) -> tuple[dict[int, tuple[Floats, Floats]], float]:
        """Of ``each`` term the information (q,q) and score (q,) of its scaled
        coefficients beside ``members`` of these sizes, and the sum of squares
        that these leave."""
        given = self._conditional_on(part, members, sizes)
        return {i: given.normal_equations(self.places([i])) for i in each}, given.chi2

    def _conditional_on(self, part: int, members: Sequence[int], sizes: Sequence[float]) -> ConditionalData:
        """What ``members`` of these sizes leave under a part."""
        scale = np.repeat(np.asarray(sizes, dtype=float), [self.terms[i].rank for i in members])
        return self._data[part].beside(self.places(members), scale)

    def with_each_further(self, found: SetEvidence, row: int) -> Floats:
        """(T,R) about the logarithm of the evidence of a set with each further
        term at each size, under the part in this ``row`` of it: by the ratio at
        those sizes of the members that are best without the term."""
        best = found.sizes[int(np.argmax(found.log[row]))]
        with_each, without = self.log_evidence_with_each(found.parts[row], found.members, best)
        return np.asarray(found.by_part[row] + with_each - without)

    def of_set(self, members: tuple[int, ...], parts: Sequence[int]) -> SetEvidence:
        """Sizes of three and more terms go by every second step of the grid."""
        first, step = (0, 1) if len(members) < 3 else (1, 2)
        grids = [self._sizes_of[i][first::step] for i in members]
        sizes = np.array(list(itertools.product(*grids)), dtype=float)
        index = self.places(members)
        prior = float(self.log_prior[list(members)].sum()) - sum(np.log(len(grid)) for grid in grids)
        information = np.empty((len(parts), len(index), len(index)))
        score = np.empty((len(parts), len(index)))
        chi2, base = np.empty((2, len(parts), 1))
        for row, part in enumerate(parts):
            data = self._data[part]
            information[row], score[row] = data.normal_equations(index)
            chi2[row] = data.chi2
            base[row] = self.parts[part].log_prior + data.half_log_weight + prior
        gain, log_det, mean = _marginalised(information, score, [self.terms[i].rank for i in members], grids)
        log = self.rows.log_likelihood(chi2 - gain) - 0.5 * log_det + base
        return SetEvidence(members, tuple(parts), sizes, log, np.einsum("ps,psq->pq", softmax(log, axis=1), mean))


def _marginalised(
    information: Floats, score: Floats, ranks: Sequence[int], grids: Sequence[Floats]
) -> tuple[Floats, Floats, Floats]:
    """Of coefficients in blocks of these ``ranks``, with ``information``
    (P,q,q) and ``score`` (P,q), for every choice S of one size for each block
    from its grid: by how much they lower the sum of squares (P,S), the
    logarithm of the determinant of their precision over that of the prior
    (P,S), and their mean (P,S,q).

    Block by block: in the axes of its own information every size is a division,
    and the rest is what it leaves.
    """
    if not ranks:
        nothing = np.zeros((len(score), 1))
        return nothing, nothing, np.zeros((len(score), 1, 0))
    r, squared = ranks[0], grids[0][:, None] ** 2
    value, axes = np.linalg.eigh(information[:, :r, :r])
    spread = 1 + squared * shown(value)[:, None]
    shrunk = squared / spread
    along = np.einsum("pqr,pq->pr", axes, score[:, :r])
    gain, log_det = np.sum(shrunk * along[:, None] ** 2, axis=2), np.log(spread).sum(axis=2)
    if len(ranks) == 1:
        return gain, log_det, (shrunk * along[:, None]) @ axes.transpose(0, 2, 1)
    crossed = axes.transpose(0, 2, 1) @ information[:, :r, r:]
    taken = shrunk[..., None] * crossed[:, None]
    rest = information[:, None, r:, r:] - crossed.transpose(0, 2, 1)[:, None] @ taken
    left = score[:, None, r:] - np.einsum("psrq,pr->psq", taken, along)
    P, R, q = left.shape
    more, more_det, others = _marginalised(rest.reshape(P * R, q, q), left.reshape(P * R, q), ranks[1:], grids[1:])
    others = others.reshape(P, R, -1, q)
    own = shrunk[:, :, None] * (along[:, None, None] - np.einsum("prq,pstq->pstr", crossed, others))
    mean = np.concatenate([np.einsum("pqr,pstr->pstq", axes, own), others], axis=3)
    gain = gain[..., None] + more.reshape(P, R, -1)
    log_det = log_det[..., None] + more_det.reshape(P, R, -1)
    return gain.reshape(P, -1), log_det.reshape(P, -1), mean.reshape(P, -1, r + q)
