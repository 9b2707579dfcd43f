"""What rounding to the steps of a digital output does to means and scatters of
readings.

Noise dithers: readings of Gaussian noise of σ steps, rounded to the nearest
step, have a mean and a variance that swing with the place of the true value
between two steps, the k-th harmonic of the swing damped by exp(−2π²k²σ²)
(Widrow and Kollár 2008, Quantization Noise, by the characteristic function of
what is rounded). Beyond one step nothing is left of it; below a third the mean
is off by what no scatter shows, and the scatter is one thing here and another
there.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.special import ndtr

from triaxcal.arrays import Floats, Ints
from triaxcal.poses.stillness.windows import Windows

COARSEST = 50
"""Steps that the range of the outputs has at least."""
TWO_READINGS_LEAST = 8
"""Windows with two readings from which a step is learned."""
ALIKE = 0.25
"""Share of a step by which printed decimals move it, at most."""
MOSTLY, SINGLE = 0.9, 0.6
"""So many of these windows differ by a step, or by two or three where the unit
moves; so many by one."""
MOSTLY_COARSE = 0.5
"""Of the windows: there the noise hardly shows for the steps."""
OTHERWISE = 1.5
"""A step so many times the smallest difference is no matter of which readings
happened to be seen."""
FINE = 1.0
"""Noise of so many steps has nothing to do with them any more: exp(−2π²) is
3e-9."""
HARMONICS = np.arange(1, 50)[:, None]
"""Of the series in the place between two steps. Without noise its terms go with
1/k² and what is left out is 1.2 %; with noise they vanish as an exponential."""
SIGMAS = np.linspace(0.0, FINE, 201)
"""Noise in steps, where its inverse is looked up."""
BLUR = 0.01
"""Steps squared: from one place to the next of those that are tried, variances
differ by no more on average."""


@dataclass(frozen=True)
class Rounding:
    """What rounding makes of an output by axis (3,), in output units squared:
    ``residue``, the variance that it leaves in a mean, however long, over all
    places between two steps; ``widest``, the variance of a reading half-way
    between two steps, where it is largest, zero where noise is wider than a
    step.
    """

    residue: Floats
    widest: Floats

    @classmethod
    def of(cls, step: Floats, scatter: Floats) -> Rounding:
        """``scatter`` (3,) is the variance of a reading where nothing moves, on
        average over the places."""
        sigma = noise_of(scatter / step**2)
        widest = np.where(sigma < FINE, widest_variance(sigma), 0.0)
        return cls(rounding_variance(step, scatter), np.asarray(step**2 * widest))


def resolution(w: Windows) -> Floats:
    """(3,) the smallest difference that any two readings show; never quite
    zero.

    A step that is a good part of the range is no resolution: outputs without
    any noise differ by their poses alone. Where readings were printed with
    decimals that are no multiples of the step, sums differ by those; windows
    that hold two readings only still show the step.
    """
    return _steps(w)[0]


def _steps(w: Windows) -> tuple[Floats, Floats]:
    """(3,) the step of the output, and (3,) that of the decimals it was printed
    with, zero where these are the same."""
    least, shown = _least_difference(w), shown_step(w)
    hidden = shown > OTHERWISE * least
    return np.where(hidden, shown, least), np.where(hidden, least, 0.0)


def _least_difference(w: Windows) -> Floats:
    """(3,) judged by the sums of windows."""
    sums = w.mean * w.size
    least: Floats = 1e-12 * np.max(np.abs(sums), axis=0, initial=1e-100)
    out = least.copy()
    for i in range(3):
        gaps = np.diff(np.unique(sums[:, i]))
        gaps = gaps[gaps > least[i]]
        fine = len(gaps) > 0 and gaps.min() * COARSEST < np.ptp(w.mean[:, i])
        out[i] = gaps.min() if fine else least[i]
    return out


def shown_step(w: Windows) -> Floats:
    """(3,) the step between the readings of those windows that hold two
    readings only, zero where these do not agree on one: such windows are many
    where the noise is narrower than the step, and by chance there is none.
    """
    out = np.zeros(3)
    for i in range(3):
        hops = w.hop[w.hop[:, i] > 0, i]
        if len(hops) < TWO_READINGS_LEAST:
            continue
        step = float(np.median(hops))
        times = np.clip(np.rint(hops / step), 1, 3)
        alike = np.abs(hops / step - times) <= ALIKE
        agree = np.mean(alike) >= MOSTLY and np.mean(alike & (times == 1)) >= SINGLE
        if agree and step * COARSEST < np.ptp(w.mean[:, i]):
            out[i] = step
    return out


def widest_steps(w: Windows) -> Floats:
    """(3,) the differences of readings in windows that hold two readings only,
    where most windows hold no more: steps of the output, or the dead band of a
    logger, which is several of them. Elsewhere the resolution."""
    out = resolution(w)
    for i in range(3):
        hops = w.hop[w.hop[:, i] > 0, i]
        if len(hops) and np.mean((w.hop[:, i] > 0) | (w.variance[:, i] == 0)) > MOSTLY_COARSE:
            out[i] = max(out[i], float(np.median(hops)))
    return out


def rounding_variance(step: Floats, scatter: Floats) -> Floats:
    """(3,) variance of what rounding of the outputs to ``step`` leaves in a
    mean, however long; ``scatter`` is the variance of a reading. Noise averages
    it out, if there is enough of it.
    """
    return np.asarray(step**2 * mean_rounding_variance(noise_of(scatter / step**2)))


def left_in_means(w: Windows, scatter: Floats, count: Ints) -> Floats:
    """(3,) variance of what rounding to the steps that these windows show
    leaves in means of poses, of which readings have ``scatter`` (k,3) over
    ``count`` (k,) windows; and with it what printing leaves: the same reading
    is printed with the same error, so that is averaged over readings alone.
    """
    step, printed = _steps(w)
    level = scatter.mean(axis=0) / step**2
    sigma = noise_of(level)
    left = mean_rounding_variance(sigma)
    for i in np.flatnonzero(sigma < FINE):
        left[i] = _left_by_poses(scatter[:, i] / step[i] ** 2, count)
    # The sum of the squared shares of the readings: of a density of σ steps,
    # 1/(2√π σ).
    again = np.minimum(1 / (2 * np.sqrt(np.pi) * np.maximum(sigma, 1e-3)), 1.0)
    return np.asarray(step**2 * left + printed**2 / 12 * again)


def _left_by_poses(variance: Floats, count: Ints) -> float:
    """`mean_rounding_variance` over all noise that poses of such ``variance``
    (k,), in steps squared, may have, estimated from ``count`` (k,) windows:
    where the poses lie between two steps is chance, so that the mean of few of
    their variances says little, and what is left goes with the square of the
    noise in an exponent.
    """
    sigma, seen, spread = _by_place()
    off = variance[:, None, None] - seen
    width = BLUR**2 + spread / count[:, None, None]
    chance = (np.exp(-(off**2) / (2 * width)) / np.sqrt(width)).mean(axis=2)
    likelihood = np.log(np.maximum(chance, 1e-300)).sum(axis=0)
    weight = np.exp(likelihood - likelihood.max())
    return float(weight @ mean_rounding_variance(sigma) / weight.sum())


@cache
def _by_place() -> tuple[Floats, Floats, Floats]:
    """Noise (s,) in steps; by it and by the place between two steps, (s,p)
    each, the variance of a reading, and that of the squared deviations, by the
    exact sums.
    """
    sigma, place = SIGMAS[4::2], (np.arange(50) + 0.5) / 100
    codes = np.arange(-6, 8)
    edges = (np.append(codes, codes[-1] + 1) - 0.5 - place[:, None]) / sigma[:, None, None]
    share = np.diff(ndtr(edges), axis=2)
    off = codes - (share @ codes)[:, :, None]
    variance = (share * off**2).sum(axis=2)
    return sigma, variance, (share * off**4).sum(axis=2) - variance**2


def mean_rounding_variance(sigma: Floats) -> Floats:
    """(n,) mean square error of an endless mean over all places between two
    steps, in steps squared, for noise of ``sigma`` (n,) steps.
    """
    k = HARMONICS
    return np.asarray((np.exp(-4 * np.pi**2 * k**2 * sigma**2) / (2 * np.pi**2 * k**2)).sum(axis=0))


def widest_variance(sigma: Floats) -> Floats:
    """(n,) variance of a reading half-way between two steps, in steps squared:
    a quarter without noise."""
    k = HARMONICS
    swing = np.exp(-2 * np.pi**2 * k**2 * sigma**2) * (1 / (np.pi**2 * k**2) + 4 * sigma**2)
    return np.asarray(sigma**2 + 1 / 12 + swing.sum(axis=0))


def noise_of(variance: Floats) -> Floats:
    """(n,) the noise in steps of which rounded readings have this ``variance``
    (n,), in steps squared, on average over the places: what the mean keeps of
    the rounding error the scatter lacks.
    """
    seen = SIGMAS**2 + 1 / 12 - mean_rounding_variance(SIGMAS)
    beyond = np.sqrt(np.maximum(variance - 1 / 12, 0.0))
    return np.asarray(np.where(variance < seen[-1], np.interp(variance, seen, SIGMAS), beyond))
