"""From samples to still poses, as the samples come."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from triaxcal.arrays import Floats, Ints
from triaxcal.errors import InvalidData, TooShort
from triaxcal.poses.arrivals import SampleTimes
from triaxcal.poses.pose import Pose, StillSpan, poses_of, still_spans_of
from triaxcal.poses.quality import QualityDetector, QualityFinding, faulty_poses
from triaxcal.poses.quality.finding import Bursts
from triaxcal.poses.stillness.detector import Span, StillnessDetector
from triaxcal.poses.stillness.windows import Windows, require_finite


class PoseFinder:
    """Finds the still poses of a stream, and faults of its samples. Samples that came
    in bursts are laid at the times at which they were taken
    (`triaxcal.poses.arrivals`).

    The blocks may have any size: the result is that of the whole. ``turn_s`` is the
    shortest duration of an in-place rotation, where the unit may turn so, as in
    `triaxcal.poses.stillness.find_spans`.
    """

    def __init__(self, turn_s: float | None = None) -> None:
        self._turn_s = turn_s
        self._times = SampleTimes()
        self._held: tuple[Floats, dict[str, Floats]] | None = None
        self._stillness = StillnessDetector()
        self._quality = QualityDetector()
        self._spans: tuple[int, list[Span]] = (0, [])
        self._poses: tuple[int, dict[tuple[tuple[int, str], ...], list[Pose]]] = (0, {})
        self._findings: list[QualityFinding] | None = None

    def feed(self, time_ns: Any, readings: Any, channels: Mapping[str, Any] | None = None) -> None:
        """Times (n,) in nanoseconds, readings (n,3) in output units, and channels
        (n,) by name. Raises InvalidData for other shapes, times that do not increase,
        or readings that are not finite."""
        self._findings = None
        if not len(time_ns):
            return
        require_finite(time_ns, readings)
        held = {name: np.asarray(v, dtype=float) for name, v in (channels or {}).items()}
        if self._held is not None and len(self._held[0]):
            readings = np.concatenate([self._held[0], readings])
            held = {name: np.concatenate([v, held[name]]) for name, v in self._held[1].items()}
        self._held = np.asarray(readings, dtype=float), held
        self._take(self._times.feed(time_ns))

    def _take(self, time_ns: Ints) -> None:
        """The next samples, as many as have times."""
        if self._held is None or not len(time_ns):
            return
        n, (readings, channels) = len(time_ns), self._held
        self._held = readings[n:], {name: v[n:] for name, v in channels.items()}
        self._stillness.feed(time_ns, readings[:n], {name: v[:n] for name, v in channels.items()})
        self._quality.feed(time_ns, readings[:n])

    def finish(self) -> None:
        """End of the stream."""
        self._findings = None
        self._take(self._times.finish())
        self._stillness.finish()
        self._quality.finish()

    def part_by(self, turn_s: float | None) -> None:
        """Separate the poses with another ``turn_s`` from now on."""
        if turn_s != self._turn_s:
            self._turn_s, self._spans, self._poses, self._findings = turn_s, (0, []), (0, {}), None

    @property
    def windows(self) -> Windows | None:
        """Summaries of the stream so far; None while there are none."""
        try:
            return self._stillness.windows()
        except InvalidData:
            return None

    def too_short(self) -> TooShort | None:
        """The reason why no pose can be found so far, or None."""
        return self._stillness.too_short()

    def still_spans(self) -> list[StillSpan]:
        """The poses so far without their noise, which takes most of the time."""
        windows = self.windows
        return [] if windows is None else still_spans_of(windows, self.spans())

    def poses(self, *, judged: bool = True) -> list[Pose]:
        """The poses so far. Those with faulty samples name the fault and do not
        contribute to the noise of the others, unless ``judged`` is false. Cached for
        the same windows."""
        windows = self.windows
        if windows is None:
            return []
        faults = faulty_poses(self.findings()) if judged else {}
        if self._poses[0] != len(windows):
            self._poses = (len(windows), {})
        cached, key = self._poses[1], tuple(sorted(faults.items()))
        if key not in cached:
            cached[key] = poses_of(windows, self.spans(), faults)
        return list(cached[key])

    def spans(self) -> list[Span]:
        """The still spans so far, cached for the same windows."""
        windows = self.windows
        if windows is None:
            return []
        if self._spans[0] != len(windows):
            self._spans = (len(windows), self._stillness.spans(self._turn_s))
        return self._spans[1]

    def findings(self) -> list[QualityFinding]:
        """Faults of the samples so far, cached."""
        if self._findings is None:
            self._findings = self._quality.findings(self.windows, self.spans())
            if (bursts := self._times.bursts()) is not None:
                self._findings.append(Bursts(*bursts))
        return self._findings
