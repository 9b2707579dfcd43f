"""Variances of pose means from the scatter of the windows in all poses together.

The shape of the noise's spectrum is a property of the unit and is estimated from all
poses. Its level is each pose's own, shrunk towards the common one as far as the poses
agree (empirical Bayes of variances; Smyth 2004, Stat. Appl. Genet. Mol. Biol. 3:3). A
restless pose, shaken or held by hand among static ones, keeps a level of its own: it
would raise the common one (as the hypervariable genes of Phipson et al. 2016, Ann.
Appl. Stat. 10:946).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from scipy import fft, special

from triaxcal.arrays import Bools, Floats
from triaxcal.distributions import normal_isf
from triaxcal.poses.noise_spectrum import Components, NoiseLevels, Periodogram, Spectrum, Track, fitted, periodogram
from triaxcal.poses.stillness.detector import Span
from triaxcal.poses.stillness.windows import Windows, left_in_means, resolution, widest_steps

# Tones in a pose: a machine shakes the stand at its own frequencies, or at their
# aliases in the windows.

CYCLES_LEAST = 4.0
"""In cycles a pose: slower tones are not distinguished from the noise of the mean."""
WINDOWS_LEAST = 24
"""Windows of a pose of 2.4 s: in shorter ones the noise next to a
tone is too little to detect it against."""
TONES_MOST = 6
"""Each tone takes three degrees of freedom: so many leave a quarter of those of the
shortest pose."""
PROMINENT = 30.0
"""Ratio of a tone's power to the median power at neighbouring frequencies; noise
exceeds it in one pose of two hundred."""
ABOUT = 8
"""Range of the median in cycles a pose, to either side."""
PADDED = 2
"""Length after zero padding over the length: bins are half a cycle apart, so a tone
between two of them loses less."""


@dataclass(frozen=True)
class Cleaned:
    """A track without its tones, and the ``variance`` (q,) of its mean due to
    them."""

    track: Track
    variance: Floats


def without_tones(track: Track) -> Cleaned:
    """Subtract tones one by one, the strongest first.

    A sine of amplitude A and j cycles changes a mean by about A/πj at most. The mean
    square over the phases halves this, and so does that over the incomplete cycle.
    """
    q = track.deviation.shape[1]
    variance, left, tones = np.zeros(q), track.deviation, 0
    if len(track) < WINDOWS_LEAST:
        return Cleaned(track, variance)
    # Strongest tone, its frequency refined, fitted with a straight line and subtracted.
    while tones < TONES_MOST and (found := _strongest(track, left)) is not None:
        frequency = _refined(track, left[:, found[1]], found[0])
        sines, coefficients = _fitted(track, left, frequency)
        left = left - sines @ coefficients
        # Worst-case gain of the mean at this frequency; A²/4 times its square.
        most = 1 / (track.length * np.sin(np.pi * frequency))
        variance = variance + (coefficients**2).sum(axis=0) / 4 * most**2
        tones += 1
    if tones:
        # Frequency, amplitude and phase took some of the noise with them.
        left = (left - left.mean(axis=0)) * np.sqrt(len(track) / (len(track) - 3.0 * tones))
        track = Track(track.place, left)
    return Cleaned(track, variance)


def _fitted(track: Track, deviation: Floats, frequency: float) -> tuple[Floats, Floats]:
    """Cosine and sine (n,2) of a frequency, and their amplitudes (2,q), fitted
    together with a straight line."""
    x = track.centred()
    angle = 2 * np.pi * frequency * x
    columns = np.stack([np.cos(angle), np.sin(angle), np.ones_like(x), x], axis=1)
    return columns[:, :2], np.linalg.lstsq(columns, deviation, rcond=None)[0][:2]


def _refined(track: Track, deviation: Floats, frequency: float) -> float:
    """The frequency after one Gauss–Newton step for deviations (n,), at most half a
    cycle a pose away."""
    # Linearise about the present frequency: ∂/∂f of a cos + b sin.
    sines, (a, b) = _fitted(track, deviation, frequency)
    rest = deviation - sines @ (a, b)
    by_frequency = 2 * np.pi * track.centred() * (b * sines[:, 0] - a * sines[:, 1])
    columns = np.concatenate([sines, by_frequency[:, None]], axis=1)
    step = float(np.linalg.lstsq(columns, rest, rcond=None)[0][2])
    return frequency + float(np.clip(step, -0.5 / track.length, 0.5 / track.length))


def _strongest(track: Track, deviation: Floats) -> tuple[float, int] | None:
    """Frequency in cycles a window, and column, of the strongest peak over the
    background; None where no peak exceeds it enough."""
    # Hann-tapered, zero-padded power spectrum, with gaps as zeros.
    n = track.length
    taper = np.sin(np.pi * (track.place - track.place[0] + 0.5) / n) ** 2
    filled = np.zeros((n, deviation.shape[1]))
    filled[track.place - track.place[0]] = deviation * taper[:, None]
    power = np.abs(fft.rfft(filled, PADDED * n, axis=0)) ** 2
    # Background: running median over the frequency.
    usual = scipy.ndimage.median_filter(power, size=(2 * PADDED * ABOUT + 1, 1), mode="reflect")
    ratio = (power / np.maximum(usual, 1e-300)).max(axis=1)
    first = int(np.ceil(PADDED * CYCLES_LEAST))
    last = len(power) - PADDED  # at half the rate of the windows sine and cosine are one
    if last <= first:
        return None
    peak = first + int(np.argmax(ratio[first:last]))
    if ratio[peak] < PROMINENT:
        return None
    column = int(np.argmax(power[peak] / np.maximum(usual[peak], 1e-300)))
    # Interpolate the peak by a parabola through the logarithms of three bins.
    below, at, above = np.log(np.maximum(power[peak - 1 : peak + 2, column], 1e-300))
    bend = below - 2 * at + above
    offset = 0.5 * (below - above) / bend if bend < 0 else 0.0
    return float(peak + np.clip(offset, -0.5, 0.5)) / (PADDED * n), column


FALSE_CREEP = 0.01
"""Probability that a recording of still poses shows a creeping one."""
RESTLESS = 3.0
"""In scatters of most poses: a smaller excess does not raise the common noise and is
not reported."""
RESTLESS_SIGMA = 6.0
"""And in standard deviations of the logarithm of the poses' variances above their
median, by chance or by their own spread: poses held by hand differ by much."""
JUDGES = 6
"""Number of poses from which a median gives the usual scatter."""
SLOWEST_ORDINATES = 4
"""The noise of the mean of a restless pose follows from its slowest ordinates, where
these exceed the rest: its spectrum is its own."""


@dataclass(frozen=True)
class PoseNoise:
    """Noise of k poses in q quantities, (k,q) each: ``variance`` of the mean, its
    degrees of freedom ``dof``, the least-squares ``slope`` a window, ``slope_error``,
    and ``significance`` of the slope in standard deviations, which chance keeps below
    ``limit``.

    All variances share the shape of the spectrum: ``levels`` is its contribution to
    their uncertainty, for the quantity that is known least, and ``common_dof`` the
    same as degrees of freedom. ``restless`` (k,) is the ratio of a restless pose's
    scatter to that of most poses; 1 for the others.
    """

    variance: Floats
    dof: Floats
    slope: Floats
    slope_error: Floats
    significance: Floats
    limit: float
    levels: NoiseLevels
    common_dof: float
    restless: Floats

    @property
    def creeping(self) -> Bools:
        """(k,q) whether the slope exceeds the noise."""
        return np.asarray(np.abs(self.significance) > self.limit)


def pose_noise(
    tracks: Sequence[Track], recording: float, creeping: Bools | None = None, steps: Floats | None = None
) -> PoseNoise:
    """The noise of all poses. ``recording`` is its length in windows. ``creeping``
    (k,) are poses known to creep; by default they are detected. ``steps`` (k,q):
    change of a window's mean by the steps of the output, which makes no pose
    restless."""
    # Remove tones, then straight lines.
    cleaned = [without_tones(t) for t in tracks]
    tracks = [c.track for c in cleaned]
    slope = np.array([t.centred() @ t.deviation / (t.centred() @ t.centred()) for t in tracks])
    straight = [Track(t.place, t.deviation - t.centred()[:, None] * s) for t, s in zip(tracks, slope, strict=True)]
    # Two-sided limit for all slopes together (Bonferroni).
    limit = float(normal_isf(FALSE_CREEP / (2 * slope.size)))
    moves = np.array([t.deviation.std(axis=0) for t in straight]) > (0.0 if steps is None else RESTLESS * steps)
    if creeping is None:
        # Creep must not count as slow noise: start from residuals of straight lines,
        # then alternate between the model and the set of creeping poses.
        model = _Model.of(straight, recording, moves, lowest=2)
        for _ in range(2):
            before: Bools | None = creeping
            creeping = np.asarray((np.abs(model.significance(tracks, slope)) > limit).any(axis=1))
            if before is not None and np.array_equal(before, creeping):
                break
            model = _Model.of(_mixed(tracks, straight, creeping), recording, moves)
    else:
        model = _Model.of(_mixed(tracks, straight, creeping), recording, moves)
    significance = model.significance(tracks, slope)
    variance = model.mean_variance(tracks) + np.array([c.variance for c in cleaned])
    error = model.slope_error(tracks) + model.vibration_slope(tracks)
    return PoseNoise(
        variance, model.dof(), slope, error, significance, limit, model.levels, model.common_dof, model.restlessness()
    )


def _mixed(tracks: Sequence[Track], straight: Sequence[Track], creeping: Bools) -> list[Track]:
    return [s if c else t for t, s, c in zip(tracks, straight, creeping, strict=True)]


@dataclass(frozen=True)
class _Power:
    """Power of the poses: their ``periodogram``, the ``components`` of the model, and
    their own ``scatter`` (k,q) with its degrees of freedom (k,)."""

    periodogram: Periodogram
    components: Components
    typical: int
    scatter: Floats
    dof: Floats
    hops: Floats
    """(k,q) half the mean square difference of neighbouring windows, which slow noise
    does not raise."""
    slowest: Bools
    """Rows of the periodogram that determine the mean of their pose."""

    @classmethod
    def of(cls, tracks: Sequence[Track], recording: float, lowest: int) -> _Power:
        # Variance of the windows in each pose, never zero.
        typical = max(int(np.median([t.length for t in tracks])), 3)
        length = np.array([t.length for t in tracks])
        longest = int(length.max())
        components = Components.of(max(typical, longest), typical, recording)
        own = np.array([(t.deviation**2).sum(axis=0) / max(len(t) - 1, 1) for t in tracks])
        own = np.maximum(own, 1e-12 * own.max(axis=0, initial=0.0) + 1e-300)
        # Periodogram without the ordinates that a straight line absorbs.
        p = periodogram(tracks, components, lowest if longest // 2 >= lowest + 2 else 1)
        slowest = p.frequency * length[p.pose] < SLOWEST_ORDINATES + 0.5
        # Half the mean square successive difference (von Neumann).
        hops = np.array([(np.diff(t.deviation, axis=0) ** 2).mean(axis=0) / 2 for t in tracks])
        return cls(p, components, typical, own, np.array([max(len(t) - 1.0, 1.0) for t in tracks]), hops, slowest)

    def heard(self, expected: Floats, rows: Floats) -> tuple[Floats, Floats]:
        """(k,q) mean power of each pose over the ``expected`` (r,q), with the rows
        weighted by ``rows`` (r,1), and its degrees of freedom."""
        p = self.periodogram
        heard, dof = np.zeros((2, *self.scatter.shape))
        np.add.at(heard, p.pose, rows * p.power / np.maximum(expected, 1e-300))
        np.add.at(dof, p.pose, 2 * rows)
        dof = np.maximum(dof, 1e-3)
        return np.maximum(2 * heard / dof, 1e-12), dof


@dataclass(frozen=True)
class _Model:
    """The common spectrum, and (k,q) the level of each pose relative to it; ``own`` is
    the same from its own scatter alone, of ``own_dof`` degrees of freedom.
    ``restless`` (k,) poses do not enter the common part."""

    spectrum: Spectrum
    scale: Floats
    scale_dof: Floats
    own: Floats
    own_dof: Floats
    restless: Bools

    @classmethod
    def of(cls, tracks: Sequence[Track], recording: float, moves: Bools, lowest: int = 1) -> _Model:
        """``moves`` (k,q): the scatter exceeds the steps of the output, so the pose
        may be restless."""
        power = _Power.of(tracks, recording, lowest)
        # Fit with all poses, detect restless ones, fit again without them.
        model = cls._fitted(power, np.zeros(len(tracks), dtype=bool))
        # Differences of white noise have 2/3 of its degrees of freedom.
        hopping = _outlying(np.maximum(power.hops, 1e-300), power.dof[:, None] / 1.5)
        for _ in range(2):
            restless = np.asarray(((_outlying(model.own, model.own_dof) | hopping) & moves).any(axis=1))
            if np.array_equal(restless, model.restless) or restless[power.periodogram.pose].all():
                break
            model = cls._fitted(power, restless)
        return model

    @classmethod
    def _fitted(cls, power: _Power, restless: Bools) -> _Model:
        # Alternate: spectrum of the powers over their levels, then levels over the
        # spectrum.
        p, usual = power.periodogram, ~restless
        scale, _ = shrunk(power.scatter / np.median(power.scatter[usual], axis=0), power.dof, usual)
        for _ in range(2):
            even = Periodogram(p.power / scale[p.pose], p.expected, p.weight, p.frequency, p.pose)
            spectrum, expected = fitted(even, power.components, power.typical, usual[p.pose])
            used = (p.frequency[:, None] <= spectrum.highest) * p.weight[:, None]
            own, dof = power.heard(expected, used)
            before = scale
            scale, scale_dof = shrunk(own, dof, usual)
            if np.allclose(scale / before, (scale / before).mean(axis=0), rtol=0.01):
                break
        # Restless poses: level of the slowest ordinates, where this is larger.
        if restless.any():
            slow, slow_dof = power.heard(expected, used * power.slowest[:, None])
            stronger = restless[:, None] & (slow > scale)
            scale, scale_dof = np.where(stronger, slow, scale), np.where(stronger, slow_dof, scale_dof)
        return cls(spectrum, scale, scale_dof, own, dof, restless)

    def mean_variance(self, tracks: Sequence[Track]) -> Floats:
        # Variance of the mean: level times the sum of the autocovariances.
        return np.asarray(self.scale * np.array([self.spectrum.variance_of_mean(t) for t in tracks]))

    def significance(self, tracks: Sequence[Track], slope: Floats) -> Floats:
        """(k,q) slopes in standard deviations, less the slope that a vibration may
        cause."""
        excess = np.maximum(np.abs(slope) - self.vibration_slope(tracks), 0.0)
        return np.asarray(np.sign(slope) * excess / self.slope_error(tracks))

    def slope_error(self, tracks: Sequence[Track]) -> Floats:
        """(k,q) standard error of the slopes by noise."""
        variance = self.scale * np.array([self.spectrum.variance_of_slope(t) for t in tracks])
        return np.asarray(np.sqrt(np.maximum(variance, 1e-300)))

    def vibration_slope(self, tracks: Sequence[Track]) -> Floats:
        """(k,q) largest slope that the incomplete period of a sine of the same
        scatter can cause.

        Zero where the spectrum was fitted up to the Nyquist frequency: then there is
        no vibration above it.
        """
        if self.spectrum.highest >= 0.5:
            return np.zeros_like(self.scale)
        size = np.array([np.sqrt(2 * (t.deviation**2).mean(axis=0)) / t.length**2 for t in tracks])
        return np.asarray(6 * size / np.sin(np.pi * self.spectrum.highest))

    def restlessness(self) -> Floats:
        """(k,) ratio of the scatter of restless poses to the median; 1 for the
        others."""
        times = np.sqrt((self.own / np.median(self.own, axis=0)).max(axis=1))
        return np.where(self.restless, times, 1.0)

    @property
    def levels(self) -> NoiseLevels:
        return self.spectrum.levels[int(np.argmin(self.spectrum.dof))]

    @property
    def common_dof(self) -> float:
        return float(self.spectrum.dof.min())

    def dof(self) -> Floats:
        """(k,q) of the common spectrum and of the pose's own scale together."""
        return np.asarray(1 / (1 / self.spectrum.dof + 1 / self.scale_dof))


