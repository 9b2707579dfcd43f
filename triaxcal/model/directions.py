"""Directions for the unit: sets of poses for a full calibration or for its biases
alone, and the missing poses of a given set.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import cache

import numpy as np

from triaxcal.arrays import Floats, Ints
from triaxcal.errors import InvalidData
from triaxcal.model.sensor import LINEAR

# The order of the poses, which separates effects of time from effects of direction.

PRIOR = np.repeat([10.0, 1.0, 10.0, 0.3, 0.3, 0.3], 3)
"""Prior standard deviations, in standard errors of one pose: of second order, third
order, steady drift, quadratic drift, drift of the scale factors, and hysteresis.
Second order and steady drift have wide priors: in real recordings one imitates the
other, so the order must separate them first."""
STARTS, ROWS_MOST, STEPS_MOST = 4, 12000, 80
"""Number of searches from different orders (one for a large plan); rows of trial orders
in one step of a search; steps of a search."""
SURE = 1e-9
"""Criteria that differ by less than this are equal: the last digits depend on the
processor."""


def in_order(a: Floats, *, attached: Floats | None = None, kind: Ints | None = None) -> Ints:
    """The order (n,) of the rows of ``a`` (n,3). The first row comes first, and again
    at the end.

    ``attached`` (n,q) has columns of target effects, which go with their row. Rows
    change places only with rows of the same ``kind`` (n,). The result is
    deterministic.
    """
    n = len(a)
    kind = np.zeros(n, dtype=int) if kind is None else kind
    first, second = np.triu_indices(n - 1, 1)
    pairs = np.stack([first, second], axis=1) + 1
    pairs = pairs[kind[pairs[:, 0]] == kind[pairs[:, 1]]]
    # Descents from several random orders; the best of them.
    best: tuple[float, Ints] = (np.inf, np.arange(n))
    for seed in range(STARTS if len(pairs) <= ROWS_MOST // n else 1) if len(pairs) else ():
        rng = np.random.default_rng(seed)
        order = _shuffled(kind, rng)
        found = _descended(a, attached, order, pairs, rng)
        if found[0] < best[0] - SURE:
            best = found
    return best[1]


def _shuffled(kind: Ints, rng: np.random.Generator) -> Ints:
    """A random order (n,) of the rows within their kinds, the first row in place."""
    order = np.arange(len(kind))
    for k in np.unique(kind):
        places = np.flatnonzero(kind == k)
        places = places[places > 0]
        order[places] = rng.permutation(places)
    return order


def _descended(
    a: Floats, attached: Floats | None, order: Ints, pairs: Ints, rng: np.random.Generator
) -> tuple[float, Ints]:
    """The criterion and the order after swaps of two rows, until none improves it. A
    large plan has a sample of the swaps, for a limited number of steps."""
    n = len(order)
    most = max(ROWS_MOST // n, 8)
    least = float(_criterion(a, attached, order[None])[0])
    for _ in range(STEPS_MOST if n < 200 else STEPS_MOST // 4):
        # Every tried swap as a row of its own.
        tried = pairs if len(pairs) <= most else rng.permutation(pairs)[:most]
        trials = np.tile(order, (len(tried), 1))
        each = np.arange(len(tried))
        trials[each, tried[:, 0]], trials[each, tried[:, 1]] = order[tried[:, 1]], order[tried[:, 0]]
        # The best swap, while it improves the order.
        values = _criterion(a, attached, trials)
        at = int(np.argmax(values <= values.min() + SURE))
        if values[at] < least - SURE:
            least, order = float(values[at]), trials[at]
        elif len(pairs) <= most:
            break
    return least, order


def _criterion(a: Floats, attached: Floats | None, orders: Ints) -> Floats:
    """(m,) sum of the variances of the effects for orders (m,n), with the first pose
    repeated at the end."""
    closed = np.concatenate([orders, orders[:, :1]], axis=1)
    b = a[closed]
    time = np.linspace(-1, 1, closed.shape[1])[:, None]
    before = np.concatenate([b[:, :1], b[:, :-1]], axis=1)
    # The linear parameters, the target effects, and the suspected ones with a prior.
    linear = [b[..., :1] * b, b[..., 1:2] * b[..., 1:], b[..., 2:] ** 2, b]
    targets = [] if attached is None else [attached[closed]]
    suspected = [b**3, b**4, time * b, time**2 * b, time * b**2, before * b]
    X = np.concatenate([*linear, *targets, *suspected], axis=2)
    precision = np.zeros(X.shape[2])
    precision[-len(PRIOR) :] = 1 / PRIOR**2
    information = np.swapaxes(X, 1, 2) @ X + np.diag(precision)
    variance = np.diagonal(np.linalg.inv(information), axis1=1, axis2=2)
    return np.asarray(variance[:, 9:].sum(axis=1))


PAPER, FULL = 14, 26
"""Faces and vertices of a cube, as in the paper; and with its edges, which make effects
of second and third order observable together."""
LEAST = LINEAR
"""A pose gives one number, |a|: fewer do not determine nine parameters."""
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
    """A plan of ``count`` distinct poses in their order. The first comes again at the
    end.

    14 is the paper's plan (faces and vertices of a cube), 26 adds the edges. Any other
    number from nine on is spread evenly over the sphere on a spiral (golden angle),
    labelled by number. The order separates drift from the other effects (`in_order`).
    Raises InvalidData for fewer than nine.
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
    """``count`` directions far from those ``taken`` (n,3) and from each other, the
    farthest first.

    Labels are in parts of the axes: "+2X-Y" is two parts X to one of minus Y. There are
    98 directions, and a larger ``count`` gives no more.
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
    """The plan with its first pose repeated at the end: the two differ by time
    alone."""
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
    """The dilution of precision: the largest standard error of any combination of the
    nine parameters, in standard errors of one pose. Each parameter is scaled by the
    range of its axis (`in_range`).

    All poses have equal noise, as is usual for a dilution. ``design`` is
    `linear_design` of the outputs in their range, if known; without it the triad
    counts as ideal. The value is about 1 for the 14 poses, and infinite for a singular
    set.
    """
    if design is None and not len(a):
        return float("inf")
    return worst_error(linear_design(a, in_range(a)) if design is None else design)


def worst_error(design: Floats) -> float:
    """The largest standard error of any combination of the nine parameters, in standard
    errors of the rows (n,9).

    With `linear_design` (a, a) the parameters are scaled to the whole reference,
    independent of the poses, so a further pose never increases the value. It is
    infinite for a singular design.
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
    """The poses of the 26 that improve a set most, each once, until its dilution is
    below ``enough``; at most ``most``.

    ``a`` (n,3) has the set's directions of up. With an uncertainty ``unsure_rad`` of
    the directions, the dilution is the worst of some sets with errors of that size.
    ``weights`` (n,) are 1/variance; an added pose has 1. The result is empty if the
    set is complete.
    """
    have = a / np.maximum(np.linalg.norm(a, axis=1, keepdims=True), 1e-300)
    root = np.ones(len(a)) if weights is None else np.sqrt(weights)
    sets = [linear_design(v, v) * root[:, None] for v in _possible(have, unsure_rad)]
    candidates = cube_directions()
    ups = np.array([v for _, v in candidates])
    rows = linear_design(ups, ups)
    information = np.array([J.T @ J for J in sets])
    # Add the best pose until the dilution suffices, then exchange.
    wanted: list[int] = []
    while len(wanted) < min(most, len(rows)) and _worst(information, rows[wanted]) > enough:
        wanted.append(_best_addition(information, rows, wanted))
    wanted = _exchanged(information, rows, wanted, enough)
    return [candidates[i] for i in wanted]


