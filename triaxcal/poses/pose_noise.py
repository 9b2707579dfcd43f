"""Variances of pose means from the scatter of the windows in all poses
together.

The shape of the noise's spectrum is one unit's, so it is estimated from all
poses; its size is each pose's own, shrunk towards the common one as far as the
poses agree (empirical Bayes of variances; Smyth 2004, Stat. Appl. Genet. Mol.
Biol. 3:3). A restless pose, shaken or held by hand among others that lie still,
has a noise of its own: it would raise the common one (as the hypervariable
genes of Phipson et al. 2016, Ann. Appl. Stat. 10:946)."""

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

# Tones in a pose: a machine shakes the stand at frequencies of its own, or at those
# to which the windows fold them.

CYCLES_LEAST = 4.0
"""What is slower, in cycles a pose, is the noise that the mean has."""
WINDOWS_LEAST = 24
"""A pose of 2.4 s: shorter ones have too little noise beside a
tone to tell it by."""
TONES_MOST = 6
"""Each takes three degrees of freedom: so many leave a quarter of the shortest
pose's."""
LOUD = 30.0
"""A tone is so many times the median power about its frequency; noise makes one
in one pose of two hundred."""
ABOUT = 8
"""The median is taken over so many cycles a pose to either side."""
PADDED = 2
"""Times the length, by zeros appended: bins are half a cycle apart, so that a
tone between two of them loses less."""


@dataclass(frozen=True)
class Cleaned:
    """A track without its tones, and the ``variance`` (q,) that they give its
    mean."""

    track: Track
    variance: Floats


def without_tones(track: Track) -> Cleaned:
    """A sine of amplitude A and j cycles adds about A/πj to a mean at most;
    half the square of that over the phases, and half of this over the parts of
    a cycle that are left.
    """
    q = track.deviation.shape[1]
    variance, left, tones = np.zeros(q), track.deviation, 0
    if len(track) < WINDOWS_LEAST:
        return Cleaned(track, variance)
    while tones < TONES_MOST and (found := _loudest(track, left)) is not None:
        frequency = _refined(track, left[:, found[1]], found[0])
        sines, coefficients = _fitted(track, left, frequency)
        left = left - sines @ coefficients
        most = 1 / (track.length * np.sin(np.pi * frequency))
        variance = variance + (coefficients**2).sum(axis=0) / 4 * most**2
        tones += 1
    if tones:
        # Frequency, amplitude and phase took some of the noise with them.
        left = (left - left.mean(axis=0)) * np.sqrt(len(track) / (len(track) - 3.0 * tones))
        track = Track(track.place, left)
    return Cleaned(track, variance)


def _fitted(track: Track, deviation: Floats, frequency: float) -> tuple[Floats, Floats]:
    """Cosine and sine (n,2) of a frequency, and their amplitudes (2,q) beside a
    straight line."""
    x = track.centred()
    angle = 2 * np.pi * frequency * x
    columns = np.stack([np.cos(angle), np.sin(angle), np.ones_like(x), x], axis=1)
    return columns[:, :2], np.linalg.lstsq(columns, deviation, rcond=None)[0][:2]


def _refined(track: Track, deviation: Floats, frequency: float) -> float:
    """The frequency by one step of Gauss and Newton for deviations (n,), at
    most half a cycle a pose away."""
    sines, (a, b) = _fitted(track, deviation, frequency)
    rest = deviation - sines @ (a, b)
    by_frequency = 2 * np.pi * track.centred() * (b * sines[:, 0] - a * sines[:, 1])
    columns = np.concatenate([sines, by_frequency[:, None]], axis=1)
    step = float(np.linalg.lstsq(columns, rest, rcond=None)[0][2])
    return frequency + float(np.clip(step, -0.5 / track.length, 0.5 / track.length))


