"""Findings from the posterior: certain names, likely names, outliers, and unmodelled
parts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import SCATTER, Effect, channel_of, is_derived, rate_of
from triaxcal.evidence.likelihood import Evidence
from triaxcal.evidence.posterior import Posterior
from triaxcal.evidence.prior import Odds
from triaxcal.evidence.unmodelled_kernels import UnmodelledKind, reading_geometry
from triaxcal.model.directions import spiral
from triaxcal.planning.design import VISIBLE
from triaxcal.poses.covariates import static_covariates
from triaxcal.rounding import reaches


@dataclass(frozen=True)
class Named:
    """One of these effects acts for certain; each with its probability, the likeliest
    first. ``together`` is the probability of at least one. A single name is
    certain."""

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
    """An unmodelled part: its ``probability``, its likeliest ``kind``, and its size
    in that case, as an rms of |a| over the poses, in the unit of the reference."""

    probability: float
    kind: UnmodelledKind | None
    rms_g: float
    significant: bool
    """Whether its probability exceeds one half."""


@dataclass(frozen=True)
class ChangePoint:
    """Another unit, or another mounting, from this pose on."""

    pose: int
    probability: float


@dataclass(frozen=True)
class Findings:
    """``candidates`` are likely names that are not certain, with their probabilities;
    ``nothing`` is the probability of no effect, no outlier and no unmodelled part.
    ``outliers`` are indices among all given poses, each with its probability."""

    named: tuple[Named, ...]
    candidates: Mapping[str, float]
    outliers: Mapping[int, float]
    unexplained: Unexplained
    change_point: ChangePoint | None
    nothing: float


def stated(found: Findings, probabilities: Mapping[str, float]) -> dict[str, float | None]:
    """Each of these ``probabilities`` of names, or None where it is not calibrated.
    The prior assumes that the truth is in the catalogue; where it is not, a likely
    name that is not certain is wrong (`benchmarks.components`)."""
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
    """Probability of the empty set without an unmodelled part; both are always
    included (`likely_sets`)."""
    weight, empty = next(
        pair for pair in zip(posterior.set_probabilities, posterior.sets, strict=True) if not pair[1].members
    )
    return float(weight * empty.part_probabilities[empty.parts.index(0)])


# Which effects poses cannot show in full, and why.

SAME = 0.1
"""Of the largest combination of coefficients all over the sphere: two that
differ in |a| by less do so by the misalignments of the axes, and look the same."""


class Why(StrEnum):
    NOT_LOGGED = "not_logged"
    SOMETIMES_LOGGED = "sometimes_logged"
    """The channel is missing in some poses."""
    RATE_UNKNOWN = "rate_unknown"
    NOT_KNOWN = "not_known"
    """A covariate that follows from the poses does not here."""
    STOOD_STILL = "stood_still"
    EVEN_RATE = "even_rate"
    """The channel changes no faster in one pose than in another."""
    EVEN_SCATTER = "even_scatter"
    MOVED_ALONG = "moved_along"
    """Too few poses, or what the effect goes with moved along with their
    directions."""
    FEW_DIRECTIONS = "few_directions"


@dataclass(frozen=True)
class NotIdentifiable:
    """``channel`` is empty where no channel is the reason."""

    why: Why
    channel: str = ""


def not_identifiable(evidence: Evidence, catalogue: Sequence[Effect]) -> Mapping[str, NotIdentifiable]:
    """Reasons by name, in the order of the ``catalogue``."""
    shown = {name for name in {term.name for term in evidence.terms} if name and _in_full(evidence, name)}
    return {effect.name: _why(evidence, effect) for effect in catalogue if effect.name not in shown}


def _in_full(evidence: Evidence, name: str) -> bool:
    """Whether, for some shape, no combination of all coefficients is equivalent to
    the nine parameters, except those that |a| never shows."""
    rows = evidence.rows
    for term in evidence.terms:
        if term.name == name and term.effect is not None and len(term.kept) == len(term.effect.coefficients):
            columns = np.asarray(term.columns) @ _shown_somewhere(evidence, term.effect)
            columns = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
            left = rows.beyond_linear(columns)
            if rows.residual_dof >= columns.shape[1] and np.linalg.svd(left, compute_uv=False)[-1] > VISIBLE:
                return True
    return False


def _shown_somewhere(evidence: Evidence, effect: Effect) -> Floats:
    """(p,r) combinations of the coefficients that |a| shows somewhere on the sphere.
    For an effect with a covariate these are all."""
    p = len(effect.coefficients)
    if effect.needs:
        return np.eye(p)
    rows = evidence.rows
    sensor = rows.state.sensor(rows.problem)
    geometry = reading_geometry(rows, sensor.output(spiral(4 * p) * rows.problem.reference, {}))
    shown = np.einsum("ni,nip->np", geometry.by_bias, effect.basis(geometry.along, {}))
    size, combinations = np.linalg.svd(shown, full_matrices=False)[1:]
    return np.asarray(combinations[size > SAME * size[0]].T)


def _why(evidence: Evidence, effect: Effect) -> NotIdentifiable:
    rows = evidence.rows
    known, still = rows.problem.channel_reference, static_covariates(rows.poses)
    for name in effect.needs:
        rate, channel = name.endswith(rate_of("")), channel_of(name.removesuffix(rate_of("")))
        logged = any(channel in p.channels for p in rows.poses)
        if name not in known and (rate or not is_derived(name)) and not (rate and logged):
            return NotIdentifiable(Why.SOMETIMES_LOGGED if logged else Why.NOT_LOGGED, channel)
        if name not in known:
            return NotIdentifiable(Why.RATE_UNKNOWN, channel) if rate else NotIdentifiable(Why.NOT_KNOWN, name)
        if name in still:
            if name in SCATTER:
                return NotIdentifiable(Why.EVEN_SCATTER)
            return NotIdentifiable(Why.EVEN_RATE if rate else Why.STOOD_STILL, channel)
    return NotIdentifiable(Why.MOVED_ALONG if effect.needs else Why.FEW_DIRECTIONS)
