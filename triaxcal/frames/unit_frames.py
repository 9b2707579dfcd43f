"""The frame of a unit's mounting faces, from poses on the faces of a fixture; the
ellipsoid does not determine it.

Each unit gives the inward normals of the faces it stood on, in its sensor's frame
(`triaxcal.frames.standing`). The fixture's faces are the same for all its units, so
all normals together give the faces, up to a common rotation, and each unit's rotation
against them. That last rotation is a convention, the datum: which three of the
fixture's errors are zero. `Fixture` holds these errors, and those that do
not depend on the frame."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from triaxcal.arrays import Floats
from triaxcal.distributions import chi2_sf, t_ppf
from triaxcal.errors import InvalidData, Refused
from triaxcal.estimate.calibration import Caution
from triaxcal.frames.faces import LABELS, axis_of, nearest_rotation, opposite
from triaxcal.frames.orientations import LARGE_RAD
from triaxcal.frames.standing import Standing, basis_of
from triaxcal.poses.degrees_of_freedom import LACK_OF_FIT

# Errors of a fixture's faces, and those that do not depend on the frame.


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


ROUNDS = 8
"""Gauss–Newton steps over small rotations, always all of them: enough for large
angles, at little cost."""
SINGULAR = 0.05
"""Faces that connect units give singular values near 1; others give those of the
faces' own errors."""


@dataclass(frozen=True)
class Datum:
    """The definition of the body's frame. ``faces``: none for the least-squares
    frame, else primary and secondary face.

    Faces are named by their outward normal: ``-Z`` is the one on which the fixture
    stands with +Z up. The least-squares frame minimises the sum of the squared errors
    of the existing faces, with equal weights. With faces, the primary's normal is the
    axis of its name, and the secondary's lies in the plane of the two.
    """

    faces: tuple[str, str] | None = None

    def __post_init__(self) -> None:
        if self.faces is None:
            return
        primary, secondary = self.faces
        if not {primary, secondary} <= set(LABELS) or primary[1] == secondary[1]:
            raise InvalidData(f"a datum is two faces at right angles, as -Z,-X, not {primary},{secondary}")

    @property
    def name(self) -> str:
        return "least_squares" if self.faces is None else ",".join(self.faces)


@dataclass(frozen=True)
class UnitFrame:
    """``rotation`` (3,3) takes vectors of the sensor's frame to the body's.

    ``covariance`` (3,3) rad² is that of a small rotation about the body's axes;
    ``dof`` (3,) the effective degrees of freedom of its diagonal.
    """

    standing: Standing
    rotation: Floats
    covariance: Floats
    dof: Floats

    @property
    def rotation_vector(self) -> Floats:
        """(3,) rad."""
        return np.asarray(Rotation.from_matrix(self.rotation).as_rotvec())

    @property
    def standard_error(self) -> Floats:
        """(3,) rad, about the body's axes."""
        return np.sqrt(np.diag(self.covariance))

    def coverage_factor(self, level: float = 0.95) -> Floats:
        """(3,): Student's t for ``dof``."""
        return np.asarray(t_ppf((1 + level) / 2, self.dof))


@dataclass(frozen=True)
class UnitsDisagree(Caution):
    """The units disagree on the fixture's faces, by ``ratio`` times what noise and
    seating explain (probability ``p``)."""

    ratio: float
    p: float


@dataclass(frozen=True)
class FacesMissing(Caution):
    """No unit stood with these ``faces`` up; the least-squares frame is that of the
    others."""

    faces: tuple[str, ...]


@dataclass(frozen=True)
class FaceFarOff(Caution):
    """A face is ``angle_rad`` off its axis."""

    angle_rad: float


@dataclass(frozen=True)
class Frames:
    """``units`` in the order given, in one frame. ``covariance`` (3u,3u) of all their
    rotations.

    ``chi2`` in ``left`` degrees of freedom measures the disagreement of the units on
    the faces; ``birge_ratio`` ≥ 1 is the factor on the standard errors for it.
    """

    datum: Datum
    units: tuple[UnitFrame, ...]
    fixture: Fixture
    covariance: Floats
    chi2: float
    left: int
    birge_ratio: float
    cautions: tuple[Caution, ...]

    @property
    def lack_of_fit_p(self) -> float | None:
        return float(chi2_sf(self.chi2, self.left)) if self.left else None

    @property
    def agree(self) -> bool | None:
        """Whether the units stood on one fixture; None where they have too few faces
        for a test."""
        return self.birge_ratio == 1 if self.left else None

    def between(self, i: int, j: int) -> tuple[Floats, Floats]:
        """Rotation vector (3,) rad from the sensor's frame of unit i to that of
        j, and its covariance (3,3).

        The covariance is of a small rotation about the body's axes.
        """
        turn = Rotation.from_matrix(self.units[j].rotation.T @ self.units[i].rotation).as_rotvec()
        a, b = slice(3 * i, 3 * i + 3), slice(3 * j, 3 * j + 3)
        V = self.covariance
        return np.asarray(turn), V[a, a] + V[b, b] - V[a, b] - V[b, a]


