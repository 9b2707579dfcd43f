"""Where to point the unit: sets of poses for a full calibration or for its biases
alone, and what a given set still lacks.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import cache

import numpy as np

from triaxcal.arrays import Floats, Ints
from triaxcal.errors import InvalidData
from triaxcal.model.sensor import LINEAR

# In which order to take poses, so that what happens in time does not pass for what
# happens with direction.

PRIOR = np.repeat([10.0, 1.0, 10.0, 0.3, 0.3, 0.3], 3)
"""Prior standard deviations, in standard errors of one pose: of second order,
third order, steady drift, drift that bends, scale factors that drift, and
hysteresis. Second order and steady drift are to be distinguished whatever they
are, since one fakes the other in real recordings; the rest where poses are left
to do it with."""
STARTS, ROWS_MOST, STEPS_MOST = 4, 12000, 80
"""Searches from different orders (one for a large plan); rows of trial orders
that one step of a search looks at."""
SURE = 1e-9
"""Orders that differ by less than this are the same, whatever the processor
makes of the last digits."""


def in_order(a: Floats, *, attached: Floats | None = None, kind: Ints | None = None) -> Ints:
    """(n,) the rows of ``a`` (n,3) in the order to take them, the first row
    first; it is repeated at the end.

    ``attached`` (n,q): columns of effects that are looked for in any case and
    go with their row. Rows change places only with rows of the same ``kind``
    (n,). Deterministic.
    """
    n = len(a)
    kind = np.zeros(n, dtype=int) if kind is None else kind
    first, second = np.triu_indices(n - 1, 1)
    pairs = np.stack([first, second], axis=1) + 1
    pairs = pairs[kind[pairs[:, 0]] == kind[pairs[:, 1]]]
    best: tuple[float, Ints] = (np.inf, np.arange(n))
    for seed in range(STARTS if len(pairs) <= ROWS_MOST // n else 1) if len(pairs) else ():
        rng = np.random.default_rng(seed)
        order = _shuffled(kind, rng)
        found = _descended(a, attached, order, pairs, rng)
        if found[0] < best[0] - SURE:
            best = found
    return best[1]


def _shuffled(kind: Ints, rng: np.random.Generator) -> Ints:
    order = np.arange(len(kind))
    for k in np.unique(kind):
        places = np.flatnonzero(kind == k)
        places = places[places > 0]
        order[places] = rng.permutation(places)
    return order


def _descended(
    a: Floats, attached: Floats | None, order: Ints, pairs: Ints, rng: np.random.Generator
) -> tuple[float, Ints]:
    """Swaps of two until none helps; of a large plan a sample of the swaps, for
    a limited number of steps."""
    n = len(order)
    some = max(ROWS_MOST // n, 8)
    least = float(_criterion(a, attached, order[None])[0])
    for _ in range(STEPS_MOST if n < 200 else STEPS_MOST // 4):
        tried = pairs if len(pairs) <= some else rng.permutation(pairs)[:some]
        trials = np.tile(order, (len(tried), 1))
        each = np.arange(len(tried))
        trials[each, tried[:, 0]], trials[each, tried[:, 1]] = order[tried[:, 1]], order[tried[:, 0]]
        values = _criterion(a, attached, trials)
        at = int(np.argmax(values <= values.min() + SURE))
        if values[at] < least - SURE:
            least, order = float(values[at]), trials[at]
        elif len(pairs) <= some:
            break
    return least, order


def _criterion(a: Floats, attached: Floats | None, orders: Ints) -> Floats:
    """(m,) for orders (m,n): the sum of the variances, the first pose repeated
    at the end."""
    closed = np.concatenate([orders, orders[:, :1]], axis=1)
    b = a[closed]
    time = np.linspace(-1, 1, closed.shape[1])[:, None]
    before = np.concatenate([b[:, :1], b[:, :-1]], axis=1)
    linear = [b[..., :1] * b, b[..., 1:2] * b[..., 1:], b[..., 2:] ** 2, b]
    asked = [] if attached is None else [attached[closed]]
    suspected = [b**3, b**4, time * b, time**2 * b, time * b**2, before * b]
    X = np.concatenate([*linear, *asked, *suspected], axis=2)
    precision = np.zeros(X.shape[2])
    precision[-len(PRIOR) :] = 1 / PRIOR**2
    information = np.swapaxes(X, 1, 2) @ X + np.diag(precision)
    variance = np.diagonal(np.linalg.inv(information), axis1=1, axis2=2)
    return np.asarray(variance[:, 9:].sum(axis=1))


PAPER, FULL = 14, 26
"""Faces and vertices of a cube, as the paper has them; with its edges, which
let effects of second and third order be seen together."""
LEAST = LINEAR
"""A pose tells one number, |a|: fewer cannot carry nine parameters."""
Direction = tuple[str, Floats]
"""A label, and the unit vector (3,) of up in the unit's frame."""


