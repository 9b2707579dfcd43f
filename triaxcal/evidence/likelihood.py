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
from triaxcal.evidence.covariances import OWN, LowRank, RowPrecision, UnmodelledCovariance, kinds_of, local_kinds_of
from triaxcal.evidence.linearised_data import LinearisedData
from triaxcal.evidence.prior import Odds
from triaxcal.evidence.terms import Term, TermColumns, WeightedColumns

# The assumptions on the unmodelled part, and the data weighted under each.


@dataclass(frozen=True, eq=False)
class UnmodelledPart:
    """An assumption on what no term describes: nothing, or a random function of one
    ``kind`` with a size of ``tau`` standard errors."""

    kind: UnmodelledCovariance | None
    tau: float
    log_prior: float


def parts_of(rows: LinearisedData, odds: Odds, suspects: Sequence[int] | None = None) -> list[UnmodelledPart]:
    """The parts of the search; the first is "none".

    A part that acts in all poses is no larger over the sphere than an effect may be:
    poses that show little of it, as half a sphere does, do not determine whether it
    is there. Local parts, which only a few poses show, are included where some of
    these poses are ``suspects``, possible outliers.
    """
    # A log-uniform grid of sizes; the prior is shared equally between kinds and sizes.
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
    """The data under one part, after projection off the nine parameters:
    ``precision`` of the projected rows, the terms' columns ``weighted`` by its
    diagonal, the products (D,k) of their base ``along`` its axes, and the misfits
    ``left`` (N,)."""

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
        """Chi-square with no term: yᵀ P y."""
        return float(self.left @ self._weighted_left)

    @cached_property
    def score(self) -> Floats:
        """Score (C,) of every scaled coefficient at zero: Xᵀ P y."""
        return np.asarray(self.columns.against(self._weighted_left)[self.columns.place] * self.columns.factor)

    @cached_property
    def _block_products(self) -> Floats:
        whole, precision = self.weighted.block_products, self.precision
        return np.asarray(whole - self.columns.block_products(self.along, precision.axes, precision.taken))

    def _along(self, places: Ints) -> Floats:
        """(q,k) products of these coefficients' columns, unscaled, with the axes."""
        return self.columns.along_of(self.columns.place[places], self.along, self.precision.axes)

    def information(self, places: Ints) -> Floats:
        """(t,q,q) information matrices of single terms with coefficients at
        ``places`` (t,q)."""
        return self.columns.of_blocks(self._block_products, places)

    def normal_equations(self, places: Ints) -> tuple[Floats, Floats]:
        """Information (q,q) and score (q,) of these scaled coefficients."""
        # P = diag(w) − A t Aᵀ, so Xᵀ P X = Xᵀ diag(w) X − (Xᵀ A) t (Xᵀ A)ᵀ.
        along = self._along(places) * self.columns.factor[places][:, None]
        return self.weighted.among(places) - (along * self.precision.taken) @ along.T, self.score[places]

    def crossed(self, places: Ints) -> Floats:
        """(q,C) cross information of these scaled coefficients with all."""
        place, factor = self.columns.place, self.columns.factor
        taken = self._along(places) * self.precision.taken
        whole = self.weighted.with_all(place[places])
        whole = whole - np.concatenate([taken @ self.along.T, taken @ self.precision.axes.T], axis=1)
        return np.asarray(factor[places][:, None] * whole[:, place] * factor)

    def conditional_on(self, places: Ints, scale: Floats) -> ConditionalData:
        """The data conditional on coefficients at these places (q,), each with a
        normal prior of standard deviation ``scale``. Combinations that the data
        determine no better than rounding keep their prior."""
        # Information of the coefficients in units of their prior: S I S = U diag(λ) Uᵀ.
        scaled = scale[:, None] * self.crossed(places)
        information, axes = np.linalg.eigh(scaled[:, places] * scale)
        information = shown(information)
        # Marginalise: Σ = S U diag(1/(1 + λ)) Uᵀ S is removed from score and
        # chi-square.
        shrunk = 1 / np.sqrt(1 + information)
        taken = shrunk[:, None] * (axes.T @ scaled)
        absorbed = shrunk * (axes.T @ (scale * self.score[places]))
        score = self.score - taken.T @ absorbed
        chi2 = max(self.chi2 - float(absorbed @ absorbed), 0.0)
        return ConditionalData(self, score, chi2, taken, 0.5 * float(np.log1p(information).sum()))


