"""A fixture whose truth is known: faces that are not square, on a table that is
not level."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.errors import InvalidData
from triaxcal.frames.faces import LABELS, axis_of


@dataclass(frozen=True)
class SyntheticFixture:
    """``inward`` normals by label of the side that is up, unit vectors (3,) in
    the body's frame.

    ``table`` (3,): the table's normal in the world, z up, a unit vector.
    """

    inward: Mapping[str, Floats]
    table: Floats

    @classmethod
    def drawn(cls, rng: np.random.Generator, face_error: float = 1e-3, tilt: float = 1e-3) -> SyntheticFixture:
        """Normals off by Gaussian angles of ``face_error`` rad about each axis,
        a table tilted by exactly ``tilt``."""
        inward = {}
        for label in LABELS:
            v = axis_of(label) + np.cross(rng.normal(0.0, face_error, 3), axis_of(label))
            inward[label] = v / np.linalg.norm(v)
        azimuth = rng.uniform(0, 2 * np.pi)
        table = np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)])
        return cls(inward, table)

    def up(self, label: str, heading: float = 0.0) -> Floats:
        """(3,) up in the body's frame where ``label`` is up and the fixture is
        turned by ``heading`` rad.

        Heading counts about the table's normal, counter-clockwise from above,
        from the table's own x axis (the world's, laid into the table) to the
        body's next axis (y for x up, z for y, x for z).
        """
        if label not in self.inward:
            raise InvalidData(f"no face {label}")
        body = _axes(self.inward[label], np.eye(3)[("XYZ".index(label[1]) + 1) % 3])
        table = _axes(self.table, np.array([1.0, 0.0, 0.0]))
        c, s = np.cos(heading), np.sin(heading)
        attitude = table @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ body.T
        return np.asarray(attitude.T @ np.array([0.0, 0.0, 1.0]))

    def ups(self, poses: Sequence[tuple[str, float]]) -> Floats:
        """(n,3) for labels and headings."""
        return np.array([self.up(label, heading) for label, heading in poses])


def _axes(normal: Floats, along: Floats) -> Floats:
    """(3,3): columns along ``along`` laid square to ``normal``, normal × that,
    and ``normal``."""
    x = along - (along @ normal) * normal
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(normal, x), normal], axis=1)