def cube_directions() -> list[Direction]:
    """Six faces, eight vertices and twelve edges of a cube, in that order, as
    labels and unit vectors of up."""
    out = []
    for corner in sorted(itertools.product((1, 0, -1), repeat=3), key=_faces_vertices_edges):
        if any(corner):
            label = "".join("+-"[v < 0] + axis for v, axis in zip(corner, "XYZ", strict=True) if v)
            v = np.array(corner, dtype=float)
            out.append((label, v / np.linalg.norm(v)))
    return out


def _faces_vertices_edges(corner: tuple[int, ...]) -> int:
    return {1: 0, 3: 1, 2: 2, 0: 3}[sum(map(abs, corner))]


def directions(count: int = FULL) -> list[Direction]:
    """A plan of ``count`` distinct poses, in the order to take them; the first
    is then taken once more.

    14 is the paper's (faces and vertices of a cube), 26 adds its edges; any
    other number of nine or more is spread evenly over the sphere on a spiral
    (golden angle), labelled by number. The order keeps drift apart from the
    rest (`triaxcal.model.directions`). Raises InvalidData where there are fewer than
    nine.
    """
    return list(_directions(count))


@cache
def _directions(count: int) -> tuple[Direction, ...]:
    if count < LEAST:
        raise InvalidData(f"a plan of {count} poses cannot carry nine parameters; at least {LEAST}")
    if count in (PAPER, FULL):
        cube = cube_directions()[:count]
        return tuple(cube[i] for i in in_order(np.array([v for _, v in cube])))
    points = spiral(count)
    return tuple((f"N{k + 1}", points[i]) for k, i in enumerate(in_order(points)))


def spiral(count: int) -> Floats:
    """(count,3) unit vectors spread evenly over the sphere, from pole to pole."""
    i = np.arange(count)
    z = 1 - (2 * i + 1) / count
    angle = i * np.pi * (3 - np.sqrt(5))
    r = np.sqrt(1 - z**2)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)


def elsewhere(taken: Floats, count: int) -> list[Direction]:
    """``count`` directions that lie far from those ``taken`` (n,3) and from
    each other, the farthest first.

    Labels are in parts of the axes: "+2X-Y" is two parts X to one of minus Y.
    Of 98 directions, so that a ``count`` above that gives no more.
    """
    candidates = _lattice()
    ups = np.array([v for _, v in candidates])
    nearest = np.max(ups @ taken.T, axis=1, initial=-1.0)
    chosen: list[Direction] = []
    while len(chosen) < min(count, len(candidates)):
        best = int(np.argmin(np.round(nearest, 9)))
        chosen.append(candidates[best])
        nearest = np.maximum(nearest, ups @ ups[best])
    return chosen


@cache
def _lattice() -> tuple[Direction, ...]:
    """Directions with up to two parts of each axis."""
    out = []
    for parts in itertools.product((1, 2, -1, -2, 0), repeat=3):
        if np.gcd.reduce(parts) == 1:
            label = "".join("+-"[p < 0] + "2" * (abs(p) == 2) + axis for p, axis in zip(parts, "XYZ", strict=True) if p)
            v = np.array(parts, dtype=float)
            out.append((label, v / np.linalg.norm(v)))
    return tuple(out)


