"""The odds of each effect for the next unit of a type, from the units so far.

A unit's effects are a draw from the type: names that exclude each other in its
posterior share one unit between them. The share of units with an effect is a posterior
mean under a Beta prior about the catalogue's odds; expectation and maximisation turn
posteriors of units into counts (Dempster, Laird and Rubin 1977, J. R. Stat. Soc. B
39:1).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.diagnosis import Loop
from triaxcal.effects.catalogue import CATALOGUE
from triaxcal.effects.odds import EFFECT_ODDS
from triaxcal.errors import InvalidData
from triaxcal.evidence.prior import Odds
from triaxcal.population.runs import SeenEffect

CATALOGUE_ODDS = EFFECT_ODDS / len(CATALOGUE)
"""Odds of one name of the catalogue, before any unit."""
UNITS = 4.0
"""Units that the catalogue's odds count as: a type differs from others, and two units
with an effect are no rule yet."""
LEAST, MOST = CATALOGUE_ODDS / 10, 1.0
"""Smallest and largest odds: a unit's own poses overrule them. A tenth costs an effect
that no unit had what one more pose brings; even odds make no name likely before
any pose."""
UNMODELLED_UNITS = 10.0
"""Units that the prior probability of an unmodelled part counts as."""
UNMODELLED_LEAST = 0.05
"""Smallest probability of an unmodelled part: it protects from wrong names, so units
without one lower it to a quarter at most."""
ROUNDS = 200
"""Of expectation and maximisation: more than it takes to settle to three digits."""
UNCERTAIN = 0.35
"""Probability of a likely name whose probability is not calibrated: half of what it
would be, because a likely name is wrong where the truth is in no catalogue. To leave it
out would count its competitors alone."""
EDGE = 1e-3
"""By which a name among others stays below certain."""
FLOOR = 1e-6
"""Smallest probability of a unit's posterior: documents are rounded."""


@dataclass(frozen=True)
class LearnedEffect:
    """``odds`` that it acts in the next unit; ``units`` is the expected number of
    units that have it."""

    odds: float
    units: float


@dataclass(frozen=True)
class LearnedOdds:
    """Odds learned from a number of ``units`` of one ``part_number`` (None for any).
    An effect that is not listed has the odds of the catalogue.
    ``unmodelled_probability`` is that of a part that no name describes."""

    part_number: str | None
    units: int
    effects: Mapping[str, LearnedEffect] = field(default_factory=dict)
    unmodelled_probability: float = Odds().unmodelled_probability

    @property
    def prior(self) -> Odds:
        """As `triaxcal.diagnosis.diagnose` takes them."""
        return Odds(
            of_effects={name: learned.odds for name, learned in self.effects.items()},
            unmodelled_probability=self.unmodelled_probability,
        )


@dataclass(frozen=True)
class SeenUnit:
    """What one run says of its unit: the ``effects`` by name, and the probability of
    an ``unmodelled`` part, under its prior probability ``unmodelled_prior``."""

    effects: Mapping[str, SeenEffect]
    unmodelled: float | None = None
    unmodelled_prior: float = Odds().unmodelled_probability

    @classmethod
    def of(cls, loop: Loop) -> SeenUnit:
        """What a diagnosis says. Beside an unmodelled part a name may be wrong, so then
        it says nothing of names."""
        evidence = loop.posterior.evidence
        names = sorted({term.name for term in evidence.terms if term.effect is not None})
        odds = {name: evidence.odds.of_effect(name, len(names)) for name in names}
        unmodelled = loop.found.unexplained
        stated = {name: loop.stated.get(name, 0.0) for name in names}
        for finding in loop.findings:
            stated[finding.effect] = finding.probability
        groups = [(f.effect, f.alternatives) for f in loop.findings if f.alternatives]
        effects = seen_effects(stated, groups, odds) if not unmodelled.significant else {}
        return cls(effects, unmodelled.probability, evidence.odds.unmodelled_probability)


