"""Still spans as poses: the mean of the outputs, and a covariance that minds
autocorrelation, creep and rounding."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol

import numpy as np

from triaxcal.arrays import Bools, Floats
from triaxcal.errors import InvalidData
from triaxcal.poses.noise_mixture import NoiseLevels
from triaxcal.poses.noise_spectrum import Track
from triaxcal.poses.pose_noise import PoseNoise, pose_noise
from triaxcal.poses.stillness.detector import Span
from triaxcal.poses.stillness.quantization import left_in_means, resolution
from triaxcal.poses.stillness.windows import Windows

SHAKEN, QUIET = 2.0, 0.1
"""Poses are shaken in which the outputs scatter with so many times the variance
of the quietest tenth of them."""


@dataclass(frozen=True)
class Run:
    """Which of several recordings of a unit a pose is of: the ``index``
    (0-based) of how many, and the middle of its poses, from which time counts
    there. Alone, time counts as it was recorded.
    """

    index: int = 0
    of: int = 1
    middle_s: float = 0.0


@dataclass(frozen=True)
class PoseStart:
    """When a pose began: seconds from the first sample of its recording, and
    which of several (0-based)."""

    start_s: float
    recording: int | None = None


@dataclass(frozen=True)
class Pose:
    """One still span. ``mean`` (3,) and ``covariance`` (3,3) of the mean,
    output units. ``dof`` are the degrees of freedom behind the covariance
    (along the measured vector, where there are six poses or more), and
    ``shared_dof`` those behind what the covariances of all poses have in
    common, infinite where that is nothing; ``noise_levels`` say the same in
    full, where all poses of a recording have it in common.

    ``channels`` are means over the span; ``t_s`` is the middle of the span,
    like ``start_s`` and ``end_s`` in seconds from the first sample. ``creep``
    (3,) is the change of the outputs along the span, output units, where it is
    more than noise, else zero; ``slope`` (3,) the same whether it is noise or
    not, and ``slope_error`` the standard error of its part along the measured
    vector, infinite where it is not known. ``rates`` are the channels' slopes
    in the middle of the span, per second, and ``bends`` their second
    derivatives, per second², from the span and half its length on either side;
    ``channel_errors``, ``rate_errors`` and ``bend_errors`` the standard errors
    of mean, slope and bend from the scatter that these leave. ``before`` (3,)
    is the mean of the pose before, None in the first; ``scatter`` (3,) the
    variance of a sample inside the span, output units squared. ``fault`` is
    what its samples are to be blamed for (`triaxcal.poses.quality`), if at all:
    no fit uses such a pose.
    """

    start_s: float
    end_s: float
    samples: int
    mean: Floats
    covariance: Floats
    dof: float
    channels: Mapping[str, float] = field(default_factory=dict)
    creep: Floats = field(default_factory=lambda: np.zeros(3))
    slope: Floats = field(default_factory=lambda: np.zeros(3))
    slope_error: float = float("inf")
    channel_errors: Mapping[str, float] = field(default_factory=dict)
    rates: Mapping[str, float] = field(default_factory=dict)
    rate_errors: Mapping[str, float] = field(default_factory=dict)
    bends: Mapping[str, float] = field(default_factory=dict)
    bend_errors: Mapping[str, float] = field(default_factory=dict)
    before: Floats | None = None
    scatter: Floats = field(default_factory=lambda: np.zeros(3))
    shared_dof: float = float("inf")
    noise_levels: NoiseLevels | None = field(default=None, repr=False, compare=False)
    run: Run = field(default_factory=Run)
    fault: str = ""

    def __post_init__(self) -> None:
        if self.mean.shape != (3,) or self.covariance.shape != (3, 3):
            raise InvalidData("a pose has a mean (3,) and a covariance (3, 3)")
        if not (np.isfinite(self.mean).all() and np.isfinite(self.covariance).all()):
            raise InvalidData(f"pose at {self.start_s:.3f} s: mean or covariance is not a finite number")

    @property
    def trend(self) -> Floats:
        """`slope`, by its older name."""
        return self.slope

    @property
    def trend_error(self) -> float:
        """`slope_error`, by its older name."""
        return self.slope_error

    @property
    def t_s(self) -> float:
        return (self.start_s + self.end_s) / 2

    @property
    def began(self) -> PoseStart:
        return PoseStart(self.start_s, self.run.index if self.run.of > 1 else None)

    @property
    def standard_error(self) -> Floats:
        """(3,) of the mean, output units."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def creep_covariance(self) -> Floats:
        """(3,3) the part of ``covariance`` that is creep, output units squared:
        the variance of a value that is anywhere on the way of a steady change,
        change²/12 (JCGM 100, 4.3.7). Zero where the pose does not creep.
        """
        return np.outer(self.creep, self.creep) / 12