def closed(plan: Sequence[Direction]) -> list[Direction]:
    """The plan with its first pose repeated at the end: what differs between
    the two is time."""
    return [*plan, plan[0]]


def linear_design(a: Floats, x: Floats) -> Floats:
    """(n,9): derivative of |a| by the nine linear parameters ``a = T x − o``, T
    upper triangular.

    ``a`` (n,3) unit vectors, ``x`` (n,3) scaled outputs (or ``a`` itself, to
    judge a plan).
    """
    rows, columns = np.triu_indices(3)
    return np.concatenate([a[:, rows] * x[:, columns], -a], axis=1)


def in_range(u: Floats) -> Floats:
    """Outputs (n,3), to any scale and offset of the axes, scaled so that each
    axis goes from −1 to 1."""
    low, high = u.min(axis=0), u.max(axis=0)
    half = (high - low) / 2
    return np.asarray((u - (low + high) / 2) / np.where(half > 0, half, 1.0))


def dilution(a: Floats, design: Floats | None = None) -> float:
    """What the directions make of the noise: the largest standard error of any
    direction of the nine parameters, each scaled by the range that its axis
    goes through (`in_range`), in standard errors of one pose.

    Noises of poses are taken as alike, as in a dilution of precision.
    ``design`` is `linear_design` of the outputs in their range, where these are
    known; without it the triad counts as ideal. About 1 for the 14 poses;
    infinite where the set is singular.
    """
    if design is None and not len(a):
        return float("inf")
    return worst_error(linear_design(a, in_range(a)) if design is None else design)


def worst_error(design: Floats) -> float:
    """The largest standard error of any direction of the nine parameters, in
    standard errors of the rows (n,9).

    With `linear_design` (a, a) the parameters are those at the whole reference,
    wherever the poses are, so that a further pose never makes it larger.
    Infinite where the design is singular.
    """
    if len(design) < 9:
        return float("inf")
    smallest = float(np.linalg.svd(design, compute_uv=False)[-1])
    return 1 / smallest if smallest > 1e-12 else float("inf")


def most_wanted(
    a: Floats,
    enough: float = 2.0,
    most: int = 9,
    *,
    unsure_rad: float = 0.0,
    weights: Floats | None = None,
) -> list[Direction]:
    """The poses of the 26 that mend a set best, each once, until its dilution
    is below ``enough``; at most ``most``.

    ``a`` (n,3): the directions of up that the set has; where they are known to
    no better than ``unsure_rad``, the dilution is that of the worst of some
    sets that are so far off. ``weights`` (n,) are 1/variance, of a pose to be
    added 1. Empty where nothing is wanted.
    """
    have = a / np.maximum(np.linalg.norm(a, axis=1, keepdims=True), 1e-300)
    root = np.ones(len(a)) if weights is None else np.sqrt(weights)
    sets = [linear_design(v, v) * root[:, None] for v in _maybe(have, unsure_rad)]
    candidates = cube_directions()
    ups = np.array([v for _, v in candidates])
    rows = linear_design(ups, ups)
    information = np.array([J.T @ J for J in sets])
    wanted: list[int] = []
    while len(wanted) < min(most, len(rows)) and _worst(information, rows[wanted]) > enough:
        wanted.append(_best_addition(information, rows, wanted))
    wanted = _exchanged(information, rows, wanted, enough)
    return [candidates[i] for i in wanted]


def _maybe(have: Floats, unsure_rad: float) -> list[Floats]:
    """The directions as they seem, and where unsure some sets that they may be."""
    rng = np.random.default_rng(0)
    out = [have]
    for _ in range(8 if unsure_rad and len(have) else 0):
        # Errors of scale and offset, which all directions have in common, and
        # which matter most.
        matrix = np.eye(3) + unsure_rad * rng.standard_normal((3, 3))
        off = have @ matrix.T + unsure_rad * rng.standard_normal(3)
        out.append(off / np.linalg.norm(off, axis=1, keepdims=True))
    return out


