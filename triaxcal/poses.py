"""Still spans as poses: the mean of the outputs, and a standard error that minds autocorrelation.

The shape of the noise's autocorrelation is one unit's, so it is estimated from all poses together; its size is
each pose's own, shrunk towards the common one as far as the poses agree (empirical Bayes of variances; Smyth 2004,
Stat. Appl. Genet. Mol. Biol. 3:3).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import special

from triaxcal.arrays import Floats, Ints
from triaxcal.errors import InvalidData
from triaxcal.stillness import Span, Windows, resolution

CREEP_SIGMA = 5.0


@dataclass(frozen=True)
class Pose:
    """One still span. ``mean`` (3,) and ``covariance`` (3,3) of the mean, output units; ``dof`` behind the covariance.

    ``channels`` are means over the span; ``t_s`` is the middle of the span, like ``start_s`` and ``end_s`` in seconds
    from the first sample. ``creep`` (3,) is the change of the outputs along the span, output units, where it is more
    than noise, else zero.
    """

    start_s: float
    end_s: float
    samples: int
    mean: Floats
    covariance: Floats
    dof: float
    channels: Mapping[str, float] = field(default_factory=dict)
    creep: Floats = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        if self.mean.shape != (3,) or self.covariance.shape != (3, 3):
            raise InvalidData("a pose has a mean (3,) and a covariance (3, 3)")
        if not (np.isfinite(self.mean).all() and np.isfinite(self.covariance).all()):
            raise InvalidData(f"pose at {self.start_s:.3f} s: mean or covariance is not a finite number")

    @property
    def t_s(self) -> float:
        return (self.start_s + self.end_s) / 2

    @property
    def standard_error(self) -> Floats:
        """(3,) of the mean, output units."""
        return np.sqrt(np.diag(self.covariance))


def poses_of(w: Windows, spans: Sequence[Span]) -> list[Pose]:
    """The poses of the still spans, in order of time."""
    if not spans:
        return []
    deviations = [w.mean[s.used] - w.mean[s.used].mean(axis=0) for s in spans]
    variance, dof = _own_variance(deviations)
    count = np.array([len(s.used) for s in spans])
    error = np.sqrt(variance / count[:, None] * _Inflation(deviations).of(count))
    covariance = np.array([_correlation(w, s) * np.outer(e, e) for s, e in zip(spans, error, strict=True)])
    mean = np.array([w.mean[s.used].mean(axis=0) for s in spans])
    covariance = _mend_along_the_radius(w, spans, mean, deviations, covariance) + np.diag(_rounding(w, spans))
    begin = int(w.start_ns[0])
    return [
        Pose(
            start_s=(int(w.start_ns[s.first]) - begin) * 1e-9,
            end_s=(int(w.end_ns[s.last]) - begin) * 1e-9,
            samples=len(s.used) * w.size,
            mean=mean[i],
            covariance=covariance[i],
            dof=float(dof[i].min()),
            channels={name: float(values[s.used].mean()) for name, values in w.channels.items()},
            creep=_creep(s, deviations[i], np.sqrt(variance[i])),
        )
        for i, s in enumerate(spans)
    ]


def _own_variance(deviations: Sequence[Floats]) -> tuple[Floats, Floats]:
    """Variance of one window's mean (k,q), shrunk, and the degrees of freedom behind it (k,q)."""
    dof = np.array([max(len(d) - 1, 1) for d in deviations], dtype=float)
    own = np.array([(d**2).sum(axis=0) for d in deviations]) / dof[:, None]
    variance, prior = _shrunk(own, dof)
    return variance, dof[:, None] + prior


def _correlation(w: Windows, s: Span) -> Floats:
    """(3,3) between the axes, from the samples inside the windows."""
    variance = w.variance[s.used].mean(axis=0)
    scale = np.maximum(np.sqrt(variance * variance[[1, 2, 0]]), 1e-300)
    xy, yz, zx = np.clip(w.cross[s.used].mean(axis=0) / scale, -0.99, 0.99)
    return np.array([[1, xy, zx], [xy, 1, yz], [zx, yz, 1]])


def _mend_along_the_radius(
    w: Windows, spans: Sequence[Span], mean: Floats, deviations: Sequence[Floats], covariance: Floats
) -> Floats:
    """Covariances whose part along the measured vector is what the outputs scatter along it.

    A unit that is held by hand, or on a stand that settles, turns a little in every pose. That moves the outputs
    across the measured vector, where |a| does not feel it, and raises the scatter of every axis; along the vector the
    noise is the sensor's own. The vector's direction in output units is known well enough from the range of the means.
    """
    half = (mean.max(axis=0) - mean.min(axis=0)) / 2
    if len(spans) < 6 or not np.all(half > 0):
        return covariance
    out = (mean - (mean.max(axis=0) + mean.min(axis=0)) / 2) / half**2
    out /= np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-300)
    # A scale for each pose, never zero, not even where a coarse output never changed in it.
    scatter = np.array([w.variance[s.used].mean(axis=0) for s in spans]) + resolution(w) ** 2 / 12
    inside = np.array([_correlation(w, s) for s in spans]) * [np.outer(e, e) for e in np.sqrt(scatter / w.size)]
    predicted = np.sqrt(np.maximum(np.einsum("ki,kij,kj->k", out, inside, out), 1e-300))
    series = [(d @ g / p)[:, None] for d, g, p in zip(deviations, out, predicted, strict=True)]
    count = np.array([len(s.used) for s in spans])
    ratio, _ = _own_variance(series)
    along = ratio[:, 0] / count * _Inflation(series).of(count)[:, 0] * predicted**2
    now = np.maximum(np.einsum("ki,kij,kj->k", out, covariance, out), 1e-300)
    across = np.einsum("kij,kj->ki", covariance, out) / now[:, None]
    mended: Floats = covariance + (along - now)[:, None, None] * across[:, :, None] * across[:, None, :]
    return mended


