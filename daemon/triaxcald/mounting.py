"""How a unit is mounted on a fixture: one of the 24 right-handed orientations."""

from __future__ import annotations

from itertools import permutations, product

import numpy as np

import triaxcal as tc


def _orientations() -> dict[str, tc.Floats]:
    found: dict[str, tc.Floats] = {}
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        rows = np.zeros((3, 3))
        rows[range(3), order] = signs
        if np.linalg.det(rows) > 0:
            name = "".join(f"{'+' if s > 0 else '-'}{'xyz'[i]}" for i, s in zip(order, signs, strict=True))
            found[name] = rows
    return found


ORIENTATIONS = _orientations()
"""By name: the axes of the fixture along which the unit's x, y and z point. The matrix
(3,3) takes a vector from the fixture's axes to the unit's."""
ALIGNED = "+x+y+z"