@dataclass(frozen=True, eq=False)
class ConditionalData:
    """The data conditional on coefficients of given sizes: the ``score`` (C,) of all
    terms, and ``chi2``; ``taken`` (q,C) such that ``takenᵀ taken`` is the information
    removed; ``half_log_det`` is half the log determinant of the coefficients'
    precision."""

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
        """(q,C) cross information of further coefficients with all."""
        return self.data.crossed(places) - self.taken[:, places].T @ self.taken

    def in_own_axes(self, places: Ints) -> tuple[Floats, Floats]:
        """Eigenvalues (t,q) of the information of single further terms with
        coefficients at ``places`` (t,q), and their squared scores along the
        eigenvectors."""
        matrix = self.information(places)
        if places.shape[1] == 1:
            return np.maximum(matrix[:, 0], 0.0), self.score[places] ** 2
        information, axes = np.linalg.eigh(matrix)
        return np.maximum(information, 0.0), np.einsum("tqr,tq->tr", axes, self.score[places]) ** 2


def weighted(parts: Sequence[UnmodelledPart], columns: TermColumns, rows: LinearisedData) -> list[WeightedData]:
    """The data under each part. Parts of one kind may share axes, and kinds of low
    rank share the weights of the rows."""
    # Project the columns off the nine parameters, once for all parts.
    beyond = columns.with_base(rows.beyond_linear(columns.base))
    unweighted = WeightedColumns(beyond, np.ones(len(rows.y)))
    taus: dict[UnmodelledCovariance | None, list[float]] = defaultdict(list)
    for part in parts:
        taus[part.kind].append(part.tau)
    out: list[WeightedData] = []
    # Per kind: its covariance, and the precision for each size tau.
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
    """Eigenvalues of one matrix, ascending; those within rounding of zero become
    zero."""
    least = information.shape[-1] * np.finfo(float).eps * information[..., -1:]
    return np.where(information > least, information, 0.0)


def _squared(columns: Floats) -> Floats:
    """(t,q,q) of (m,t,q): the products of each term's columns."""
    return np.asarray(columns.transpose(1, 2, 0) @ columns.transpose(1, 0, 2))


# The log evidence of a set of terms with an unmodelled part.


@dataclass(frozen=True, eq=False)
class SetEvidence:
    """The evidence of one set, for ``parts`` (P,) and sizes (S,k) of its k terms:
    ``log`` (P,S) evidence times the priors of part, sizes and members, and ``mean``
    (P,q) posterior means of the scaled coefficients, averaged over the sizes."""

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
        """(P,) log evidence, summed over the sizes."""
        return np.asarray(log_sum_exp(self.log, axis=1))

    @cached_property
    def part_probabilities(self) -> Floats:
        """(P,) posterior of the parts, given this set."""
        return np.asarray(np.exp(self.by_part - self.total))

    @property
    def coefficients(self) -> Floats:
        """(q,) means of the scaled coefficients, over parts and sizes."""
        return np.asarray(self.part_probabilities @ self.mean)


