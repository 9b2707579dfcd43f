"""What no name describes: a random function of one kind or another, whose covariance is all that is said of it.

Every function of direction is taken less what nine parameters absorb of it over the sphere, not at the poses: these
would take half of it, and the linear part would come out two or three times worse.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.planning.directions import directions
from triaxcal.posterior.rows import Rows

SPHERE = 300
"""Directions over which the nine parameters absorb what they can."""
SMOOTH = (0.4, 0.8)
"""Correlation lengths on the sphere, of unit radius: bumps of a face's size, and of a hemisphere's."""
BY_AXIS = 0.3
"""Of the reference vector, along the reading of an axis: a function of that reading alone, odd or even."""
MEMORY = 0.8
"""Of the reference vector, by the pose before."""
IN_TIME = (0.1, 0.3)
"""Of the recording's duration."""


class What(StrEnum):
    """What an unmodelled part goes with."""

    NOTHING = "each_pose"
    DIRECTION = "direction"
    ODD = "odd_by_axis"
    EVEN = "even_by_axis"
    BEFORE = "pose_before"
    TIME = "time"
    INSIDE = "inside_poses"
    """The slopes alone: noise of a logged channel does that."""


@dataclass(frozen=True, eq=False)
class Kind:
    """A covariance of the rows beside the nine parameters, in its own axes: ``variance`` (m,) along ``axes`` (m,m),
    with mean 1, so that τ² is the mean variance in units of the noise. ``covariance`` (N,N) of the rows over their
    errors; it and every other covariance of this kind are to be multiplied by ``scale``. ``length`` is that of its
    correlation."""

    what: What
    length: float
    variance: Floats
    axes: Floats
    covariance: Floats
    scale: float

    def bias_at(self, rows: Rows, t_s: float) -> Floats:
        """(3,N) covariance of the bias at a moment of the last recording with the rows over their errors, of what goes
        with time; a length is a share of the recording's duration. The bias itself has the variance ``scale``."""
        length = self.length * duration_of(rows)
        apart = t_s - rows.t_s
        near = np.exp(-(apart**2) / 2 / length**2) * (rows.run == rows.run.max())
        both = [near] if not rows.slopes else [near, near * apart / length**2 * rows.held_s]
        by_v = place(rows, rows.problem.u).by_v
        return np.asarray(self.scale * np.concatenate([each[:, None] * by_v for each in both]).T / rows.error)


def duration_of(rows: Rows) -> float:
    """Of the longest recording."""
    return max(1e-9, *(float(np.ptp(rows.t_s[rows.run == run])) for run in np.unique(rows.run)))


def kinds_of(rows: Rows) -> list[Kind]:
    found = []
    for what, length, covariance in _covariances(rows):
        weighted = covariance / rows.error[:, None] / rows.error[None]
        inner = rows.beside.T @ weighted @ rows.beside
        total = float(np.trace(inner))
        if total <= 0:
            continue
        scale = len(inner) / total
        variance, axes = np.linalg.eigh(inner * scale)
        found.append(Kind(what, length, np.maximum(variance, 0.0), axes, weighted * scale, scale))
    return found


def _covariances(rows: Rows) -> Iterator[tuple[What, float, Floats]]:
    """(N,N) each, in units of the reference squared, but for a factor."""
    n = rows.n

    def of_means(covariance: Floats) -> Floats:
        whole = np.zeros((len(rows.y), len(rows.y)))
        whole[:n, :n] = covariance
        return whole

    yield What.NOTHING, 0.0, of_means(np.eye(n))
    sphere = _Sphere.of(rows)
    for length in SMOOTH:
        yield What.DIRECTION, length, of_means(sphere.covariance(lambda p, q, s=length: _smooth(p, q, s)))
    for what, sign in ((What.ODD, -1), (What.EVEN, 1)):
        length = BY_AXIS * rows.problem.reference
        yield what, length, of_means(sphere.covariance(lambda p, q, s=sign, at=length: _by_axis(p, q, s, at)))
    before = np.stack([rows.problem.conditions[f"before_{axis}"] for axis in "xyz"], axis=1) / rows.problem.reference
    near = np.exp(-np.sum((before[:, None] - before[None]) ** 2, axis=2) / 2 / MEMORY**2)
    together = sphere.here.by_v @ sphere.here.by_v.T
    yield What.BEFORE, MEMORY, of_means(near * together)
    for share in IN_TIME:
        yield What.TIME, share, _in_time(rows, share, together)
    if rows.slopes:
        slopes = np.zeros((len(rows.y), len(rows.y)))
        slopes[n:, n:] = np.eye(n)
        yield What.INSIDE, 0.0, slopes


