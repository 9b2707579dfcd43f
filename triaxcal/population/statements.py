"""Effects that belong to a place or a time instead of a unit: a fixture, a slot, a
station, an operator, a batch, an hour of the day, everything since some day.

Runs differ as units do; a place adds a shift of some figures, a drift, more scatter, or
more units with some effect, always or for some time. All places, times and patterns
compete with each other and with nothing. Several act as a sum of single effects, each
with a posterior over all of them (Wang, Sarkar, Carbonetto and Stephens 2020, J. R.
Stat. Soc. B 82:1273): places that hold the same units share the probability, and are
reported together.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import TypeVar

from triaxcal.errors import InvalidData
from triaxcal.population.figures import LEAST_RUNS, FigureKind
from triaxcal.population.hypotheses import Family, Form, PlacePrior, SingleEffect
from triaxcal.population.runs import PlaceKind, UnitRun
from triaxcal.population.single_effects import Search


@dataclass(frozen=True)
class Place:
    """``name`` is the label; of hours a span, of everywhere empty."""

    kind: PlaceKind
    name: str


@dataclass(frozen=True)
class Pattern:
    """What a place changes.

    ``kind`` and ``group`` say of which figures; ``name`` is one of them, a common
    factor or shift, or "several". A pattern is what was seen, and no cause."""

    form: Form
    kind: FigureKind
    group: str
    name: str


class Verdict(StrEnum):
    NAMED = "named"
    """It acts for certain, at this place."""
    CONFOUNDED = "confounded"
    """It acts for certain, at one of these places, which the runs do not tell
    apart."""
    CANDIDATE = "candidate"
    """It acts more likely than not, and not for certain."""


@dataclass(frozen=True)
class Change:
    """By how much a figure changes, with its standard uncertainty, in ``unit``;
    ``in_spreads`` in standard deviations between units. Of more scatter it is the
    factor, of more units with an effect the share of units."""

    value: float
    uncertainty: float
    unit: str
    in_spreads: float


@dataclass(frozen=True)
class Statement:
    """``probability`` is that of any effect of a place. ``places`` and ``patterns``
    have theirs, the likeliest first; they are those of ``place`` and ``pattern`` if it
    acts. ``since_s`` and ``until_s`` bound the time in which it acts, None if that is
    not bounded by a change; ``since_interval_s`` holds the change with 95 %.
    ``sizes`` are the changes by figure; ``runs`` is the number of runs it acts in."""

    verdict: Verdict
    probability: float
    places: Mapping[Place, float]
    patterns: Mapping[Pattern, float]
    since_s: float | None
    since_interval_s: tuple[float, float] | None
    until_s: float | None
    sizes: Mapping[str, Change]
    runs: int

    @property
    def place(self) -> Place:
        return next(iter(self.places))

    @property
    def pattern(self) -> Pattern:
        return next(iter(self.patterns))


@dataclass(frozen=True)
class PlacedEffects:
    """``statements`` are certain, ``candidates`` are not, the likeliest first;
    ``nothing`` is the probability that no further one acts. ``runs`` are those used,
    ``omitted`` those of part numbers with too few."""

    statements: tuple[Statement, ...]
    candidates: tuple[Statement, ...]
    nothing: float
    runs: int
    omitted: int


def placed_effects(runs: Sequence[UnitRun], prior: PlacePrior | None = None) -> PlacedEffects:
    """Effects of places in these runs, in any order. Raises InvalidData for fewer than
    sixty runs of one part number."""
    prior = prior or PlacePrior()
    used = _enough(runs)
    if not used:
        raise InvalidData(f"{len(runs)} runs: effects of places need {LEAST_RUNS} of one part number")
    search = Search.of(used, prior)
    found = search.run()
    said = [_statement(search, effect) for effect in found]
    known = [s for s in said if s.verdict is not Verdict.CANDIDATE]
    rest = [s for s in said if s.verdict is Verdict.CANDIDATE]
    return PlacedEffects(
        tuple(sorted(known, key=lambda s: -s.probability)),
        tuple(sorted(rest, key=lambda s: -s.probability)),
        search.nothing,
        len(used),
        len(runs) - len(used),
    )


def _enough(runs: Sequence[UnitRun]) -> list[UnitRun]:
    """Runs of part numbers that have enough of them, by time."""
    count: dict[str | None, int] = defaultdict(int)
    for run in runs:
        count[run.part_number] += 1
    return sorted(
        (run for run in runs if count[run.part_number] >= LEAST_RUNS), key=lambda run: (run.time_s, run.serial)
    )


LISTED = 0.01
"""Share below which a place or a pattern is not listed: all of them are below the
chance of a wrong certain name."""


def _statement(search: Search, effect: SingleEffect) -> Statement:
    posterior = effect.posterior
    acts = 1 - posterior.nothing
    share = defaultdict[Place, float](float)
    of_pattern = defaultdict[Pattern, float](float)
    for family, p in posterior.families():
        of_pattern[_pattern(search, family)] += float(p.sum())
        places = family.places
        for i, q in enumerate(p.sum(axis=1)):
            share[Place(places.kind, places.names[i])] += float(q)
    places_found = _listed(share, search.prior.certain)
    if acts < search.prior.certain:
        verdict = Verdict.CANDIDATE
    else:
        alone = next(iter(places_found.values())) >= search.prior.certain
        verdict = Verdict.NAMED if alone else Verdict.CONFOUNDED
    best, place, _ = posterior.best()
    inside, since, interval, until = search.time_of(posterior, best, place)
    return Statement(
        verdict, acts, places_found, _listed(of_pattern, search.prior.certain), since, interval, until,
        {name: Change(*values) for name, values in search.sizes(effect).items()}, inside,
    )  # fmt: skip


def _pattern(search: Search, family: Family) -> Pattern:
    group = search.groups[family.group].group if family.group >= 0 else None
    if group is None:
        return Pattern(family.form, FigureKind.EFFECT, family.pattern, family.pattern)
    return Pattern(family.form, group.kind, group.name, family.pattern)


K = TypeVar("K")


def _listed(share: Mapping[K, float], certain: float) -> dict[K, float]:
    """The smallest set that has the truth for certain, the likeliest first; two at
    least where the first alone does not."""
    out: dict[K, float] = {}
    for key, p in sorted(share.items(), key=lambda item: -item[1]):
        if out and (sum(out.values()) >= certain or (p < LISTED and len(out) > 1)):
            break
        out[key] = p
    return out
