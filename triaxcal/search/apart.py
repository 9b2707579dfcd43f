"""Which recording would tell a finding from what would do as well."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from triaxcal.arrays import Bools, Floats, Ints
from triaxcal.conditions import at_reference
from triaxcal.effects.contract import (
    BEFORE,
    CHANGE,
    HELD,
    RUN,
    SCATTER,
    SINCE_START,
    TIME,
    Effect,
    channel_of,
    is_derived,
    rate_of,
)
from triaxcal.effects.part import Part, mix_of, whole
from triaxcal.figures import plain
from triaxcal.plan.directions import directions, spiral
from triaxcal.problem import State, linearise
from triaxcal.search.alternatives import NEAR
from triaxcal.search.search import Search
from triaxcal.search.worth import Model, deviance

SPHERE = 400
APART_DEG = 30.0
POSES, POSES_MOST = 3, 12
FORMS = 6
ONE_OF_TWENTY = 1.645
"""Chi-square that rises by δ² on average rises by δ² − 2 δ times this at least, but in one recording of twenty."""
DIGITS = 6

FROM_OTHER_SIDES = "come to the same poses from other sides: another order, or the same backwards"
UNSHAKEN = "record again with what shakes the stand switched off"

DIRECTION, CLOCK, HISTORY, SHAKING, START = "direction", "time", "history", "shaking", "start"


def telling_apart(search: Search, effect: Effect, others: Mapping[str, Model]) -> list[str]:
    """One sentence for each way in which the finding differs from its alternatives."""
    out: dict[str, None] = {}
    mine = goes_with(effect)
    for name, model in list(others.items())[:3]:
        other = next((e for e in model.effects if e.name == name), effect)
        theirs = goes_with(other)
        if {mine, theirs} == {DIRECTION}:
            out[_directions(search, effect, model, name)] = None
        elif START in (mine, theirs):
            out["switch the unit off and on, and record the same poses once more"] = None
        elif mine == theirs == CLOCK:
            out["go on for as long again, with the same poses, the unit left switched on"] = None
        elif DIRECTION in (mine, theirs) and CLOCK in (mine, theirs):
            out["record the same poses again in another order, the first of them repeated at the end"] = None
        elif HISTORY in (mine, theirs):
            out[FROM_OTHER_SIDES] = None
        elif SHAKING in (mine, theirs):
            out[UNSHAKEN] = None
        else:
            one, *another = dict.fromkeys(c for c in (mine, theirs) if c not in (DIRECTION, CLOCK))
            if another:
                out[f"record again while {one} changes and {another[0]} stands still"] = None
            elif mine == theirs and set(effect.needs) == set(other.needs):
                out[f"record again while {one} goes through a wider range, from pose to pose"] = None
            elif mine == theirs:
                out[f"record again while {one} rises, falls and stands still, from pose to pose"] = None
            else:
                out[f"record the same poses again in the same order, while {one} goes another way"] = None
    return list(out)


def goes_with(effect: Effect) -> str:
    """What an effect goes with: the direction alone, the time, the pose before, shaking, the start of the unit, or a
    channel by its name."""
    needs = set(effect.needs) - {HELD}
    if not needs:
        return DIRECTION
    if needs == {RUN}:
        return START
    if needs <= {TIME, SINCE_START, RUN}:
        return CLOCK
    if needs <= {*BEFORE, *CHANGE}:
        return HISTORY
    if needs <= set(SCATTER):
        return SHAKING
    first = sorted(needs)[0]
    return channel_of(first.removesuffix(rate_of("")) if is_derived(first) else first)


@dataclass(frozen=True)
class _Wrong:
    """One of two models, should the other one be right: by how much it is ``off`` (m,) in further poses, ``by_theta``
    (m,p) what the poses leave open in it, in standard errors, and the standard error of a pose."""

    search: Search
    model: Model
    right: Model
    off: Floats
    by_theta: Floats
    error: float

    @classmethod
    def of(cls, search: Search, wrong: Model, right: Model, up: Floats) -> _Wrong:
        return cls(search, wrong, right, *_difference(search, right, wrong, up))

    def known(self) -> Bools:
        return np.asarray(np.isfinite(self.off) & np.isfinite(self.by_theta).all(axis=1))

    def rises(self, sets: Ints) -> Floats:
        """By how much chi-square rises with each of some sets (s,k) of poses, though the model is fitted again."""
        axes, singular, _ = np.linalg.svd(self.by_theta[sets])
        variance = np.full(sets.shape, self.error**2)
        variance[:, : singular.shape[1]] += singular**2
        along = (axes.transpose(0, 2, 1) @ self.off[sets][:, :, None])[:, :, 0]
        return np.asarray(np.sum(along**2 / variance, axis=1))

    def behind(self, rows: Sequence[int]) -> float:
        """By how much it scores worse than the right one with these poses in nineteen of twenty recordings."""
        risen = float(self.rises(np.array([rows]))[0]) if rows else 0.0
        unlucky = max(risen - 2 * ONE_OF_TWENTY * np.sqrt(risen), 0.0)
        return self._score(self.model, len(rows), unlucky) - self._score(self.right, len(rows))

    def _score(self, m: Model, further: int, risen: float = 0.0) -> float:
        """Of a model of so many poses more, in which chi-square has risen beside what their noise makes of it."""
        left = self.search.left(m.effects) + further
        means = float(deviance(np.array(m.chi2 + further + risen), left))
        return means + self.search.against_trends(m) + m.price


def _forms(search: Search, m: Model, name: str) -> list[Model]:
    """A model, and those with the effect of this name in other forms that come near: on one more axis, say. Further
    poses may make it take one of these."""
    rest = [e for e in m.effects if e.name != name]
    without = search.model(rest)
    if without is None:
        return [m]
    beside, limit = search.beside(without), search.score_of_means(m) + NEAR - without.price
    order = [i for i in np.argsort(beside.scores, kind="stable") if beside.scores[i] < limit]
    near = [c.effect for i in order if (c := beside.candidates[int(i)]).name == name][:FORMS]
    others = [f for e in near if (f := search.model([*rest, e])) is not None]
    return [m, *(f for f in others if f is not m)]


def _directions(search: Search, effect: Effect, other: Model, name: str) -> str:
    """The poses that tell an effect from the one of this name in the ``other`` model, whichever of them is right."""
    mine = search.found
    # As they are told: a tenth is what a hand can do.
    up = np.round(np.concatenate([[v for _, v in directions()], spiral(SPHERE)]), 1) + 0.0
    size = np.linalg.norm(up, axis=1)
    unit = up / size[:, None]
    ways = [_Wrong.of(search, form, mine, unit) for form in _forms(search, other, name)]
    ways += [_Wrong.of(search, form, other, unit) for form in _forms(search, mine, effect.name)]
    known = np.all([w.known() for w in ways], axis=0)
    near = np.abs(up @ up.T) > np.cos(np.radians(APART_DEG)) * np.outer(size, size)
    chosen: list[int] = []
    told = False
    while len(chosen) < POSES_MOST and not told:
        far = np.flatnonzero(known & ~near[:, chosen].any(axis=1))
        if not len(far):
            break
        sets = np.column_stack([np.tile(chosen, (len(far), 1)).astype(np.int64), far])
        # A processor's rounding must not decide between two that tell as much.
        hardest = min(ways, key=lambda w: _rounded(w.behind(chosen)))
        chosen.append(int(far[np.argmax([_rounded(r) for r in hardest.rises(sets)])]))
        told = len(chosen) >= POSES and all(w.behind(chosen) >= NEAR for w in ways)
    if not chosen:
        return "add poses in further directions"
    shown = chosen if told else chosen[:POSES]
    where = ", ".join("(" + ", ".join(f"{v:+.1f}" for v in up[i]) + ")" for i in shown)
    end = "which would tell" if told else f"of which even {len(chosen)} would hardly tell"
    largest = plain(float(np.max(np.abs(ways[0].off[shown]))) * 1e6, 2)
    return f"add poses with up at {where}: there it differs from {name} by up to {largest} µg, {end}"


def _rounded(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")


def _difference(search: Search, right: Model, wrong: Model, up: Floats) -> tuple[Floats, Floats, float]:
    """|a| − reference (m,) under the wrong model of what the right one says the outputs are, all over the sphere; its
    derivatives by what the poses leave open in the wrong one (m,p), in standard errors; and that of a pose (rms)."""
    problem = search.problem
    held = at_reference(problem.channel_reference, len(up))
    outputs = right.state.sensor(problem).output(up * problem.reference, held)
    channels = {n: problem.channel_reference[n] + values for n, values in held.items()}
    there = replace(problem, u=outputs, covariance=np.zeros((len(up), 3, 3)), channels=channels, further=None)
    bent = _in_full(wrong.state)
    off, by_theta, _ = linearise(there, bent)
    _, J, s = linearise(problem, bent)
    size = np.maximum(np.linalg.norm(J / s[:, None], axis=0), 1e-300)
    _, singular, axes = np.linalg.svd(J / s[:, None] / size)
    singular = np.pad(singular, (0, len(axes) - len(singular)))
    open_ = axes.T / np.maximum(singular, singular[0] * 1e-12)
    return off, by_theta / size @ open_, float(np.sqrt(np.mean(s**2)))


def _in_full(state: State) -> State:
    """The same with all coefficients of the effects of which the poses show some combinations only: further poses may
    show others."""
    theta, effects, at = [state.theta[:9]], [], 9
    for effect in state.effects:
        q = state.theta[at : at + len(effect.coefficients)]
        at += len(effect.coefficients)
        combined = isinstance(effect, Part) and not effect.selects
        theta.append(mix_of(effect) @ q if combined else q)
        effects.append(whole(effect) if combined else effect)
    return State(np.concatenate(theta), tuple(effects))
