"""What is read off the posterior: names that are known, names that are likely,
outliers, and what has no name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from triaxcal.evidence.posterior import Posterior
from triaxcal.evidence.prior import Odds
from triaxcal.evidence.unmodelled_kernels import UnmodelledKind
from triaxcal.rounding import reaches


@dataclass(frozen=True)
class Named:
    """One of these effects acts for certain, each with its probability, the
    likeliest first; ``together`` is that of at least one. A name alone is
    known."""

    probabilities: Mapping[str, float]
    together: float

    @property
    def effect(self) -> str:
        return next(iter(self.probabilities))

    @property
    def unique(self) -> bool:
        return len(self.probabilities) == 1


@dataclass(frozen=True)
class Unexplained:
    """Something acts that no name describes: with which ``probability``, of
    which ``kind`` it is most likely, and how large it then is, as an rms of |a|
    over the poses, in the unit of the reference."""

    probability: float
    kind: UnmodelledKind | None
    rms_g: float
    significant: bool
    """Whether it is likelier than not."""


@dataclass(frozen=True)
class ChangePoint:
    """From this pose on there is another unit, or another mounting."""

    pose: int
    probability: float


@dataclass(frozen=True)
class Findings:
    """``candidates`` are likely names that are not certain, with their
    probability; ``nothing`` is the probability that no effect, no outlier and
    nothing unmodelled acts. ``outliers`` are poses, each with its probability,
    counted among all that were given."""

    named: tuple[Named, ...]
    candidates: Mapping[str, float]
    outliers: Mapping[int, float]
    unexplained: Unexplained
    change_point: ChangePoint | None
    nothing: float


def stated(found: Findings, probabilities: Mapping[str, float]) -> dict[str, float | None]:
    """Each of these ``probabilities`` of names, or None where it is not
    calibrated. The odds before the poses were seen have the truth in the
    catalogue; where it is in none, a name that is likely and not known is wrong
    (`benchmarks.components`)."""
    known = {named.effect for named in found.named if named.unique}
    least = Odds().reported
    return {name: p if name in known or not reaches(p, least) else None for name, p in probabilities.items()}


def findings(posterior: Posterior) -> Findings:
    odds = posterior.evidence.odds
    certain = {name for group in posterior.certain for name in group}
    places = posterior.evidence.rows.places
    outliers = {
        int(places[i]): float(p) for i, p in enumerate(posterior.outlier_probabilities) if reaches(p, odds.reported)
    }
    another = int(places[int(np.argmax(posterior.change_point_probabilities))])
    from_there_on = float(posterior.change_point_probabilities.sum())
    return Findings(
        named=tuple(
            Named({name: posterior.effect_probabilities[name] for name in group}, posterior.any_of(group))
            for group in posterior.certain
        ),
        candidates={
            n: p for n, p in posterior.effect_probabilities.items() if reaches(p, odds.reported) and n not in certain
        },
        outliers=dict(sorted(outliers.items(), key=lambda item: -item[1])),
        unexplained=_unexplained(posterior),
        change_point=ChangePoint(another, from_there_on) if reaches(from_there_on, odds.reported) else None,
        nothing=_nothing(posterior),
    )


def _unexplained(posterior: Posterior) -> Unexplained:
    rows, total = posterior.evidence.rows, posterior.unmodelled_probability
    variance = 0.0
    for p, part in zip(posterior.part_probabilities, posterior.evidence.parts, strict=True):
        if part.kind is not None and part.kind.what is not UnmodelledKind.WITHIN_POSE:
            squares = part.kind.of_rows.variances[: rows.n] * rows.error[: rows.n] ** 2
            variance += float(p) * part.tau**2 * float(np.mean(squares))
    likeliest = next(
        (what for what in posterior.unmodelled_kind_probabilities if what is not UnmodelledKind.WITHIN_POSE), None
    )
    rms = float(np.sqrt(variance / total)) if total > 0 else 0.0
    return Unexplained(total, likeliest, rms, reaches(total, posterior.evidence.odds.reported))


def _nothing(posterior: Posterior) -> float:
    """The empty set is always among the sets, and no unmodelled part always
    among its parts (`likely_sets`)."""
    weight, empty = next(
        pair for pair in zip(posterior.set_probabilities, posterior.sets, strict=True) if not pair[1].members
    )
    return float(weight * empty.part_probabilities[empty.parts.index(0)])
