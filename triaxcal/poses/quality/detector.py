"""The detector of data quality: summaries of a stream that is fed in blocks of any
size.

The stream is cut into chunks that depend on the samples alone, so live and replayed
streams are judged alike. Memory grows with time, not with the sample rate: about a
hundred bytes for each tenth of a second, and in the first hours three thousand for a
second of spectra.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from triaxcal.arrays import Floats, Ints
from triaxcal.poses.arrivals import RATE_LEAST, RATE_S, RATE_SAMPLES, first_period_ns
from triaxcal.poses.pose import Pose
from triaxcal.poses.quality import faults, mains
from triaxcal.poses.quality.faults import CellKeeper, Gaps, RunLengths, StepEstimator
from triaxcal.poses.quality.finding import (
    AXES,
    Disturbance,
    DisturbedPoses,
    MergedPoses,
    MissingSamples,
    Move,
    QualityFinding,
    StillIntervals,
)
from triaxcal.poses.stillness.detector import Span
from triaxcal.poses.stillness.windows import (
    OTHERWISE,
    Windows,
    shown_step,
    window_size,
)

CHUNK_LEAST = 4096
"""Samples judged at once, 256 blocks of noise: enough for quantiles, with little
memory. The same at slow rates, where a chunk lasts longer."""


@dataclass
class QualityDetector:
    """Feed it blocks of any size, `finish`, then read `findings`.

    Before `finish` the findings are those of the samples up to the last whole chunk.
    """

    samples: int = 0
    _pending: list[tuple[Ints, Floats]] = field(default_factory=list)
    _held: int = 0
    _begin_ns: int | None = None
    _period_ns: float = 0.0
    _low: Floats = field(default_factory=lambda: np.full(3, np.inf))
    _high: Floats = field(default_factory=lambda: np.full(3, -np.inf))

    def feed(self, time_ns: Ints, readings: Floats) -> None:
        """``time_ns`` (n,) strictly increasing across calls, ``readings`` (n,3)
        finite, output units."""
        if not len(time_ns):
            return
        if self._begin_ns is None:
            self._begin_ns = int(time_ns[0])
        self._pending.append((np.asarray(time_ns, dtype=np.int64), np.asarray(readings, dtype=float)))
        self._held += len(time_ns)
        if not self._period_ns and self._held >= RATE_SAMPLES and time_ns[-1] - self._begin_ns >= RATE_S * 1e9:
            self._learn_rate()
        if self._period_ns and self._held >= self._chunk:
            self._take_chunks()

    def finish(self) -> None:
        """End of the stream."""
        if not self._period_ns and self._held >= RATE_LEAST:
            self._learn_rate()
        if self._period_ns:
            self._take_chunks(last=True)

    def _learn_rate(self) -> None:
        self._period_ns = max(first_period_ns(np.concatenate([p[0] for p in self._pending])), 1.0)
        size = window_size(self._period_ns)
        self._chunk = -(-CHUNK_LEAST // size) * size
        self._cells, self._steps, self._runs = CellKeeper(size), StepEstimator(), RunLengths()
        self._gaps, self._spectra = Gaps(), mains.Spectra(self._period_ns)

    def _take_chunks(self, *, last: bool = False) -> None:
        time_ns = np.concatenate([p[0] for p in self._pending])
        readings = np.concatenate([p[1] for p in self._pending])
        at = 0
        while len(time_ns) - at >= self._chunk or (last and at < len(time_ns)):
            part = slice(at, min(at + self._chunk, len(time_ns)))
            self._take(time_ns[part], np.ascontiguousarray(readings[part].T))
            at = part.stop
        if last:
            self._gaps.feed(time_ns[:0], last=True)
        self._pending, self._held = [(time_ns[at:], readings[at:])], len(time_ns) - at

    def _take(self, time_ns: Ints, u: Floats) -> None:
        """Summarise a chunk ``u`` (3,n)."""
        self.samples += len(time_ns)
        self._low = np.minimum(self._low, u.min(axis=1))
        self._high = np.maximum(self._high, u.max(axis=1))
        whole = len(time_ns) // self._cells.size * self._cells.size
        if whole:
            self._cells.feed(time_ns[:whole], u[:, :whole])
        self._steps.feed(u)
        self._runs.feed(time_ns, u)
        self._gaps.feed(time_ns)
        self._spectra.feed(time_ns, u)

    def findings(self, w: Windows | None, spans: Sequence[Span]) -> list[QualityFinding]:
        """One finding for each kind of fault, with the still ``spans`` from windows
        ``w`` of the same stream."""
        if not self.samples or self._begin_ns is None:
            return []
        holds = StillIntervals.of(self._begin_ns, w, spans)
        step, roughness = self._steps.step(), self._steps.roughness(self._runs.constant())
        if w is not None:
            # Printed decimals that are no multiples of the step hide it from
            # single differences.
            shown = shown_step(w)
            step = np.where(shown > OTHERWISE * step, shown, step)
        noisy = self._steps.scatters(roughness, step)
        rate_hz = 1e9 / self._period_ns
        cells = self._cells.cells()
        # Frozen runs, rails, and the poses that they affect.
        frozen = faults.frozen_runs(cells, self._runs, holds, noisy)
        rails, affected = faults.saturation(cells, self._runs, frozen, holds, step, roughness, noisy)
        for poses, runs in zip(affected, frozen, strict=False):
            poses.update(i for r in (*runs, *frozen[-1]) for i in holds.touched(r.start_ns, r.end_ns))
        # Repeated samples, dead axes, mains lines.
        slow, twice = faults.repeated_samples(self._runs, noisy, rate_hz)
        flat = self._low == self._high
        dead = [axis for axis, never_changes in zip(AXES, flat, strict=True) if never_changes]
        lines = self._spectra.lines(holds)
        found = [
            rails,
            faults.stuck_output(frozen, slow, holds, dead),
            self._missing(),
            twice,
            mains.pickup(lines, rate_hz) if lines else None,
            faults.coarse_quantization(holds, affected, step),
        ]
        return [f for f in found if f is not None]

    def _missing(self) -> QualityFinding | None:
        g = self._gaps
        if not g.gaps or self._begin_ns is None:
            return None
        first_s = (g.first_ns - self._begin_ns) * 1e-9
        return MissingSamples(g.missing, self.samples + g.missing, g.gaps, g.longest, first_s)


# Faults of the poses themselves: vibration, and moves hidden by it.


def disturbances(poses: Sequence[Pose]) -> list[QualityFinding]:
    """Faults of the poses of one recording, in order of time: vibration in a part or
    throughout, and moves hidden by vibration."""
    found: list[QualityFinding] = []
    by_pose = [_of(p) for p in poses]
    if all_of_them := tuple(itertools.chain.from_iterable(by_pose)):
        disturbed = tuple(i for i, own in enumerate(by_pose) if own)
        found.append(DisturbedPoses(all_of_them, disturbed, len(poses)))
    if moves := tuple(_move(here, there) for here, there in itertools.pairwise(poses) if there.parted):
        found.append(MergedPoses(moves))
    return found


def _of(pose: Pose) -> list[Disturbance]:
    out = [Disturbance(pose.start_s, (s.start_s, s.end_s), s.times, s.scatter) for s in pose.shaken]
    if pose.restless > 1:
        out.append(Disturbance(pose.start_s, None, pose.restless, None))
    return out


def _move(here: Pose, there: Pose) -> Move:
    apart = np.abs(there.mean - here.mean)
    axis = int(np.argmax(apart))
    return Move(here.end_s, there.start_s, AXES[axis], float(apart[axis]))
