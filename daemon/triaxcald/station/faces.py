"""Faces of a fixture: how a unit sits on it, and a direction of up in the words
of its faces, edges and corners."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Final

import numpy as np

import triaxcal as tc
from triaxcald.mounting import AXES, axis_vector

OWN_NAMES: Final[Mapping[str, str]] = {axis: axis.upper() for axis in AXES}
"""Names of faces without a name of their own."""
STEP_DEG = 5.0
"""Tilts are told in steps of so much: nobody turns a fixture by hand any nearer, and a
pose may be off by `COVERED_DEG` of the guidance."""
SAME_BEARING_DEG = 1.0
"""Of two names in the same bearing, to this, the one with fewer faces is told."""


def turned(direction: tc.planning.Direction, matrix: tc.Floats) -> tc.planning.Direction:
    """The direction in other axes, where ``matrix`` (3,3) exchanges axes. A label of
    axes changes with it, and the number of a direction stays."""
    label, v = direction
    other = matrix @ v
    if label.startswith(("+", "-")):
        parts = np.round(other / np.min(np.abs(other)[np.abs(other) > 1e-9])).astype(int)
        label = "".join(
            f"{'-' if n < 0 else '+'}{abs(n) if abs(n) > 1 else ''}{axis}"
            for n, axis in zip(parts, "XYZ", strict=True)
            if n
        )
    return label, other


def described(up: tc.Floats, names: Mapping[str, str] = OWN_NAMES) -> str:
    """The direction of ``up``, a unit vector (3,), by the ``names`` of the faces.

    Of the faces, edges and corners the nearest points up; the rest is a tilt towards
    another of them, of that many degrees.
    """
    faces, ups = _cube()
    nearest = int(np.argmax(np.round(ups @ up, 9)))
    base = f"{_name(faces[nearest], names)} up"
    tilt_deg = _nearby_deg(ups[nearest], up)
    if not tilt_deg:
        return base
    towards = _towards(ups[nearest], up)
    return f"{base}, tilted {tilt_deg:g}° towards {_name(faces[towards], names)}"


def face_up(up: tc.Floats, names: Mapping[str, str] = OWN_NAMES) -> str | None:
    """Name of the face that points up where `described` tells it alone."""
    return next((names[axis] for axis in AXES if _nearby_deg(axis_vector(axis), up) == 0), None)


def _nearby_deg(a: tc.Floats, b: tc.Floats) -> float:
    """Angle between unit vectors in steps of `STEP_DEG`."""
    angle = np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))
    return float(STEP_DEG * np.round(angle / STEP_DEG))


def _towards(here: tc.Floats, up: tc.Floats) -> int:
    """Number of the face, edge or corner in whose bearing ``up`` lies, seen from
    ``here``."""
    faces, ups = _cube()
    cosines = ups @ here
    in_sight = (cosines > -1e-9) & (cosines < 1 - 1e-9)  # at most 90 degrees away
    aside = ups - np.outer(cosines, here)
    aside /= np.maximum(np.linalg.norm(aside, axis=1, keepdims=True), 1e-12)
    way = up - (up @ here) * here
    off_deg = np.degrees(np.arccos(np.clip(aside @ way / np.linalg.norm(way), -1.0, 1.0)))
    off = np.where(in_sight, np.round(off_deg / SAME_BEARING_DEG), np.inf)
    return min(range(len(ups)), key=lambda i: (off[i], len(faces[i]), -cosines[i]))


@cache
def _cube() -> tuple[list[list[str]], tc.Floats]:
    """Axes (one to three) of the 26 faces, edges and corners, and their directions
    (26,3)."""
    ups = np.array([v for _, v in tc.planning.cube_directions()])
    faces = [[f"{'-' if c < 0 else '+'}{axis}" for c, axis in zip(v, "xyz", strict=True) if c] for v in ups]
    return faces, ups


def _name(axes: list[str], names: Mapping[str, str]) -> str:
    kind = ("", "edge ", "corner ")[len(axes) - 1]
    return kind + "/".join(names[axis] for axis in axes)
