"""Noise of known colour for synthetic streams; each (n, 3), unit variance of a
sample unless said otherwise."""

from __future__ import annotations

import numpy as np
import scipy

from triaxcal.arrays import Floats


def white(n: int, rng: np.random.Generator) -> Floats:
    return rng.standard_normal((n, 3))


def moving_average(n: int, length: int, rng: np.random.Generator) -> Floats:
    """White noise averaged over ``length`` samples: a triangular
    autocorrelation."""
    total = np.cumsum(rng.standard_normal((n + length, 3)), axis=0)
    return np.asarray((total[length:] - total[:-length]) / np.sqrt(length))


def first_order(n: int, time_constant: float, rng: np.random.Generator) -> Floats:
    """AR(1): correlation exp(−k / ``time_constant``) at a lag of k samples,
    stationary from the first."""
    phi = np.exp(-1 / time_constant)
    start = rng.standard_normal((1, 3))
    drive = rng.standard_normal((n, 3)) * np.sqrt(1 - phi**2)
    return np.asarray(scipy.signal.lfilter([1.0], [1.0, -phi], drive, axis=0, zi=phi * start)[0])


def flicker(n: int, corner: float, rng: np.random.Generator) -> Floats:
    """White noise of unit variance plus 1/f noise as strong as it at the
    frequency ``corner``, cycles a sample.

    The 1/f part begins at one cycle in the stream: what is slower is a constant
    of the whole stream.
    """
    f = np.fft.rfftfreq(n)
    shape = np.zeros(len(f))
    shape[1:] = np.sqrt(corner / f[1:])
    slow = np.fft.irfft(np.fft.rfft(rng.standard_normal((n, 3)), axis=0) * shape[:, None], n, axis=0)
    return np.asarray(slow + rng.standard_normal((n, 3)))
