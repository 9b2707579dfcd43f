"""Several units in one environment, eight sensors on a board say: which effects
act in all of them.

Every unit has its own linear model and its own coefficients of an effect. They
may share which effect it is, its size, and its shape (a time constant, the
moment of a step). Existence is asked of all together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

from triaxcal.diagnosis import Loop
from triaxcal.errors import InvalidData
from triaxcal.evidence.pooled import Pooled, pool
from triaxcal.evidence.posterior import Shape, shapes_of


class Answer(StrEnum):
    AGREE = "agree"
    """Effects act in every unit for certain."""
    PERHAPS = "perhaps"
    """An effect probably acts in every unit."""
    DISAGREE = "disagree"
    """Some unit shows an effect, and none probably acts in every unit."""
    NOTHING = "nothing"
    """No unit shows an effect."""


@dataclass(frozen=True)
class SharedShape:
    """A shape that the units share, and their ``own`` by the index of each unit
    that may have the effect."""

    shared: Shape
    own: Mapping[int, Shape]


@dataclass(frozen=True)
class PooledEffect:
    """An effect: the ``probability`` that it acts in every unit, and ``common``
    that its values are the same in all, if it does. ``units`` is the
    probability that it acts in each, by that unit alone. ``named`` are the
    units (indices) in which it is a finding by itself, ``listed`` those in
    which it is among others of which one acts."""

    effect: str
    probability: float
    common: float
    units: tuple[float, ...]
    named: tuple[int, ...]
    listed: tuple[int, ...]
    shapes: Mapping[str, SharedShape]


@dataclass(frozen=True)
class PooledAnalysis:
    """``agreed`` are groups of effects, in each of which one acts in every
    unit; where the answer is only likely, that one effect. ``probability`` is
    that of the most doubtful of the groups. ``effects`` are all that every unit
    could have shown, the likeliest first; ``nothing`` is the probability that
    none acts in any unit."""

    answer: Answer
    agreed: tuple[tuple[str, ...], ...]
    probability: float
    effects: tuple[PooledEffect, ...]
    nothing: float


def pooled_analysis(loops: Sequence[Loop]) -> PooledAnalysis:
    """Of units that were diagnosed one by one. Raises InvalidData for fewer
    than two."""
    if len(loops) < 2:
        raise InvalidData("whether units agree takes two of them")
    smallest = min(float(loop.posterior.evidence.sizes[0]) for loop in loops)
    units = [loop.posterior.resized(smallest) for loop in loops]
    found = pool(units)
    odds = units[0].evidence.odds
    agreed = found.certain(odds.certain)
    first, likeliest = next(iter(found.probability.items()), ("", 0.0))
    if agreed:
        answer = Answer.AGREE
    elif likeliest >= odds.reported:
        answer, agreed = Answer.PERHAPS, ((first,),)
    else:
        shown = found.nothing < odds.reported or any(loop.findings or loop.candidates for loop in loops)
        answer = Answer.DISAGREE if shown else Answer.NOTHING
    return PooledAnalysis(
        answer,
        agreed,
        min((_probability(group, found) for group in agreed), default=0.0),
        tuple(_common(name, found, loops) for name in found.probability),
        found.nothing,
    )


def _probability(group: tuple[str, ...], found: Pooled) -> float:
    return found.probability[group[0]] if len(group) == 1 else found.one_of(group)


def _common(name: str, found: Pooled, loops: Sequence[Loop]) -> PooledEffect:
    named, listed = [], []
    for i, loop in enumerate(loops):
        for finding in loop.findings:
            if finding.effect == name and not finding.alternatives:
                named.append(i)
            elif name in (finding.effect, *finding.alternatives):
                listed.append(i)
    own = {i: shapes_of(unit, name) for i, unit in enumerate(found.units)}
    shapes = {
        shape: SharedShape(shared, {i: of_unit[shape] for i, of_unit in own.items() if shape in of_unit})
        for shape, shared in found.shapes[name].items()
    }
    of_units = tuple(unit.effect_probabilities.get(name, 0.0) for unit in found.units)
    return PooledEffect(
        name, found.probability[name], found.common[name], of_units, tuple(named), tuple(listed), shapes
    )
