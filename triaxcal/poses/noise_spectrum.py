"""The spectrum of a unit's noise from all its poses, and the variance of a pose mean
that follows from it.

A pose shows the noise at the frequencies 1/T, 2/T, … of its own length T; the
variance of its mean depends on lower ones. All poses share one unit, hence one shape
of spectrum, and a model of few parameters extrapolates it: white noise, one process
of short memory (first-order, as AR(1), of any time constant; or a moving average of
any length, as a sensor's filter makes), and 1/f noise, alone or together. The model
is fitted by Whittle's likelihood with the exact expectation of the periodogram
(Sykulski et al. 2019, Biometrika 106:251), which includes leakage and the subtraction
of the mean. The Bayesian information criterion (Schwarz 1978) weights the models.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import fft, special

from triaxcal.arrays import Bools, Floats, Ints
from triaxcal.distributions import DOF_MOST, chi2_isf, t_isf

# The uncertainty of the variance of a pose mean: a mixture over all models of the
# spectrum that the poses support.

DOF_LEVEL = 0.99
"""Coverage at which Student's t is matched to the mixture: far enough out for
improbable levels to count, not so far that only they do."""
DOF_GRID = np.geomspace(1.0, 1e5, 200)
"""Grid of degrees of freedom for interpolation, 6 % apart; beyond the last, Student's
t is the normal distribution."""
LEAST_WEIGHT = 1e-6
"""Models of smaller probability are dropped."""
GRID = 4000
"""Size of the table of the likelihood, which is smooth and is evaluated for hundreds
of thousands of chi-squares."""
CHI2_LEAST = 1e-3
"""Smaller chi-squares have the same likelihood."""


@dataclass(frozen=True, eq=False)
class NoiseLevels:
    """A mixture of m levels: probability ``share`` (m,), ``variance`` (m,) of a mean
    over the stated one (their mean is 1), and degrees of freedom ``dof`` (m,) of
    each."""

    share: Floats
    variance: Floats
    dof: Floats

    @classmethod
    def of(cls, share: Floats, variance: Floats, dof: Floats) -> NoiseLevels:
        """The mixture of models (m,) with these weights and variances in any unit."""
        kept = (share > LEAST_WEIGHT) & (variance > 0)
        if not kept.any():
            return cls.known_by(1.0)
        share, variance = share[kept] / share[kept].sum(), variance[kept]
        return cls(share, variance / float(share @ variance), np.clip(dof[kept], 1.0, DOF_MOST))

    @classmethod
    def known_by(cls, dof: float) -> NoiseLevels:
        """One level with so many degrees of freedom."""
        return cls(np.ones(1), np.ones(1), np.array([dof]))

    def blurred(self, variance: float) -> NoiseLevels:
        """The same levels with an additional independent relative error of variance 2
        ``variance``."""
        return replace(self, dof=1 / (1 / self.dof + variance))

    @cached_property
    def students_dof(self) -> float:
        """Degrees of freedom of Student's t with the same quantile at `DOF_LEVEL` as
        the mixture, both in units of the mixture's standard deviation.

        Matching moments would give an improbable model of large variance too much
        influence.
        """
        # Bisect for the quantile of the mixture of t distributions.
        low, high = 0.0, 100.0 * float(np.sqrt(self.variance.max()))
        for _ in range(40):
            middle = (low + high) / 2
            beyond = float(self.share @ (2 * special.stdtr(self.dof, -middle / np.sqrt(self.variance))))
            low, high = (middle, high) if beyond > 1 - DOF_LEVEL else (low, middle)
        # Invert the quantile of Student's t by interpolation.
        reach = t_isf((1 - DOF_LEVEL) / 2, DOF_GRID)
        return float(np.interp(-low, -reach, DOF_GRID))

    @property
    def _known(self) -> Floats:
        """(m,) degrees of freedom, at least those of the mixture: an improbable,
        poorly known level would have the longest tail and explain residuals of any
        size."""
        return np.maximum(self.dof, min(self.students_dof, float(self.dof.max())))

    def log_likelihood(self, chi2: Floats, left: int) -> Floats:
        """Log likelihood, up to a constant, of residuals in ``left`` degrees of
        freedom with chi-square ``chi2`` (any shape) under the stated variance: a
        mixture of multivariate Student distributions."""
        chi2 = np.log(np.maximum(chi2, CHI2_LEAST))
        # Tabulate this function of one variable, then interpolate on even steps.
        grid, step = np.linspace(chi2.min(), chi2.max() + 1e-9, GRID, retstep=True)
        dof = self._known
        constant = special.gammaln((dof + left) / 2) - special.gammaln(dof / 2) - left / 2 * np.log(dof * self.variance)
        each = constant - (dof + left) / 2 * np.log1p(np.exp(grid)[:, None] / (dof * self.variance))
        known = special.logsumexp(each, axis=1, b=self.share)
        place = (chi2 - grid[0]) / step
        below = np.minimum(place.astype(np.int64), GRID - 2)
        return np.asarray(known[below] + (place - below) * np.diff(known)[below])


BANDS = 1.25
"""Ratio of the edges of the bands that collect the ordinates of a periodogram."""
TIME_CONSTANTS = 12
"""Number of first-order processes, evenly spaced in the logarithm. They share one
prior, so their number costs only time; fewer leave gaps."""
LENGTHS = 12
"""Number of moving averages, spaced likewise."""
SLOWEST = 0.40
"""exp(3/2 − γ) / 2π: ∫(1 − sinc²(πx)) dx/x from 0 to X tends to ln X + ln 2π +
γ − 3/2."""
STEPS = 12
"""Steps of the search for amplitudes. The number is fixed for identical bits on every
machine; each step costs as much as the first."""
FLICKER = 0.3
"""Prior odds of 1/f noise strong enough to matter."""
GAPS = 1 / 3
"""Missing share of a pose above which the slow noise absorbed by its mean is computed
(`_taken_by_the_mean`). Bumps leave smaller gaps; after a long disturbance 1/f noise
would come out at a third of its size."""
PART = 2**20
"""Numbers held at once in each of the few arrays of a long pose: 8 MiB."""
MISFIT = 1e-3
"""Probability of the fit below which the model is fitted to lower frequencies
only."""


@dataclass(frozen=True)
class Track:
    """Deviations (n,q) of q quantities from their mean over a pose, at whole
    places (n,) in units of a window."""

    place: Ints
    deviation: Floats

    def __len__(self) -> int:
        return len(self.place)

    @property
    def length(self) -> int:
        """Length of the pose in windows, with the excluded ones."""
        return int(self.place[-1] - self.place[0]) + 1

    def pairs(self, weight: Floats | None = None) -> Floats:
        """(length,) sums of the products of weights (default 1) over all pairs of
        windows at lag k."""
        # Autocorrelation of the weights by FFT.
        there = np.zeros(self.length)
        there[self.place - self.place[0]] = 1.0 if weight is None else weight
        size = fft.next_fast_len(2 * self.length, real=True)
        return np.asarray(fft.irfft(np.abs(fft.rfft(there, size)) ** 2, size)[: self.length])

    def centred(self) -> Floats:
        """(n,) places from their middle."""
        return np.asarray(self.place - self.place.mean())


@dataclass(frozen=True)
class Periodogram:
    """Rows of one band of one pose each: ``power`` (r,q), expected power of every
    component (r,c), ``weight`` (r,) as half the degrees of freedom, ``frequency`` in
    cycles a window, index ``pose``."""

    power: Floats
    expected: Floats
    weight: Floats
    frequency: Floats
    pose: Ints

    def only(self, rows: Bools) -> Periodogram:
        return Periodogram(
            self.power[rows], self.expected[rows], self.weight[rows], self.frequency[rows], self.pose[rows]
        )


@dataclass(frozen=True)
class Components:
    """Autocovariances (c, lags) of the components of a spectrum: white, 1/f,
    first-order for each time constant, moving averages for each length, and none."""

    autocovariance: Floats

    @classmethod
    def of(cls, lags: int, typical: float, recording: float) -> Components:
        """Components for poses of ``typical`` length in a recording of given length,
        both in windows.

        1/f noise is a mixture of first-order processes with time constants spread
        evenly in the logarithm. Noise slower than the recording is common to all
        poses and counts as bias: the variance of 1/f noise about its mean over a
        length L is that of its part above SLOWEST / L.
        """
        # Grids of time constants and lengths, evenly spaced in the logarithm.
        constants = np.geomspace(0.4, max(typical / 5, 0.8), TIME_CONSTANTS)
        lengths = np.geomspace(0.5, max(typical / 8, 1.0), LENGTHS)
        mixture = np.geomspace(0.03, max(recording / (2 * np.pi * SLOWEST), 1.0), 160)
        # 1/f noise: the mean of first-order processes.
        many = np.zeros(lags)
        for constant in mixture:  # one by one: a pose may last for a day
            many += first_order_windows(constant, lags)
        many = many / len(mixture) * np.log(mixture[-1] / mixture[0])
        rows = [np.eye(1, lags)[0], many, *(first_order_windows(t, lags) for t in constants)]
        rows += [*(moving_average_windows(t, lags) for t in lengths), np.zeros(lags)]
        return cls(np.array(rows))

    @property
    def models(self) -> Ints:
        """(m,3) indices of the components of each model; the last component, a row of
        zeros, means none."""
        none = len(self.autocovariance) - 1
        orders = range(2, none)
        rows = [(0, none, none), (0, 1, none), *((0, none, i) for i in orders), *((0, 1, i) for i in orders)]
        return np.array(rows, dtype=np.int64)

    def parts(self, lags: int) -> Iterator[Floats]:
        """(·, lags) blocks of the autocovariances of limited memory; multiples of
        eight rows, so that the blocking does not change the last bits."""
        at_once = max(PART // (8 * lags), 1) * 8
        for first in range(0, len(self.autocovariance), at_once):
            yield self.autocovariance[first : first + at_once, :lags]

    def variance_of_mean(self, n: int) -> Floats:
        """(c,) variance of a mean over n windows: Σ (n − |k|) γ(k) / n²."""
        pairs = np.r_[n, 2.0 * np.arange(n - 1, 0, -1)]
        return np.asarray(self.autocovariance[:, :n] @ pairs / n**2)


def first_order_windows(constant: float, lags: int) -> Floats:
    """Autocovariance of window averages of a first-order process of unit variance."""
    k = np.arange(lags, dtype=float)
    # Integrals of exp(−|t|/τ) over two windows at lag k, and within one window.
    fall = -np.expm1(-1 / constant)
    out = constant**2 * fall**2 * np.exp(-np.maximum(k - 1, 0) / constant)
    out[0] = 2 * constant**2 * (1 / constant - fall)
    return np.asarray(out)


def moving_average_windows(length: float, lags: int) -> Floats:
    """Autocovariance of window averages of white noise averaged over a length: the
    fourth-order difference of |t|³."""
    steps = [(-1, 1.0), (0, -2.0), (1, 1.0)]
    k = np.arange(lags, dtype=float)
    out = np.sum([a * b * np.abs(k + i + j * length) ** 3 for i, a in steps for j, b in steps], axis=0)
    return np.asarray(np.where(k < 1 + length, out, 0.0) / out[0])


def periodogram(tracks: Sequence[Track], components: Components, lowest: int = 1) -> Periodogram:
    """Periodogram of all tracks, without the first ``lowest`` − 1 ordinates of
    each."""
    rows: list[tuple[Floats, Floats, Floats, Floats, Ints]] = []
    for number, track in enumerate(tracks):
        n = track.length
        # Power spectrum, with gaps as zeros.
        filled = np.zeros((n, track.deviation.shape[1]))
        filled[track.place - track.place[0]] = track.deviation
        power = np.abs(fft.rfft(filled, axis=0)) ** 2 / len(track)
        j = np.arange(lowest, n // 2 + 1)
        if not len(j):
            continue
        # Collect the ordinates: single ones up to 8, then bands of constant ratio.
        weight = np.where(2 * j == n, 0.5, 1.0)
        band = np.where(j < 8, j, 8 + np.floor(np.log(np.maximum(j, 8) / 8) / np.log(BANDS)).astype(int))
        first = np.flatnonzero(np.diff(band, prepend=-1))
        total = np.add.reduceat(weight, first)
        # Exact expectation: the transform of the autocovariance times the pair counts,
        # which includes leakage (Sykulski et al. 2019).
        pairs, sums = track.pairs(), [np.add.reduceat(power[j] * weight[:, None], first, axis=0)]
        for part in components.parts(n):
            weighted = part * pairs
            expected = (2 * fft.rfft(weighted, axis=1).real - weighted[:, :1]).T / len(track)
            if len(track) < (1 - GAPS) * n:
                expected = expected - _taken_by_the_mean(track, part, weighted)
            sums.append(np.add.reduceat(expected[j] * weight[:, None], first, axis=0))
        # Weighted means of the bands.
        means = [np.asarray(s / total[:, None]) for s in (sums[0], np.concatenate(sums[1:], axis=1))]
        centre = np.add.reduceat(j * weight, first) / total / n
        rows.append((means[0], means[1], total, centre, np.full(len(first), number)))
    return Periodogram(*(np.concatenate(column) for column in zip(*rows, strict=True)))


def _taken_by_the_mean(track: Track, autocovariance: Floats, weighted: Floats) -> Floats:
    """(n//2+1,c) reduction of the expected power of a track with gaps by the
    subtraction of its mean; without gaps it is zero except at frequency zero.

    With the transforms X of the readings and M of the m windows present, the
    transform becomes X(f) − M(f) X(0)/m.
    """
    n = track.length
    there = np.zeros(n)
    there[track.place - track.place[0]] = 1.0
    # Extend the autocovariance to negative lags, circularly.
    size = fft.next_fast_len(2 * n, real=True)
    both = np.zeros((len(autocovariance), size))
    both[:, :n] = autocovariance
    both[:, size - n + 1 :] = autocovariance[:, :0:-1]
    # Covariance of each reading with the sum of all.
    with_sum = fft.irfft(fft.rfft(both, axis=1) * fft.rfft(there, size), size, axis=1)[:, :n] * there
    # |X − M X(0)/m|² = |X|² − 2 Re(X M* X(0)*)/m + |M|² |X(0)|²/m².
    of_mean = (2 * weighted.sum(axis=1) - weighted[:, 0]) / len(track) ** 2
    mask = fft.rfft(there)
    crossed = 2 * (fft.rfft(with_sum, axis=1) * mask.conj()).real / len(track)
    return np.asarray((crossed - np.abs(mask) ** 2 * of_mean[:, None]).T / len(track))


@dataclass(frozen=True)
class Spectrum:
    """Autocovariance (q, lags) of window means up to the level of each pose;
    ``levels`` of the variance of a mean of typical length for each quantity.
    ``highest`` is the upper limit of the fitted frequencies."""

    autocovariance: Floats
    levels: tuple[NoiseLevels, ...]
    highest: float

    @property
    def dof(self) -> Floats:
        """(q,) degrees of freedom of intervals, from the levels."""
        return np.array([level.students_dof for level in self.levels])

    def variance_of_mean(self, track: Track) -> Floats:
        """(q,) variance of the mean of a track: Σ γ(k) pairs(k) / n²."""
        return self._sum(track.pairs()) / len(track) ** 2

    def variance_of_slope(self, track: Track) -> Floats:
        """(q,) variance of a least-squares slope a window."""
        x = track.centred()
        return self._sum(track.pairs(x)) / float(x @ x) ** 2

    def _sum(self, pairs: Floats) -> Floats:
        held = self.autocovariance[:, : len(pairs)] * pairs
        # Lower bound, a thousandth of the white-noise value: rounding and lines at the
        # Nyquist frequency.
        return np.asarray(np.maximum(2 * held.sum(axis=1) - held[:, 0], 1e-3 * held[:, 0]))


def fitted(p: Periodogram, components: Components, typical: int, learned: Bools) -> tuple[Spectrum, Floats]:
    """The spectrum of every quantity from the rows ``learned`` (r,) of ``p``, and the
    expected power (r,q) of every row."""
    highest = 0.5
    # Halve the highest frequency until the model fits.
    while True:
        part = p.only(learned & (p.frequency <= highest))
        amplitude, levels = _averaged(part, components, typical)
        if highest / 2 * typical < 5 or _fits(part, part.expected @ amplitude.T):
            break
        highest /= 2
    return Spectrum(amplitude @ components.autocovariance, levels, highest), p.expected @ amplitude.T


def _fits(p: Periodogram, expected: Floats) -> bool:
    """Whether the residuals of the frequency bands over all poses are consistent with
    noise."""
    # Chi-square of mean power over expectation in each band.
    band = np.floor(np.log(np.maximum(p.frequency, 1e-9)) / np.log(1.3)).astype(int)
    _, group = np.unique(band, return_inverse=True)
    weight = np.bincount(group, p.weight)
    off = [
        np.bincount(group, p.weight * (i / np.maximum(e, 1e-300) - 1))
        for i, e in zip(p.power.T, expected.T, strict=True)
    ]
    misfit = float((np.square(off) / weight).sum())
    return misfit < float(chi2_isf(MISFIT, np.size(off)))


def _averaged(p: Periodogram, components: Components, typical: int) -> tuple[Floats, tuple[NoiseLevels, ...]]:
    """Amplitudes (q,c) averaged over the models, and the levels (q) of the variance
    of a mean."""
    models, n = components.models, components.variance_of_mean(typical)
    # Whittle fit of every model to every quantity.
    fits = [_amplitudes(p.expected[:, models], column, p.weight) for column in p.power.T]
    # Models of one kind with different time constants share one prior.
    none = len(n) - 1
    flicker, order = models[:, 1] != none, models[:, 2] != none
    free = len(fits) * (1 + flicker + order)
    prior = np.where(order, 1 / (TIME_CONSTANTS + LENGTHS), 1.0) * np.where(flicker, FLICKER, 1.0)
    # BIC weight: prior × exp(−loss − ½ parameters ln n).
    loss = np.sum([f[1] for f in fits], axis=0) + free * np.log(max(len(fits) * p.weight.sum(), 2.0)) / 2
    share = prior * np.exp(loss.min() - loss)
    share /= share.sum()
    out, levels = np.zeros((len(fits), len(n))), []
    # Variance of the mean under each model, and its error by the delta method.
    for i, (amplitude, _, information) in enumerate(fits):
        np.add.at(out[i], models, share[:, None] * amplitude)
        each = (n[models] * amplitude).sum(axis=1)
        gradient = np.where(amplitude > 0, n[models], 0.0)
        spread = np.einsum("mi,mij,mj->m", gradient, np.linalg.pinv(information, hermitian=True), gradient)
        levels.append(NoiseLevels.of(share, each, 2 * each**2 / np.maximum(spread, 1e-12 * each**2 + 1e-300)))
    return out, tuple(levels)


SUBSETS = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [1, 0, 1], [0, 1, 1], [1, 1, 1]], dtype=bool)
"""Subsets of the three amplitudes that may be positive: all seven are solved, the
best is used."""


def _amplitudes(basis: Floats, power: Floats, weight: Floats) -> tuple[Floats, Floats, Floats]:
    """For ``basis`` (r,m,3) of m models: non-negative amplitudes (m,3) that maximise
    Whittle's likelihood; its negative (m,); Fisher information (m,3,3) of the
    positive ones."""
    # Scale power and basis to order one.
    size = float(np.average(power, weights=weight))
    power = power / (size or 1.0)
    level = np.maximum(np.average(basis, axis=0, weights=weight), 1e-300)
    basis = np.ascontiguousarray((basis / level).transpose(1, 0, 2))
    used = level > 1e-200
    amplitude = np.where(used, 1.0, 0.0) / used.sum(axis=1, keepdims=True)
    # A fixed number of steps: where to stop must not hang on the last bits,
    # which differ between processors.
    for step in range(STEPS):
        expected = np.maximum((basis @ amplitude[:, :, None])[:, :, 0], 1e-9)
        scaled = basis * (np.sqrt(weight) / expected)[:, :, None]
        information = scaled.transpose(0, 2, 1) @ scaled
        target = (scaled.transpose(0, 2, 1) @ (power * np.sqrt(weight) / expected)[:, :, None])[:, :, 0]
        new = _nonnegative(information, target, used)
        amplitude = (amplitude + new) / 2 if step < 3 else new
    expected = np.maximum((basis @ amplitude[:, :, None])[:, :, 0], 1e-9)
    loss = (np.log(expected) + power / expected) @ weight
    held = amplitude > 0
    information = information * (held[:, :, None] & held[:, None, :]) * level[:, :, None] * level[:, None, :]
    return amplitude * size / level, np.asarray(loss), information / max(size, 1e-150) ** 2


def _nonnegative(information: Floats, target: Floats, used: Bools) -> Floats:
    """(m,3) non-negative least-squares solutions of normal equations: the best of the
    solutions in all subsets without a negative element."""
    # Scale to a unit diagonal, then solve all subsets at once.
    scale = 1 / np.sqrt(np.maximum(np.einsum("mii->mi", information), 1e-300))
    matrix = information * scale[:, :, None] * scale[:, None, :] + 1e-10 * np.eye(3)
    vector = target * scale
    allowed = SUBSETS[None] & used[:, None, :]
    both = allowed[..., :, None] & allowed[..., None, :]
    solved = np.linalg.solve(
        np.where(both, matrix[:, None], np.eye(3)), np.where(allowed, vector[:, None], 0.0)[..., None]
    )[..., 0]
    # The feasible subset with the largest gain.
    gain = np.where((solved >= 0).all(axis=2), np.einsum("msi,mi->ms", solved, vector), -np.inf)
    best = solved[np.arange(len(solved)), np.argmax(gain, axis=1)]
    return np.asarray(best * scale)