def _in_time(rows: Rows, share: float, together: Floats) -> Floats:
    """A bias of each axis that wanders smoothly, in each recording anew: one process for means and slopes, or slow
    drift is paid twice."""
    n, length = rows.n, share * duration_of(rows)
    apart = rows.t_s[:, None] - rows.t_s[None]
    near = np.exp(-(apart**2) / 2 / length**2) * together * (rows.run[:, None] == rows.run)
    if not rows.slopes:
        return np.asarray(near)
    held = rows.held_s
    mixed = near * apart / length**2 * held[None]
    inside = near * (1 / length**2 - apart**2 / length**4) * held[:, None] * held[None]
    whole = np.zeros((2 * n, 2 * n))
    whole[:n, :n], whole[:n, n:], whole[n:, :n], whole[n:, n:] = near, mixed, mixed.T, inside
    return whole


@dataclass(frozen=True, eq=False)
class Place:
    """k readings: ``up`` (k,3) unit vectors, ``by_v`` (k,3) how |a| goes with the bias of each axis, ``along`` (k,3)
    the readings along the sensitive axes in g, ``linear`` (k,9) derivatives by the nine parameters."""

    up: Floats
    by_v: Floats
    along: Floats
    linear: Floats


class _Covariance(Protocol):
    def __call__(self, p: Place, q: Place) -> Floats: ...


@dataclass(frozen=True, eq=False)
class _Sphere:
    """The poses, and directions all over the sphere with what takes the nine parameters' part off a function there."""

    here: Place
    everywhere: Place
    fit: Floats

    @classmethod
    def of(cls, rows: Rows) -> _Sphere:
        sensor = rows.state.sensor(rows.problem)
        up = np.array([v for _, v in directions(SPHERE)]) * rows.problem.reference
        everywhere = place(rows, sensor.output(up, {}))
        return cls(place(rows, rows.problem.u), everywhere, np.linalg.pinv(everywhere.linear))

    def covariance(self, of: _Covariance) -> Floats:
        """(n,n) of a function of direction in the poses, less its linear part over the sphere."""
        absorbed = self.here.linear @ self.fit
        crossed = of(self.here, self.everywhere)
        both = absorbed @ crossed.T
        return of(self.here, self.here) - both - both.T + absorbed @ of(self.everywhere, self.everywhere) @ absorbed.T


def place(rows: Rows, u: Floats) -> Place:
    sensor, problem = rows.state.sensor(rows.problem), rows.problem
    radius = sensor.radius(u, {})
    x = (u - problem.middle) / problem.half
    a, by_s = radius.a, radius.by_s
    angles = -np.stack([by_s[:, 1] * a[:, 2], by_s[:, 0] * a[:, 2], by_s[:, 0] * a[:, 1]], axis=1)
    linear = np.concatenate([radius.by_v * x, -radius.by_v, angles], axis=1) / rows.lengths
    return Place(a / radius.length[:, None], -radius.by_v, radius.s, linear)


def _smooth(p: Place, q: Place, length: float) -> Floats:
    return np.asarray(np.exp(-np.sum((p.up[:, None] - q.up[None]) ** 2, axis=2) / 2 / length**2))


def _by_axis(p: Place, q: Place, sign: int, length: float) -> Floats:
    total = np.zeros((len(p.up), len(q.up)))
    for i in range(3):
        same = np.exp(-((p.along[:, None, i] - q.along[None, :, i]) ** 2) / 2 / length**2)
        mirrored = np.exp(-((p.along[:, None, i] + q.along[None, :, i]) ** 2) / 2 / length**2)
        total += np.outer(p.by_v[:, i], q.by_v[:, i]) * (same + sign * mirrored)
    return total
