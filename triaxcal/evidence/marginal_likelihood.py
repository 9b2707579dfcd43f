"""How well a set of terms, beside an unmodelled part, accounts for the rows:
the logarithm of its evidence.

All is conjugate: coefficients are normal of a size ρ, sizes lie on a grid with
even shares, the nine parameters are flat and projected out, and the size of the
noise is integrated over what the poses tell of it. All evidences are of the
same rows, linearised at the same point, and so compare.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from triaxcal.arrays import Floats, Ints
from triaxcal.distributions import log_sum_exp, softmax
from triaxcal.evidence.covariance_hypotheses import ConditionalData, parts_of, shown, weighted
from triaxcal.evidence.linearised_data import LinearisedData
from triaxcal.evidence.prior import Odds
from triaxcal.evidence.row_covariance import LowRank, RowPrecision
from triaxcal.evidence.term_columns import TermColumns
from triaxcal.evidence.terms import Term


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
