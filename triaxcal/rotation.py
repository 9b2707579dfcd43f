"""Calibration from a unit that turns slowly and never rests: adjusted least squares from streaming moments.

Ordinary fits of an ellipsoid to raw samples are biased by the square of the noise, which more samples do not cure.
Adjusted least squares (Markovsky, Kukush and Van Huffel 2004, Numer. Math. 98:177) corrects the moments of the samples
for the noise instead, and finds the noise as the value at which the corrected moments first fit an ellipsoid exactly.
All it needs of the samples are their moments up to the fourth degree: one pass, constant memory.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

import numpy as np
from scipy import optimize

from triaxcal.arrays import Floats
from triaxcal.ellipsoid import coefficients
from triaxcal.errors import InvalidData, Refused
from triaxcal.sensor import Sensor

_MONOMIALS = [e for e in itertools.product(range(3), repeat=3) if sum(e) <= 2]
"""Exponents of the ten monomials of a quadric; products of two of them give all up to the fourth degree."""
_CHUNK = 1 << 15
ROUNDS_MOST = 20
DILUTION_MOST = 100.0
"""Largest standard error of a combination of parameters, in noises of one sample over the root of their number."""


@dataclass
class Moments:
    """Sums of products of monomials of the scaled samples. ``feed`` blocks of any size, then `fit_rotation`.

    The scaling is fixed by the first block, so that digits are not lost to an offset.
    """

    count: int = 0
    sums: Floats = field(default_factory=lambda: np.zeros((10, 10)))
    middle: Floats | None = None
    half: Floats = field(default_factory=lambda: np.ones(3))

    def feed(self, u: Floats) -> None:
        """``u`` (n,3) raw outputs. Raises InvalidData where one is not a finite number."""
        if not len(u):
            return
        if not np.isfinite(u).all():
            raise InvalidData("a reading is not a finite number")
        if self.middle is None:
            low, high = u.min(axis=0), u.max(axis=0)
            self.middle = (low + high) / 2
            self.half = np.maximum((high - low) / 2, 1e-9 * np.maximum(np.abs(self.middle), 1e-300))
        for start in range(0, len(u), _CHUNK):
            x = ((u[start : start + _CHUNK] - self.middle) / self.half).T
            terms = np.stack([x[0] ** i * x[1] ** j * x[2] ** k for i, j, k in _MONOMIALS])
            self.sums += terms @ terms.T
            self.count += x.shape[1]

    def of(self, exponent: tuple[int, ...]) -> float:
        """Mean of ``x^i y^j z^k`` for a total degree of at most four."""
        left = tuple(min(e, 2) for e in exponent)
        while sum(left) > 2:
            at = max(i for i in range(3) if left[i])
            left = tuple(e - (i == at) for i, e in enumerate(left))
        right = tuple(e - f for e, f in zip(exponent, left, strict=True))
        return float(self.sums[_MONOMIALS.index(left), _MONOMIALS.index(right)]) / self.count


# Hermite polynomials undo what Gaussian noise of variance v does to a power: coefficients of x^(n-2m) v^m.
_UNDO = {0: (1.0,), 1: (1.0,), 2: (1.0, -1.0), 3: (1.0, -3.0), 4: (1.0, -6.0, 3.0)}


def _corrected(moments: Moments, variance: Floats) -> Floats:
    """(10,10) moments of the noiseless samples, for noise of ``variance`` (3,) in scaled units."""
    out = np.empty((10, 10))
    for (i, left), (j, right) in itertools.product(enumerate(_MONOMIALS), repeat=2):
        if j < i:
            continue
        powers = tuple(p + q for p, q in zip(left, right, strict=True))
        total = 0.0
        for lowered in itertools.product(*(range(len(_UNDO[p])) for p in powers)):
            factor = np.prod([_UNDO[p][m] * v**m for p, m, v in zip(powers, lowered, variance, strict=True)])
            total += float(factor) * moments.of(tuple(p - 2 * m for p, m in zip(powers, lowered, strict=True)))
        out[i, j] = out[j, i] = total
    return out


@dataclass(frozen=True)
class RotationFit:
    """``noise_g`` of one sample, per axis alike; ``standard_error`` (9,) of scale factor, misalignment and bias."""

    sensor: Sensor
    noise_g: float
    standard_error: Floats
    samples: int


def fit_rotation(moments: Moments, *, signs: tuple[int, int, int] = (1, 1, 1), reference: float = 1.0) -> RotationFit:
    """Fit the linear model to the moments of a turning unit, whose noise in g is alike in all axes and white.

    Raises Refused where the directions cannot carry nine parameters.
    """
    if moments.count < 100 or moments.middle is None:
        raise Refused(f"{moments.count} samples of a turning unit; at least 100 are needed")
    k = moments.half.copy()
    for _ in range(ROUNDS_MOST):
        shape = (k / moments.half) ** 2  # the noise is alike in g, hence unlike in scaled units
        noise = _noise(moments, shape)
        A, c = _ellipsoid(_corrected(moments, noise * shape), moments)
        before, (k, angles, b) = k, coefficients(A * reference, c)
        if np.max(np.abs(k / before - 1)) < 1e-12:
            break
    s = np.asarray(signs, dtype=float)
    ax, ay, az = angles
    sensor = Sensor(s * k, np.array([ax * s[1] * s[2], ay * s[0] * s[2], az * s[0] * s[1]]), s * b)
    noise_g = float(np.sqrt(noise))
    return RotationFit(
        sensor, noise_g, _standard_error(moments, noise * shape, A, c, noise_g, reference), moments.count
    )


def _noise(moments: Moments, shape: Floats) -> float:
    """The noise (variance, for ``shape`` (3,) by axis) at which the corrected moments first become singular."""

    def smallest(variance: float) -> float:
        return float(np.linalg.eigvalsh(_corrected(moments, variance * shape))[0])

    low, high = 0.0, 1e-12
    while smallest(high) > 0:
        low, high = high, high * 4
        if high > 1:
            raise Refused("the samples lie on no ellipsoid, whatever the noise")
    if low == 0.0:
        return 0.0
    return float(optimize.brentq(smallest, low, high, xtol=1e-18, rtol=1e-12))


def _ellipsoid(corrected: Floats, moments: Moments) -> tuple[Floats, Floats]:
    """``A`` (3,3) upper triangular and ``c`` (3,) in output units."""
    values, vectors = np.linalg.eigh(corrected)
    if values[1] < 1e-9 * values[-1]:
        raise Refused("the directions of the turning unit cannot carry nine parameters: turn it about more axes")
    held = dict(zip(_MONOMIALS, vectors[:, 0], strict=True))
    B = np.array(
        [
            [held[2, 0, 0], held[1, 1, 0] / 2, held[1, 0, 1] / 2],
            [held[1, 1, 0] / 2, held[0, 2, 0], held[0, 1, 1] / 2],
            [held[1, 0, 1] / 2, held[0, 1, 1] / 2, held[0, 0, 2]],
        ]
    )
    linear = np.array([held[1, 0, 0], held[0, 1, 0], held[0, 0, 1]])
    try:
        centre = -0.5 * np.linalg.solve(B, linear)
        A = np.linalg.cholesky(B / (centre @ B @ centre - held[0, 0, 0])).T
    except np.linalg.LinAlgError:
        raise Refused("the samples lie on no ellipsoid: turn the unit about more axes") from None
    assert moments.middle is not None
    return A / moments.half, moments.middle + moments.half * centre


def _standard_error(
    moments: Moments, variance: Floats, A: Floats, c: Floats, noise_g: float, reference: float
) -> Floats:
    """By the Cramér–Rao bound for these directions, which the estimate comes within a tenth of."""
    assert moments.middle is not None
    # a = T x − o, rows of the design a_i x_j (i ≤ j), −a_i: quadratic in x, so its moments are of the fourth degree.
    T, o = A * moments.half, A @ (c - moments.middle)
    linear = [_MONOMIALS.index((1, 0, 0)), _MONOMIALS.index((0, 1, 0)), _MONOMIALS.index((0, 0, 1))]
    rows = np.zeros((9, 10))
    for n, (i, j) in enumerate(itertools.combinations_with_replacement(range(3), 2)):
        for m in range(3):
            e = [0, 0, 0]
            e[m] += 1
            e[j] += 1
            rows[n, _MONOMIALS.index((e[0], e[1], e[2]))] += T[i, m]
        rows[n, linear[j]] -= o[i]
    for i in range(3):
        rows[6 + i, linear] = -T[i]
        rows[6 + i, _MONOMIALS.index((0, 0, 0))] = o[i]
    information = rows @ _corrected(moments, variance) @ rows.T * moments.count
    weakest = float(np.linalg.eigvalsh(information / moments.count)[0])
    if weakest < DILUTION_MOST**-2:
        raise Refused("the directions of the turning unit cannot carry nine parameters: turn it about more axes")
    covariance = np.linalg.inv(information) * (noise_g / reference) ** 2
    G = _by_differences(T, o, moments, reference)
    return np.sqrt(np.diag(G @ covariance @ G.T))


def _by_differences(T: Floats, o: Floats, moments: Moments, reference: float) -> Floats:
    """(9,9) derivative of scale factor, misalignment and bias by the entries of T and o."""
    assert moments.middle is not None
    rows, columns = np.triu_indices(3)
    start = np.concatenate([T[rows, columns], o])

    middle = moments.middle

    def of(p: Floats) -> Floats:
        shifted = np.zeros((3, 3))
        shifted[rows, columns] = p[:6]
        A = shifted / moments.half
        c = middle + np.linalg.solve(A, p[6:])
        return np.concatenate(coefficients(A * reference, c))

    step = 1e-6
    out = np.empty((9, 9))
    for n in range(9):
        shift = np.zeros(9)
        shift[n] = step
        out[:, n] = (of(start + shift) - of(start - shift)) / (2 * step)
    return out