class Evidence:
    """The evidence of sets of ``terms``: the ``rows``, the ``columns`` (N,C) of all
    terms, the ``parts`` (the first is none), and the grid of ``sizes`` (R,) of
    effects in g."""

    def __init__(
        self, rows: LinearisedData, terms: Sequence[Term], odds: Odds, suspects: Sequence[int] | None = None
    ) -> None:
        """The smallest size is a share (of the odds) of the noise of a pose;
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
        # Group terms of one rank, so that each group is one batched operation.
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
        """The same evidence with a grid of sizes from ``smallest_g``."""
        other = copy(self)
        other._begin_sizes(smallest_g)
        return other

    def precision(self, part: int) -> RowPrecision:
        """The inverse covariance of the rows over their errors: noise and unmodelled
        part."""
        assumed = self.parts[part]
        of_rows = LowRank(np.empty((len(self.rows.y), 0))) if assumed.kind is None else assumed.kind.of_rows
        return of_rows.precision(assumed.tau)

    def places(self, members: Sequence[int]) -> Ints:
        """Indices of the scaled coefficients of these terms among those of all."""
        ranges = [np.arange(self._ends[i], self._ends[i + 1]) for i in members]
        return np.concatenate([np.empty(0, dtype=int), *ranges])

    def log_evidence_with_each(
        self, part: int, members: Sequence[int] = (), sizes: Sequence[float] = ()
    ) -> tuple[Floats, float]:
        """Log evidence (T,R) of each term at each size together with ``members`` of
        given sizes, and that of the members alone; with the priors of the part and of
        the term's size, without those of names."""
        # Condition on the members, then add single terms in their eigenbasis.
        given = self._conditional_on(part, members, sizes)
        base = self.parts[part].log_prior + self._data[part].half_log_weight - given.half_log_det
        out = np.empty((len(self.terms), len(self.sizes)))
        for index, places in self._by_rank:
            information, along = given.in_own_axes(places)
            # A coefficient of prior ρ² and information λ lowers χ² by ρ² s² / (1 + ρ²
            # λ), and costs ½ ln(1 + ρ² λ).
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
        """(o,) reduction in chi-square by a term of this size, conditional on
        ``members`` of given sizes, without the rows of each of the ``outliers``."""
        # Schur complement: a free coefficient for the row of the outlier removes it.
        given = self._conditional_on(part, members, sizes)
        own, rows = self.places([term[0]]), np.array([self.places([i]) for i in outliers])
        crossed = given.crossed(own)[:, rows].transpose(1, 0, 2)
        rest = np.linalg.pinv(given.information(rows), hermitian=True)
        through = crossed @ rest
        information, score = given.normal_equations(own)
        information = information - through @ crossed.transpose(0, 2, 1)
        score = score - np.einsum("oqr,or->oq", through, given.score[rows])
        # Ridge estimate with the prior of the term: sᵀ (1/ρ² + I)⁻¹ s.
        shrunk = np.linalg.inv(np.eye(len(own)) / term[1] ** 2 + information)
        return np.asarray(np.einsum("oq,oqp,op->o", score, shrunk, score))

    def normal_equations(
        self, part: int, members: Sequence[int], sizes: Sequence[float], each: Sequence[int]
    ) -> tuple[dict[int, tuple[Floats, Floats]], float]:
        """Information (q,q) and score (q,) of the scaled coefficients of ``each``
        term, conditional on ``members`` of these sizes; and the chi-square of
        these."""
        given = self._conditional_on(part, members, sizes)
        return {i: given.normal_equations(self.places([i])) for i in each}, given.chi2

    def _conditional_on(self, part: int, members: Sequence[int], sizes: Sequence[float]) -> ConditionalData:
        """The data under a part, conditional on ``members`` of these sizes."""
        scale = np.repeat(np.asarray(sizes, dtype=float), [self.terms[i].rank for i in members])
        return self._data[part].conditional_on(self.places(members), scale)

    def with_each_further(self, found: SetEvidence, row: int) -> Floats:
        """Approximate log evidence (T,R) of a set with each further term at each
        size, under the part in this ``row``: the ratio at those sizes of the members
        that are best without the term."""
        best = found.sizes[int(np.argmax(found.log[row]))]
        with_each, without = self.log_evidence_with_each(found.parts[row], found.members, best)
        return np.asarray(found.by_part[row] + with_each - without)

    def of_set(self, members: tuple[int, ...], parts: Sequence[int]) -> SetEvidence:
        """The evidence of one set under some ``parts``. Sets of three or more terms
        use every second size of the grid."""
        first, step = (0, 1) if len(members) < 3 else (1, 2)
        # All combinations of one size for each member.
        grids = [self._sizes_of[i][first::step] for i in members]
        sizes = np.array(list(itertools.product(*grids)), dtype=float)
        index = self.places(members)
        prior = float(self.log_prior[list(members)].sum()) - sum(np.log(len(grid)) for grid in grids)
        # Information and score of the members under each part.
        information = np.empty((len(parts), len(index), len(index)))
        score = np.empty((len(parts), len(index)))
        chi2, base = np.empty((2, len(parts), 1))
        for row, part in enumerate(parts):
            data = self._data[part]
            information[row], score[row] = data.normal_equations(index)
            chi2[row] = data.chi2
            base[row] = self.parts[part].log_prior + data.half_log_weight + prior
        # Integrate the coefficients out, for all sizes; then the noise
        # (`log_likelihood`).
        gain, log_det, mean = _marginalised(information, score, [self.terms[i].rank for i in members], grids)
        log = self.rows.log_likelihood(chi2 - gain) - 0.5 * log_det + base
        return SetEvidence(members, tuple(parts), sizes, log, np.einsum("ps,psq->pq", softmax(log, axis=1), mean))