def _loudest(track: Track, deviation: Floats) -> tuple[float, int] | None:
    """Frequency, in cycles a window, and column of what stands out most in the
    spectrum; None where nothing does."""
    n = track.length
    taper = np.sin(np.pi * (track.place - track.place[0] + 0.5) / n) ** 2
    filled = np.zeros((n, deviation.shape[1]))
    filled[track.place - track.place[0]] = deviation * taper[:, None]
    power = np.abs(fft.rfft(filled, PADDED * n, axis=0)) ** 2
    usual = scipy.ndimage.median_filter(power, size=(2 * PADDED * ABOUT + 1, 1), mode="reflect")
    ratio = (power / np.maximum(usual, 1e-300)).max(axis=1)
    first = int(np.ceil(PADDED * CYCLES_LEAST))
    last = len(power) - PADDED  # at half the rate of the windows sine and cosine are one
    if last <= first:
        return None
    peak = first + int(np.argmax(ratio[first:last]))
    if ratio[peak] < LOUD:
        return None
    column = int(np.argmax(power[peak] / np.maximum(usual[peak], 1e-300)))
    below, at, above = np.log(np.maximum(power[peak - 1 : peak + 2, column], 1e-300))
    bend = below - 2 * at + above
    beside = 0.5 * (below - above) / bend if bend < 0 else 0.0
    return float(peak + np.clip(beside, -0.5, 0.5)) / (PADDED * n), column


FALSE_CREEP = 0.01
"""Probability that a recording of still poses shows a creeping one."""
RESTLESS = 3.0
"""Times the scatter of most poses: less does not raise the common noise, nor is
it worth a word."""
RESTLESS_SIGMA = 6.0
"""And so many standard deviations of the logarithm of the poses' variances above
their median, by chance or as these differ: poses held by hand differ by much."""
JUDGES = 6
"""Poses of which a median says what is usual."""
SLOWEST_ORDINATES = 4
"""The noise that moves the mean of a restless pose is that of its slowest
ordinates, where these are louder than the rest: its spectrum is its own."""


