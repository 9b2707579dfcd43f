"""Which recording would tell a finding from what would do as well."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from triaxcal.arrays import Floats
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
from triaxcal.figures import plain
from triaxcal.plan.directions import directions, spiral
from triaxcal.search.search import Search
from triaxcal.search.worth import Model

SPHERE = 400
APART_DEG = 40.0
POSES = 3
TOLD = 3.0
"""Two models are told apart by poses in which they differ by so many of their standard errors, all together."""

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
    up = np.concatenate([[v for _, v in directions()], spiral(SPHERE)])
    off, error = _difference(search, mine, other, up)
    chosen: list[int] = []
    for i in np.argsort(-np.abs(off), kind="stable"):
        if all(abs(float(up[i] @ up[k])) < np.cos(np.radians(APART_DEG)) for k in chosen):
            chosen.append(int(i))
        if len(chosen) == POSES:
            break
    # A hair's breadth of one direction from another must not change the words from processor to processor.
    where = ", ".join("(" + ", ".join(f"{v + 0.0:+.1f}" for v in np.round(up[i], 1)) + ")" for i in chosen)
    sigma = abs(off[chosen[0]]) / error
    times = int(np.ceil((TOLD / max(sigma, 1e-9)) ** 2))
    how = {1: "one such pose"}.get(times, f"{times} such poses" if times <= 100 else f"only {times:.0e} such poses")
    return (
        f"add poses with up at {where}: there it differs from {name} by up to "
        f"{plain(abs(off[chosen[0]]) * 1e6, 2)} µg, so that {how} would tell"
    )


def _difference(search: Search, mine: Model, other: Model, up: Floats) -> tuple[Floats, float]:
    """|a| − reference (m,) under the other model of what the first says the outputs are, all over the sphere; and the
    standard error of a pose (rms)."""
    problem = search.problem
    held = at_reference(problem.channel_reference, len(up))
    first, second = mine.state.sensor(problem), other.state.sensor(problem)
    length, _ = second.magnitude(first.output(up * problem.reference, held), held)
    _, by_u = first.magnitude(problem.u, problem.conditions)
    error = np.sqrt(np.mean(np.einsum("ni,nij,nj->n", by_u, problem.covariance, by_u)))
    return length - problem.reference, float(error)