def _possible(have: Floats, unsure_rad: float) -> list[Floats]:
    """The measured directions and, if uncertain, some possible sets."""
    rng = np.random.default_rng(0)
    out = [have]
    for _ in range(8 if unsure_rad and len(have) else 0):
        # Errors of scale and offset: all directions share them, and they matter most.
        matrix = np.eye(3) + unsure_rad * rng.standard_normal((3, 3))
        off = have @ matrix.T + unsure_rad * rng.standard_normal(3)
        out.append(off / np.linalg.norm(off, axis=1, keepdims=True))
    return out


def _worst(information: Floats, more: Floats) -> float:
    """Dilution of the worst of the sets (k,9,9) with further rows (m,9)."""
    smallest = np.linalg.eigvalsh(information + more.T @ more)[:, 0].min()
    return float(1 / np.sqrt(max(float(smallest), 1e-12)))


def _best_addition(information: Floats, rows: Floats, wanted: list[int]) -> int:
    """The further row that increases the determinant most, over all sets; the first of
    equal ones."""
    chosen = rows[wanted]
    inverse = np.linalg.inv(information + chosen.T @ chosen + 1e-9 * np.eye(9))
    gain = np.log1p(np.einsum("ci,kij,cj->kc", rows, inverse, rows)).sum(axis=0)
    gain[wanted] = -np.inf
    return int(np.argmax(gain >= gain.max() - 1e-6))