class StillSpan(Protocol):
    """Where and when a unit was still: all of a pose but its noise. ``mean``
    (3,) output units; times in seconds."""

    @property
    def start_s(self) -> float: ...
    @property
    def end_s(self) -> float: ...
    @property
    def mean(self) -> Floats: ...


@dataclass(frozen=True)
class _StillSpan:
    start_s: float
    end_s: float
    mean: Floats


def still_spans_of(w: Windows, spans: Sequence[Span]) -> list[StillSpan]:
    """The still spans, in order of time."""
    begin = int(w.start_ns[0])
    return [
        _StillSpan(
            (int(w.start_ns[s.first]) - begin) * 1e-9,
            (int(w.end_ns[s.last]) - begin) * 1e-9,
            w.mean[s.used].mean(axis=0),
        )
        for s in spans
    ]


def poses_of(w: Windows, spans: Sequence[Span], faults: Mapping[int, str] | None = None) -> list[Pose]:
    """The poses of the still spans, in order of time. ``faults`` name those, by
    index, whose samples are not to be trusted: they tell nothing of the noise
    of the others.
    """
    if faults:
        sound = iter(poses_of(w, [s for i, s in enumerate(spans) if i not in faults]))
        return [
            replace(p, fault=faults[i]) if i in faults else replace(next(sound), before=p.before)
            for i, p in enumerate(poses_of(w, spans))
        ]
    if not spans:
        return []
    tracks = [_track(w, s) for s in spans]
    recording = float(w.end_ns[spans[-1].last] - w.start_ns[spans[0].first]) / w.period_ns
    held = still_spans_of(w, spans)
    mean = np.array([h.mean for h in held])
    noise = pose_noise(tracks, recording)
    creeping = np.asarray(noise.creeping.any(axis=1))
    length = np.array([t.place[-1] - t.place[0] for t in tracks])[:, None]
    creep = np.where(creeping[:, None], noise.slope * length, 0.0)
    covariance = np.array(
        [_correlation(w, s) * np.outer(e, e) for s, e in zip(spans, np.sqrt(noise.variance), strict=True)]
    )
    dof, shared_dof, levels = noise.dof.min(axis=1), noise.common_dof, noise.levels
    slope, slope_error = noise.slope * (length + 1), np.full(len(spans), np.inf)
    out = outward(mean)
    if out is not None:
        along, predicted = _along(w, spans, tracks, out, recording, creeping)
        covariance = _mended(covariance, out, along.variance[:, 0] * predicted**2)
        dof, shared_dof, levels = along.dof[:, 0], along.common_dof, along.levels
        # A unit that turns creeps across the measured vector; along it only
        # where that shows by itself.
        slope_error = along.slope_error[:, 0] * predicted * (length[:, 0] + 1)
        radial = np.einsum("ki,ki->k", creep, out) * ~along.creeping[:, 0]
        creep = creep - radial[:, None] * out
    covariance = covariance + np.diag(_rounding(w, spans))
    steps = {name: _step(channel) for name, channel in w.channels.items()}
    logged = [_logged(w, s, steps) for s in spans]
    return [
        Pose(
            start_s=held[i].start_s,
            end_s=held[i].end_s,
            samples=len(s.used) * w.size,
            mean=held[i].mean,
            covariance=covariance[i] + np.outer(creep[i], creep[i]) / 12,
            dof=float(dof[i]),
            shared_dof=shared_dof,
            noise_levels=levels,
            channels={name: float(values[s.used].mean()) for name, values in w.channels.items()},
            creep=creep[i],
            slope=slope[i],
            slope_error=float(slope_error[i]),
            channel_errors={name: channel.error for name, channel in logged[i].items()},
            rates={name: channel.rate for name, channel in logged[i].items()},
            rate_errors={name: channel.rate_error for name, channel in logged[i].items()},
            bends={name: channel.bend for name, channel in logged[i].items()},
            bend_errors={name: channel.bend_error for name, channel in logged[i].items()},
            before=held[i - 1].mean if i else None,
            scatter=w.variance[s.used].mean(axis=0) * (w.size - 1) / w.size + w.mean[s.used].var(axis=0),
        )
        for i, s in enumerate(spans)
    ]


