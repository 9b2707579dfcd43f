"""The raw readings as the page shows them: few enough points to draw, no
extreme lost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

import triaxcal as tc


@dataclass(frozen=True)
class StreamOverview:
    """Raw readings thinned for a picture.

    time_s (n,), readings (n, 3) in `unit`, spans the still spans as (start_s,
    end_s) on the same clock. Raises ValueError when the shapes disagree.
    """

    time_s: NDArray[np.float64]
    readings: NDArray[np.float64]
    spans: tuple[tuple[float, float], ...]
    unit: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "time_s", np.asarray(self.time_s, dtype=np.float64))
        object.__setattr__(self, "readings", np.asarray(self.readings, dtype=np.float64))
        object.__setattr__(self, "spans", tuple((float(start), float(end)) for start, end in self.spans))
        if self.time_s.ndim != 1 or self.readings.shape != (self.time_s.size, 3):
            raise ValueError(
                f"stream overview: time_s {self.time_s.shape} and readings {self.readings.shape}, "
                "expected (n,) and (n, 3)"
            )


def thin(time_s: ArrayLike, readings: ArrayLike, points: int = 2000) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """At most `points` rows of (n,) and (n, 3), in order, among them every
    stretch's extremes of each axis.

    Raises ValueError below 8 points: the ends and one stretch's six extremes.
    """
    times, values = np.asarray(time_s, dtype=np.float64), np.asarray(readings, dtype=np.float64)
    if points < 8:
        raise ValueError(f"points = {points}, expected at least 8")
    if times.size <= points:
        return times, values
    edges = np.linspace(0, times.size, (points - 2) // 6 + 1).astype(np.intp)
    kept = [np.array([0, times.size - 1])]
    for start, end in pairwise(edges):
        block = values[start:end]
        kept.append(start + np.where(np.isnan(block), np.inf, block).argmin(axis=0))
        kept.append(start + np.where(np.isnan(block), -np.inf, block).argmax(axis=0))
    rows = np.unique(np.concatenate(kept))
    return times[rows], values[rows]


def overview_of(windows: tc.poses.Windows | None, poses: Sequence[tc.Pose], unit: str) -> StreamOverview | None:
    """The stream from its windows' means; None where there is not one whole
    window."""
    if windows is None:
        return None
    time_s, readings = thin((windows.start_ns - int(windows.start_ns[0])) * 1e-9, windows.mean)
    return StreamOverview(time_s, readings, tuple((p.start_s, p.end_s) for p in poses), unit)
