"""Tones in a pose: a machine shakes the stand at frequencies of its own, or at
those to which the windows fold them.

A tone averages out as one over the length of the pose, and noise as its root.
Taken for noise, it makes the standard error of a mean several times too large.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from scipy import fft

from triaxcal.arrays import Floats
from triaxcal.poses.noise_spectrum import Track

CYCLES_LEAST = 4.0
"""What is slower, in cycles a pose, is the noise that the mean has."""
WINDOWS_LEAST = 24
"""A pose of 2.4 s (decision 0025): shorter ones have too little noise beside a
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
