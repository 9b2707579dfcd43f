"""Variances of pose means from the scatter of the windows in all poses
together.

The shape of the noise's spectrum is one unit's, so it is estimated from all
poses; its size is each pose's own, shrunk towards the common one as far as the
poses agree (empirical Bayes of variances; Smyth 2004, Stat. Appl. Genet. Mol.
Biol. 3:3).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special

from triaxcal.arrays import Bools, Floats
from triaxcal.distributions import normal_isf
from triaxcal.poses.mean_variance_mixture import NoiseLevels
from triaxcal.poses.noise_spectrum import Components, Spectrum, Track, fitted, periodogram
from triaxcal.poses.tones import without_tones

FALSE_CREEP = 0.01
"""Probability that a recording of still poses shows a creeping one."""


@dataclass(frozen=True)
class PoseNoise:
    """For k poses and q quantities, (k,q) each: variance of the mean, degrees
    of freedom behind it, least-squares slope a window, its standard error, and
    its significance in standard deviations. ``limit`` is where the latter is
    more than chance. What the variances of all poses have in common is the
    shape of the spectrum: ``levels`` say what it may make them, of the quantity
    that is known least, and ``common_dof`` the same as degrees of freedom.
    """

    variance: Floats
    dof: Floats
    slope: Floats
    slope_error: Floats
    significance: Floats
    limit: float
    levels: NoiseLevels
    common_dof: float

    @property
    def creeping(self) -> Bools:
        """(k,q)"""
        return np.asarray(np.abs(self.significance) > self.limit)


def pose_noise(tracks: Sequence[Track], recording: float, creeping: Bools | None = None) -> PoseNoise:
    """``recording`` is its length in windows. ``creeping`` (k,) are poses known
    to creep; without it they are found."""
    cleaned = [without_tones(t) for t in tracks]
    tracks = [c.track for c in cleaned]
    slope = np.array([t.centred() @ t.deviation / (t.centred() @ t.centred()) for t in tracks])
    straight = [Track(t.place, t.deviation - t.centred()[:, None] * s) for t, s in zip(tracks, slope, strict=True)]
    limit = float(normal_isf(FALSE_CREEP / (2 * slope.size)))
    if creeping is None:
        # What creeps must not pass for slow noise: the first look is at what a
        # straight line leaves.
        model = _Model.of(straight, recording, lowest=2)
        for _ in range(2):
            before: Bools | None = creeping
            creeping = np.asarray((np.abs(model.significance(tracks, slope)) > limit).any(axis=1))
            if before is not None and np.array_equal(before, creeping):
                break
            model = _Model.of(_mixed(tracks, straight, creeping), recording)
    else:
        model = _Model.of(_mixed(tracks, straight, creeping), recording)
    significance = model.significance(tracks, slope)
    variance = model.mean_variance(tracks) + np.array([c.variance for c in cleaned])
    error = model.slope_error(tracks) + model.vibration_slope(tracks)
    return PoseNoise(variance, model.dof(), slope, error, significance, limit, model.levels, model.common_dof)


def _mixed(tracks: Sequence[Track], straight: Sequence[Track], creeping: Bools) -> list[Track]:
    return [s if c else t for t, s, c in zip(tracks, straight, creeping, strict=True)]


@dataclass(frozen=True)
class _Model:
    """The common spectrum, and by how much (k,q) each pose's noise is above it."""

    spectrum: Spectrum
    scale: Floats
    scale_dof: Floats

    @classmethod
    def of(cls, tracks: Sequence[Track], recording: float, lowest: int = 1) -> _Model:
        typical = max(int(np.median([t.length for t in tracks])), 3)
        lags = max(typical, *(t.length for t in tracks))
        components = Components.of(lags, typical, recording)
        own = np.array([(t.deviation**2).sum(axis=0) / max(len(t) - 1, 1) for t in tracks])
        floor = 1e-12 * own.max(axis=0, initial=0.0) + 1e-300
        own = np.maximum(own, floor)
        scale, _ = shrunk(own / np.median(own, axis=0), np.array([max(len(t) - 1.0, 1.0) for t in tracks]))
        longest = max(t.length for t in tracks)
        p = periodogram(tracks, components, lowest if longest // 2 >= lowest + 2 else 1)
        for _ in range(2):
            even = type(p)(p.power / scale[p.pose], p.expected, p.weight, p.frequency, p.pose)
            spectrum, expected = fitted(even, components, typical)
            used = (p.frequency[:, None] <= spectrum.highest) * p.weight[:, None]
            heard, dof = np.zeros((2, *scale.shape))
            np.add.at(heard, p.pose, used * p.power / np.maximum(expected, 1e-300))
            np.add.at(dof, p.pose, 2 * used)
            dof = np.maximum(dof, 1e-3)
            before = scale
            scale, scale_dof = shrunk(np.maximum(2 * heard / dof, 1e-12), dof)
            if np.allclose(scale / before, (scale / before).mean(axis=0), rtol=0.01):
                break
        return cls(spectrum, scale, scale_dof)

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

    @property
    def levels(self) -> NoiseLevels:
        return self.spectrum.levels[int(np.argmin(self.spectrum.dof))]

    @property
    def common_dof(self) -> float:
        return float(self.spectrum.dof.min())

    def dof(self) -> Floats:
        """(k,q) of the common spectrum and of the pose's own scale together."""
        return np.asarray(1 / (1 / self.spectrum.dof + 1 / self.scale_dof))


def shrunk(own: Floats, dof: Floats) -> tuple[Floats, Floats]:
    """Variances (k,q) of ``dof`` degrees of freedom, (k,) or (k,q), shrunk
    towards their common value, and the degrees of freedom (k,q) that they have
    then; infinite where the poses agree, as the common value is all there is.
    """
    dof = np.broadcast_to(dof if dof.ndim == 2 else dof[:, None], own.shape)
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