def _outlying(own: Floats, dof: Floats) -> Bools:
    """(k,q) variances (k,q) far above those of most poses."""
    if len(own) < JUDGES:
        return np.zeros(own.shape, dtype=bool)
    # Robust z-score of the log variances; at least their sampling error ψ′(ν/2).
    log = np.log(own)
    above = log - np.median(log, axis=0)
    spread = 1.4826 * np.median(np.abs(above), axis=0)
    sigma = np.maximum(spread, np.sqrt(special.polygamma(1, dof / 2)))
    return np.asarray(above > np.maximum(RESTLESS_SIGMA * sigma, 2 * np.log(RESTLESS)))


def shrunk(own: Floats, dof: Floats, usual: Bools | None = None) -> tuple[Floats, Floats]:
    """Variances (k,q) of ``dof`` degrees of freedom, (k,) or (k,q), shrunk towards
    their common value, with their degrees of freedom (k,q) afterwards; infinite where
    the poses agree.

    The common value is that of the ``usual`` ones (k,); the others stay unchanged.
    """
    dof = np.broadcast_to(dof if dof.ndim == 2 else dof[:, None], own.shape)
    if usual is not None and not usual.all():
        out = own.copy(), dof.astype(float)
        for values, of in zip(out, shrunk(own[usual], dof[usual]), strict=True):
            values[usual] = of
        return out
    # Pooled variance.
    common = (own * dof).sum(axis=0) / dof.sum(axis=0)
    prior = np.full(own.shape[1], np.inf)
    if len(own) > 2:
        # Excess of the spread of the log variances over their sampling error ψ′(ν/2)
        # gives the prior degrees of freedom, ψ′(ν₀/2) = excess (Smyth 2004).
        log = np.log(np.maximum(own, 1e-12 * np.maximum(common, 1e-300)))
        weight = np.sqrt(np.minimum(dof, 100.0))
        centre = (weight * log).sum(axis=0) / weight.sum(axis=0)
        spread = (weight * (log - centre) ** 2).sum(axis=0) / weight.sum(axis=0) * len(own) / (len(own) - 1)
        chance = (weight * special.polygamma(1, dof / 2)).sum(axis=0) / weight.sum(axis=0)
        # The spread of k logarithms is itself uncertain by √(2/(k−1)).
        excess = spread - chance
        for axis in np.flatnonzero(excess > 0):
            prior[axis] = 2 * _inverse_trigamma(float(excess[axis]))
    # Weighted mean of own and common variance: (ν s² + ν₀ s₀²) / (ν + ν₀).
    few = np.isfinite(prior)
    share = np.where(few, dof / (dof + np.where(few, prior, 1.0)), 0.0)
    return share * own + (1 - share) * common, np.where(few, dof + prior, np.inf)


