"""Where to point the unit: sets of poses, and what a given set still lacks."""

from __future__ import annotations

import itertools

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.errors import InvalidData

PAPER, FULL = 14, 26


def cube_directions() -> list[tuple[str, Floats]]:
    """Six faces, eight vertices and twelve edges of a cube, in that order, as labels and unit vectors of up."""
    out = []
    for corner in sorted(itertools.product((1, 0, -1), repeat=3), key=_faces_vertices_edges):
        if any(corner):
            label = "".join("+-"[v < 0] + axis for v, axis in zip(corner, "XYZ", strict=True) if v)
            v = np.array(corner, dtype=float)
            out.append((label, v / np.linalg.norm(v)))
    return out


def _faces_vertices_edges(corner: tuple[int, ...]) -> int:
    return {1: 0, 3: 1, 2: 2, 0: 3}[sum(map(abs, corner))]


def directions(count: int = FULL) -> list[tuple[str, Floats]]:
    """A plan of ``count`` poses as labels and unit vectors of up in the unit's frame.

    14 is the paper's (faces and vertices of a cube), 26 adds its edges; any other number of nine or more is spread
    evenly over the sphere on a spiral (golden angle), labelled by number.
    """
    if count in (PAPER, FULL):
        return cube_directions()[:count]
    if count < 9:
        raise InvalidData(f"a plan of {count} poses cannot carry nine parameters; at least 9")
    i = np.arange(count)
    z = 1 - (2 * i + 1) / count
    angle = i * np.pi * (3 - np.sqrt(5))
    r = np.sqrt(1 - z**2)
    points = np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)
    # A spiral runs from pole to pole; taken in strides, direction and time do not go together.
    stride = next(s for s in range(round(count * 0.382), count + 1) if np.gcd(s, count) == 1)
    order = [(k * stride) % count for k in range(count)]
    return [(f"N{k + 1}", points[j]) for k, j in enumerate(order)]


def linear_design(a: Floats, x: Floats) -> Floats:
    """(n,9): derivative of |a| by the nine linear parameters ``a = T x − o``, T upper triangular.

    ``a`` (n,3) unit vectors, ``x`` (n,3) scaled outputs (or ``a`` itself, to judge a plan).
    """
    rows, columns = np.triu_indices(3)
    return np.concatenate([a[:, rows] * x[:, columns], -a], axis=1)


def dilution(a: Floats, design: Floats | None = None) -> float:
    """The worst standard error of any direction of the nine parameters, in standard errors of one pose.

    About 1 for the 14 poses; infinite where the set is singular.
    """
    J = linear_design(a, a) if design is None else design
    if len(J) < 9:
        return float("inf")
    smallest = float(np.linalg.svd(J, compute_uv=False)[-1])
    return 1 / smallest if smallest > 1e-12 else float("inf")


def most_wanted(a: Floats, enough: float = 2.0, most: int = 9) -> list[tuple[str, Floats]]:
    """The poses of the 26 that mend a set best, greedily, until its dilution is below ``enough``.

    ``a`` (n,3): the directions of up that the set has. Empty where nothing is wanted.
    """
    have = a / np.maximum(np.linalg.norm(a, axis=1, keepdims=True), 1e-300)
    information = 1e-9 * np.eye(9)
    J = linear_design(have, have)
    information += J.T @ J
    wanted: list[tuple[str, Floats]] = []
    candidates = cube_directions()
    while len(wanted) < most and 1 / np.sqrt(np.linalg.eigvalsh(information)[0]) > enough:
        rows = [linear_design(v[None], v[None])[0] for _, v in candidates]
        gains = [row @ np.linalg.solve(information, row) for row in rows]
        best = int(np.argmax(gains))
        wanted.append(candidates[best])
        information += np.outer(rows[best], rows[best])
    return wanted


def distinct(a: Floats, apart_deg: float = 5.0) -> int:
    """How many directions differ from all before them by more than ``apart_deg``."""
    kept: list[Floats] = []
    for v in a / np.linalg.norm(a, axis=1, keepdims=True):
        if all(float(v @ k) < np.cos(np.radians(apart_deg)) for k in kept):
            kept.append(v)
    return len(kept)