def _worst(information: Floats, more: Floats) -> float:
    """Dilution of the worst of the sets (k,9,9) with further rows (m,9)."""
    smallest = np.linalg.eigvalsh(information + more.T @ more)[:, 0].min()
    return float(1 / np.sqrt(max(float(smallest), 1e-12)))


def _best_addition(information: Floats, rows: Floats, wanted: list[int]) -> int:
    """The row not yet wanted that adds most to the determinant, over all sets;
    the first of those that add as much."""
    held = rows[wanted]
    inverse = np.linalg.inv(information + held.T @ held + 1e-9 * np.eye(9))
    gain = np.log1p(np.einsum("ci,kij,cj->kc", rows, inverse, rows)).sum(axis=0)
    gain[wanted] = -np.inf
    return int(np.argmax(gain >= gain.max() - 1e-6))


def _exchanged(information: Floats, rows: Floats, wanted: list[int], enough: float) -> list[int]:
    """As few as do, and of those the ones that lower the dilution most."""
    wanted = list(wanted)
    for i in reversed(range(len(wanted))):
        fewer = wanted[:i] + wanted[i + 1 :]
        if _worst(information, rows[fewer]) <= enough:
            wanted = fewer
    for _ in range(3):
        before = list(wanted)
        for i in range(len(wanted)):
            others = {*wanted[:i], *wanted[i + 1 :]}
            trials = [[*wanted[:i], c, *wanted[i + 1 :]] for c in range(len(rows)) if c not in others]
            values = np.array([_worst(information, rows[t]) for t in trials])
            if values.min() < _worst(information, rows[wanted]) - 1e-6:
                wanted = trials[int(np.argmax(values <= values.min() + 1e-6))]
        if wanted == before:
            break
    return wanted


def distinct(a: Floats, apart_deg: float = 5.0) -> int:
    """How many directions differ from all before them by more than
    ``apart_deg``."""
    kept: list[Floats] = []
    for v in a / np.linalg.norm(a, axis=1, keepdims=True):
        if all(float(v @ k) < np.cos(np.radians(apart_deg)) for k in kept):
            kept.append(v)
    return len(kept)


# Where to point the unit for its biases alone, where scale factors and angles are
# kept.

BIAS_POSES = 3
"""A pose tells one number, |a|: fewer cannot carry three biases."""
BIAS_DILUTION_LIMIT = 5.0
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
BIAS_STARTS = 12
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
    while len(wanted) < BIAS_POSES and (distinct_directions(held) < BIAS_POSES or not determined(held)):
        best = int(np.argmin(_variances(np.array([[*held, v] for v in ups]))))
        wanted.append(candidates[best][0])
        held = np.concatenate([held, ups[best : best + 1]])
    return tuple(wanted)


def bias_dilution(up: Floats) -> float:
    """The largest standard error of any direction of the bias, in standard
    errors of one pose; infinite where the directions (n,3) do not span space."""
    if len(up) < BIAS_POSES:
        return float("inf")
    smallest = float(np.linalg.svd(up, compute_uv=False)[-1])
    return 1 / smallest if smallest > 1e-12 else float("inf")


def determined(up: Floats) -> bool:
    """Whether directions (n,3) determine three biases."""
    return bias_dilution(up) < BIAS_DILUTION_LIMIT


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
    for seed in range(BIAS_STARTS):
        order = np.arange(len(ups)) if seed == 0 else np.random.default_rng(seed).permutation(len(ups))
        best = min(best, _bias_exchanged(ups, order[:count]))
    return best[1]


def _bias_exchanged(ups: Floats, chosen: Ints) -> tuple[float, tuple[int, ...]]:
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