def frames(standings: Sequence[Standing], *, datum: Datum | None = None) -> Frames:
    """One frame for units that stood on the faces of one fixture.

    Raises InvalidData without a unit, Refused where the faces do not connect the
    units or the datum's are not among them.
    """
    if not standings:
        raise InvalidData("no unit")
    datum = datum or Datum()
    faces = tuple(label for label in LABELS if any(label in s.faces for s in standings))
    _datum_is_there(datum, faces)
    # Least squares over rotations and normals; chi-square of the redundancy.
    joint = _Joint(standings, faces, datum).connected().solved()
    n = 3 * len(standings)
    left = sum(2 * len(s.faces) for s in standings) - n - 2 * len(faces) + 3
    p = float(chi2_sf(joint.chi2, left)) if left else 1.0
    # Birge ratio where the units disagree significantly.
    birge_ratio = float(np.sqrt(joint.chi2 / left)) if p < LACK_OF_FIT else 1.0
    covariance = joint.covariance * birge_ratio**2
    dofs = _dof(joint, standings) if birge_ratio == 1 else [np.full(3, float(left))] * len(standings)
    found = tuple(
        UnitFrame(s, joint.rotations[i], covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3], dofs[i])
        for i, s in enumerate(standings)
    )
    fixture = fixture_of(faces, joint.up, covariance[n:, n:], joint.axes, joint.constraints()[0])
    cautions = [*_cautions(fixture, datum), *([UnitsDisagree(birge_ratio, p)] if birge_ratio > 1 else [])]
    return Frames(datum, found, fixture, covariance[:n, :n], joint.chi2, left, birge_ratio, tuple(cautions))


def _datum_is_there(datum: Datum, faces: Sequence[str]) -> None:
    lost = [face for face in datum.faces or () if opposite(face) not in faces]
    if lost:
        raise Refused(
            f"no unit stood on the face {', '.join(lost)}, which the datum needs", wanted=[opposite(f) for f in lost]
        )


