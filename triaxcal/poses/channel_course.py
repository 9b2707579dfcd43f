"""How a logged channel goes about the middle of a pose: its rate and its bend,
with their standard errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.poses.stillness.detector import Span
from triaxcal.poses.stillness.windows import Windows


class ChannelCourse(NamedTuple):
    """A channel about the middle of a pose: standard error of its mean; its
    rate per second and its bend per second², each with its standard error."""

    error: float
    rate: float
    rate_error: float
    bend: float
    bend_error: float


def courses_of(w: Windows, spans: Sequence[Span]) -> list[dict[str, ChannelCourse]]:
    """Of each span, by channel."""
    steps = {name: _step(channel) for name, channel in w.channels.items()}
    return [_course(w, s, steps) for s in spans]


def _course(w: Windows, s: Span, steps: Mapping[str, float]) -> dict[str, ChannelCourse]:
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
        out[name] = ChannelCourse(
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
