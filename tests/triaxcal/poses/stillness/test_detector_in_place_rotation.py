"""A fixture that turns in place on a level table comes to rest twice; a knock is still a knock."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.half_turns import HANDS, Stood, stood
from triaxcal.model.sensor import Sensor
from triaxcal.poses.stillness.detector import TURN_S, Span, StillnessDetector
from triaxcal.poses.stillness.windows import Windows

TILTS = (0.0, 5e-5, 2e-4, 1e-3)


def found(stream: Stood, turn_s: float | None = TURN_S) -> tuple[Windows, list[Span]]:
    detector = StillnessDetector()
    detector.feed(stream.time_ns, stream.u)
    detector.finish()
    return detector.windows(), detector.spans(turn_s)


def holds_of(stream: Stood, w: Windows, spans: list[Span]) -> list[list[int]]:
    """The holds that each span has more than a window of."""
    begin, end = stream.holds.T
    out = []
    for span in spans:
        shared = np.minimum(end, w.end_ns[span.last] * 1e-9) - np.maximum(begin, w.start_ns[span.first] * 1e-9)
        out.append(np.flatnonzero(shared > 0.1).tolist())
    return out


@pytest.mark.slow
@pytest.mark.parametrize("tilt", TILTS)
@pytest.mark.parametrize("hand", HANDS)
def test_each_orientation_is_a_span_of_its_own_however_the_hand_turns(
    hand: str, tilt: float, paper_unit: Sensor
) -> None:
    for seed in range(2):
        stream = stood(paper_unit, HANDS[hand], tilt, seed, others=False)
        assert holds_of(stream, *found(stream)) == [[i] for i in range(12)]


def test_without_a_word_of_turns_one_reading_is_one_pose(paper_unit: Sensor) -> None:
    stream = stood(paper_unit, HANDS["turns it about the sensor itself"], 0.0, 0, others=False)
    assert holds_of(stream, *found(stream, None)) == [[2 * k, 2 * k + 1] for k in range(6)]


@pytest.mark.parametrize("tilt", TILTS)
@pytest.mark.parametrize(("height_g", "width_s"), [(1.0, 0.02), (0.01, 0.1), (0.1, 0.05)])
def test_a_knock_inside_a_pose_does_not_part_it(
    height_g: float, width_s: float, tilt: float, paper_unit: Sensor
) -> None:
    hand = HANDS["lifts it and puts it down"]
    stream = stood(paper_unit, hand, tilt, 1, others=False, knocks=(height_g, width_s))
    w, spans = found(stream)
    assert holds_of(stream, w, spans) == [[i] for i in range(12)]
    assert all(np.any(np.diff(span.used) > 1) for span in spans[::3]), "the knocks do not show"


def test_a_long_knock_is_shorter_than_the_turns(paper_unit: Sensor) -> None:
    stream = stood(paper_unit, HANDS["slides it slowly"], 0.0, 2, others=False, knocks=(0.1, 0.2))
    w, parted = found(stream, 0.0)
    assert len(parted) > 12
    lengths = sorted((span.since_s for span in parted if np.isfinite(span.since_s)), reverse=True)
    spans = found(stream, lengths[5])[1]
    assert holds_of(stream, w, spans) == [[i] for i in range(12)]


@pytest.mark.slow
def test_spans_are_the_same_in_blocks_of_any_size(paper_unit: Sensor) -> None:
    stream = stood(paper_unit, HANDS["changes its grip half-way"], 0.0, 3, others=False, knocks=(0.1, 0.05))
    whole = [span.used.tolist() for span in found(stream)[1]]
    for size in (1, 7, 64, 1000):
        pieces = StillnessDetector()
        for at in range(0, len(stream.u), size):
            pieces.feed(stream.time_ns[at : at + size], stream.u[at : at + size])
            if at % 5000 == 3000:
                pieces.spans(TURN_S)
        pieces.finish()
        assert [span.used.tolist() for span in pieces.spans(TURN_S)] == whole


def test_a_machine_that_shakes_whole_poses_takes_none(paper_unit: Sensor) -> None:
    """Between poses in other places, what is shaken is no turn."""
    stream = stood(paper_unit, HANDS["slides it on the table"], 1e-3, 4)
    into = np.concatenate([np.zeros(12, bool), np.arange(20) % 2 == 1])
    on = np.any([(stream.t_s >= b) & (stream.t_s < e) for b, e in stream.holds[into]], axis=0)
    hum = 0.006 * np.sin(2 * np.pi * 17.3 * stream.t_s[:, None] + [0.0, 1.0, 2.0]) * on[:, None]
    shaken = replace(stream, u=stream.u + hum * paper_unit.scale_factor)
    assert holds_of(shaken, *found(shaken)) == [[i] for i in range(32)]
