"""How a unit is mounted on a fixture: one of the 24 right-handed orientations."""

from __future__ import annotations

from contextlib import suppress
from itertools import product
from typing import Final

import numpy as np

import triaxcal as tc

AXES: Final = ("+x", "-x", "+y", "-y", "+z", "-z")
ALIGNED: Final = "+x+y+z"


def rotation(mounting: str) -> tc.Floats:
    """(3,3) matrix from the unit's axes to the fixture's, as ``+x+y+z`` or ``-y+x+z``
    names them: the fixture's axes along which the unit's x, y, and z point.

    Raises ValueError if these are not three axes or the unit would be a mirror
    image.
    """
    axes = [mounting[i : i + 2] for i in range(0, len(mounting), 2)]
    if len(axes) != 3 or not all(axis in AXES for axis in axes):
        raise ValueError("expected three axes of the fixture, each with its sign, as in '+x+y+z'")
    for axis in "xyz":
        if mounting.count(axis) > 1:
            raise ValueError(f"the fixture's {axis} axis is given twice, expected each axis once")
    matrix = np.stack([axis_vector(axis) for axis in axes], axis=1)
    if np.linalg.det(matrix) < 0:
        raise ValueError("a mirror image, no rotation: expected right-handed axes, such as '+x+y+z'")
    return matrix


def axis_vector(axis: str) -> tc.Floats:
    return np.where(np.array(list("xyz")) == axis[1], -1.0 if axis[0] == "-" else 1.0, 0.0)


def _orientations() -> dict[str, tc.Floats]:
    found: dict[str, tc.Floats] = {}
    for axes in product(AXES, repeat=3):
        with suppress(ValueError):
            found["".join(axes)] = rotation("".join(axes)).T
    return found


ORIENTATIONS: Final = _orientations()
"""By name: the axes of the fixture along which the unit's x, y and z point. The matrix
(3,3) takes a vector from the fixture's axes to the unit's."""
