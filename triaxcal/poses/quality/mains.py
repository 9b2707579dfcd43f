"""Mains lines in the spectrum of still poses, at their own frequency or as aliases.

Segments of a second, half overlapping, with a Hann window (Welch 1967); only the bins
about the frequencies in question are kept until the still spans are known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import fft

from triaxcal.arrays import Bools, Floats, Ints
from triaxcal.distributions import gamma_sf
from triaxcal.poses.quality.finding import MainsPickup, StillIntervals, Tone

MAINS_HZ = (50.0, 60.0)
"""Nominal frequencies of the public grids."""
HARMONICS = (1, 2, 3)
"""The mains and two harmonics. Each further one is one more place where noise, or a
motor, may be taken for it."""
TOLERANCE = 0.02
"""Relative tolerance: the mains wander by half a hertz in fifty, and the sampling
clock by up to one percent."""
SEGMENT_S = 1.0
"""Length of a segment; one bin is 1 Hz then. Longer segments fit into fewer poses;
shorter ones do not separate a line from the noise next to it."""
SEGMENT_LEAST = 16
"""Least samples in a segment at low rates; so few bins have no room for a band."""
SEGMENTS_MOST = 2**13
"""Number of segments that are kept, of 1.1 hours: at 1 kHz they take 15 MB. Of a
longer stream every second one is kept, every fourth, and so on. Four times as many
would show lines 0.7 times as high, which are far below the noise of a sample."""
SEGMENTS_LEAST = 8
"""Segments of still poses below which their mean spectrum is too uncertain."""
GAP = 4.0
"""Sample periods of silence after which a segment ends."""
GUARD = 3
"""Bins from a band to its flank: a line at its edge extends over two through a Hann
window."""
FLANK = 8
"""Bins of a flank: a line at the edge extends into the first ones, the others show
the noise."""
FALSE_ALARM = 3e-4
"""Probability of a false alarm for all tests of a recording together: one test for
each axis and bin has this over their number (Bonferroni). White noise raises a third
of these alarms (simulated at 0.01 and 0.03), since a line also has to exceed its
neighbouring bins."""
OUTLYING = 4.0
"""Standard deviations above the noise next to a band, beyond which bins hold another
line."""
STRONG = 4.0  # over the median level: a machine was on, or somebody knocked
KNOCK = 12.0
"""Factor over the level of most segments beyond which a segment is excluded, and
largest weight of a single bin: knocks."""
WIDEST = 0.125
"""Share of the sampling rate that the band of a folded line may cover."""


@dataclass(frozen=True)
class Band:
    """Bins (b,) about the frequency ``at_hz`` at which a line of ``source_hz`` shows,
    as an alias where ``folded``.

    ``inside`` (b,) may hold the line, ``flank`` (b,) shows the noise.
    """

    source_hz: float
    at_hz: float
    folded: bool
    bins: Ints
    inside: Bools
    flank: Bools


@dataclass(frozen=True)
class Line:
    """``amplitude`` (3,) output units, zero where the axis does not show it."""

    band: Band
    frequency_hz: float
    amplitude: Floats
    p_value: float


def bands(rate_hz: float, size: int) -> list[Band]:
    """Bands in which the mains may show in segments of ``size`` samples. Aliased
    harmonics are ambiguous and omitted, as are aliases in the slow noise at the
    bottom of the spectrum."""
    top, bin_hz = size // 2, rate_hz / size
    found: list[Band] = []
    for harmonic in HARMONICS:
        for mains in MAINS_HZ:
            source = mains * harmonic
            # Frequency of the alias, and the bins that the line may reach.
            at = abs(source - rate_hz * round(source / rate_hz))
            folded = source > rate_hz / 2 * (1 + TOLERANCE / 2)
            reach = TOLERANCE * source
            if folded and (harmonic > 1 or reach > WIDEST * rate_hz):
                continue
            low, high = int(np.ceil((at - reach) / bin_hz - 0.5)), int(np.floor((at + reach) / bin_hz + 0.5))
            bins = np.arange(max(low - GUARD - FLANK, 2), min(high + GUARD + FLANK, top) + 1)
            inside = (bins >= low) & (bins <= high)
            flank = (bins < low - GUARD + 1) | (bins > high + GUARD - 1)
            if low - GUARD < 2 or flank.sum() < FLANK:
                continue
            found.append(Band(source, at, folded, bins, inside, flank))
    return found


@dataclass
class Spectra:
    """Power of segments of the stream in the bins of `bands`, of one in ``every`` of
    them. Fed chunks in order."""

    period_ns: float
    size: int = 0
    bands: list[Band] = field(default_factory=list)
    every: int = 1
    _count: int = 0
    _held: Floats = field(default_factory=lambda: np.zeros((3, 0)))
    _held_ns: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    _start_ns: list[int] = field(default_factory=list)
    _end_ns: list[int] = field(default_factory=list)
    _power: list[Floats] = field(default_factory=list)

    def __post_init__(self) -> None:
        rate = 1e9 / self.period_ns
        self.size = max(2 * round(SEGMENT_S * rate / 2), SEGMENT_LEAST)
        self.bands = bands(rate, self.size)
        self._kept = np.unique(np.concatenate([b.bins for b in self.bands])) if self.bands else np.zeros(0, np.int64)
        self._taper = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(self.size) / self.size)

    def feed(self, time_ns: Ints, u: Floats) -> None:
        """``u`` (3,n)."""
        if not self.bands:
            return
        times, held = np.concatenate([self._held_ns, time_ns]), np.concatenate([self._held, u], axis=1)
        breaks = np.flatnonzero(np.diff(times) > GAP * self.period_ns) + 1
        at = 0
        for stop in (*breaks, len(times)):
            while stop - at >= self.size:
                self._take(times[at : at + self.size], held[:, at : at + self.size])
                at += self.size // 2
            at = stop if stop < len(times) else at
        self._held_ns, self._held = times[at:].copy(), held[:, at:].copy()

    def _take(self, time_ns: Ints, u: Floats) -> None:
        """Take one segment at a time, so that results do not depend on the size of
        the blocks."""
        self._count += 1
        if (self._count - 1) % self.every:
            return
        if len(self._power) == SEGMENTS_MOST:
            self.every *= 2
            for kept in (self._power, self._start_ns, self._end_ns):
                del kept[1::2]
        rest = (u - u.mean(axis=1, keepdims=True)) * self._taper
        spectrum = fft.rfft(rest, axis=1)[:, self._kept]
        self._power.append((spectrum.real**2 + spectrum.imag**2).astype(np.float32))
        self._start_ns.append(int(time_ns[0]))
        self._end_ns.append(int(time_ns[-1]))

    def lines(self, holds: StillIntervals) -> list[Line]:
        """The mains lines in the segments that lie in still spans."""
        if not self._power:
            return []
        still = holds.within(np.array(self._start_ns), np.array(self._end_ns)) >= 0
        chosen = np.flatnonzero(still)
        if len(chosen) < SEGMENTS_LEAST:
            return []
        tests = 3 * sum(int(b.inside.sum()) for b in self.bands)
        found: list[Line] = []
        for band in self.bands:
            line = self._judged(band, chosen, FALSE_ALARM / tests)
            if line is not None and not any(abs(line.frequency_hz - f.frequency_hz) < 1.0 for f in found):
                found.append(line)
        return found

    def _judged(self, band: Band, chosen: Ints, alarm: float) -> Line | None:
        """The line of a band from the power of ``chosen`` segments (m,), or None."""
        amplitude, places, least = np.zeros(3), np.zeros(3), 1.0
        bin_hz = 1e9 / self.period_ns / self.size
        first = int(np.searchsorted(self._kept, band.bins[0]))
        bins = slice(first, first + len(band.bins))
        for axis in range(3):
            power = np.array([self._power[i][axis, bins] for i in chosen], dtype=float)
            # Segments with a usual level; ratio of their mean spectrum to that level.
            level = np.median(power[:, band.flank], axis=1)
            sound = (level > 1e-12 * power.max(initial=0.0)) & (level < STRONG * np.median(level))
            if sound.sum() < SEGMENTS_LEAST:
                continue
            # One level for all: a bin over its own segment's level is small
            # where that is drawn from it.
            usual = float(np.mean(level[sound]))
            ratios = power[sound] / usual
            ratio, clipped = ratios.mean(axis=0), np.minimum(ratios, KNOCK).mean(axis=0)
            # Test of the highest bin, interpolation of its frequency, amplitude from
            # its excess.
            peak, p_value, floor = _peak(band, ratio, clipped, int(sound.sum()), self.size // 2)
            if peak < 0 or p_value > alarm:
                continue
            place = (band.bins[peak] + _offset(ratio - floor, peak)) * bin_hz
            if abs(place - band.at_hz) > TOLERANCE * band.source_hz + 0.25 * bin_hz:
                continue
            about = slice(max(peak - 2, 0), peak + 3)
            excess = float((ratio - floor)[about].sum()) * usual
            amplitude[axis] = np.sqrt(max(4 * excess / (self.size * float((self._taper**2).sum())), 0.0))
            places[axis], least = place, min(least, p_value)
        if not amplitude.any():
            return None
        return Line(band, float(places[int(np.argmax(amplitude))]), amplitude, least)


def _peak(band: Band, ratio: Floats, clipped: Floats, segments: int, top: int) -> tuple[int, float, Floats]:
    """The highest bin inside the band, or -1 where it is the skirt of a line outside;
    the probability of such a height by noise, from means without knocks; and the
    noise (b,), smooth over the flanks."""
    x = np.log(band.bins / band.bins.mean())
    log = np.log(np.maximum(clipped, 1e-300))
    used = band.flank.copy()
    independent = segments / 1.06  # half overlap through a Hann window (Welch 1967)
    expected = 1 / np.sqrt(independent)
    order = 2 if band.bins[-1] < top and (band.bins > band.bins[band.inside][-1]).sum() >= FLANK else 1
    for _ in range(4):
        # Robust polynomial fit of the log power over the flanks.
        fitted = np.polyval(np.polyfit(x[used], log[used], order), x)
        off = log - fitted
        spread = max(expected, 1.4826 * float(np.median(np.abs(off[used]))))
        kept = band.flank & (off < OUTLYING * spread)
        if kept.sum() < FLANK or (kept == used).all():
            break
        used = kept
    spread = max(expected, float(np.sqrt(np.mean(off[used] ** 2) * used.sum() / (used.sum() - order - 1))))
    # The highest bin must exceed its neighbours.
    candidates = np.flatnonzero(band.inside)
    peak = int(candidates[np.argmax(ratio[candidates])])
    about = ratio[max(peak - 2, 0) : peak + 3]
    if ratio[peak] < about.max():
        return -1, 1.0, np.exp(fitted)
    # Degrees of freedom that give the spread seen, fewer at the top of the
    # spectrum, where there is no imaginary part.
    shape = 1 / spread**2 / (2 if band.bins[peak] == top else 1)
    p_value = _raised(float(np.exp(off[peak])), shape, int(used.sum()) / (order + 1))
    # A line is narrow: three bins away it is gone, while the skirt of something
    # broad is not.
    neighbours = [clipped[i] for d in (3, 4) for i in (peak - d, peak + d) if 0 <= i < len(clipped)]
    narrow = _raised(float(clipped[peak] / np.mean(neighbours)), shape, len(neighbours))
    return peak, max(p_value, narrow), np.exp(fitted)


def _raised(excess: float, shape: float, bins: float) -> float:
    """Probability that noise of ``shape`` degrees of freedom raises a bin by
    ``excess`` above a level from ``bins`` bins."""
    held = shape / (1 + 1 / bins)
    return float(gamma_sf(excess * held, held))


def _offset(excess: Floats, peak: int) -> float:
    """Offset of a line from its peak bin, in bins, by the ratio of the neighbouring
    amplitudes through a Hann window."""
    neighbours = [excess[i] if 0 <= i < len(excess) else 0.0 for i in (peak - 1, peak + 1)]
    up = neighbours[1] > neighbours[0]
    share = float(np.sqrt(max(neighbours[int(up)], 0.0) / max(excess[peak], 1e-300)))
    return float(np.clip((2 * share - 1) / (share + 1), 0.0, 0.5)) * (1 if up else -1)


def pickup(lines: Sequence[Line], rate_hz: float) -> MainsPickup:
    tones = []
    for line in lines:
        x, y, z = (float(a) for a in line.amplitude)
        tones.append(Tone(line.frequency_hz, (x, y, z), line.band.source_hz if line.band.folded else None))
    return MainsPickup(tuple(tones), rate_hz)