def _inverse_trigamma(value: float) -> float:
    """x with trigamma(x) = value, by Newton's method on 1/trigamma, which is nearly
    linear."""
    x = 0.5 + 1 / value
    for _ in range(50):
        tri = float(special.polygamma(1, x))
        step = tri * (1 - tri / value) / float(special.polygamma(2, x))
        x += step
        if abs(step) < 1e-9 * x:
            break
    return x


# The covariance of pose means, with autocorrelation, creep and rounding.

LONGEST = 2**17
"""Largest number of windows of a pose that are treated one by one. In longer poses
(over three and a half hours) several are averaged: the arrays of a day would take
half a gigabyte."""
SHORTEST = 64
"""Smallest number of windows, or averages, that the shortest pose keeps."""
VIBRATING, QUIETEST_SHARE = 2.0, 0.1
"""A pose is vibrating where its outputs have so many times the variance of the
quietest tenth of the poses."""


@dataclass(frozen=True)
class MeanNoise:
    """Noise of k poses in output units: ``covariance`` (k,3,3) of the means without
    creep; ``creep`` and ``slope`` (k,3), ``slope_error`` and ``dof`` (k,),
    ``shared_dof`` and ``levels`` as in `triaxcal.poses.pose.Pose`; ``restless`` (k,)
    as in `PoseNoise`, along the measured vector where this is known."""

    covariance: Floats
    creep: Floats
    slope: Floats
    slope_error: Floats
    dof: Floats
    shared_dof: float
    levels: NoiseLevels
    restless: Floats