def _rounding(w: Windows, spans: Sequence[Span]) -> Floats:
    """(3,) variance of what rounding of the outputs leaves in a mean, however long: noise averages it out, if there is
    enough of it (Widrow and Kollár 2008, Quantization Noise: the harmonics of the rounding error under Gaussian noise).
    """
    step = resolution(w)
    scatter = np.mean([w.variance[s.used].mean(axis=0) for s in spans], axis=0)
    noise = np.maximum(scatter / step**2 - 1 / 12, 0.0)
    k = np.arange(1, 50)[:, None]
    return np.asarray(step**2 * (np.exp(-4 * np.pi**2 * k**2 * noise) / (2 * np.pi**2 * k**2)).sum(axis=0))


def _creep(s: Span, deviation: Floats, scatter: Floats) -> Floats:
    """(3,) how far a straight line through the window means climbs over the span, zero where that is noise."""
    x = s.used - s.used.mean()
    slope = x @ deviation / (x @ x)
    significant = np.abs(slope) * np.sqrt(x @ x) > CREEP_SIGMA * scatter
    return np.where(significant, slope * float(s.used[-1] - s.used[0]), 0.0)


class _Inflation:
    """By how much correlation between windows raises the variance of the mean of n windows, for each column."""

    def __init__(self, deviations: Sequence[Floats]) -> None:
        lags = max(1, max(len(d) for d in deviations) // 3)
        columns = range(deviations[0].shape[1])
        self._rho = np.array([_autocorrelation([d[:, c] for d in deviations], lags) for c in columns])

    def of(self, count: Ints) -> Floats:
        """(k,q) for poses of ``count`` (k,) windows."""
        return np.array([[n * _mean_variance(rho, n) for rho in self._rho] for n in count.tolist()])


def _autocorrelation(deviations: Sequence[Floats], lags: int) -> Floats:
    """Pooled over the poses, at lags 0…lags; zero from the first lag that is not significantly above zero.

    Subtracting a pose's own mean lowers every lag by the variance of that mean; this is put back by iteration.
    """
    pairs = np.array([sum(max(len(d) - k, 0) for d in deviations) for k in range(lags + 1)], dtype=float)
    raw = np.array(
        [sum(float(d[: len(d) - k] @ d[k:]) for d in deviations if len(d) > k) for k in range(lags + 1)]
    ) / np.maximum(pairs, 1)
    out = np.zeros(lags + 1)
    out[0] = 1.0
    if raw[0] <= 0:
        return out
    gamma = raw.copy()
    k: Ints = np.arange(lags + 1)
    for _ in range(5):
        rho = np.where(k < _cutoff(gamma / gamma[0], pairs), gamma / gamma[0], 0.0)
        mean_variance = np.array([_mean_variance(rho, len(d)) for d in deviations]) * gamma[0]
        weight = np.array([[max(len(d) - j, 0) for d in deviations] for j in k], dtype=float)
        gamma = raw + weight @ mean_variance / np.maximum(weight.sum(axis=1), 1)
    return np.where(k < _cutoff(gamma / gamma[0], pairs), gamma / gamma[0], 0.0)


def _mean_variance(rho: Floats, n: int) -> float:
    """Variance of the mean of n windows, in units of one window's."""
    k = np.arange(1, min(n, len(rho)))
    return float(1 + 2 * ((1 - k / n) * rho[k]).sum()) / n


def _cutoff(rho: Floats, pairs: Floats) -> int:
    """The first lag whose correlation is not two standard errors above zero."""
    below = np.flatnonzero(rho[1:] < 2 / np.sqrt(np.maximum(pairs[1:], 1)))
    return int(below[0]) + 1 if len(below) else len(rho)


def _shrunk(own: Floats, dof: Floats) -> tuple[Floats, Floats]:
    """Variances (k,q) shrunk towards their common value, and the degrees of freedom (q,) that this is worth."""
    common = (own * dof[:, None]).sum(axis=0) / dof.sum()
    prior = np.full(own.shape[1], float(dof.sum()))
    if len(own) > 2:
        log = np.log(np.maximum(own, 1e-12 * np.maximum(common, 1e-300)))
        excess = log.var(axis=0, ddof=1) - special.polygamma(1, dof / 2).mean()
        for axis in np.flatnonzero(excess > 0):
            prior[axis] = min(prior[axis], 2 * _inverse_trigamma(float(excess[axis])))
    blended = (prior * common + dof[:, None] * own) / (prior + dof[:, None])
    return blended, prior


def _inverse_trigamma(value: float) -> float:
    """x with trigamma(x) = value, by Newton's method on 1/trigamma, which is nearly straight."""
    x = 0.5 + 1 / value
    for _ in range(50):
        tri = float(special.polygamma(1, x))
        step = tri * (1 - tri / value) / float(special.polygamma(2, x))
        x += step
        if abs(step) < 1e-9 * x:
            break
    return x
