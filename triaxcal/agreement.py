"""Several units in one environment, eight sensors on a board say: whether what each shows by itself is one effect.

Every unit has its own linear model and its own coefficients of the effect. What they share is which effect it is, and
its shape (a time constant, the moment of a step). One unit may not tell two effects apart where all together do: the
scores, which are log-likelihoods with a price, add up.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from triaxcal.arrays import Floats
from triaxcal.distributions import chi2_sf
from triaxcal.effects.contract import Effect, reshaped
from triaxcal.effects.part import Part
from triaxcal.errors import InvalidData
from triaxcal.loop import Loop
from triaxcal.search.alternatives import NEAR
from triaxcal.search.candidates import Ground
from triaxcal.search.search import Search
from triaxcal.search.worth import Model, deviance
from triaxcal.shapes import edges_of, has_edges, spread

LOOKED_AT = 2
"""Of each effect so many variants, the best for all units together in linear reckoning, are fitted in earnest."""
STEP = 0.05
"""Relative step by which the curvature of a profile is sought, before its width is known."""
BEYOND = 3
"""Of what no unit alone tells from a straight line all together may tell the curvature: a slow time constant."""


@dataclass(frozen=True)
class SharedShape:
    """A shape that the units share, by the minimum of their summed deviance; ``standard_error`` None where the poses do
    not tell it. ``own`` are value and standard error in each of ``units`` (indices), ``p_value`` the probability of own
    values as different as these, were they one (likelihood ratio); None for one unit alone.
    """

    value: float
    standard_error: float | None
    unit: str
    units: tuple[int, ...]
    own: tuple[tuple[float, float | None], ...]
    p_value: float | None


@dataclass(frozen=True)
class Common:
    """One effect, in all units. ``worse`` is by how much its summed score exceeds that of the best effect, ``gain`` by
    how much it is better than the same models without it; ``units_gain`` likewise by unit. ``shown`` are the units
    (indices) in which that is beyond chance, the choice among units and effects allowed for; ``named`` those that name
    it uniquely, ``listed`` those that have it among what would do as well.
    """

    effect: str
    worse: float
    gain: float
    units_gain: tuple[float, ...]
    shown: tuple[int, ...]
    named: tuple[int, ...]
    listed: tuple[int, ...]
    shapes: Mapping[str, SharedShape]


@dataclass(frozen=True)
class Agreement:
    """``agreed`` are the effects that do for all; none where the units do not agree. ``effects`` are all that every
    unit could have shown, the best first.
    """

    verdict: str
    agreed: tuple[str, ...]
    effects: tuple[Common, ...]


def agreement(loops: Sequence[Loop]) -> Agreement:
    """Whether units, each diagnosed by itself, agree on the effect. Raises InvalidData for fewer than two."""
    if len(loops) < 2:
        raise InvalidData("whether units agree takes two of them")
    units = [_Unit.of(loop) for loop in loops]
    names = [n for n in units[0].search.names if all(n in u.search.names for u in units)]
    if not names:
        return Agreement(_verdict((), units), (), ())
    # What units show beside the effect that most speaks for is their own; beside that, all names stand for the same.
    first = max(names, key=lambda name: sum(_Joint.of(name, units, name).gains))
    joint = {name: _Joint.of(name, units, first) for name in names}
    order = sorted(names, key=lambda name: joint[name].score)
    chance = 2 * float(np.log(len(units) * len(names)))
    effects = [_common(joint[name], units, joint[order[0]].score, chance) for name in order]
    agreed = _agreed(effects, units)
    finished = tuple(_with_shapes(c, joint[c.effect], units) if c.effect in agreed else c for c in effects)
    return Agreement(_verdict(agreed, units), agreed, finished)


@dataclass(frozen=True)
class _Unit:
    search: Search
    alternatives: Mapping[str, tuple[str, ...]]
    """Of each effect that was found."""
    verdicts: Mapping[str, str]

    @classmethod
    def of(cls, loop: Loop) -> _Unit:
        if loop.search is None:
            raise InvalidData("the units' diagnoses do not hold their search")
        found = {e.name for e in loop.search.found.effects}
        findings = [f for f in loop.findings if f.effect in found]
        return cls(loop.search, {f.effect: f.alternatives for f in findings}, {f.effect: f.verdict for f in findings})

    def beside(self, name: str) -> tuple[Effect, ...]:
        """What the unit shows beside the effect of that name: not what this would do as well for."""
        found = self.search.found.effects
        return tuple(e for e in found if e.name != name and name not in self.alternatives.get(e.name, ()))

    def model(self, effects: Sequence[Effect]) -> Model | None:
        return self.search.model(effects) if effects else self.search.linear

    def deviance(self, m: Model) -> float:
        """Of the means, and by how much worse than the linear model it foretells the trends inside the poses."""
        return float(deviance(np.array(m.chi2), self.search.left(m.effects))) + self.search.against_trends(m)

    def score(self, m: Model, choices: int = 1) -> float:
        """Deviance, and Schwarz's price; the last effect was chosen among so many parts of it."""
        coefficients = sum(len(e.coefficients) for e in m.effects)
        return self.deviance(m) + coefficients * float(np.log(len(self.search.poses))) + 2 * float(np.log(choices))