def noise_of_means(w: Windows, spans: Sequence[Span], mean: Floats) -> MeanNoise:
    """The noise of the still spans with means (k,3)."""
    # Noise by axis, and the poses that creep.
    at_once = _averaged_at_once([len(s.used) for s in spans])
    tracks = [_track(w, s, at_once) for s in spans]
    recording = float(w.end_ns[spans[-1].last] - w.start_ns[spans[0].first]) / w.period_ns / at_once
    steps = np.tile(widest_steps(w), (len(spans), 1))
    noise = pose_noise(tracks, recording, steps=steps)
    creeping = np.asarray(noise.creeping.any(axis=1))
    # Creep: slope times the length of the pose.
    length = np.array([t.place[-1] - t.place[0] for t in tracks])[:, None]
    creep = np.where(creeping[:, None], noise.slope * length, 0.0)
    # Correlation from the samples inside the windows, scaled to the variances.
    covariance = np.array(
        [_correlation(w, s) * np.outer(e, e) for s, e in zip(spans, np.sqrt(noise.variance), strict=True)]
    )
    dof, shared_dof, levels, restless = noise.dof.min(axis=1), noise.common_dof, noise.levels, noise.restless
    slope, slope_error = noise.slope * (length + 1), np.full(len(spans), np.inf)
    # Noise along the measured vector, where its direction is known.
    out = _outward(mean)
    if out is not None:
        along, predicted = _along(w, spans, tracks, out, recording, creeping, steps)
        covariance = _mended(covariance, out, along.variance[:, 0] * predicted**2)
        dof, shared_dof, levels, restless = along.dof[:, 0], along.common_dof, along.levels, along.restless
        # Rotation makes a pose creep across the measured vector; creep along it needs
        # evidence of its own.
        slope_error = along.slope_error[:, 0] * predicted * (length[:, 0] + 1)
        radial = np.einsum("ki,ki->k", creep, out) * ~along.creeping[:, 0]
        creep = creep - radial[:, None] * out
    # Rounding of the outputs does not average out.
    covariance = covariance + np.diag(_rounding(w, spans))
    return MeanNoise(covariance, creep, slope, slope_error, dof, shared_dof, levels, restless)


