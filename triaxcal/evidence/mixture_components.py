"""The posterior of all parameters as a mixture of normal distributions: one for
each likely set, part of the evidence and choice of sizes."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats, Ints
from triaxcal.distributions import log_sum_exp
from triaxcal.evidence.marginal_likelihood import SetEvidence
from triaxcal.evidence.posterior import Posterior
from triaxcal.evidence.row_covariance import RowPrecision, inverse_of
from triaxcal.model.sensor import LINEAR

NEGLIGIBLE_PROBABILITY = 1e-6
"""The probability of a set that moves no average."""
CELLS = 400
"""Sets, with one part and one choice of sizes each, whose covariances are
mixed: the likeliest. The others are as these are."""


@dataclass(frozen=True, eq=False)
class Components:
    """A likely set, with one ``part`` of the evidence, under k choices of
    ``sizes`` (k,q) of its q scaled coefficients. ``share`` (k,) is the
    probability of each. Of the linear parameters and the coefficients, d = 9 +
    q, ``conditional_mean`` (k,d) are the means and ``conditional_covariance``
    (k,d,d) the covariances but for the ``noise`` (k,); ``residuals`` (k,N) the
    rows that are left, ``design`` (N,d) the derivatives of the rows and
    ``inverse`` (N,N) that of their covariance."""

    found: SetEvidence
    names: frozenset[str]
    places: Ints
    part: int
    share: Floats
    sizes: Floats
    conditional_mean: Floats
    conditional_covariance: Floats
    noise: Floats
    residuals: Floats
    design: Floats
    inverse: RowPrecision


def components(posterior: Posterior, share: float = 1.0) -> list[Components]:
    """Of the likeliest cells that hold this ``share`` of the probability, those
    of one set and part together."""
    evidence = posterior.evidence
    rows = evidence.rows
    together: dict[tuple[int, int], list[tuple[float, int]]] = defaultdict(list)
    sets: dict[int, SetEvidence] = {}
    for log_share, found, row, cell in _likely_cells(posterior, share):
        sets[id(found)] = found
        together[id(found), row].append((np.exp(log_share), cell))
    inverse: dict[int, RowPrecision] = {}
    out = []
    for (key, row), cells in together.items():
        found = sets[key]
        part, places = found.parts[row], evidence.places(found.members)
        if part not in inverse:
            inverse[part] = evidence.precision(part)
        design = np.concatenate([rows.linear, evidence.columns.at(places)], axis=1)
        weighted = design.T @ inverse[part]
        of, chosen = np.array([p for p, _ in cells]), [cell for _, cell in cells]
        sizes = np.repeat(found.sizes[chosen], [evidence.terms[i].rank for i in found.members], axis=1)
        precision = np.tile(weighted @ design, (len(cells), 1, 1))
        own = np.arange(LINEAR, design.shape[1])
        precision[:, own, own] += sizes**-2.0
        within = inverse_of(precision)
        here = within @ (weighted @ rows.y)
        left = rows.y - here @ design.T
        chi2 = np.maximum(left @ (inverse[part] @ rows.y), 0.0)
        noise = np.array([rows.noise_variance_given(float(of_cell)) for of_cell in chi2])
        names = posterior.names_of(found)
        out.append(Components(found, names, places, part, of, sizes, here, within, noise, left, design, inverse[part]))
    return out


def _likely_cells(posterior: Posterior, share: float) -> list[tuple[float, SetEvidence, int, int]]:
    """The logarithm of its probability, the set, and the places of part and
    sizes."""
    total = float(log_sum_exp([found.total for found in posterior.sets]))
    log, of_set, where = [], [], []
    for k, found in enumerate(posterior.sets):
        if found.total - total < np.log(NEGLIGIBLE_PROBABILITY):
            break
        flat = found.log.ravel()
        few = np.argpartition(-flat, CELLS // 4)[: CELLS // 4] if len(flat) > CELLS // 4 else np.arange(len(flat))
        log.append(flat[few] - total)
        of_set.append(np.full(len(few), k))
        where.append(few)
    every = np.concatenate(log)
    best = np.argsort(-every, kind="stable")[:CELLS]
    best = best[: int(np.searchsorted(np.cumsum(np.exp(every[best])), share)) + 1]
    chosen = zip(every[best], np.concatenate(of_set)[best], np.concatenate(where)[best], strict=True)
    return [(float(p), posterior.sets[k], *divmod(int(i), posterior.sets[k].log.shape[1])) for p, k, i in chosen]