@dataclass(frozen=True)
class PoseNoise:
    """For k poses and q quantities, (k,q) each: variance of the mean, degrees
    of freedom behind it, least-squares slope a window, its standard error, and
    its significance in standard deviations. ``limit`` is where the latter is
    more than chance. What the variances of all poses have in common is the
    shape of the spectrum: ``levels`` say what it may make them, of the quantity
    that is known least, and ``common_dof`` the same as degrees of freedom.
    ``restless`` (k,) is how many times as much as most poses a pose scatters
    that is not as they are; 1 for these.
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
        """(k,q)"""
        return np.asarray(np.abs(self.significance) > self.limit)


def pose_noise(
    tracks: Sequence[Track], recording: float, creeping: Bools | None = None, steps: Floats | None = None
) -> PoseNoise:
    """``recording`` is its length in windows. ``creeping`` (k,) are poses known
    to creep; without it they are found. ``steps`` (k,q): how far the steps of
    the output may move the mean of a window, which makes no pose restless.
    """
    cleaned = [without_tones(t) for t in tracks]
    tracks = [c.track for c in cleaned]
    slope = np.array([t.centred() @ t.deviation / (t.centred() @ t.centred()) for t in tracks])
    straight = [Track(t.place, t.deviation - t.centred()[:, None] * s) for t, s in zip(tracks, slope, strict=True)]
    limit = float(normal_isf(FALSE_CREEP / (2 * slope.size)))
    moves = np.array([t.deviation.std(axis=0) for t in straight]) > (0.0 if steps is None else RESTLESS * steps)
    if creeping is None:
        # What creeps must not pass for slow noise: the first look is at what a
        # straight line leaves.
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
    """What the poses show: their ``periodogram``, the ``components`` that may
    make it, and their own ``scatter`` (k,q) with its degrees of freedom (k,).
    """

    periodogram: Periodogram
    components: Components
    typical: int
    scatter: Floats
    dof: Floats
    hops: Floats
    """(k,q) half the mean square difference of neighbouring windows, which no
    slow noise raises."""
    slowest: Bools
    """Rows of the periodogram that say most of a pose's mean."""

    @classmethod
    def of(cls, tracks: Sequence[Track], recording: float, lowest: int) -> _Power:
        typical = max(int(np.median([t.length for t in tracks])), 3)
        length = np.array([t.length for t in tracks])
        longest = int(length.max())
        components = Components.of(max(typical, longest), typical, recording)
        own = np.array([(t.deviation**2).sum(axis=0) / max(len(t) - 1, 1) for t in tracks])
        own = np.maximum(own, 1e-12 * own.max(axis=0, initial=0.0) + 1e-300)
        p = periodogram(tracks, components, lowest if longest // 2 >= lowest + 2 else 1)
        slowest = p.frequency * length[p.pose] < SLOWEST_ORDINATES + 0.5
        hops = np.array([(np.diff(t.deviation, axis=0) ** 2).mean(axis=0) / 2 for t in tracks])
        return cls(p, components, typical, own, np.array([max(len(t) - 1.0, 1.0) for t in tracks]), hops, slowest)

    def heard(self, expected: Floats, rows: Floats) -> tuple[Floats, Floats]:
        """(k,q) mean power of each pose over the ``expected`` (r,q), in these
        ``rows`` (r,1) by their weights, and its degrees of freedom."""
        p = self.periodogram
        heard, dof = np.zeros((2, *self.scatter.shape))
        np.add.at(heard, p.pose, rows * p.power / np.maximum(expected, 1e-300))
        np.add.at(dof, p.pose, 2 * rows)
        dof = np.maximum(dof, 1e-3)
        return np.maximum(2 * heard / dof, 1e-12), dof


@dataclass(frozen=True)
class _Model:
    """The common spectrum, and by how much (k,q) each pose's noise is above it;
    ``own`` is the same by its own
    scatter alone, of ``own_dof`` degrees of freedom. ``restless`` (k,) poses are
    no part of what is common."""

    spectrum: Spectrum
    scale: Floats
    scale_dof: Floats
    own: Floats
    own_dof: Floats
    restless: Bools

    @classmethod
    def of(cls, tracks: Sequence[Track], recording: float, moves: Bools, lowest: int = 1) -> _Model:
        """``moves`` (k,q): what scatters by more than the steps of the output,
        and may be restless."""
        power = _Power.of(tracks, recording, lowest)
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
        if restless.any():
            slow, slow_dof = power.heard(expected, used * power.slowest[:, None])
            louder = restless[:, None] & (slow > scale)
            scale, scale_dof = np.where(louder, slow, scale), np.where(louder, slow_dof, scale_dof)
        return cls(spectrum, scale, scale_dof, own, dof, restless)

    def mean_variance(self, tracks: Sequence[Track]) -> Floats:
        return np.asarray(self.scale * np.array([self.spectrum.variance_of_mean(t) for t in tracks]))

    def significance(self, tracks: Sequence[Track], slope: Floats) -> Floats:
        """(k,q) of slopes, in standard deviations; of what exceeds the slope
        that a vibration makes."""
        excess = np.maximum(np.abs(slope) - self.vibration_slope(tracks), 0.0)
        return np.asarray(np.sign(slope) * excess / self.slope_error(tracks))

    def slope_error(self, tracks: Sequence[Track]) -> Floats:
        """(k,q) standard error of the slopes by noise."""
        variance = self.scale * np.array([self.spectrum.variance_of_slope(t) for t in tracks])
        return np.asarray(np.sqrt(np.maximum(variance, 1e-300)))

    def vibration_slope(self, tracks: Sequence[Track]) -> Floats:
        """(k,q) the largest slope that a sine of the scatter's size makes by
        the part of a period at its ends.

        Zero where the spectrum was fitted to the end: there is none then.
        """
        if self.spectrum.highest >= 0.5:
            return np.zeros_like(self.scale)
        size = np.array([np.sqrt(2 * (t.deviation**2).mean(axis=0)) / t.length**2 for t in tracks])
        return np.asarray(6 * size / np.sin(np.pi * self.spectrum.highest))

    def restlessness(self) -> Floats:
        """(k,)"""
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
    log = np.log(own)
    above = log - np.median(log, axis=0)
    spread = 1.4826 * np.median(np.abs(above), axis=0)
    sigma = np.maximum(spread, np.sqrt(special.polygamma(1, dof / 2)))
    return np.asarray(above > np.maximum(RESTLESS_SIGMA * sigma, 2 * np.log(RESTLESS)))


def shrunk(own: Floats, dof: Floats, usual: Bools | None = None) -> tuple[Floats, Floats]:
    """Variances (k,q) of ``dof`` degrees of freedom, (k,) or (k,q), shrunk
    towards their common value, and the degrees of freedom (k,q) that they have
    then; infinite where the poses agree, as the common value is all there is.
    What is common is that of the ``usual`` ones (k,); the others stay as they
    are.
    """
    dof = np.broadcast_to(dof if dof.ndim == 2 else dof[:, None], own.shape)
    if usual is not None and not usual.all():
        out = own.copy(), dof.astype(float)
        for values, of in zip(out, shrunk(own[usual], dof[usual]), strict=True):
            values[usual] = of
        return out
    common = (own * dof).sum(axis=0) / dof.sum(axis=0)
    prior = np.full(own.shape[1], np.inf)
    if len(own) > 2:
        log = np.log(np.maximum(own, 1e-12 * np.maximum(common, 1e-300)))
        weight = np.sqrt(np.minimum(dof, 100.0))
        centre = (weight * log).sum(axis=0) / weight.sum(axis=0)
        spread = (weight * (log - centre) ** 2).sum(axis=0) / weight.sum(axis=0) * len(own) / (len(own) - 1)
        chance = (weight * special.polygamma(1, dof / 2)).sum(axis=0) / weight.sum(axis=0)
        # The spread of k logarithms is itself uncertain by √(2/(k−1)).
        excess = spread - chance
        for axis in np.flatnonzero(excess > 0):
            prior[axis] = 2 * _inverse_trigamma(float(excess[axis]))
    few = np.isfinite(prior)
    share = np.where(few, dof / (dof + np.where(few, prior, 1.0)), 0.0)
    return share * own + (1 - share) * common, np.where(few, dof + prior, np.inf)


def _inverse_trigamma(value: float) -> float:
    """x with trigamma(x) = value, by Newton's method on 1/trigamma, which is
    nearly straight."""
    x = 0.5 + 1 / value
    for _ in range(50):
        tri = float(special.polygamma(1, x))
        step = tri * (1 - tri / value) / float(special.polygamma(2, x))
        x += step
        if abs(step) < 1e-9 * x:
            break
    return x


# The noise of pose means: a covariance that minds autocorrelation, creep and
# rounding.

LONGEST = 2**17
"""Windows of a pose whose noise is taken window by window; of a longer one,
three and a half hours, several are averaged, since the arrays of a day would
take half a gigabyte."""
SHORTEST = 64
"""So many windows, or averages of some, even the shortest pose keeps."""
SHAKEN, QUIET = 2.0, 0.1
"""Poses are shaken in which the outputs scatter with so many times the variance
of the quietest tenth of them."""


@dataclass(frozen=True)
class MeanNoise:
    """Of k poses, in output units: ``covariance`` (k,3,3) of the means without
    creep; ``creep`` and ``slope`` (k,3), ``slope_error`` and ``dof`` (k,),
    ``shared_dof`` and ``levels`` as `triaxcal.poses.pose.Pose` has them;
    ``restless`` (k,) as `PoseNoise` has it, along the measured vector where that
    is known."""

    covariance: Floats
    creep: Floats
    slope: Floats
    slope_error: Floats
    dof: Floats
    shared_dof: float
    levels: NoiseLevels
    restless: Floats


def noise_of_means(w: Windows, spans: Sequence[Span], mean: Floats) -> MeanNoise:
    """Of the still spans, whose means (k,3) are known."""
    at_once = _averaged_at_once([len(s.used) for s in spans])
    tracks = [_track(w, s, at_once) for s in spans]
    recording = float(w.end_ns[spans[-1].last] - w.start_ns[spans[0].first]) / w.period_ns / at_once
    steps = np.tile(widest_steps(w), (len(spans), 1))
    noise = pose_noise(tracks, recording, steps=steps)
    creeping = np.asarray(noise.creeping.any(axis=1))
    length = np.array([t.place[-1] - t.place[0] for t in tracks])[:, None]
    creep = np.where(creeping[:, None], noise.slope * length, 0.0)
    covariance = np.array(
        [_correlation(w, s) * np.outer(e, e) for s, e in zip(spans, np.sqrt(noise.variance), strict=True)]
    )
    dof, shared_dof, levels, restless = noise.dof.min(axis=1), noise.common_dof, noise.levels, noise.restless
    slope, slope_error = noise.slope * (length + 1), np.full(len(spans), np.inf)
    out = _outward(mean)
    if out is not None:
        along, predicted = _along(w, spans, tracks, out, recording, creeping, steps)
        covariance = _mended(covariance, out, along.variance[:, 0] * predicted**2)
        dof, shared_dof, levels, restless = along.dof[:, 0], along.common_dof, along.levels, along.restless
        # A unit that turns creeps across the measured vector; along it only
        # where that shows by itself.
        slope_error = along.slope_error[:, 0] * predicted * (length[:, 0] + 1)
        radial = np.einsum("ki,ki->k", creep, out) * ~along.creeping[:, 0]
        creep = creep - radial[:, None] * out
    covariance = covariance + np.diag(_rounding(w, spans))
    return MeanNoise(covariance, creep, slope, slope_error, dof, shared_dof, levels, restless)


def _averaged_at_once(lengths: Sequence[int]) -> int:
    """How many windows are averaged. The variance of a mean is the sum of the
    autocovariances, which averages of neighbours keep; what lies above their
    frequency averages out of the mean itself."""
    at_once = 1
    while max(lengths) > LONGEST * at_once and min(lengths) >= 2 * SHORTEST * at_once:
        at_once *= 2
    return at_once


def _track(w: Windows, s: Span, at_once: int) -> Track:
    """Places by time, so that a silence inside a pose counts as the windows
    that it lacks."""
    place = np.round((w.start_ns[s.used] - w.start_ns[s.first]) / w.period_ns).astype(np.int64)
    place = np.maximum.accumulate(place - np.arange(len(place))) + np.arange(len(place))
    deviation = w.mean[s.used] - w.mean[s.used].mean(axis=0)
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
    """(k,3) unit gradients of the length of the measured vector at pose means
    (k,3), in output units; known well enough from the range of the means, for
    six poses or more.
    """
    half = (mean.max(axis=0) - mean.min(axis=0)) / 2
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
    """Noise of the poses along the measured vector, in units (k,) of what the
    scatter inside the windows predicts.

    A unit that is held by hand, or on a stand that settles, turns a little in
    every pose. That moves the outputs across the measured vector, where |a|
    does not feel it, and raises the scatter of every axis; along the vector the
    noise is the sensor's own.
    """
    # A scale for each pose, never zero, not even where a coarse output never
    # changed in it.
    scatter = np.array([w.variance[s.used].mean(axis=0) for s in spans]) + resolution(w) ** 2 / 12
    # Where a machine shakes the stand the scatter is the machine's, most of
    # which a window averages out.
    scatter = np.minimum(scatter, SHAKEN * np.quantile(scatter, QUIET, axis=0))
    inside = np.array([_correlation(w, s) for s in spans]) * [np.outer(e, e) for e in np.sqrt(scatter / w.size)]
    predicted = np.sqrt(np.maximum(np.einsum("ki,kij,kj->k", out, inside, out), 1e-300))
    radial = [Track(t.place, (t.deviation @ g / p)[:, None]) for t, g, p in zip(tracks, out, predicted, strict=True)]
    rounded = np.sqrt((steps**2 * out**2).sum(axis=1)) / predicted
    return pose_noise(radial, recording, creeping, rounded[:, None]), predicted


def _mended(covariance: Floats, out: Floats, along: Floats) -> Floats:
    """Covariances (k,3,3) whose part along ``out`` (k,3) is ``along`` (k,)."""
    now = np.maximum(np.einsum("ki,kij,kj->k", out, covariance, out), 1e-300)
    across = np.einsum("kij,kj->ki", covariance, out) / now[:, None]
    return np.asarray(covariance + (along - now)[:, None, None] * across[:, :, None] * across[:, None, :])


def _rounding(w: Windows, spans: Sequence[Span]) -> Floats:
    """(3,) variance of what rounding of the outputs leaves in a mean, where no
    shaking averages it out."""
    scatter = np.array([w.variance[s.used].mean(axis=0) for s in spans])
    # Half-way between two steps readings have a variance of a quarter.
    usual = np.maximum(np.median(scatter, axis=0), resolution(w) ** 2 / 4)
    quiet = np.asarray((scatter <= SHAKEN * usual).all(axis=1))
    quiet |= not quiet.any()
    return left_in_means(w, scatter[quiet], np.array([len(s.used) for s in spans])[quiet])