def _averaged_at_once(lengths: Sequence[int]) -> int:
    """Number of windows in an average. The variance of a mean is the sum of the
    autocovariances, which averages of neighbours preserve; faster noise averages out
    of the mean itself."""
    at_once = 1
    while max(lengths) > LONGEST * at_once and min(lengths) >= 2 * SHORTEST * at_once:
        at_once *= 2
    return at_once


def _track(w: Windows, s: Span, at_once: int) -> Track:
    """Windows of a pose at whole places by time, so that a gap counts as missing
    windows."""
    place = np.round((w.start_ns[s.used] - w.start_ns[s.first]) / w.period_ns).astype(np.int64)
    place = np.maximum.accumulate(place - np.arange(len(place))) + np.arange(len(place))
    deviation = w.mean[s.used]
    deviation -= deviation.mean(axis=0)
    if at_once == 1:
        return Track(place, deviation)
    first = np.flatnonzero(np.diff(place // at_once, prepend=-1))
    count = np.diff(first, append=len(place))[:, None]
    return Track(place[first] // at_once, np.add.reduceat(deviation, first, axis=0) / count)


def _correlation(w: Windows, s: Span) -> Floats:
    """(3,3) between the axes, from the samples inside the windows."""
    variance = w.variance[s.used].mean(axis=0)
    scale = np.maximum(np.sqrt(variance * variance[[1, 2, 0]]), 1e-300)
    xy, yz, zx = np.clip(w.cross[s.used].mean(axis=0) / scale, -0.99, 0.99)
    return np.array([[1, xy, zx], [xy, 1, yz], [zx, yz, 1]])


def _outward(mean: Floats) -> Floats | None:
    """(k,3) unit gradients of the length of the measured vector at pose means (k,3)
    in output units, from the range of the means; None for fewer than six poses."""
    half = (mean.max(axis=0) - mean.min(axis=0)) / 2
    # Gradient of Σ (uᵢ − cᵢ)² / hᵢ², with centre and half range of the means.
    if len(mean) < 6 or not np.all(half > 0):
        return None
    out = (mean - (mean.max(axis=0) + mean.min(axis=0)) / 2) / half**2
    return np.asarray(out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-300))


def _along(
    w: Windows,
    spans: Sequence[Span],
    tracks: Sequence[Track],
    out: Floats,
    recording: float,
    creeping: Bools,
    steps: Floats,
) -> tuple[PoseNoise, Floats]:
    """Noise of the poses along the measured vector, in units (k,) of the noise
    predicted from the scatter inside the windows.

    A unit held by hand, or on a settling stand, rotates a little in every pose. The
    outputs then change across the measured vector, where |a| does not respond, and
    the scatter of every axis rises; along the vector the noise is the sensor's own.
    """
    # The scale of each pose: never zero, not even with constant coarse outputs.
    scatter = np.array([w.variance[s.used].mean(axis=0) for s in spans]) + resolution(w) ** 2 / 12
    # Where a machine shakes the stand, the scatter is mostly the machine's, which a
    # window averages out.
    scatter = np.minimum(scatter, VIBRATING * np.quantile(scatter, QUIETEST_SHARE, axis=0))
    # Predicted standard deviation √(gᵀ Σ g) of a window mean along the vector.
    inside = np.array([_correlation(w, s) for s in spans]) * [np.outer(e, e) for e in np.sqrt(scatter / w.size)]
    predicted = np.sqrt(np.maximum(np.einsum("ki,kij,kj->k", out, inside, out), 1e-300))
    # Project the tracks onto the gradient.
    radial = [Track(t.place, (t.deviation @ g / p)[:, None]) for t, g, p in zip(tracks, out, predicted, strict=True)]
    rounded = np.sqrt((steps**2 * out**2).sum(axis=1)) / predicted
    return pose_noise(radial, recording, creeping, rounded[:, None]), predicted


def _mended(covariance: Floats, out: Floats, along: Floats) -> Floats:
    """Covariances (k,3,3) with the variance along ``out`` (k,3) replaced by ``along``
    (k,): Σ + (σ² − gᵀΣg) w wᵀ, w = Σg / gᵀΣg."""
    now = np.maximum(np.einsum("ki,kij,kj->k", out, covariance, out), 1e-300)
    across = np.einsum("kij,kj->ki", covariance, out) / now[:, None]
    return np.asarray(covariance + (along - now)[:, None, None] * across[:, :, None] * across[:, None, :])


def _rounding(w: Windows, spans: Sequence[Span]) -> Floats:
    """(3,) variance of the rounding error that remains in a mean without
    vibration."""
    scatter = np.array([w.variance[s.used].mean(axis=0) for s in spans])
    # Half-way between two steps readings have a variance of a quarter.
    usual = np.maximum(np.median(scatter, axis=0), resolution(w) ** 2 / 4)
    quiet = np.asarray((scatter <= VIBRATING * usual).all(axis=1))
    quiet |= not quiet.any()
    return left_in_means(w, scatter[quiet], np.array([len(s.used) for s in spans])[quiet])
