"""Errors of a fixture's faces, and those that do not depend on the frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.errors import InvalidData
from triaxcal.frames.faces import LABELS, axis_of


@dataclass(frozen=True)
class Quantity:
    value: float
    standard_error: float


@dataclass(frozen=True)
class Fixture:
    """Faces by the label of the side that is up. ``up`` (f,3) their inward normals in
    the body's frame.

    ``error`` (f,3) rad: deviations of the normals from the axes, along the body's
    axes; ``covariance`` (3f,3f) of all. ``squareness`` by pair of axes (XY, YZ, ZX):
    deviation of the mean normals from a right angle, positive for a smaller angle.
    ``parallelism`` by axis: half of the deviation of its two faces, as the mean of
    both inward normals, along the two other axes in cyclic order. Neither depends on
    the datum. ``offset`` (3,) rad: standard error, about the body's axes, of the
    datum against the frame to which faces with independent errors of this size were
    made; None where that size is not known.
    """

    faces: tuple[str, ...]
    up: Floats
    error: Floats
    covariance: Floats
    squareness: dict[str, Quantity]
    parallelism: dict[str, tuple[Quantity, Quantity]]
    offset: Floats | None

    @property
    def standard_error(self) -> Floats:
        """(f,3) rad."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0)).reshape(-1, 3)


def fixture_of(faces: tuple[str, ...], up: Floats, covariance: Floats, axes: Floats, datum: Floats) -> Fixture:
    """The fixture with ``covariance`` (2f,2f) of the normals in ``axes`` (f,3,2);
    ``datum`` (3,2f) are the combinations of their errors that it sets to zero."""
    nominal = np.array([axis_of(label) for label in faces])
    spread = np.zeros((3 * len(faces), 2 * len(faces)))
    for k in range(len(faces)):
        # What a normal loses along its own axis is of second order, and no
        # error of the face.
        spread[3 * k : 3 * k + 3, 2 * k : 2 * k + 2] = axes[k] - np.outer(nominal[k], nominal[k] @ axes[k])
    # Deviation of each normal across its own axis.
    error = up - nominal * np.sum(nominal * up, axis=1, keepdims=True)
    V = spread @ covariance @ spread.T
    flat = error.ravel()

    def quantity(weight: Floats) -> Quantity:
        return Quantity(float(weight @ flat), float(np.sqrt(max(float(weight @ V @ weight), 0.0))))

    def component(label: str, axis: int) -> Floats:
        weight = np.zeros(len(flat))
        weight[3 * faces.index(label) + axis] = 1.0
        return weight

    both = [a for a in range(3) if f"+{'XYZ'[a]}" in faces and f"-{'XYZ'[a]}" in faces]
    mean, half = {}, {}
    for a in range(3):
        here = [label for label in faces if label[1] == "XYZ"[a]]
        for b in range(3):
            if here and a != b:
                # The mean normal of an axis, the face of the minus side turned
                # round.
                mean[a, b] = np.sum([component(x, b) * axis_of(x)[a] for x in here], axis=0) / len(here)
            if a in both and a != b:
                half[a, b] = np.sum([component(x, b) for x in here], axis=0) / 2
    # Squareness and parallelism as linear combinations of the errors.
    squareness = {
        "XYZ"[a] + "XYZ"[b]: quantity(mean[a, b] + mean[b, a])
        for a, b in ((0, 1), (1, 2), (2, 0))
        if (a, b) in mean and (b, a) in mean
    }
    parallelism = {"XYZ"[a]: (quantity(half[a, (a + 1) % 3]), quantity(half[a, (a + 2) % 3])) for a in both}
    return Fixture(faces, up, error, V, squareness, parallelism, _offset(nominal, axes, error, V, datum))


def _offset(nominal: Floats, axes: Floats, error: Floats, V: Floats, datum: Floats) -> Floats | None:
    left = 2 * len(nominal) - 3
    if left < 1:
        return None
    turns = np.cross(np.eye(3), nominal[:, None]).transpose(0, 2, 1)  # (f,3,3) errors by a rotation of all faces
    B = turns.reshape(-1, 3)
    shape = np.eye(len(B)) - B @ np.linalg.pinv(B)  # errors as the least-squares frame has them, whatever the datum
    rest = shape @ error.ravel()
    variance = max(float(rest @ rest) - float(np.trace(shape @ V @ shape)), 0.0) / left
    # Rotation of the datum by the errors that it sets to zero.
    across = (axes.transpose(0, 2, 1) @ turns).reshape(-1, 3)
    turned = np.linalg.solve(datum @ across, datum)
    return np.asarray(np.sqrt(variance * np.sum(turned**2, axis=1)))


# A fixture whose truth is known: faces that are not square, on a table that is not
# level.


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
        """Normals with Gaussian errors of ``face_error`` rad about each axis, and a
        table tilted by exactly ``tilt`` rad."""
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
    """(3,3): columns ``along``, made perpendicular to ``normal``, normal × that, and
    ``normal``."""
    x = along - (along @ normal) * normal
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(normal, x), normal], axis=1)
