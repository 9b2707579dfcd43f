"""The evidence of coefficients that several units have in common, by Laplace's
method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.distributions import log_sum_exp
from triaxcal.evidence.base_models import BaseModel, log_ratio_without
from triaxcal.evidence.posterior import Posterior

STEPS = 6
"""Towards coefficients that units share: each weighs the units by the noise
that is left in them."""


@dataclass(frozen=True, eq=False)
class TermEquations:
    """Of each term of a name the information (q,q) and score (q,) of its scaled
    coefficients, in standard errors, beside one set with one part and one
    choice of sizes that leave ``chi2``. Its share of the unit by itself is
    ``log_share``; ``variance`` is that of the noise where one more term
    explains what it can."""

    of_terms: Mapping[int, tuple[Floats, Floats]]
    chi2: float
    variance: float
    log_share: float


def term_equations(unit: Posterior, bases: Sequence[BaseModel], name: str, none: bool) -> TermEquations:
    """Beside what explains most with one more term of this name; without an
    unmodelled part, where ``none``."""
    evidence = unit.evidence
    mine = [i for i, term in enumerate(evidence.terms) if term.name == name]
    others = [base for base in bases if name not in base.names]
    found = max(others, key=lambda base: base.with_each[mine].max()).found
    row = found.parts.index(0) if none and 0 in found.parts else int(np.argmax(found.by_part))
    cell = int(np.argmax(found.log[row]))
    without = float(log_sum_exp([base.found.total for base in others]))
    share = float(found.by_part[row]) - without + log_ratio_without(unit, bases, name)
    of_terms, chi2 = evidence.normal_equations(found.parts[row], found.members, found.sizes[cell], mine)
    explained = max(_explained(*equations) for equations in of_terms.values())
    return TermEquations(of_terms, chi2, evidence.rows.noise_variance_given(chi2 - explained), share)


def _explained(information: Floats, score: Floats) -> float:
    """By how much a term lowers the sum of squares, at most."""
    return float(score @ np.linalg.pinv(information) @ score)


def of_common_values(units: Sequence[Posterior], equations: Sequence[TermEquations], index: Sequence[int]) -> Floats:
    """(R,) log evidence with a term over that without, one for each size, where
    the coefficients are common to all units: by Laplace's method about the
    coefficients that explain most, as the noise of no unit is known beforehand.
    Two such points are looked for, since a unit may as well lack the effect and
    be noisy."""
    first = units[0].evidence.terms[index[0]]
    scaled = []
    for unit, of_unit, i in zip(units, equations, index, strict=True):
        scale = first.combination / unit.evidence.terms[i].combination
        information, score = of_unit.of_terms[i]
        scaled.append((scale[:, None] * information * scale, scale * score))
    shared = (
        np.array([of[0] for of in scaled]),
        np.array([of[1] for of in scaled]),
        np.array([of_unit.chi2 for of_unit in equations]),
    )
    explained = np.array([of_unit.variance for of_unit in equations])
    noisy = np.array([u.evidence.rows.noise_variance_given(e.chi2) for u, e in zip(units, equations, strict=True)])
    found = [_laplace_log_evidence(units, *shared, start) for start in (explained, noisy)]
    return np.asarray(np.max(found, axis=0) + sum(of_unit.log_share for of_unit in equations))


def _laplace_log_evidence(
    units: Sequence[Posterior], information: Floats, score: Floats, chi2: Floats, start: Floats
) -> Floats:
    """(R,) the logarithm of the evidence of coefficients that U units share
    over that of none, for each size. Of each unit ``information`` (U,q,q),
    ``score`` (U,q) and ``chi2`` (U,) without them; ``start`` (U,) are variances
    of the noise."""
    size = units[0].evidence.sizes
    prior = np.eye(score.shape[1]) / size[:, None, None] ** 2
    variance = np.broadcast_to(start, (len(size), len(units)))
    for _ in range(STEPS):
        precision = prior + np.einsum("ru,uqp->rqp", 1 / variance, information)
        values = np.linalg.solve(precision, ((1 / variance) @ score)[:, :, None])[:, :, 0]
        squares = np.einsum("rq,uqp,rp->ru", values, information, values)
        left = np.maximum(chi2 - 2 * values @ score.T + squares, 0.0)
        variance = np.array(
            [[u.evidence.rows.noise_variance_given(float(x)) for u, x in zip(units, row, strict=True)] for row in left]
        )
    gain = np.zeros(len(size))
    for k, unit in enumerate(units):
        rows = unit.evidence.rows
        gain += rows.log_likelihood(left[:, k]) - rows.log_likelihood(chi2[k])
    precision = prior + np.einsum("ru,uqp->rqp", 1 / variance, information)
    log_det = np.linalg.slogdet(precision * size[:, None, None] ** 2)[1]
    return np.asarray(gain - 0.5 * np.sum((values / size[:, None]) ** 2, axis=1) - 0.5 * log_det)
