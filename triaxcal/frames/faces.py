"""Which poses stand on which face of the fixture.

A face pose has the label of the side that is up: ``+X`` stands on the face −X.
Directions are unit vectors of up in the sensor's frame; a mounting is a
rotation (3,3) that takes them to the body's frame.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Bools, Floats
from triaxcal.errors import InvalidData, Refused
from triaxcal.estimate.calibration import Caution

LABELS = ("+X", "-X", "+Y", "-Y", "+Z", "-Z")
NEAR_RAD = 0.05
"""A pose stands on a face if up is as near as this to the face's own; tilts and
errors of a fixture are far smaller."""
LABEL_RAD = 0.2
"""Beyond this a label that was given contradicts the others."""
AS_GOOD = 0.75
"""Share of the best score from which on a frame is as good; the one nearest to
the sensor's axes is taken. Beside a whole cube with two poses a face it may
lack one face, or the second poses of two."""
SEEDS_MOST = 300
"""Poses of which pairs span frames: 45 thousand pairs at most, for the sake of
time."""


def axis_of(label: str) -> Floats:
    """(3,) nominal direction of up in the body's frame for a face pose."""
    axis = np.zeros(3)
    axis["XYZ".index(label[1])] = -1.0 if label[0] == "-" else 1.0
    return axis


def opposite(label: str) -> str:
    return ("-" if label[0] == "+" else "+") + label[1]


AXES: Floats = np.array([axis_of(label) for label in LABELS])


def _proper() -> Floats:
    """(24,3,3): the rotations that take a cube into itself, the identity first."""
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            M = np.zeros((3, 3))
            M[range(3), order] = signs
            if np.linalg.det(M) > 0:
                found.append(M)
    return np.array(found)


TURNS: Floats = _proper()


class Miscounted(InvalidData):
    """The number of labels fits neither poses nor faces."""


@dataclass(frozen=True)
class AxesAssumed(Caution):
    """No labels were given: the sensor's axes are taken to lie near the faces'
    axes of the same name."""


@dataclass(frozen=True)
class SeveralCubes(Caution):
    """The poses lie on the axes of more than one cube; taken is the one nearest
    to the sensor's own axes."""


@dataclass(frozen=True)
class Labelling:
    """``labels`` and ``headings`` (rad, or None) of each pose, None where it
    stands on no face or is excluded.

    ``assumed``: the axes of the sensor were taken to lie near those of the
    body, which nothing in the data shows.
    """

    labels: tuple[str | None, ...]
    headings: tuple[float | None, ...]
    mounting: Floats
    assumed: bool
    cautions: tuple[Caution, ...] = ()

    @property
    def faces(self) -> tuple[str, ...]:
        return tuple(label for label in LABELS if label in self.labels)


def nearest_rotation(up: Floats, axes: Floats) -> Floats:
    """The rotation C (…,3,3) that minimises Σ|C upᵢ − axesᵢ|² (Wahba's problem;
    Markley 1988), for two (…,n,3)."""
    u, _, vt = np.linalg.svd(np.swapaxes(axes, -1, -2) @ up)
    u[..., 2] *= np.sign(np.linalg.det(u @ vt))[..., None]
    return np.asarray(u @ vt)


def recognise(up: Floats, used: Bools) -> Labelling:
    """Face poses by direction alone, with the axes of the sensor near the body's.
    Raises Refused where there are none.

    Among the frames with axes through the poses, the best have the most poses on
    their axes, counting up to two a face; of equally good ones the nearest to the
    sensor's frame is used.
    """
    # Rotate every frame by the 24 rotations of the cube to the nearest one.
    frames, scores = _frames(up[used])
    if not len(frames):
        raise Refused("no two poses at right angles: none stand on the faces of a cube", wanted=LABELS)
    traces = np.einsum("tij,fji->ft", TURNS, frames)
    frames = TURNS[np.argmax(traces, axis=1)] @ frames
    near = traces.max(axis=1)
    # The nearest of the good frames, then the best of its neighbours.
    good = scores >= AS_GOOD * scores.max()
    best = frames[np.argmax(np.where(good, near, -4.0))]
    alike = np.einsum("fij,ij->f", frames, best) > 1 + 2 * np.cos(2 * NEAR_RAD)
    best = frames[np.argmax(np.where(alike, scores + 0.1 * near, -1.0))]
    rival = good & (np.max(np.einsum("fij,tik,kj->ft", frames, TURNS, best), axis=1) < 1 + 2 * np.cos(0.2))
    # Alternate between assignment of the poses and the rotation.
    labels = _on_faces(up, used, best)
    for _ in range(3):
        mounting = _mounting(up, labels)
        labels = _on_faces(up, used, mounting)
    mounting = _mounting(up, labels)
    cautions = (AxesAssumed(), SeveralCubes()) if rival.any() else (AxesAssumed(),)
    return Labelling(labels, (None,) * len(up), mounting, True, cautions)


