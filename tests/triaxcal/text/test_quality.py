"""The lines of data quality."""

from __future__ import annotations

import pytest

from triaxcal.poses.quality.finding import (
    AtRail,
    Bursts,
    CoarseQuantization,
    Disturbance,
    DisturbedPoses,
    DuplicateSamples,
    Freeze,
    MainsPickup,
    MergedPoses,
    MissingSamples,
    Move,
    QualityFinding,
    Saturation,
    SlowUpdate,
    Steps,
    StuckOutput,
    Tone,
    Touched,
)
from triaxcal.text import quality, quality_line

TWO = Touched((1, 4), (5.02, 20.0))
LINES: list[tuple[QualityFinding, str]] = [
    (
        Saturation((AtRail("x", 2.4931, 812, 5.1, TWO), AtRail("y", -32768.0, 1, 4.5, Touched()))),
        "saturation: x at 2.4931 in 812 samples, first at 5.1 s, in the poses that begin at 5.0, 20.0 s: take again; "
        "y at -32768 in 1 sample, first at 4.5 s, in no pose",
    ),
    (
        StuckOutput(("z",), SlowUpdate(2.0, 100.0), ()),
        "stuck_output: z never changes; new values only every 2.00 samples, at 50 Hz of 100 Hz",
    ),
    (
        StuckOutput((), None, (Freeze("y", 0.25, 1, 200, 21.0, Touched((3,), (20.0,))),)),
        "stuck_output: y repeats 0.25 for 200 samples, first at 21.0 s, in the pose that begins at 20.0 s: take again",
    ),
    (
        StuckOutput((), None, (Freeze(None, 0.25, 3, 200, 21.0, Touched()),)),
        "stuck_output: all axes freeze 3 times, 200 samples at the longest, first at 21.0 s, in no pose",
    ),
    (Bursts(25, 0.25), "bursts: 25 samples every 250 ms, taken for evenly spaced"),
    (MissingSamples(3, 6000, 1, 3, 10.0), "missing_samples: 3 of 6000 by the times, at 10.0 s"),
    (
        MissingSamples(4, 6000, 2, 3, 10.0),
        "missing_samples: 4 of 6000 by the times, in 2 gaps, the first at 10.0 s, 3 in the longest",
    ),
    (DuplicateSamples(50, 5999), "duplicate_samples: 50 of 5999 samples repeat the one before on all axes"),
    (
        MainsPickup((Tone(40.0, (1.23e-3, 0.0, 5e-4), 60.0),), 100.0),
        "mains_pickup: 40.0 Hz, amplitude x 0.0012 V, z 0.0005 V (the alias of 60 Hz at 100 Hz sampling, or a "
        "vibration)",
    ),
    (
        CoarseQuantization((Steps("x", 2.4e-3, 1e-4, 1.2e-3),)),
        "coarse_quantization: x in steps of 0.0024 V, scatter 0.0001 V, pose means off by up to 0.0012 V",
    ),
    (
        DisturbedPoses((Disturbance(88.1, (90.1, 91.9), 103.4, 0.0246),), (11,), 26),
        "disturbed_pose: 1 of 26; the pose that begins at 88.1 s is shaken from 90.1 to 91.9 s by 0.025 V, 103 times "
        "the scatter of its rest, and the mean leaves that out",
    ),
    (
        DisturbedPoses(tuple(Disturbance(10.0 * i, None, 4.56, None) for i in range(9)), tuple(range(9)), 60),
        "disturbed_pose: 9 of 60; "
        + "; ".join(
            f"the pose that begins at {10 * i}.0 s scatters 4.6 times as much as most, and its standard error says so"
            for i in range(8)
        )
        + "; and 1 more",
    ),
    (
        MergedPoses((Move(158.9, 161.1, "x", 0.117),)),
        "merged_poses: shaking hides a move between 158.9 and 161.1 s, x by 0.12 V: two poses",
    ),
]


@pytest.mark.parametrize(("found", "line"), LINES, ids=lambda v: type(v).__name__)
def test_a_finding_is_said_with_its_figures_in_the_unit_of_the_outputs(found: QualityFinding, line: str) -> None:
    assert quality_line(found, "V") == line


def test_where_no_unit_is_known_none_is_said() -> None:
    assert quality(CoarseQuantization((Steps("x", 3.0, 1.0, 1.5),))).startswith("x in steps of 3, scatter 1, ")


def test_many_poses_are_counted_behind_the_first_eight() -> None:
    many = Touched(tuple(range(11)), tuple(5.0 * i for i in range(11)))
    said = quality(Saturation((AtRail("x", 1.0, 5, 0.0, many),)))
    assert said.endswith("at 0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0 s and 3 more: take again")


def test_every_kind_of_finding_has_words() -> None:
    assert {type(found) for found, _ in LINES} == set(QualityFinding.__subclasses__())
