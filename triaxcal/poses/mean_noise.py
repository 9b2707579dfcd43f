"""The noise of pose means: a covariance that minds autocorrelation, creep and
rounding.

It is that of each axis by itself, mended along the measured vector, since |a|
feels nothing else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Bools, Floats
from triaxcal.poses.mean_variance_mixture import NoiseLevels
from triaxcal.poses.noise_spectrum import Track
from triaxcal.poses.pose_noise import PoseNoise, pose_noise
from triaxcal.poses.stillness.detector import Span
from triaxcal.poses.stillness.quantization import left_in_means, resolution, widest_steps
from triaxcal.poses.stillness.windows import Windows

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
