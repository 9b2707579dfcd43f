"""What the likely sets say of poses that nobody has taken: of each a normal
distribution, given all rows seen.

Universal kriging: the nine parameters are flat, what no term describes is
predicted through its covariance with the rows seen, and the coefficients of the
terms have the distribution that these leave them.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from triaxcal.arrays import Floats, Ints
from triaxcal.effects.plugins import EffectFault
from triaxcal.evidence.linearised_data import LinearisedData
from triaxcal.evidence.marginal_likelihood import Evidence, SetEvidence
from triaxcal.evidence.mixture_components import Components, components
from triaxcal.evidence.posterior import Posterior
from triaxcal.evidence.row_covariance import RowPrecision
from triaxcal.evidence.terms import Term
from triaxcal.evidence.unmodelled_kernels import PoseInputs, UnmodelledCovariance, UnmodelledKind


@dataclass(frozen=True)
class Hypothesis:
    """What a reader wants to know: which effects act, which poses are outliers,
    from which pose on there is another unit (−1: from none), and with what
    something goes that no name describes (None: with nothing)."""

    names: frozenset[str]
    outliers: frozenset[int]
    change_point: int
    unmodelled: UnmodelledKind | None


@dataclass(frozen=True, eq=False)
class Predictive:
    """The likeliest sets, each with one part of the evidence and one choice of
    sizes: C of them, of H hypotheses. ``weight`` (C,) adds up to one and gives
    each hypothesis its share of the probability of all that have a cell here;
    ``of`` (C,) is the place of each cell's hypothesis among the
    ``hypotheses``."""

    posterior: Posterior
    mixture: Sequence[Components]
    weight: Floats
    hypotheses: Sequence[Hypothesis]
    of: Ints

    @classmethod
    def likeliest(cls, posterior: Posterior, share: float) -> Predictive:
        """Those that hold this share of the probability, or as many as there
        are."""
        mixture = components(posterior, share)
        each = [_hypothesis(posterior, cells.found, cells.part) for cells in mixture]
        hypotheses = list(dict.fromkeys(each))
        of = np.repeat([hypotheses.index(h) for h in each], [len(cells.share) for cells in mixture])
        weight = np.concatenate([cells.share for cells in mixture])
        whole = probabilities(posterior)
        wanted = np.array([whole[h] for h in hypotheses])
        weight = weight * (wanted / np.bincount(of, weight))[of]
        return cls(posterior, mixture, weight / weight.sum(), hypotheses, of)

    def with_name(self, name: str) -> Floats:
        """(C,) one where the effect acts, else zero."""
        return np.array([float(name in h.names) for h in self.hypotheses])[self.of]

    def predicted(self, rows: LinearisedData) -> tuple[Floats, Floats]:
        """Mean (C,M) and covariance (C,M,M) of M rows to come, over their
        errors."""
        evidence = self.posterior.evidence
        columns = _columns(evidence, sorted({i for cells in self.mixture for i in cells.found.members}), rows)
        here, there = PoseInputs.of(evidence.rows), PoseInputs.of(rows)
        of_parts: dict[int, tuple[Floats, Floats]] = {}
        mean, covariance = [], []
        for cells in self.mixture:
            kind, tau = evidence.parts[cells.part].kind, evidence.parts[cells.part].tau
            if cells.part not in of_parts:
                of_parts[cells.part] = _unmodelled(kind, tau, here, there, cells.inverse)
            to, error = of_parts[cells.part]
            design = np.concatenate([rows.linear, columns[:, cells.places]], axis=1) - to @ cells.design
            mean.append(to @ evidence.rows.y + cells.conditional_mean @ design.T)
            covariance.append(cells.noise[:, None, None] * (error + design @ cells.conditional_covariance @ design.T))
        return np.concatenate(mean), np.concatenate(covariance)


def _unmodelled(
    kind: UnmodelledCovariance | None, tau: float, here: PoseInputs, there: PoseInputs, inverse: RowPrecision
) -> tuple[Floats, Floats]:
    """Of the rows to come, noise and what no term describes: the best linear
    prediction (M,N) by the rows seen, of whose covariance this is the
    ``inverse``, and the covariance (M,M) of its error."""
    k, n = len(there.error), len(here.error)
    if kind is None:
        return np.zeros((k, n)), np.eye(k)
    crossed = tau**2 * kind.covariance_of(there, here)
    to = crossed @ inverse
    return to, np.eye(k) + tau**2 * kind.covariance_of(there, there) - to @ crossed.T


def probabilities(posterior: Posterior) -> Mapping[Hypothesis, float]:
    """Of every hypothesis."""
    out: dict[Hypothesis, float] = defaultdict(float)
    for weight, found in zip(posterior.set_probabilities, posterior.sets, strict=True):
        share = weight * found.part_probabilities
        by_what: dict[UnmodelledKind | None, float] = defaultdict(float)
        for part, p in zip(found.parts, share, strict=True):
            by_what[_what(posterior, part)] += float(p)
        any_of = _hypothesis(posterior, found, 0)
        for what, p in by_what.items():
            out[replace(any_of, unmodelled=what)] += p
    return out


def _hypothesis(posterior: Posterior, found: SetEvidence, part: int) -> Hypothesis:
    terms = (posterior.evidence.terms[i] for i in found.members)
    another = max((term.change_point for term in terms), default=-1)
    return Hypothesis(posterior.names_of(found), posterior.poses_of(found), another, _what(posterior, part))


def _what(posterior: Posterior, part: int) -> UnmodelledKind | None:
    kind = posterior.evidence.parts[part].kind
    return None if kind is None or kind.what is UnmodelledKind.WITHIN_POSE else kind.what


def _columns(evidence: Evidence, members: Sequence[int], rows: LinearisedData) -> Floats:
    """(M,C) of all terms in the rows to come; zero of those that are no
    ``members``, of outliers, and where an effect of another package does not
    say what it adds."""
    out = np.zeros((len(rows.y), evidence.columns.count))
    known: dict[int, Floats] = {}
    for i in members:
        term = evidence.terms[i]
        out[:, evidence.places([i])] = _of_term(term, rows, known)
    return out


def _of_term(term: Term, rows: LinearisedData, known: dict[int, Floats]) -> Floats:
    if term.change_point >= 0:
        return np.asarray(rows.linear * term.combination)
    if term.effect is None:
        return np.zeros((len(rows.y), term.rank))
    if id(term.effect) not in known:
        try:
            columns = rows.by_coefficients(term.effect)
        except EffectFault:
            columns = np.full((len(rows.y), len(term.effect.coefficients)), np.nan)
        known[id(term.effect)] = np.where(np.isfinite(columns), columns, 0.0)
    return np.asarray(known[id(term.effect)][:, list(term.kept)] * term.combination)
