"""Which sets of terms are likely: single ones all, larger ones grown from the
best (Occam's window)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.distributions import log_sum_exp, softmax
from triaxcal.evidence.marginal_likelihood import Evidence, SetEvidence

SINGLES, LARGER = 0.3, 0.8
"""Shares of the work, about, at which the sets of one term are reckoned, and
all roughly."""
Scores = dict[tuple[int, ...], float]
LEADERS = (12, 6)
"""Sets of one term that are grown, and of more: two by each choice of names,
then one."""
GROWN = 60
"""Terms that are put beside one leader, the best."""
MOST = 260
"""Sets that are reckoned in full. More than so many within the window share
what a few leave."""
ROUGH = 4.0
"""In the logarithm: by so much the score of a larger set may be off, as it is
reckoned at the sizes and the parts that its smaller one likes best."""
NO_PART = 1e-3
"""A part with a smaller share in every leading set is left out of the sums."""


def likely_sets(evidence: Evidence, told: Callable[[float], None] = lambda done: None) -> list[SetEvidence]:
    """Those within the window, the best first; the empty one is among them.
    ``told`` is called with about the share of the work that is done."""
    singles = []
    for part in range(len(evidence.parts)):
        singles.append(evidence.log_evidence_with_each(part))
        told(SINGLES * part / len(evidence.parts))
    of_each = log_sum_exp([of_terms for of_terms, _ in singles], axis=(0, 2)) + evidence.log_prior
    level: Scores = {(i,): float(score) for i, score in enumerate(of_each)}
    scores: Scores = {(): float(log_sum_exp([alone for _, alone in singles]))} | level
    for depth in range(1, evidence.odds.together):
        level = _grown(evidence, level, depth)
        scores |= level
        told(SINGLES + (LARGER - SINGLES) * depth / (evidence.odds.together - 1))
    window = max(scores.values()) - np.log(evidence.odds.window)
    ranked = sorted(scores, key=lambda members: -scores[members])
    kept = [m for m in ranked if scores[m] > window - (ROUGH if len(m) > 1 else 0.0)][:MOST]
    parts = _parts_that_matter(evidence, kept[: LEADERS[0]])
    exact = [evidence.of_set(m, parts) for m in dict.fromkeys([*kept, ()])]
    return sorted(exact, key=lambda found: -found.total)


def _grown(evidence: Evidence, level: Mapping[tuple[int, ...], float], depth: int) -> Scores:
    """Sets of one more term, each with its rough score."""
    out: Scores = {}
    for members in _leaders(evidence, level, depth):
        scores = _scores_with_each_term(evidence, members)
        for other in np.argsort(-scores)[:GROWN]:
            if _go_together(evidence, members, int(other)):
                grown = tuple(sorted((*members, int(other))))
                out[grown] = max(out.get(grown, -np.inf), float(scores[other]))
    return out


def _leaders(evidence: Evidence, level: Mapping[tuple[int, ...], float], depth: int) -> Iterator[tuple[int, ...]]:
    """The best of this size, within the window of the best of it."""
    best = max(level.values(), default=0.0) - np.log(evidence.odds.window)
    count_by_kinds: dict[tuple[str, ...], int] = {}
    most, alike = (LEADERS[0], 2) if depth == 1 else (LEADERS[1], 1)
    for members in sorted(level, key=lambda m: -level[m]):
        if level[members] < best - ROUGH or sum(count_by_kinds.values()) == most:
            return
        kinds = tuple(sorted(evidence.terms[i].kind for i in members))
        if count_by_kinds.get(kinds, 0) < alike:
            count_by_kinds[kinds] = count_by_kinds.get(kinds, 0) + 1
            yield members


def _scores_with_each_term(evidence: Evidence, members: tuple[int, ...]) -> Floats:
    """(T,) about the logarithm of the evidence of the members with each term,
    with all priors: at the sizes that are best for the members, without an
    unmodelled part and with the three that are likeliest beside the members."""
    alone = evidence.of_set(members, range(len(evidence.parts)))
    likely = np.argsort(-alone.by_part)[:3]
    rows = dict.fromkeys([0, *map(int, likely)])
    each = [log_sum_exp(evidence.with_each_further(alone, row), axis=1) for row in rows]
    return np.asarray(log_sum_exp(each, axis=0) + evidence.log_prior)


def _go_together(evidence: Evidence, members: tuple[int, ...], other: int) -> bool:
    kind = evidence.terms[other].kind
    return all(evidence.terms[i].kind != kind and not _nested(evidence.terms[i].kind, kind) for i in members)


def _nested(one: str, other: str) -> bool:
    """Whether one of the names has the columns of the other: temperature,
    linear and quadratic."""
    return {one, other} == {"temperature_bias", "temperature_bias_quadratic"}


def _parts_that_matter(evidence: Evidence, leaders: list[tuple[int, ...]]) -> list[int]:
    share = np.zeros(len(evidence.parts))
    for members in leaders:
        by_part = evidence.of_set(members, range(len(evidence.parts))).by_part
        share = np.maximum(share, softmax(by_part))
    return [part for part in range(len(share)) if part == 0 or share[part] > NO_PART]