def labelled(
    up: Floats, used: Bools, labels: Sequence[str | None], headings: Sequence[float | None] | None = None
) -> Labelling:
    """Face poses by the labels given, whatever the mounting.

    There are as many labels as poses (None, or a label that is no face's, for
    poses on no face), or as face poses, or as faces stood on, in order of time.
    Raises Miscounted where there are not, InvalidData where they contradict the
    readings, Refused where the faces are too few.
    """
    given = [label if label in LABELS else None for label in labels]
    turns = list(headings) if headings is not None else [None] * len(labels)
    if len(given) != len(up):
        given, turns = _spread(up, used, given, turns)
    kept = tuple(label if ok else None for label, ok in zip(given, used, strict=True))
    mounting = _mounting(up, kept)
    _check(up, kept, mounting)
    known = tuple(turn if label else None for turn, label in zip(turns, kept, strict=True))
    return Labelling(kept, known, mounting, False)


def _spread(
    up: Floats, used: Bools, given: Sequence[str | None], turns: Sequence[float | None]
) -> tuple[list[str | None], list[float | None]]:
    """Labels for some poses as labels for all: of the face poses, or of the
    faces, each in order of first time."""
    found = recognise(up, used)
    on_face = [i for i, label in enumerate(found.labels) if label]
    order = list(dict.fromkeys(found.labels[i] for i in on_face))
    labels: list[str | None] = [None] * len(up)
    known: list[float | None] = [None] * len(up)
    if len(given) == len(on_face):
        for i, label, turn in zip(on_face, given, turns, strict=True):
            labels[i], known[i] = label, turn
    elif len(given) == len(order) and all(turn is None for turn in turns):
        meaning = dict(zip(order, given, strict=True))
        for i in on_face:
            labels[i] = meaning[found.labels[i]]
    else:
        raise Miscounted(
            f"{len(given)} labels for {len(up)} poses, of which {len(on_face)} stand on {len(order)} faces; expected "
            "one for each pose, or for each pose on a face, or for each face"
        )
    return labels, known


def _mounting(up: Floats, labels: Sequence[str | None]) -> Floats:
    rows = [i for i, label in enumerate(labels) if label]
    axes = {label[1] for label in labels if label}
    if len(axes) < 2:
        have = tuple(label for label in LABELS if label in labels)
        raise Refused(
            f"poses on {', '.join(have) or 'no'} faces do not give a rotation: at least two faces at right angles, "
            "each in two orientations",
            wanted=[label for label in LABELS if label[1] not in axes],
        )
    # Each face counts once, however many poses stand on it.
    faces = [label for label in LABELS if label in labels]
    means = np.array([up[[i for i in rows if labels[i] == label]].mean(axis=0) for label in faces])
    return nearest_rotation(means, np.array([axis_of(label) for label in faces]))


def _check(up: Floats, labels: Sequence[str | None], mounting: Floats) -> None:
    rows = np.array([i for i, label in enumerate(labels) if label])
    axes = np.array([axis_of(label) for label in labels if label])
    off = _angles(up[rows] @ mounting.T, axes)
    if off.max() <= LABEL_RAD:
        return
    # Test whether a mirror image fits.
    u, _, vt = np.linalg.svd(axes.T @ up[rows])
    if np.linalg.det(u @ vt) < 0 and _angles(up[rows] @ (u @ vt).T, axes).max() <= LABEL_RAD:
        raise InvalidData(
            "the labels fit a mirror image of the readings: a label is wrong, or the sign of one scale factor or of "
            "all three"
        )
    worst = int(np.argmax(off))
    raise InvalidData(
        f"the labels contradict the readings: pose {rows[worst] + 1} is labelled {labels[rows[worst]]} and is "
        f"{np.degrees(off[worst]):.0f}° from it where the others fit best"
    )


def _angles(a: Floats, b: Floats) -> Floats:
    return np.asarray(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1)))


def _on_faces(up: Floats, used: Bools, mounting: Floats) -> tuple[str | None, ...]:
    along = up @ mounting.T @ AXES.T
    return tuple(
        LABELS[int(np.argmax(row))] if ok and row.max() > np.cos(NEAR_RAD) else None
        for row, ok in zip(along, used, strict=True)
    )


def _frames(up: Floats) -> tuple[Floats, Floats]:
    """Rotations (f,3,3) with poses on at least two of their axes, and their scores
    (f,)."""
    # Frames from all pairs of nearly perpendicular poses (Gram–Schmidt).
    seeds = up[:SEEDS_MOST]
    i, j = np.nonzero(np.triu(np.abs(seeds @ seeds.T) < np.sin(NEAR_RAD), 1))
    x = seeds[i]
    y = seeds[j] - np.sum(seeds[j] * x, axis=1, keepdims=True) * x
    y /= np.maximum(np.linalg.norm(y, axis=1, keepdims=True), 1e-300)
    frames = np.stack([x, y, np.cross(x, y)], axis=1)
    scores = np.zeros(len(frames))
    for k, frame in enumerate(frames):
        count = np.count_nonzero(up @ frame.T @ AXES.T > np.cos(NEAR_RAD), axis=0)
        scores[k] = float(np.sum(np.minimum(count, 2) ** 2))
    return frames, scores
