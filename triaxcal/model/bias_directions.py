"""Where to point the unit for its biases alone, where scale factors and angles
are kept."""

from __future__ import annotations

from functools import cache

import numpy as np

from triaxcal.arrays import Floats, Ints
from triaxcal.model.directions import Direction, cube_directions, directions, distinct

LEAST = 3
"""A pose tells one number, |a|: fewer cannot carry three biases."""
DILUTION_LIMIT = 5.0
"""Above this three biases are refused: some combination of them is so many
times as uncertain as a pose, and with scale factors that change by 200 ppm,
which a pose shows like noise, half as uncertain as without any pose."""
APART_DEG = 10.0
"""Poses nearer to each other count as one: as far apart as a station wants its
poses by default."""
FAR_APART_DEG = 45.0
"""Of two poses nearer to each other more than half of what one tells of the
biases (the square of the cosine) the other tells as well."""
SCALE_FACTOR, ANGLE, BIAS = 2.0, 0.3, 20.0
"""By how much the parameters may be off before the poses are seen, in errors of
a pose: of 100 µg, where scale factors change by 200 ppm and biases by 2 mg from
start to start (MIMU4444). The design hardly depends on them."""
STARTS = 12
"""Sets from which the exchange begins: one of them ends with the best set for
all counts up to six, by comparison with all sets."""


def bias_directions(count: int) -> list[Direction]:
    """``count`` directions of up that determine the biases best: of the 26 of
    the cube while there are so many, then `directions`.

    The sum of the biases' variances is least (A-optimal), where scale factors
    may have changed a little as well. Four are the corners of a tetrahedron, in
    which a change of any scale factor makes the same error in all four and so
    none in the biases; six are the faces.
    """
    if count > len(cube_directions()):
        return directions(count)
    return [cube_directions()[i] for i in _best(count)]


def wanted_for_biases(have: Floats) -> tuple[str, ...]:
    """Labels of the poses that mend a set: ``have`` (n,3) are its directions of
    up. The fewest that determine the biases, the best first."""
    candidates = cube_directions()
    ups = np.array([v for _, v in candidates])
    held = have
    wanted: list[str] = []
    while len(wanted) < LEAST and (distinct_directions(held) < LEAST or not determined(held)):
        best = int(np.argmin(_variances(np.array([[*held, v] for v in ups]))))
        wanted.append(candidates[best][0])
        held = np.concatenate([held, ups[best : best + 1]])
    return tuple(wanted)


def bias_dilution(up: Floats) -> float:
    """The largest standard error of any direction of the bias, in standard
    errors of one pose; infinite where the directions (n,3) do not span space."""
    if len(up) < LEAST:
        return float("inf")
    smallest = float(np.linalg.svd(up, compute_uv=False)[-1])
    return 1 / smallest if smallest > 1e-12 else float("inf")


def determined(up: Floats) -> bool:
    """Whether directions (n,3) determine three biases."""
    return bias_dilution(up) < DILUTION_LIMIT


def distinct_directions(up: Floats) -> int:
    return distinct(up, APART_DEG) if len(up) else 0


def first_distinct(up: Floats, count: int) -> list[int]:
    """Rows of the first ``count`` directions (n,3) that are `FAR_APART_DEG`
    from all before them; where there are not so many, `APART_DEG`."""
    for apart_deg in (FAR_APART_DEG, APART_DEG):
        kept: list[int] = []
        for i, v in enumerate(up):
            if len(kept) < count and all(float(v @ up[k]) < np.cos(np.radians(apart_deg)) for k in kept):
                kept.append(i)
        if len(kept) == count:
            break
    return kept


def _variances(sets: Floats) -> Floats:
    """(m,) sums of the variances of the biases, in variances of a pose, for
    sets (m,n,3) of directions."""
    x, y, z = np.moveaxis(sets, -1, 0)
    rows = np.concatenate([np.stack([x * x, y * y, z * z, y * z, x * z, x * y], axis=-1), -sets], axis=-1)
    precision = np.array([SCALE_FACTOR, ANGLE, BIAS]).repeat(3) ** -2.0
    information = np.swapaxes(rows, 1, 2) @ rows + np.diag(precision)
    variance = np.diagonal(np.linalg.inv(information), axis1=1, axis2=2)[:, 6:].sum(axis=1)
    return np.asarray(np.round(variance, 9))


@cache
def _best(count: int) -> tuple[int, ...]:
    ups = np.array([v for _, v in cube_directions()])
    best: tuple[float, tuple[int, ...]] = (np.inf, ())
    for seed in range(STARTS):
        order = np.arange(len(ups)) if seed == 0 else np.random.default_rng(seed).permutation(len(ups))
        best = min(best, _exchanged(ups, order[:count]))
    return best[1]


def _exchanged(ups: Floats, chosen: Ints) -> tuple[float, tuple[int, ...]]:
    """One for another, as long as that helps."""
    held = sorted(map(int, chosen))
    least = float(_variances(ups[None, held])[0])
    while True:
        others = [k for k in range(len(ups)) if k not in held]
        trials = np.array([sorted([*held[:i], k, *held[i + 1 :]]) for i in range(len(held)) for k in others], dtype=int)
        values = _variances(ups[trials]) if len(trials) else np.array([np.inf])
        at = int(np.argmin(values))
        if not values[at] < least:
            return least, tuple(held)
        held, least = trials[at].tolist(), float(values[at])