def _marginalised(
    information: Floats, score: Floats, ranks: Sequence[int], grids: Sequence[Floats]
) -> tuple[Floats, Floats, Floats]:
    """Gaussian integral over coefficients in blocks of these ``ranks``, with
    ``information`` (P,q,q) and ``score`` (P,q), for all S choices of one size per
    block from its grid: reduction in chi-square (P,S), log determinant of the
    precision over that of the prior (P,S), and posterior mean (P,S,q).

    The blocks are eliminated one by one. In the eigenbasis of a block's information
    each size is a division; the Schur complement is left for the other blocks.
    """
    if not ranks:
        nothing = np.zeros((len(score), 1))
        return nothing, nothing, np.zeros((len(score), 1, 0))
    # Eigenbasis of the first block: precision 1/ρ² + λ for every size ρ.
    r, squared = ranks[0], grids[0][:, None] ** 2
    value, axes = np.linalg.eigh(information[:, :r, :r])
    spread = 1 + squared * shown(value)[:, None]
    shrunk = squared / spread
    along = np.einsum("pqr,pq->pr", axes, score[:, :r])
    gain, log_det = np.sum(shrunk * along[:, None] ** 2, axis=2), np.log(spread).sum(axis=2)
    if len(ranks) == 1:
        return gain, log_det, (shrunk * along[:, None]) @ axes.transpose(0, 2, 1)
    # Schur complement of the first block, for every size.
    crossed = axes.transpose(0, 2, 1) @ information[:, :r, r:]
    taken = shrunk[..., None] * crossed[:, None]
    rest = information[:, None, r:, r:] - crossed.transpose(0, 2, 1)[:, None] @ taken
    left = score[:, None, r:] - np.einsum("psrq,pr->psq", taken, along)
    # The rest recursively, with (parts × sizes) as the new first dimension.
    P, R, q = left.shape
    more, more_det, others = _marginalised(rest.reshape(P * R, q, q), left.reshape(P * R, q), ranks[1:], grids[1:])
    others = others.reshape(P, R, -1, q)
    # Back substitution for the mean of the first block.
    own = shrunk[:, :, None] * (along[:, None, None] - np.einsum("prq,pstq->pstr", crossed, others))
    mean = np.concatenate([np.einsum("pqr,pstr->pstq", axes, own), others], axis=3)
    gain = gain[..., None] + more.reshape(P, R, -1)
    log_det = log_det[..., None] + more_det.reshape(P, R, -1)
    return gain.reshape(P, -1), log_det.reshape(P, -1), mean.reshape(P, -1, r + q)