class _Logged(NamedTuple):
    """A channel about the middle of a pose: standard error of its mean; its
    rate per second and its bend per second², each with its standard error."""

    error: float
    rate: float
    rate_error: float
    bend: float
    bend_error: float


def _logged(w: Windows, s: Span, steps: Mapping[str, float]) -> dict[str, _Logged]:
    """By a parabola through the span and half its length on either side: a
    thermometer's steps and noise are spread over what is around the pose as
    well.
    """
    begin, end = int(w.start_ns[s.first]), int(w.end_ns[s.last])
    half = (end - begin) // 2
    first, last = np.searchsorted(w.start_ns, [begin - half, end + half])
    t_s = (w.start_ns[first:last] + w.period_ns / 2 - (begin + end) / 2) * 1e-9
    scale = max((end - begin) * 1e-9, 1e-9)
    powers = np.vander(t_s / scale, 3, increasing=True)
    gain = np.linalg.pinv(powers)
    spread = np.sqrt((gain**2).sum(axis=1))
    out = {}
    for name, channel in w.channels.items():
        values = channel[first:last] - channel[first:last].mean()
        middle, rate, bend = gain @ values
        scatter = float(np.sqrt(np.sum((values - powers @ [middle, rate, bend]) ** 2) / max(len(t_s) - 3, 1)))
        # Of the order of the slope that a step of a coarse thermometer makes.
        step = steps[name]
        out[name] = _Logged(
            error=scatter / np.sqrt(len(s.used)),
            rate=float(rate) / scale,
            rate_error=float(np.hypot(scatter * spread[1], 0.75 * step)) / scale,
            bend=2 * float(bend) / scale**2,
            bend_error=float(np.hypot(2 * scatter * spread[2], 4 * step)) / scale**2,
        )
    return out


def _step(channel: Floats) -> float:
    """By how much a channel moves where it stands still between its moves; zero
    where it is always on the move. A step that falls inside a window makes two
    moves, so it is more than half a step."""
    moves = np.abs(np.diff(channel))
    return float(np.median(moves[moves > 0])) if 0 < np.count_nonzero(moves) < len(moves) / 2 else 0.0


def _track(w: Windows, s: Span) -> Track:
    """Places by time, so that a silence inside a pose counts as the windows
    that it lacks."""
    place = np.round((w.start_ns[s.used] - w.start_ns[s.first]) / w.period_ns).astype(np.int64)
    place = np.maximum.accumulate(place - np.arange(len(place))) + np.arange(len(place))
    return Track(place, w.mean[s.used] - w.mean[s.used].mean(axis=0))


def _correlation(w: Windows, s: Span) -> Floats:
    """(3,3) between the axes, from the samples inside the windows."""
    variance = w.variance[s.used].mean(axis=0)
    scale = np.maximum(np.sqrt(variance * variance[[1, 2, 0]]), 1e-300)
    xy, yz, zx = np.clip(w.cross[s.used].mean(axis=0) / scale, -0.99, 0.99)
    return np.array([[1, xy, zx], [xy, 1, yz], [zx, yz, 1]])


def outward(mean: Floats) -> Floats | None:
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
    w: Windows, spans: Sequence[Span], tracks: Sequence[Track], out: Floats, recording: float, creeping: Bools
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
    return pose_noise(radial, recording, creeping), predicted


def _mended(covariance: Floats, out: Floats, along: Floats) -> Floats:
    """Covariances (k,3,3) whose part along ``out`` (k,3) is ``along`` (k,)."""
    now = np.maximum(np.einsum("ki,kij,kj->k", out, covariance, out), 1e-300)
    across = np.einsum("kij,kj->ki", covariance, out) / now[:, None]
    return np.asarray(covariance + (along - now)[:, None, None] * across[:, :, None] * across[:, None, :])


def _rounding(w: Windows, spans: Sequence[Span]) -> Floats:
    """(3,) variance of what rounding of the outputs leaves in a mean."""
    scatter = np.array([w.variance[s.used].mean(axis=0) for s in spans])
    return left_in_means(w, scatter, np.array([len(s.used) for s in spans]))
