"""What the likely sets say of poses that nobody has taken: of each a normal distribution, given all rows seen.

Universal kriging: the nine parameters are flat, what no term describes is predicted through its covariance with the
rows seen, and the coefficients of the terms have the distribution that these leave them.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats, Ints
from triaxcal.effects.plugins import EffectFault
from triaxcal.posterior.evidence import Evidence, SetEvidence
from triaxcal.posterior.posterior import Posterior
from triaxcal.posterior.rows import Rows
from triaxcal.posterior.solved import likely_cells
from triaxcal.posterior.terms import Term
from triaxcal.posterior.unmodelled import Held, What


@dataclass(frozen=True)
class Hypothesis:
    """What a reader wants to know: which effects act, which poses are outliers, from which pose on there is another
    unit (−1: from none), and with what something goes that no name describes (None: with nothing)."""

    names: frozenset[str]
    outliers: frozenset[int]
    another: int
    unmodelled: What | None


@dataclass(frozen=True, eq=False)
class Cells:
    """The likeliest sets, each with one part of the evidence and one choice of sizes: C of them, of H hypotheses.
    ``weight`` (C,) adds up to one and gives each hypothesis its share of the probability of all that have a cell here;
    ``of`` (C,) is the place of each cell's hypothesis among the ``hypotheses``."""

    seen: Posterior
    places: Sequence[tuple[SetEvidence, int, int]]
    weight: Floats
    hypotheses: Sequence[Hypothesis]
    of: Ints

    @classmethod
    def likeliest(cls, seen: Posterior, share: float) -> Cells:
        """Those that hold this share of the probability, or as many as there are."""
        cells = likely_cells(seen)
        weight = np.exp([log_share for log_share, *_ in cells])
        kept = int(np.searchsorted(np.cumsum(weight), share)) + 1
        cells, weight = cells[:kept], weight[:kept]
        each = [_hypothesis(seen, found, row) for _, found, row, _ in cells]
        hypotheses = list(dict.fromkeys(each))
        of = np.array([hypotheses.index(h) for h in each])
        whole = probabilities(seen)
        wanted = np.array([whole[h] for h in hypotheses])
        weight = weight * (wanted / np.bincount(of, weight))[of]
        return cls(seen, [(found, row, cell) for _, found, row, cell in cells], weight / weight.sum(), hypotheses, of)

    def with_name(self, name: str) -> Floats:
        """(C,) one where the effect acts, else zero."""
        return np.array([float(name in h.names) for h in self.hypotheses])[self.of]

    def predicted(self, rows: Rows) -> tuple[Floats, Floats]:
        """Mean (C,M) and covariance (C,M,M) of M rows to come, over their errors."""
        evidence = self.seen.evidence
        members = sorted({i for found, *_ in self.places for i in found.members})
        columns = _columns(evidence, members, rows)
        here, there = Held.of(evidence.rows), Held.of(rows)
        kriging: dict[int, _Kriging] = {}
        mean, covariance = [], []
        for found, row, cell in self.places:
            part = found.parts[row]
            if part not in kriging:
                kriging[part] = _Kriging.of(evidence, part, rows, here, there, columns)
            one, spread = kriging[part].given(evidence, found, row, cell)
            mean.append(one)
            covariance.append(spread)
        return np.array(mean), np.array(covariance)


def probabilities(seen: Posterior) -> Mapping[Hypothesis, float]:
    """Of every hypothesis."""
    out: dict[Hypothesis, float] = defaultdict(float)
    for weight, found in zip(seen.weight, seen.sets, strict=True):
        share = weight * np.exp(found.by_part - found.total)
        for row, p in enumerate(share):
            out[_hypothesis(seen, found, row)] += float(p)
    return out


def _hypothesis(seen: Posterior, found: SetEvidence, row: int) -> Hypothesis:
    terms = (seen.evidence.terms[i] for i in found.members)
    another = max((term.another for term in terms), default=-1)
    kind = seen.evidence.parts[found.parts[row]].kind
    what = None if kind is None or kind.what is What.INSIDE else kind.what
    return Hypothesis(seen.names_of(found), seen.poses_of(found), another, what)


def _columns(evidence: Evidence, members: Sequence[int], rows: Rows) -> Floats:
    """(M,C) of all terms in the rows to come; zero of those that are no ``members``, of outliers, and where an effect
    of another package does not say what it adds."""
    out = np.zeros((len(rows.y), evidence.columns.shape[1]))
    known: dict[int, Floats] = {}
    for i in members:
        term = evidence.terms[i]
        out[:, evidence.places([i])] = _of_term(term, rows, known)
    return out


def _of_term(term: Term, rows: Rows, known: dict[int, Floats]) -> Floats:
    if term.another >= 0:
        return np.asarray(rows.linear * term.mix)
    if term.effect is None:
        return np.zeros((len(rows.y), term.rank))
    if id(term.effect) not in known:
        try:
            columns = rows.by_coefficients(term.effect)
        except EffectFault:
            columns = np.full((len(rows.y), len(term.effect.coefficients)), np.nan)
        known[id(term.effect)] = np.where(np.isfinite(columns), columns, 0.0)
    return np.asarray(known[id(term.effect)][:, list(term.kept)] * term.mix)


@dataclass(frozen=True, eq=False)
class _Kriging:
    """Beside one part of the evidence: ``precision`` (N,N) of the rows seen beside the nine parameters, ``to`` (M,N)
    the best linear prediction by these, ``error`` (M,M) its covariance, and ``columns`` (M,C) of all terms in the rows
    to come, less what the prediction makes of theirs in the rows seen."""

    precision: Floats
    to: Floats
    error: Floats
    columns: Floats

    @classmethod
    def of(cls, evidence: Evidence, part: int, rows: Rows, here: Held, there: Held, columns: Floats) -> _Kriging:
        seen, assumed = evidence.rows, evidence.parts[part]
        inverse = np.linalg.inv(evidence.covariance(part))
        weighted = inverse @ seen.linear
        of_nine = np.linalg.inv(seen.linear.T @ weighted)
        error: Floats = np.eye(len(rows.y))
        crossed: Floats = np.zeros((len(rows.y), len(seen.y)))
        if assumed.kind is not None:
            error = error + assumed.tau**2 * assumed.kind.covariance_of(there, there)
            crossed = assumed.tau**2 * assumed.kind.covariance_of(there, here)
        left = rows.linear - crossed @ weighted
        to = crossed @ inverse + left @ of_nine @ weighted.T
        error = error - crossed @ inverse @ crossed.T + left @ of_nine @ left.T
        precision = inverse - weighted @ of_nine @ weighted.T
        return cls(precision, to, error, columns - to @ evidence.columns)

    def given(self, evidence: Evidence, found: SetEvidence, row: int, cell: int) -> tuple[Floats, Floats]:
        """Mean (M,) and covariance (M,M), for the noise that this cell leaves."""
        rows, places = evidence.rows, evidence.places(found.members)
        sizes = np.repeat(found.sizes[cell], [evidence.terms[i].rank for i in found.members])
        own, scaled = evidence.columns[:, places], found.mean[row, cell]
        weighted = self.precision @ own
        spread = np.linalg.inv(own.T @ weighted + np.diag(sizes**-2.0))
        chi2 = float(rows.y @ self.precision @ rows.y - (weighted.T @ rows.y) @ scaled)
        columns = self.columns[:, places]
        mean = self.to @ rows.y + columns @ scaled
        return mean, rows.noise_given(chi2) * (self.error + columns @ spread @ columns.T)