def _exchanged(information: Floats, rows: Floats, wanted: list[int], enough: float) -> list[int]:
    """The fewest rows that suffice, and of these the ones with the lowest dilution."""
    wanted = list(wanted)
    # Drop rows that are not needed, the last first.
    for i in reversed(range(len(wanted))):
        fewer = wanted[:i] + wanted[i + 1 :]
        if _worst(information, rows[fewer]) <= enough:
            wanted = fewer
    # Exchange one row for another while that lowers the dilution.
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
    """The number of directions that differ from all before them by more than
    ``apart_deg``."""
    kept: list[Floats] = []
    for v in a / np.linalg.norm(a, axis=1, keepdims=True):
        if all(float(v @ k) < np.cos(np.radians(apart_deg)) for k in kept):
            kept.append(v)
    return len(kept)


# Directions for the biases alone; scale factors and angles are kept.

BIAS_POSES = 3
"""A pose gives one number, |a|: fewer do not determine three biases."""
BIAS_DILUTION_LIMIT = 5.0
"""Limit of the biases' dilution. Above it some combination of them is so many times as
uncertain as a pose; with scale factors that change by 200 ppm, which act like noise of
a pose, it is half as uncertain as without any pose."""
APART_DEG = 10.0
"""Poses nearer to each other count as one. A station has the same default."""
FAR_APART_DEG = 45.0
"""Two poses nearer to each other share more than half of their information on the
biases (the square of the cosine)."""
SCALE_FACTOR, ANGLE, BIAS = 2.0, 0.3, 20.0
"""Prior standard deviations of the parameters, in errors of a pose of 100 µg: scale
factors change by 200 ppm and biases by 2 mg from start to start (MIMU4444). The design
hardly depends on them."""
BIAS_STARTS = 12
"""Number of initial sets of the exchange. For all counts up to six one of them ends
with the best set, by comparison with all sets."""


def bias_directions(count: int) -> list[Direction]:
    """``count`` directions of up that determine the biases best: from the 26 of the
    cube, and `directions` for more.

    The plan is A-optimal: it has the least sum of the biases' variances, with small
    changes of the scale factors. Four directions are the corners of a tetrahedron: a
    change of any scale factor makes the same error in all four, and so none in the
    biases. Six are the faces.
    """
    if count > len(cube_directions()):
        return directions(count)
    return [cube_directions()[i] for i in _best(count)]


def wanted_for_biases(have: Floats) -> tuple[str, ...]:
    """Labels of the fewest further poses that determine the biases, the best first.
    ``have`` (n,3) has the directions of up of the set."""
    candidates = cube_directions()
    ups = np.array([v for _, v in candidates])
    up = have  # the set's directions and those of the wanted poses
    wanted: list[str] = []
    while len(wanted) < BIAS_POSES and (distinct_directions(up) < BIAS_POSES or not determined(up)):
        best = int(np.argmin(_variances(np.array([[*up, v] for v in ups]))))
        wanted.append(candidates[best][0])
        up = np.concatenate([up, ups[best : best + 1]])
    return tuple(wanted)


def bias_dilution(up: Floats) -> float:
    """The largest standard error of any combination of the biases, in standard errors
    of one pose; infinite if the directions (n,3) do not span space."""
    if len(up) < BIAS_POSES:
        return float("inf")
    smallest = float(np.linalg.svd(up, compute_uv=False)[-1])
    return 1 / smallest if smallest > 1e-12 else float("inf")


def determined(up: Floats) -> bool:
    """Whether directions (n,3) determine three biases."""
    return bias_dilution(up) < BIAS_DILUTION_LIMIT


def distinct_directions(up: Floats) -> int:
    """The number of directions (n,3) that are `APART_DEG` apart."""
    return distinct(up, APART_DEG) if len(up) else 0


def first_distinct(up: Floats, count: int) -> list[int]:
    """Rows of the first ``count`` directions (n,3) that are `FAR_APART_DEG` from all
    before them, or `APART_DEG` if there are fewer."""
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
    """The best set of ``count`` cube directions over all initial sets."""
    ups = np.array([v for _, v in cube_directions()])
    best: tuple[float, tuple[int, ...]] = (np.inf, ())
    for seed in range(BIAS_STARTS):
        order = np.arange(len(ups)) if seed == 0 else np.random.default_rng(seed).permutation(len(ups))
        best = min(best, _bias_exchanged(ups, order[:count]))
    return best[1]


def _bias_exchanged(ups: Floats, chosen: Ints) -> tuple[float, tuple[int, ...]]:
    """The criterion and the set after exchanges of one direction, until none
    improves it."""
    kept = sorted(map(int, chosen))
    least = float(_variances(ups[None, kept])[0])
    while True:
        others = [k for k in range(len(ups)) if k not in kept]
        trials = np.array([sorted([*kept[:i], k, *kept[i + 1 :]]) for i in range(len(kept)) for k in others], dtype=int)
        values = _variances(ups[trials]) if len(trials) else np.array([np.inf])
        at = int(np.argmin(values))
        if not values[at] < least:
            return least, tuple(kept)
        kept, least = trials[at].tolist(), float(values[at])
