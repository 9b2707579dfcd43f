"""The course of a channel about the middle of a pose, against numpy's polynomial fit."""

from __future__ import annotations

import numpy as np
import pytest

import triaxcal as tc
from triaxcal.poses.pose import courses_of

RATE_HZ = 50.0


@pytest.mark.parametrize("hold_s", [2.0, 20.0, 600.0])
@pytest.mark.parametrize("bend", [0.0, 1e-5])
def test_rate_bend_and_scatter_are_those_of_a_parabola(hold_s: float, bend: float) -> None:
    rng = np.random.default_rng(7)
    t_s = np.arange(0, 4 * (hold_s + 2), 1 / RATE_HZ)
    pose, into_s = np.divmod(t_s, hold_s + 2)
    directions = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    share = np.clip((into_s - hold_s) / 2, 0, 1)[:, None]
    here = pose.astype(int)
    a = directions[here] * (1 - share) + directions[here + 1] * share + rng.normal(size=(len(t_s), 3)) * 1e-3
    channel = 25 + 3e-3 * t_s + bend * t_s**2 + 0.01 * rng.normal(size=len(t_s))
    finder = tc.poses.PoseFinder()
    finder.feed((t_s * 1e9).astype(np.int64), a, {"temperature_c": channel})
    finder.finish()
    w, spans = finder.windows, finder.spans()
    assert w is not None
    assert len(spans) >= 3
    for span, found in zip(spans, courses_of(w, spans), strict=True):
        course = found["temperature_c"]
        # The span and half its length on either side, in windows.
        begin, end = int(w.start_ns[span.first]), int(w.end_ns[span.last])
        half = (end - begin) // 2
        near = (w.start_ns >= begin - half) & (w.start_ns < end + half)
        x = (w.start_ns[near] + w.period_ns / 2 - (begin + end) / 2) * 1e-9
        y = w.channels["temperature_c"][near]
        (second, first, middle), unscaled = np.polyfit(x, y - y.mean(), 2, cov="unscaled")
        rest = y - y.mean() - np.polyval([second, first, middle], x)
        scatter = np.sqrt(rest @ rest / (len(x) - 3))
        assert course.rate == pytest.approx(first, rel=1e-9)
        assert course.bend == pytest.approx(2 * second, rel=1e-7)
        assert course.error == pytest.approx(scatter / np.sqrt(len(span.used)), rel=1e-9)
        assert course.rate_error == pytest.approx(scatter * np.sqrt(unscaled[1, 1]), rel=1e-9)
        assert course.bend_error == pytest.approx(2 * scatter * np.sqrt(unscaled[0, 0]), rel=1e-9)