@dataclass(frozen=True)
class _Joint:
    """An effect in one variant for all units: each unit's best part of it beside ``rest``, None where it cannot carry
    any, and the summed ``score``."""

    variants: tuple[Effect, ...]
    parts: tuple[Effect | None, ...]
    rest: tuple[tuple[Effect, ...], ...]
    gains: tuple[float, ...]
    score: float

    @classmethod
    def of(cls, name: str, units: Sequence[_Unit], first: str) -> _Joint:
        """In the place of the effect named ``first``, beside what the units show beside that."""
        most = max(units, key=lambda u: len(u.search.poses)).search
        effect = next(e for e in most.catalogue if e.name == name)
        variants = tuple(effect.variants(most.problem.conditions))
        rest = [tuple(e for e in u.beside(first) if e.name != name) for u in units]
        without = [u.model(r) or u.search.linear for u, r in zip(units, rest, strict=True)]
        rest = [m.effects for m in without]
        near = [_near(u, m, variants) for u, m in zip(units, without, strict=True)]
        totals = [sum(unit[i][0] for unit in near) for i in range(len(variants))]
        trials = []
        for i in np.argsort(totals, kind="stable")[:LOOKED_AT]:
            parts, gains, total = [], [], 2 * float(np.log(len(variants)))
            for u, m, unit in zip(units, without, near, strict=True):
                _, part, choices = unit[int(i)]
                both = u.model([*m.effects, part]) if part is not None else None
                score = u.score(m if both is None else both, choices)
                parts.append(part if both is not None else None)
                gains.append(u.score(m) - score)
                total += score
            trials.append(cls(variants, tuple(parts), tuple(rest), tuple(gains), total))
        return min(trials, key=lambda t: t.score)


def _near(unit: _Unit, without: Model, variants: Sequence[Effect]) -> list[tuple[float, Effect | None, int]]:
    """For each variant: score in linear reckoning, the part that has it, and among how many parts."""
    search = unit.search
    ground = Ground.at(search.problem, without.state)
    chi2, trends = float(ground.y @ ground.y), search.against_trends(without)
    out: list[tuple[float, Effect | None, int]] = []
    for variant in variants:
        found = []
        for part, gain in _parts(ground, variant):
            left = search.left([*without.effects, part])
            if left >= search.kept:
                price = len(part.coefficients) * float(np.log(len(search.poses)))
                found.append((float(deviance(np.array(chi2 - gain), left)) + price + trends, part))
        # What is too much for the means of few poses, their trends may carry.
        if not variant.shape and search.left([*without.effects, variant]) < search.kept:
            both = search.model([*without.effects, variant])
            found += [(unit.score(both), variant)] if both is not None else []
        score, best = min(found, key=lambda f: f[0], default=(unit.deviance(without), None))
        out.append((score, best, max(len(found), 1)))
    return out


def _parts(ground: Ground, effect: Effect) -> Iterator[tuple[Effect, float]]:
    """What shows of an effect, and each of its parts that shows, with what it takes out of chi-square."""
    columns = ground.columns(effect)
    if not np.isfinite(columns).all():
        return
    basis, mix = ground.shown(columns)
    if basis.shape[1]:
        whole = basis.shape[1] == columns.shape[1]
        yield effect if whole else Part(effect, mix), float(np.sum((basis.T @ ground.y) ** 2))
    labels = dict.fromkeys(c.part for c in effect.coefficients)
    for label in labels if len(labels) > 1 else ():
        part = Part.of(effect, label)
        own, _ = ground.shown(columns @ part.mix)
        if own.shape[1] == part.mix.shape[1]:
            yield part, float(np.sum((own.T @ ground.y) ** 2))


def _common(j: _Joint, units: Sequence[_Unit], best: float, chance: float) -> Common:
    name = j.variants[0].name
    named = tuple(i for i, u in enumerate(units) if u.verdicts.get(name) == "adopted")
    listed = tuple(
        i
        for i, u in enumerate(units)
        if u.verdicts.get(name) == "confounded" or any(name in others for others in u.alternatives.values())
    )
    shown = tuple(i for i, gain in enumerate(j.gains) if gain > chance)
    return Common(name, j.score - best, float(sum(j.gains)), j.gains, shown, named, listed, {})


