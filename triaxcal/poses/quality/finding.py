"""Faults of a raw stream as values, and the still spans that their detection
needs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from triaxcal.arrays import Bools, Floats, Ints
from triaxcal.poses.stillness.detector import Span
from triaxcal.poses.stillness.windows import Windows

AXES = "xyz"
INVALIDATING = ("saturation", "stuck_output")
"""Faults with which a mean does not follow the acceleration."""


@dataclass(frozen=True)
class Touched:
    """The still spans that a fault affects, by index, and the beginning of each in
    seconds from the first sample."""

    poses: tuple[int, ...] = ()
    starts_s: tuple[float, ...] = ()


@dataclass(frozen=True)
class QualityFinding:
    """A kind of fault with its data-quality ``name``; `triaxcal.text` describes it in
    a sentence."""

    name: ClassVar[str]

    @property
    def poses(self) -> tuple[int, ...]:
        """Indices of the affected spans, which have to be repeated."""
        return ()


@dataclass(frozen=True)
class AtRail:
    """Number of ``samples`` of an axis at one extreme value, output units."""

    axis: str
    rail: float
    samples: int
    first_s: float
    touched: Touched


@dataclass(frozen=True)
class Saturation(QualityFinding):
    name: ClassVar[str] = "saturation"
    rails: tuple[AtRail, ...]

    @property
    def poses(self) -> tuple[int, ...]:
        return tuple(sorted({i for r in self.rails for i in r.touched.poses}))


@dataclass(frozen=True)
class Freeze:
    """An axis (None: all at once) repeats a reading ``times`` times, for up to
    ``longest`` samples; ``value`` is that of the longest, output units."""

    axis: str | None
    value: float
    times: int
    longest: int
    first_s: float
    touched: Touched


@dataclass(frozen=True)
class SlowUpdate:
    """New values come only ``every`` so many samples, in a stream of ``rate_hz``."""

    every: float
    rate_hz: float


@dataclass(frozen=True)
class StuckOutput(QualityFinding):
    """``dead`` are axes that never change."""

    name: ClassVar[str] = "stuck_output"
    dead: tuple[str, ...]
    slow: SlowUpdate | None
    freezes: tuple[Freeze, ...]

    @property
    def poses(self) -> tuple[int, ...]:
        return tuple(sorted({i for f in self.freezes for i in f.touched.poses}))


@dataclass(frozen=True)
class MissingSamples(QualityFinding):
    """By the times, ``missing`` of ``of`` samples, in ``gaps`` gaps."""

    name: ClassVar[str] = "missing_samples"
    missing: int
    of: int
    gaps: int
    longest: int
    first_s: float


@dataclass(frozen=True)
class Bursts(QualityFinding):
    """The samples come together, ``samples`` every ``period_s`` (medians)."""

    name: ClassVar[str] = "bursts"
    samples: int
    period_s: float


@dataclass(frozen=True)
class DuplicateSamples(QualityFinding):
    """``repeated`` samples equal the previous one on all axes."""

    name: ClassVar[str] = "duplicate_samples"
    repeated: int
    samples: int


@dataclass(frozen=True)
class Tone:
    """``amplitude`` by axis, output units. ``alias_of_hz``: the frequency of which it
    may be the alias."""

    frequency_hz: float
    amplitude: tuple[float, float, float]
    alias_of_hz: float | None


@dataclass(frozen=True)
class MainsPickup(QualityFinding):
    name: ClassVar[str] = "mains_pickup"
    tones: tuple[Tone, ...]
    rate_hz: float


@dataclass(frozen=True)
class Steps:
    """Steps of an axis, with the scatter in the poses and the possible error of pose
    means, output units."""

    axis: str
    step: float
    scatter: float
    mean_error: float


@dataclass(frozen=True)
class CoarseQuantization(QualityFinding):
    name: ClassVar[str] = "coarse_quantization"
    axes: tuple[Steps, ...]


@dataclass(frozen=True)
class Disturbance:
    """A disturbance of the pose that begins at ``pose_s``: a stretch of time that its
    mean excludes, or the whole pose (None). The outputs scatter so many ``times`` as
    in the rest of the pose, or as in most poses; ``scatter`` of a stretch is a
    standard deviation, output units."""

    pose_s: float
    stretch_s: tuple[float, float] | None
    times: float
    scatter: float | None


@dataclass(frozen=True)
class DisturbedPoses(QualityFinding):
    """``disturbed`` are the indices of the poses, ``of`` the number of all."""

    name: ClassVar[str] = "disturbed_pose"
    disturbances: tuple[Disturbance, ...]
    disturbed: tuple[int, ...]
    of: int


@dataclass(frozen=True)
class Move:
    """A move from one pose to the next, between these times, by ``apart`` in the
    output that changes most."""

    start_s: float
    end_s: float
    axis: str
    apart: float


@dataclass(frozen=True)
class MergedPoses(QualityFinding):
    name: ClassVar[str] = "merged_poses"
    moves: tuple[Move, ...]


def faulty_poses(findings: Iterable[QualityFinding]) -> dict[int, str]:
    """By index, the still spans in which the outputs do not follow the
    acceleration, with the name of the fault."""
    return {i: f.name for f in findings if f.name in INVALIDATING for i in f.poses}


@dataclass(frozen=True)
class StillIntervals:
    """The still spans of a stream: ``start_ns``, ``end_ns`` (k,); ``begin_ns`` is the
    zero of its seconds. ``variance`` (k,3) of the readings in each, slow noise
    included."""

    begin_ns: int
    start_ns: Ints
    end_ns: Ints
    variance: Floats

    @classmethod
    def of(cls, begin_ns: int, w: Windows | None, spans: Sequence[Span]) -> StillIntervals:
        if w is None or not spans:
            none = np.zeros(0, dtype=np.int64)
            return cls(begin_ns, none, none, np.zeros((0, 3)))
        start = np.array([w.start_ns[s.first] for s in spans])
        end = np.array([w.end_ns[s.last] for s in spans])
        variance = [w.variance[s.used].mean(axis=0) + w.mean[s.used].var(axis=0) for s in spans]
        return cls(int(w.start_ns[0]), start, end, np.array(variance))

    def __len__(self) -> int:
        return len(self.start_ns)

    def seconds(self, time_ns: int) -> float:
        return (time_ns - self.begin_ns) * 1e-9

    def within(self, start_ns: Ints, end_ns: Ints) -> Ints:
        """(n,) index of the span that contains each stretch of time, else -1."""
        if not len(self):
            return np.full(len(start_ns), -1, dtype=np.int64)
        at = np.searchsorted(self.start_ns, start_ns, side="right") - 1
        whole = (at >= 0) & (end_ns <= self.end_ns[np.maximum(at, 0)])
        return np.where(whole, at, -1)

    def touched(self, start_ns: int, end_ns: int) -> tuple[int, ...]:
        """Spans that overlap a stretch of time."""
        shared: Bools = (self.start_ns <= end_ns) & (self.end_ns >= start_ns)
        return tuple(int(i) for i in np.flatnonzero(shared))

    def touching(self, poses: Sequence[int]) -> Touched:
        return Touched(tuple(poses), tuple(self.seconds(int(self.start_ns[i])) for i in poses))