def seen_effects(
    stated: Mapping[str, float | None],
    groups: Sequence[tuple[str, Mapping[str, float | None]]],
    odds: Mapping[str, float],
) -> dict[str, SeenEffect]:
    """Effects from their ``stated`` probabilities. Of ``groups``, each a name with its
    alternatives, one acts for certain: what the alternatives leave is the name's."""
    probabilities = dict(stated)
    for name, alternatives in groups:
        probabilities |= alternatives
        rest = [alternatives[other] for other in alternatives]
        if probabilities.get(name) is None and None not in rest:
            probabilities[name] = float(np.clip(1 - sum(p for p in rest if p is not None), 0.0, Odds().certain - EDGE))
    return {name: SeenEffect(p, {}, odds.get(name, CATALOGUE_ODDS)) for name, p in probabilities.items()}


def learned_odds(units: Sequence[SeenUnit], *, part_number: str | None = None) -> LearnedOdds:
    """The odds for the next unit, from one run of each unit so far. Raises
    InvalidData without any."""
    if not units:
        raise InvalidData("no unit to learn odds from")
    names = sorted({name for unit in units for name in unit.effects})
    each = [_Unit.of(unit, names) for unit in units]
    prior = CATALOGUE_ODDS / (1 + CATALOGUE_ODDS)
    share = np.full(len(names), prior)
    known = np.array([unit.known for unit in each]).reshape(len(each), len(names))
    count = np.zeros(len(names))
    for _ in range(ROUNDS):
        odds = share / (1 - share)
        count = np.sum([unit.expected(odds) for unit in each], axis=0)
        share = np.clip((UNITS * prior + count) / (UNITS + known.sum(axis=0)), FLOOR, 1 - FLOOR)
    odds = np.clip(share / (1 - share), LEAST, MOST)
    return LearnedOdds(
        part_number,
        len(units),
        {name: LearnedEffect(float(o), float(c)) for name, o, c in zip(names, odds, count, strict=True)},
        _unmodelled(units),
    )


@dataclass(frozen=True, eq=False)
class _Unit:
    """``known`` (m,) whether the unit says anything of a name; ``certain`` (m,) whether
    it acts for certain; ``ratio`` (m,) are likelihood ratios of the others, each acting
    alone against none of them."""

    known: np.ndarray
    certain: np.ndarray
    ratio: Floats

    @classmethod
    def of(cls, unit: SeenUnit, names: Sequence[str]) -> _Unit:
        seen = [unit.effects.get(name) for name in names]
        known = np.array([s is not None for s in seen], dtype=bool)
        p = np.array([0.0 if s is None else UNCERTAIN if s.probability is None else s.probability for s in seen])
        odds = np.array([s.prior_odds if s is not None and s.prior_odds > 0 else CATALOGUE_ODDS for s in seen])
        certain = known & (p >= Odds().certain)
        rest = np.where(known & ~certain, np.maximum(p, FLOOR), 0.0)
        none = max(1 - rest.sum(), FLOOR)
        return cls(known, certain, np.where(known & ~certain, rest / none / odds, 0.0))

    def expected(self, odds: Floats) -> Floats:
        """(m,) probability of each name at these odds: one of the uncertain ones, or
        none."""
        weight = self.ratio * odds
        return np.where(self.certain, 1.0, weight / (1 + weight.sum()))


def _unmodelled(units: Sequence[SeenUnit]) -> float:
    """Probability of an unmodelled part in the next unit, between `UNMODELLED_LEAST`
    and one half."""
    prior = Odds().unmodelled_probability
    ratio = np.array(
        [
            np.clip(u.unmodelled, FLOOR, 1 - FLOOR) / (1 - np.clip(u.unmodelled, FLOOR, 1 - FLOOR))
            * (1 - u.unmodelled_prior) / u.unmodelled_prior
            for u in units if u.unmodelled is not None
        ]
    )  # fmt: skip
    share = prior
    for _ in range(ROUNDS):
        odds = share / (1 - share)
        share = (UNMODELLED_UNITS * prior + np.sum(ratio * odds / (1 + ratio * odds))) / (UNMODELLED_UNITS + len(ratio))
    return float(np.clip(share, UNMODELLED_LEAST, 0.5))
