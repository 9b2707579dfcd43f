"""A unit on the faces of its fixture, on a table that is not level: directions of the
faces and tilt of the table.

A fixture on face k at heading ψ has up at ``cos τ m + B d`` in its own frame: m the
inward normal of that face, B (3,2) two axes perpendicular to it, d (2,) the tilt of
the table in the fixture's axes, |d| = sin τ. Half a turn about the normal changes d
into −d and leaves m: the sum of two such poses is along m for any tilt. With one
orientation only, d is not distinguished from m.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from triaxcal.arrays import Floats
from triaxcal.distributions import chi2_sf
from triaxcal.estimate.calibration import Caution
from triaxcal.frames.faces import Labelling, axis_of
from triaxcal.frames.orientations import (
    FLOOR_RAD,
    LARGE_RAD,
    SHOWS,
    Assumed,
    Face,
    Verticals,
    felt,
    tilt_of_others,
    turned,
)
from triaxcal.poses.degrees_of_freedom import SIGNIFICANT

ROUNDS = 6
"""How often the axes follow the normals, so that no angle is taken for small;
two do from where a former solution ended. More cost time alone."""


@dataclass(frozen=True)
class FaceTilt:
    """The table's tilt on one face. ``tilt`` (2,) rad in the face's axes, in the
    orientation recorded first.

    ``poses`` are indices; ``resolved`` where the orientations on this face separate
    the tilt from the face's direction.
    """

    label: str
    poses: tuple[int, ...]
    tilt: Floats
    covariance: Floats
    resolved: bool

    @property
    def magnitude(self) -> float:
        return float(np.linalg.norm(self.tilt))

    @property
    def standard_error(self) -> float:
        """Standard error of the magnitude, where this exceeds the noise."""
        along = self.tilt / max(self.magnitude, 1e-300)
        return float(np.sqrt(max(float(along @ self.covariance @ along), 0.0)))


@dataclass(frozen=True)
class Table:
    """``tilt`` of the table from level, rad, and its standard error; None where
    nothing shows it.

    ``source``: ``measured``, or ``given`` by the user. ``shows`` where it is
    more than noise; ``p_value`` of the differences between faces, and between
    repeated poses, if there were only the noise of the poses (and a seating
    error that was given); ``vector`` (2,) and its ``vector_covariance`` where
    headings are known: up in the axes that headings count from.
    """

    tilt: float | None
    standard_error: float | None
    source: str
    shows: bool
    p_value: float | None
    vector: Floats | None = None
    vector_covariance: Floats | None = None


@dataclass(frozen=True)
class SeatingsDiffer(Caution):
    """Seatings differ by more than the noise: ``seating_rad`` each, from ``dof``
    degrees of freedom; the uncertainties include that."""

    seating_rad: float
    dof: int


@dataclass(frozen=True)
class NoSecondOrientation(Caution):
    """The tilt of the table enters the rotation in full, with the stated size."""


@dataclass(frozen=True)
class SingleOrientation(Caution):
    """On these ``faces`` the table's tilt enters with a size of ``tilt_rad``,
    as ``given`` or as on the other faces, and an unknown direction."""

    faces: tuple[str, ...]
    tilt_rad: float
    given: bool


@dataclass(frozen=True)
class OrientationsAlike(Caution):
    """The two orientations on each face differ by no more than noise."""


@dataclass(frozen=True)
class TableTilts(Caution):
    """So far that these may not be poses on the faces of one fixture."""

    tilt_rad: float


@dataclass(frozen=True)
class Standing:
    """``up`` (f,3): the inward normal of the face stood on, sensor frame, for
    each of ``faces`` (labels of up).

    ``labelling`` says which poses stood there, and ``dof`` are those behind
    their covariance. ``covariance`` (2f,2f) of the normals in ``basis``
    (f,3,2), rad²; ``seating_part`` that part of it which seating makes.
    ``seating`` is the standard error of one seating, from ``seating_dof``
    degrees of freedom (0: not from the poses).
    """

    labelling: Labelling
    dof: float
    faces: tuple[str, ...]
    up: Floats
    basis: Floats
    covariance: Floats
    seating_part: Floats
    seating: float
    seating_dof: int
    tilts: tuple[FaceTilt, ...]
    table: Table
    cautions: tuple[Caution, ...]


def basis_of(label: str, up: Floats, mounting: Floats) -> Floats:
    """(3,2): the next axis of the body (y for x, z for y, x for z) square to
    ``up``, and ``up`` × it. Sensor frame."""
    r = mounting[("XYZ".index(label[1]) + 1) % 3]
    r = r - (r @ up) * up
    r = r / np.linalg.norm(r)
    return np.stack([r, np.cross(up, r)], axis=1)


def stand(found: Verticals, labelling: Labelling, assumed: Assumed | None = None) -> Standing:
    """Normals of the faces and the table's tilt. Raises Refused where the tilt is
    confounded with the faces."""
    assumed = assumed or Assumed()
    # Orientations on every face, and the prior tilt where they do not resolve it.
    faces = [Face.of(found, labelling, label) for label in labelling.faces]
    faces, of_faces = turned(faces, found)
    prior = _prior_tilt(faces, assumed)
    seating, dof = assumed.seating or 0.0, 0
    # Solve without seating error; estimate it where the misfit is significant.
    solved = _solve(found, labelling, faces, prior, seating)
    left, chi2 = _misfit(solved)
    p = float(chi2_sf(chi2, left)) if left else None
    if assumed.seating is None and p is not None and p < SIGNIFICANT:
        begin, dof = solved.up, left
        seating = _seating(lambda s: _misfit(_solve(found, labelling, faces, prior, s, begin))[1], left)
        solved = _solve(found, labelling, faces, prior, seating, begin)
    # Covariance of the normals, with the error of half turns.
    covariance = solved.covariance[: 2 * len(faces), : 2 * len(faces)]
    covariance = covariance + _turning(solved, assumed.turn)
    part = solved.gain[: 2 * len(faces)]
    table, of_table = _table(solved, assumed, p)
    if dof:
        of_table.append(SeatingsDiffer(seating, dof))
    return Standing(
        labelling=labelling,
        dof=found.dof,
        faces=tuple(f.label for f in faces),
        up=solved.up,
        basis=solved.basis,
        covariance=covariance,
        seating_part=seating**2 * part @ part.T,
        seating=seating,
        seating_dof=dof,
        tilts=solved.tilts,
        table=table,
        cautions=(*of_faces, *of_table),
    )


def _prior_tilt(faces: Sequence[Face], assumed: Assumed) -> float:
    """Prior tilt where the orientations do not resolve it: stated, or −1 for that of
    the other faces; 0 where all resolve it."""
    headed = [f for f in faces if f.headed]
    single = [f for f in faces if not f.headed and not f.resolved]
    if not single and (not headed or any(f.resolved for f in headed)):
        return 0.0
    if assumed.tilt is not None:
        return assumed.tilt
    return -1.0  # to be had from the other faces


@dataclass(frozen=True)
class _Solved:
    """Joint solution: ``covariance`` of normals and tilts, ``gain`` from the
    observations to them, weighted residuals."""

    up: Floats
    basis: Floats
    covariance: Floats
    gain: Floats
    chi2: float
    left: int
    tilts: tuple[FaceTilt, ...]
    vector: Floats | None
    vector_covariance: Floats | None


def _design(faces: Sequence[Face]) -> tuple[Floats, int]:
    """(2n, 2f + 2t): derivatives of the observations by normals and tilts. One tilt
    for each face without headings, one for all others."""
    own = [f.label for f in faces if not f.headed]
    columns = 2 * (len(faces) + len(own) + any(f.headed for f in faces))
    blocks = []
    for k, face in enumerate(faces):
        at = 2 * (len(faces) + (len(own) if face.headed else own.index(face.label)))
        for turn in face.turn:
            row = np.zeros((2, columns))
            row[:, 2 * k : 2 * k + 2] = np.eye(2)
            row[:, at : at + 2] = felt(float(turn))
            blocks.append(row)
    return np.concatenate(blocks), len(own)


def _prior(faces: Sequence[Face], up: Floats, basis: Floats, variance: float, columns: int) -> Floats:
    """(columns, columns) prior information on unresolved tilts, with ``variance`` of
    a component.

    The variance is τ²/2 for an unknown heading. Headings of different faces are
    correlated: rolled over the table from face to face, a fixture sees the tilt as
    one rotation. So the tilts are a rotation of that variance, plus independent parts
    of the same variance.
    """
    information = np.zeros((columns, columns))
    own = [f.label for f in faces if not f.headed]
    single = [k for k, f in enumerate(faces) if not f.headed and not f.resolved]
    if single:
        rows = [basis[k].T @ _cross(-up[k]) for k in single]
        Q = np.concatenate(rows)
        at = np.concatenate([2 * (len(faces) + own.index(faces[k].label)) + np.arange(2) for k in single])
        information[np.ix_(at, at)] = np.linalg.inv(variance * (np.eye(len(at)) + Q @ Q.T))
    headed = [f for f in faces if f.headed]
    if headed and not any(f.resolved for f in headed):
        information[-2:, -2:] = np.eye(2) / variance
    return information


def _solve(
    found: Verticals,
    labelling: Labelling,
    faces: Sequence[Face],
    tilt: float,
    seating: float,
    begin: Floats | None = None,
) -> _Solved:
    """The joint solution; ``begin`` (f,3) are normals of a solution near by, if there
    is one."""
    rows = [i for f in faces for i in f.rows]
    face_of = np.concatenate([np.full(len(f.rows), k) for k, f in enumerate(faces)])
    H, own = _design(faces)
    if tilt < 0:
        tilt = tilt_of_others(faces, found)
    index = np.concatenate([3 * r + np.arange(3) for r in rows])
    V3 = found.covariance[np.ix_(index, index)]
    up = np.array([labelling.mounting.T @ axis_of(f.label) for f in faces]) if begin is None else begin
    # Gauss–Newton: axes at the present normals, weights, and a regularised solution.
    for _ in range(ROUNDS if begin is None else 2):
        basis = np.array([basis_of(f.label, up[k], labelling.mounting) for k, f in enumerate(faces)])
        across = np.zeros((2 * len(rows), 3 * len(rows)))
        for i, k in enumerate(face_of):
            across[2 * i : 2 * i + 2, 3 * i : 3 * i + 3] = basis[k].T
        V = across @ V3 @ across.T + (seating**2 + FLOOR_RAD**2) * np.eye(2 * len(rows))
        weight = np.linalg.inv(V)
        scale = float(np.trace(V)) / len(V)
        prior = _prior(faces, up, basis, max(tilt**2 / 2, 1e-6 * scale), H.shape[1])
        covariance = np.linalg.inv((H.T @ weight @ H + prior) * scale) * scale
        gain = covariance @ H.T @ weight
        y = across @ found.direction[rows].ravel()
        x = gain @ y
        up = up + np.einsum("kij,kj->ki", basis, x[: 2 * len(faces)].reshape(-1, 2))
        up /= np.linalg.norm(up, axis=1, keepdims=True)
    rest = y - H @ x
    left = 2 * len(rows) - H.shape[1] + 2 * _unresolved(faces)
    tilts = _tilts(faces, x, covariance)
    headed = H.shape[1] > 2 * (len(faces) + own)
    return _Solved(
        up, basis, covariance, gain, float(rest @ weight @ rest), left, tilts,
        x[-2:] if headed else None, covariance[-2:, -2:] if headed else None,
    )  # fmt: skip


def _unresolved(faces: Sequence[Face]) -> int:
    headed = [f for f in faces if f.headed]
    return sum(not f.resolved for f in faces if not f.headed) + bool(headed and not any(f.resolved for f in headed))


def _tilts(faces: Sequence[Face], x: Floats, covariance: Floats) -> tuple[FaceTilt, ...]:
    own = [f.label for f in faces if not f.headed]
    together = any(f.resolved for f in faces if f.headed)
    found = []
    for face in faces:
        at = 2 * (len(faces) + (len(own) if face.headed else own.index(face.label)))
        T = felt(float(face.turn[0]))
        block = covariance[at : at + 2, at : at + 2]
        resolved = together if face.headed else face.resolved
        found.append(FaceTilt(face.label, face.rows, T @ x[at : at + 2], T @ block @ T.T, resolved))
    return tuple(found)


def _misfit(solved: _Solved) -> tuple[int, float]:
    """Degrees of freedom and chi-square of repeated seatings and of the common
    tilt."""
    left, chi2 = solved.left, solved.chi2
    pairs = _telling(solved)
    if len(pairs) > 1:
        size = np.array([t.magnitude for t in pairs])
        weight = 1 / np.array([max(t.standard_error, FLOOR_RAD) for t in pairs]) ** 2
        mean = float(weight @ size / weight.sum())
        left, chi2 = left + len(pairs) - 1, chi2 + float(weight @ (size - mean) ** 2)
    return left, chi2


def _telling(solved: _Solved) -> list[FaceTilt]:
    """Tilts of single faces, where most are significant enough to compare their
    magnitudes."""
    if solved.vector is not None:
        return []
    pairs = [t for t in solved.tilts if t.resolved]
    far = [t for t in pairs if t.magnitude > 4 * t.standard_error]
    return pairs if len(far) > len(pairs) / 2 else []


def _seating(chi2_at: Callable[[float], float], left: int) -> float:
    """Standard error of a seating with which chi-square equals its degrees of freedom
    (Paule and Mandel 1982)."""
    high = 1e-6
    while chi2_at(high) > left and high < 1:
        high *= 4
    return float(scipy.optimize.brentq(lambda s: chi2_at(s) - left, 0.0, high, xtol=1e-6 * high, rtol=1e-6))


def _turning(solved: _Solved, turn: float) -> Floats:
    """(2f,2f): a half turn with an error δ leaves d δ/2 of the tilt, perpendicular to
    it."""
    n = 2 * len(solved.tilts)
    out = np.zeros((n, n))
    for k, t in enumerate(solved.tilts):
        left = np.array([-t.tilt[1], t.tilt[0]]) * turn / 2
        out[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = np.outer(left, left)
    return out


def _table(solved: _Solved, assumed: Assumed, p: float | None) -> tuple[Table, list[Caution]]:
    cautions: list[Caution] = []
    resolved = [t for t in solved.tilts if t.resolved]
    single = tuple(t.label for t in solved.tilts if not t.resolved)
    if not resolved:
        cautions.append(NoSecondOrientation())
        return Table(assumed.tilt, None, "given", False, None), cautions
    if single:
        size = _rms(resolved) if assumed.tilt is None else assumed.tilt
        cautions.append(SingleOrientation(single, size, given=assumed.tilt is not None))
    if solved.vector is not None and solved.vector_covariance is not None:
        size = float(np.linalg.norm(solved.vector))
        along = solved.vector / max(size, 1e-300)
        error = float(np.sqrt(along @ solved.vector_covariance @ along))
        chi2 = float(solved.vector @ np.linalg.solve(solved.vector_covariance, solved.vector))
        shows = bool(chi2_sf(chi2, 2) < SHOWS)
        table = Table(size, error, "measured", shows, p, solved.vector, solved.vector_covariance)
    else:
        chi2 = sum(float(t.tilt @ np.linalg.solve(t.covariance, t.tilt)) for t in resolved)
        shows = bool(chi2_sf(chi2, 2 * len(resolved)) < SHOWS)
        error = float(np.sqrt(np.mean([t.standard_error**2 for t in resolved]) / len(resolved)))
        table = Table(_rms(resolved), error, "measured", shows, p)
    if not table.shows:
        cautions.append(OrientationsAlike())
    if table.tilt is not None and table.tilt > LARGE_RAD:
        cautions.append(TableTilts(table.tilt))
    return table, cautions


def _rms(tilts: Sequence[FaceTilt]) -> float:
    """Rms magnitude, less the contribution of the noise to its square."""
    squares = [float(t.tilt @ t.tilt - np.trace(t.covariance)) for t in tilts]
    return float(np.sqrt(max(float(np.mean(squares)), 0.0)))


def _cross(v: Floats) -> Floats:
    """(3,3) with ``_cross(v) @ w = v × w``."""
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
