"""Which recording would tell a finding from what would do as well."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from triaxcal.arrays import Floats, Ints
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
from triaxcal.effects.plugins import EffectFault
from triaxcal.errors import Refused
from triaxcal.figures import plain
from triaxcal.planning.directions import directions, spiral
from triaxcal.problem import linearise
from triaxcal.search.alternatives import NEAR
from triaxcal.search.search import Search
from triaxcal.search.worth import Model, deviance

SPHERE = 400
APART_DEG = 30.0
POSES, POSES_MOST = 3, 12
ONE_OF_TWENTY = 1.645
"""Chi-square that rises by δ² on average rises by δ² − 2 δ times this at least, but in one recording of twenty."""
DIGITS = 6

FURTHER = "add poses in further directions"
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
            out[_directions(search, search.found, model, name)] = None
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


def _directions(search: Search, mine: Model, other: Model, name: str) -> str:
    """The poses in which the other model is off by most of what it is sure of, should this one be right."""
    # As they are told: a tenth is what a hand can do.
    up = np.round(np.concatenate([[v for _, v in directions()], spiral(SPHERE)]), 1) + 0.0
    try:
        off, by_theta, error = _difference(search, mine, other, up / np.linalg.norm(up, axis=1, keepdims=True))
    except (EffectFault, Refused):  # it does not hold everywhere
        return FURTHER

    def rises(sets: Ints) -> Floats:
        """By how much chi-square rises with some sets (s,k) of poses each, though the other model is fitted again."""
        axes, singular, _ = np.linalg.svd(by_theta[sets])
        variance = np.full(sets.shape, error**2)
        variance[:, : singular.shape[1]] += singular**2
        along = (axes.transpose(0, 2, 1) @ off[sets][:, :, None])[:, :, 0]
        return np.asarray(np.sum(along**2 / variance, axis=1))

    def score_with(m: Model, k: int, risen: float = 0.0) -> float:
        """Of a model of so many poses more, in which chi-square has risen beside what their noise makes of it."""
        means = float(deviance(np.array(m.chi2 + k + risen), search.left(m.effects) + k))
        return means + search.against_trends(m) + m.price

    def enough(rows: list[int]) -> bool:
        """Whether the other model is out then, in nineteen of twenty recordings."""
        k, risen = len(rows), float(rises(np.array([rows]))[0])
        unlucky = max(risen - 2 * ONE_OF_TWENTY * np.sqrt(risen), 0.0)
        return score_with(other, k, unlucky) - score_with(mine, k) >= NEAR

    chosen: list[int] = []
    size = np.linalg.norm(up, axis=1)
    near = np.abs(up @ up.T) > np.cos(np.radians(APART_DEG)) * np.outer(size, size)
    known = np.isfinite(off) & np.isfinite(by_theta).all(axis=1)
    while len(chosen) < POSES_MOST and (len(chosen) < POSES or not enough(chosen)):
        far = np.flatnonzero(known & ~near[:, chosen].any(axis=1))
        if not len(far):
            break
        risen = rises(np.column_stack([np.tile(chosen, (len(far), 1)).astype(np.int64), far]))
        # A processor's rounding must not decide between two that tell as much.
        chosen.append(int(far[np.argmax([float(f"{r:.{DIGITS}g}") for r in risen])]))
    if not chosen:
        return FURTHER
    told = enough(chosen)
    shown = chosen if told else chosen[:POSES]
    where = ", ".join("(" + ", ".join(f"{v:+.1f}" for v in up[i]) + ")" for i in shown)
    end = "which would tell" if told else f"of which even {len(chosen)} would hardly tell"
    largest = plain(float(np.max(np.abs(off[shown]))) * 1e6, 2)
    return f"add poses with up at {where}: there it differs from {name} by up to {largest} µg, {end}"


def _difference(search: Search, mine: Model, other: Model, up: Floats) -> tuple[Floats, Floats, float]:
    """|a| − reference (m,) under the other model of what the first says the outputs are, all over the sphere; its
    derivatives by what the poses leave open in the other model (m,p), in standard errors; and that of a pose (rms)."""
    problem = search.problem
    held = at_reference(problem.channel_reference, len(up))
    outputs = mine.state.sensor(problem).output(up * problem.reference, held)
    channels = {n: problem.channel_reference[n] + values for n, values in held.items()}
    there = replace(problem, u=outputs, covariance=np.zeros((len(up), 3, 3)), channels=channels, further=None)
    off, by_theta, _ = linearise(there, other.state)
    _, J, s = linearise(problem, other.state)
    size = np.maximum(np.linalg.norm(J / s[:, None], axis=0), 1e-300)
    _, singular, axes = np.linalg.svd(J / s[:, None] / size)
    singular = np.pad(singular, (0, len(axes) - len(singular)))
    open_ = axes.T / np.maximum(singular, singular[0] * 1e-12)
    return off, by_theta / size @ open_, float(np.sqrt(np.mean(s**2)))