@dataclass
class _Joint:
    """Least-squares rotations of the units and normals of the faces from all observed
    normals, under the datum.

    Unknowns of a step: a small rotation about the body's axes for each unit (3u,),
    shifts of the normals in two axes each (2f,). The three constraints of the datum
    fix the common rotation, which is not observable.
    """

    standings: Sequence[Standing]
    faces: tuple[str, ...]
    datum: Datum

    def __post_init__(self) -> None:
        self.nominal = np.array([axis_of(label) for label in self.faces])
        self.up = self.nominal.copy()
        self.rotations = [
            nearest_rotation(s.up, np.array([axis_of(label) for label in s.faces])) for s in self.standings
        ]

    def connected(self) -> _Joint:
        """Itself; raises Refused where the common faces leave units free to rotate
        against each other."""
        n = 3 * len(self.standings)
        self._prepare()
        G = np.concatenate([np.zeros((3, n)), self.constraints()[0]], axis=1)
        rows = np.concatenate([*(self._observed(i, s)[0] for i, s in enumerate(self.standings)), G])
        if np.linalg.matrix_rank(rows, tol=SINGULAR) < rows.shape[1]:
            raise Refused(
                "the units stood on faces that do not connect them: any two at right angles that one has in common "
                "with the others would",
                wanted=[label for label in LABELS if not all(label in s.faces for s in self.standings)],
            )
        return self

    def solved(self) -> _Joint:
        # Apply the small rotations and shifts; renormalise the normals.
        for _ in range(ROUNDS):
            step = self._step()
            for i in range(len(self.standings)):
                turn = Rotation.from_rotvec(step[3 * i : 3 * i + 3]).as_matrix()
                self.rotations[i] = turn @ self.rotations[i]
            shift = step[3 * len(self.standings) :].reshape(-1, 2)
            self.up = self.up + np.einsum("kij,kj->ki", self.axes, shift)
            self.up /= np.linalg.norm(self.up, axis=1, keepdims=True)
        self._step()
        return self

    def _prepare(self) -> None:
        self.axes = np.array([basis_of(label, self.up[k], np.eye(3)) for k, label in enumerate(self.faces)])

    def _step(self) -> Floats:
        self._prepare()
        n, m = 3 * len(self.standings), 2 * len(self.faces)
        # Normal equations of all units.
        information, right = np.zeros((n + m, n + m)), np.zeros(n + m)
        self.chi2 = 0.0
        self.gains = []
        for i, standing in enumerate(self.standings):
            J, y, V = self._observed(i, standing)
            weight = np.linalg.inv(V)
            information += J.T @ weight @ J
            right += J.T @ weight @ y
            self.chi2 += float(y @ weight @ y)
            self.gains.append(J.T @ weight)
        # Bordered system with the datum's constraints (Lagrange multipliers).
        G, miss = self.constraints()
        G = np.concatenate([np.zeros((3, n)), G], axis=1)
        scale = float(np.trace(information)) / (n + m)
        bordered = np.block([[information / scale, G.T], [G, np.zeros((3, 3))]])
        inverse = np.linalg.inv(bordered)
        self.covariance = inverse[: n + m, : n + m] / scale
        self.gains = [self.covariance @ gain for gain in self.gains]
        step: Floats = self.covariance @ right + inverse[: n + m, n + m :] @ -miss
        return step

    def _observed(self, i: int, standing: Standing) -> tuple[Floats, Floats, Floats]:
        """Derivatives (2k, 3u+2f), residuals (2k,) and their covariance for one
        unit's normals, in the body's axes."""
        n = 3 * len(self.standings)
        k = len(standing.faces)
        J, y, turn = np.zeros((2 * k, n + 2 * len(self.faces))), np.zeros(2 * k), np.zeros((2 * k, 2 * k))
        for row, label in enumerate(standing.faces):
            face = self.faces.index(label)
            # Residual of the rotated normal in the tangent plane of the face; d(R n) =
            # ω × R n.
            T, seen = self.axes[face], self.rotations[i] @ standing.up[row]
            at = slice(2 * row, 2 * row + 2)
            y[at] = -(T.T @ seen)
            J[at, 3 * i : 3 * i + 3] = -T.T @ np.cross(seen, np.eye(3), axisb=0).T
            J[at, n + 2 * face : n + 2 * face + 2] = -np.eye(2)
            turn[at, at] = T.T @ self.rotations[i] @ standing.basis[row]
        return J, y, turn @ standing.covariance @ turn.T

    def constraints(self) -> tuple[Floats, Floats]:
        """(3,2f) derivatives, and residuals (3,), of the datum's constraints."""
        G = np.zeros((3, 2 * len(self.faces)))
        if self.datum.faces is None:
            for k in range(len(self.faces)):
                G[:, 2 * k : 2 * k + 2] = np.cross(self.nominal[k], self.axes[k], axisb=0).T
            return G, np.sum(np.cross(self.nominal, self.up), axis=0)
        first, second = (self.faces.index(opposite(face)) for face in self.datum.faces)
        rows = [*(np.delete(np.eye(3), np.argmax(np.abs(self.nominal[first])), axis=0))]
        third = np.cross(self.nominal[first], self.nominal[second])
        for row, v in enumerate(rows):
            G[row, 2 * first : 2 * first + 2] = v @ self.axes[first]
        G[2, 2 * second : 2 * second + 2] = third @ self.axes[second]
        return G, np.array([*(v @ self.up[first] for v in rows), third @ self.up[second]])


def _dof(joint: _Joint, standings: Sequence[Standing]) -> list[Floats]:
    """(3,) for each unit by the Welch–Satterthwaite formula (JCGM 100, G.4.1)."""
    out: list[Floats] = []
    for i in range(len(standings)):
        whole = np.diag(joint.covariance)[3 * i : 3 * i + 3]
        parts = np.zeros(3)
        for standing, gain in zip(standings, joint.gains, strict=True):
            rows = gain[3 * i : 3 * i + 3]
            seated = np.diag(rows @ standing.seating_part @ rows.T)
            other = np.diag(rows @ standing.covariance @ rows.T) - seated
            parts += np.maximum(other, 0.0) ** 2 / standing.dof
            if standing.seating_dof:
                parts += seated**2 / standing.seating_dof
        out.append(np.asarray(np.clip(whole**2 / np.maximum(parts, 1e-300), 1.0, 1e9)))
    return out


def _cautions(fixture: Fixture, datum: Datum) -> Iterator[Caution]:
    missing = tuple(label for label in LABELS if label not in fixture.faces)
    if missing and datum.faces is None:
        yield FacesMissing(missing)
    worst = float(np.abs(fixture.error).max())
    if worst > LARGE_RAD:
        yield FaceFarOff(worst)
