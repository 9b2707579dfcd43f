"""From ``u = P g + c`` to a sensor and the rotation of its frame: K, R and C of
``P = K R C``."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import scipy.linalg

from triaxcal.arrays import Floats
from triaxcal.errors import InvalidData
from triaxcal.inputs.turntable import TurntableSolution
from triaxcal.model.sensor import Sensor

SECOND_ORDER = 0.2
"""Share of a standard error from which on squares of the misalignments' errors
are added to it."""


def signs_of(s: TurntableSolution, signs: Sequence[float] | None) -> Floats:
    """(3,) as declared, else those with which the sensor's frame lies nearest
    to the table's."""
    product = float(np.sign(np.linalg.det(s.P)))
    if signs is not None:
        flips = np.asarray(signs, dtype=float)
        if float(np.prod(flips)) != product:
            raise InvalidData(
                f"the product of the signs is {np.prod(flips):+.0f}, but the attitudes say {product:+.0f}: a sign is "
                "wrong, or the frame of the attitudes is left-handed"
            )
        return flips
    choices = [np.array(f) for f in itertools.product((1.0, -1.0), repeat=3) if np.prod(f) == product]
    return max(choices, key=lambda f: float(np.trace(sensor_and_rotation(s.P, s.c, f)[1])))


def sensor_and_rotation(P: Floats, c: Floats, flips: Floats) -> tuple[Sensor, Floats]:
    """The sensor, its frame such that R is upper triangular and K has the signs
    ``flips``, and the rotation C."""
    KR, C = scipy.linalg.rq(P)
    turn = flips * np.sign(np.diag(KR))
    KR, C = KR * turn, turn[:, None] * C
    k = np.diag(KR).copy()
    R = KR / k[:, None]
    return Sensor(k, np.array([R[1, 2], R[0, 2], R[0, 1]]), c / k), np.asarray(C)


def parameters_by_entries(s: TurntableSolution, flips: Floats, C: Floats) -> Floats:
    """(12,12) derivative of scale factor, misalignment, bias and turns of the
    sensor's frame by P row by row and c."""

    def of(p: Floats) -> Floats:
        sensor, turned = sensor_and_rotation(p[:9].reshape(3, 3), p[9:], flips)
        W = turned @ C.T
        turns = np.array([W[2, 1] - W[1, 2], W[0, 2] - W[2, 0], W[1, 0] - W[0, 1]]) / 2
        return np.concatenate([sensor.scale_factor, sensor.misalignment, sensor.bias, turns])

    start = np.concatenate([s.P.ravel(), s.c])
    sizes = np.concatenate([np.repeat(np.linalg.norm(s.P, axis=1), 3), np.linalg.norm(s.P, axis=1)])
    steps = 1e-6 * sizes
    return np.stack([(of(start + h) - of(start - h)) / (2 * h.sum()) for h in np.diag(steps)], axis=1)


def second_order(covariance: Floats, sensor: Sensor, reference: float) -> Floats:
    """(12,) what angles that are known so poorly do to scale factors and biases
    by their squares, where this counts.

    On six faces only attitudes tell the misalignments; an axis that is off by
    an angle reads its cosine.
    """
    square = float(np.max(np.diag(covariance)[3:6]))
    scale = np.abs(sensor.scale_factor) * square
    if np.all(scale < SECOND_ORDER * np.sqrt(np.diag(covariance)[:3])):
        return np.zeros(12)
    return np.concatenate([scale, np.zeros(3), np.full(3, reference * square), np.zeros(3)])
