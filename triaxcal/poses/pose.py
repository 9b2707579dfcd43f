"""Still spans as poses: mean, covariance, channels and history of each."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.errors import InvalidData
from triaxcal.poses.noise_spectrum import NoiseLevels
from triaxcal.poses.pose_noise import noise_of_means
from triaxcal.poses.stillness.detector import Span
from triaxcal.poses.stillness.vibration import VIBRATING
from triaxcal.poses.stillness.windows import Windows, resolution

# The time course of a logged channel about the middle of a pose: rate and bend,
# with their standard errors.


class ChannelCourse(NamedTuple):
    """A channel about the middle of a pose: standard error of its mean; its rate per
    second and its bend per second², each with its standard error."""

    error: float
    rate: float
    rate_error: float
    bend: float
    bend_error: float


def courses_of(w: Windows, spans: Sequence[Span]) -> list[dict[str, ChannelCourse]]:
    """The courses of each span, by channel."""
    steps = {name: _step(channel) for name, channel in w.channels.items()}
    return [_course(w, s, steps) for s in spans]


def _course(w: Windows, s: Span, steps: Mapping[str, float]) -> dict[str, ChannelCourse]:
    """A parabola through the span and half its length on either side: steps and noise
    of a thermometer average over the surroundings of the pose too."""
    # Windows of the span, extended by half its length on either side.
    begin, end = int(w.start_ns[s.first]), int(w.end_ns[s.last])
    half = (end - begin) // 2
    first, last = np.searchsorted(w.start_ns, [begin - half, end + half])
    # Least-squares parabola in time, scaled to the span, by its normal equations: a
    # span may last for days. Its three columns are far from parallel.
    scale = max((end - begin) * 1e-9, 1e-9)
    t = (w.start_ns[first:last] + w.period_ns / 2 - (begin + end) / 2) * (1e-9 / scale)
    sums = [float(np.sum(t**k)) for k in range(5)]
    inverse = np.linalg.pinv(np.array([sums[k : k + 3] for k in range(3)]), rcond=1e-12)
    spread = np.sqrt(np.maximum(np.diag(inverse), 0.0))
    out = {}
    for name, channel in w.channels.items():
        values = channel[first:last] - channel[first:last].mean()
        middle, rate, bend = inverse @ [values.sum(), t @ values, t**2 @ values]
        values -= middle + t * (rate + t * bend)
        scatter = float(np.sqrt(values @ values / max(len(t) - 3, 1)))
        # A step of a coarse thermometer adds an error of the order of its slope.
        step = steps[name]
        out[name] = ChannelCourse(
            error=scatter / np.sqrt(len(s.used)),
            rate=float(rate) / scale,
            rate_error=float(np.hypot(scatter * spread[1], 0.75 * step)) / scale,
            bend=2 * float(bend) / scale**2,
            bend_error=float(np.hypot(2 * scatter * spread[2], 4 * step)) / scale**2,
        )
    return out


def _step(channel: Floats) -> float:
    """Median change of a channel that is constant between changes; zero where it
    always changes. A step inside a window makes two changes, so the result is more
    than half a step."""
    moves = np.abs(np.diff(channel))
    return float(np.median(moves[moves > 0])) if 0 < np.count_nonzero(moves) < len(moves) / 2 else 0.0


@dataclass(frozen=True)
class Run:
    """The recording of a pose among several of one unit: ``index`` (0-based), ``of``
    how many, and the middle of its poses, from which time counts. A single recording
    keeps its own time."""

    index: int = 0
    of: int = 1
    middle_s: float = 0.0


@dataclass(frozen=True)
class PoseStart:
    """The time at which a pose began, in seconds from the first sample of its
    recording, and the recording among several (0-based)."""

    start_s: float
    recording: int | None = None


@dataclass(frozen=True)
class VibrationPart:
    """A stretch of time under vibration with a ``scatter`` (standard deviation of a
    sample, axis with the largest, output units), so many ``times`` that of the rest
    of the pose."""

    start_s: float
    end_s: float
    scatter: float
    times: float


@dataclass(frozen=True)
class Pose:
    """One still span. ``mean`` (3,) and ``covariance`` (3,3) of the mean, output
    units. ``t_s``, the middle of the span, ``start_s`` and ``end_s`` are in seconds
    from the first sample.

    ``dof`` are the degrees of freedom of the covariance (along the measured vector,
    for six poses or more), ``shared_dof`` those of the part that all poses share,
    infinite without one; ``noise_levels`` describe this part in full.

    ``channels`` are means over the span, ``rates`` their slopes in its middle, per
    second, ``bends`` their second derivatives, per second², from the span and half
    its length on either side; ``channel_errors``, ``rate_errors`` and ``bend_errors``
    are their standard errors. ``slope`` (3,) is the change of the outputs along the
    span, output units, ``slope_error`` the standard error of its part along the
    measured vector, infinite if unknown; ``creep`` (3,) is the slope if it exceeds
    the noise, else zero. ``before`` (3,) is the mean of the previous pose, None in
    the first; ``scatter`` (3,) the variance of a sample inside the span, output units
    squared. ``fault`` names a fault of its samples (`triaxcal.poses.quality`): no fit
    uses such a pose. ``shaken`` are vibrating parts that its mean excludes.
    ``restless`` is the ratio of its scatter to that of most poses if far larger, else
    1. ``parted``: a move hidden by vibration precedes it.
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
    shaken: tuple[VibrationPart, ...] = ()
    restless: float = 1.0
    parted: bool = False

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
    """A still span: mean and times of a pose without its noise. ``mean`` (3,) output
    units; times in seconds."""

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
    index, with faulty samples: they do not contribute to the noise of the others."""
    # Noise of the sound poses from the sound poses alone.
    if faults:
        sound = iter(poses_of(w, [s for i, s in enumerate(spans) if i not in faults]))
        return [
            replace(p, fault=faults[i]) if i in faults else replace(next(sound), before=p.before)
            for i, p in enumerate(poses_of(w, spans))
        ]
    if not spans:
        return []
    # Means, noise, and the time courses of the channels.
    held = still_spans_of(w, spans)
    noise = noise_of_means(w, spans, np.array([h.mean for h in held]))
    courses = courses_of(w, spans)
    return [
        Pose(
            start_s=held[i].start_s,
            end_s=held[i].end_s,
            samples=len(s.used) * w.size,
            mean=held[i].mean,
            covariance=noise.covariance[i] + np.outer(noise.creep[i], noise.creep[i]) / 12,
            dof=float(noise.dof[i]),
            shared_dof=noise.shared_dof,
            noise_levels=noise.levels,
            channels={name: float(values[s.used].mean()) for name, values in w.channels.items()},
            creep=noise.creep[i],
            slope=noise.slope[i],
            slope_error=float(noise.slope_error[i]),
            channel_errors={name: course.error for name, course in courses[i].items()},
            rates={name: course.rate for name, course in courses[i].items()},
            rate_errors={name: course.rate_error for name, course in courses[i].items()},
            bends={name: course.bend for name, course in courses[i].items()},
            bend_errors={name: course.bend_error for name, course in courses[i].items()},
            before=held[i - 1].mean if i else None,
            scatter=w.variance[s.used].mean(axis=0) * (w.size - 1) / w.size + w.mean[s.used].var(axis=0),
            shaken=_vibration_parts(w, s),
            restless=float(noise.restless[i]),
            parted=s.parted,
        )
        for i, s in enumerate(spans)
    ]


def _vibration_parts(w: Windows, s: Span) -> tuple[VibrationPart, ...]:
    if not len(s.vibrating):
        return ()
    begin, usual = int(w.start_ns[0]), np.maximum(w.variance[s.used].mean(axis=0), resolution(w) ** 2 / 12)
    parts = []
    for at in np.split(s.vibrating, np.flatnonzero(np.diff(s.vibrating) > 1) + 1):
        start_s, end_s = (int(w.start_ns[at[0]]) - begin) * 1e-9, (int(w.end_ns[at[-1]]) - begin) * 1e-9
        strong = (w.variance[at] > VIBRATING**2 * usual).any(axis=1)
        variance = w.variance[at[strong] if strong.any() else at].mean(axis=0)
        axis = int(np.argmax(variance / usual))
        scatter, times = np.sqrt(variance[axis]), np.sqrt(variance[axis] / usual[axis])
        parts.append(VibrationPart(start_s, end_s, float(scatter), float(times)))
    return tuple(parts)


# Names of poses in sentences: the time at which they began.


def moment(began: PoseStart) -> str:
    """When a pose began, and in which of several recordings, counted from 1."""
    of = "" if began.recording is None else f" of recording {began.recording + 1}"
    return f"{began.start_s:.1f} s{of}"


def the_poses(began: Iterable[PoseStart]) -> str:
    """The poses, by the times at which they began."""
    return " and ".join(f"the pose at {moment(b)}" for b in began)