def _agreed(effects: Sequence[Common], units: Sequence[_Unit]) -> tuple[str, ...]:
    """Those that are as good as the best, and that two units or more show or have among their own findings, being most
    of those that show anything.
    """
    found = {i for i, u in enumerate(units) if u.search.found.effects}
    out = []
    for c in effects:
        speak = {*c.shown, *c.named, *c.listed}
        if c.worse < NEAR and c.gain > 0 and len(speak) >= 2 and 2 * len(found & speak) > len(found):
            out.append(c.effect)
    return tuple(out)


def _verdict(agreed: Sequence[str], units: Sequence[_Unit]) -> str:
    if agreed:
        *most, last = agreed
        return f"agree on {', '.join(most)} or {last}" if most else f"agree on {last}"
    if not any(u.search.found.effects for u in units):
        return "no unit shows an effect"
    return "do not agree"


# Shapes.


def _with_shapes(c: Common, j: _Joint, units: Sequence[_Unit]) -> Common:
    some = {i: part for i, part in enumerate(j.parts) if part is not None and c.units_gain[i] > 0}
    shape = next((part.shape for part in some.values()), {})
    shapes = {name: _shared(name, unit, j, units, list(some)) for name, (_, unit) in shape.items()}
    return replace(c, shapes=shapes)


def _shared(name: str, unit: str, j: _Joint, units: Sequence[_Unit], some: Sequence[int]) -> SharedShape:
    grid = sorted({v.shape[name][0] for v in j.variants if name in v.shape})
    profiles = [_profile(units[i], j, i, name) for i in some]

    def together(x: float) -> float:
        return sum(profile(x) for profile in profiles)

    value = _lowest(together, grid)
    own = [_lowest(profile, grid) for profile in profiles]
    apart = sum(profile(value) - profile(x) for profile, x in zip(profiles, own, strict=True))
    p = float(chi2_sf(max(apart, 0.0), len(some) - 1)) if len(some) > 1 else None
    edges = {i: edges_of(units[i].search.problem) for i in some} if has_edges(j.variants[0]) else {}
    errors = [_error(profile, x, grid, edges.get(i)) for i, profile, x in zip(some, profiles, own, strict=True)]
    error = _error(together, value, grid, np.concatenate(list(edges.values())) if edges else None)
    return SharedShape(value, error, unit, tuple(some), tuple(zip(own, errors, strict=True)), p)


def _profile(unit: _Unit, j: _Joint, i: int, name: str) -> Callable[[float], float]:
    """The unit's deviance by one shape of the effect, all else fitted."""
    part, known = j.parts[i], dict[float, float]()
    assert part is not None

    def of(x: float) -> float:
        if x not in known:
            model = unit.model([*j.rest[i], reshaped(part, name, x)])
            known[x] = np.inf if model is None else unit.deviance(model)
        return known[x]

    return of


def _lowest(profile: Callable[[float], float], grid: Sequence[float]) -> float:
    """The minimum, between the neighbours of the best point of the grid; at its upper end, somewhat beyond."""
    values = [profile(x) for x in grid]
    at = int(np.argmin(values))
    low, high = grid[max(at - 1, 0)], grid[at + 1] if at + 1 < len(grid) else _beyond(grid)
    if not low < high:
        return grid[at]
    found = scipy.optimize.minimize_scalar(
        profile, bounds=(low, high), method="bounded", options={"xatol": 1e-3 * high}
    )
    return float(found.x) if found.fun < values[at] - 1e-3 else grid[at]


def _beyond(grid: Sequence[float]) -> float:
    """As far beyond the upper end as `BEYOND` more points of the grid, were it geometric."""
    return grid[-1] * (grid[-1] / grid[-2]) ** BEYOND if len(grid) > 1 and grid[-2] > 0 else grid[-1]


def _error(
    profile: Callable[[float], float], x: float, grid: Sequence[float], edges: Floats | None = None
) -> float | None:
    """By the curvature of a deviance at its minimum; None where it is flat, or at the end of what was tried. Of what
    changes at the ``edges`` of poses, by its likelihood."""
    if edges is not None:
        return spread(x, profile, grid, edges)
    if x <= grid[0] or x >= 0.99 * _beyond(grid):
        return None
    step, error = STEP * x, None
    for _ in range(2):
        low, high = x - step, x + step
        bend = (profile(low) + profile(high) - 2 * profile(x)) / step**2
        if not (np.isfinite(bend) and bend * x**2 > 1e-3):
            return None
        error = float(np.sqrt(2 / bend))
        step = min(error, 0.3 * x)
    return error
