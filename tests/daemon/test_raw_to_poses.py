"""The way from raw records to poses: the same however the records are cut, and nothing lost in silence."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import triaxcal as tc
from triaxcal.poses.pose import Pose
from triaxcal.poses.quality import QualityDetector, QualityFinding
from triaxcal.poses.quality.finding import MissingSamples, StuckOutput
from triaxcal_drivers.catalogue import load_bundle, parse_bundle
from triaxcal_drivers.interface import RawBatch, SampleBlock
from triaxcal_drivers.profile import CORRECTED, READINGS
from triaxcald import decoded, text
from triaxcald.decoded import DecodedStream, beside_samples, only_finite
from triaxcald.raw_to_poses import Pipeline, together
from triaxcald.recording.schema import cut
from triaxcald.simulation.bench import DeviceFile, physics_of
from triaxcald.simulation.can_unit import tpdos
from triaxcald.simulation.unit import ReferenceUnit

T0_NS = 1_700_000_000_000_000_000
BUNDLE = load_bundle(Path("triax-ref-can"))


@pytest.fixture(scope="module")
def records() -> list[tuple[int, int, int, bytes]]:
    """Twenty seconds of a unit that goes from pose to pose, as CAN frames."""
    device = DeviceFile.model_validate(
        {
            "format": "triaxcal.device/1",
            "profile": "triax-ref-can",
            "bus": {},
            "fixture": {"poses": 26, "hold_s": 2.0, "move_s": 0.8},
        }
    )
    run = ReferenceUnit(physics_of(device), serial_number=1).advance(20.0)
    frames = zip(*tpdos(run), strict=True)
    return [
        (T0_NS + round(t * 1e9) + 1000 * i, 0x185 + 0x100 * i, 0, data)
        for t, parts in zip(run.unit_time_s, frames, strict=True)
        for i, data in enumerate(parts)
    ]


def _poses_equal(one: list[Pose], other: list[Pose]) -> None:
    assert [(p.start_s, p.end_s, p.samples) for p in one] == [(p.start_s, p.end_s, p.samples) for p in other]
    for p, q in zip(one, other, strict=True):
        np.testing.assert_array_equal(p.mean, q.mean)
        np.testing.assert_array_equal(p.covariance, q.covariance)


@pytest.mark.slow
@pytest.mark.parametrize("stream", [READINGS, CORRECTED])
@pytest.mark.parametrize("size", [5, 1024])
def test_poses_are_the_same_however_the_records_are_cut(
    records: list[tuple[int, int, int, bytes]], stream: str, size: int
) -> None:
    whole = Pipeline(BUNDLE, stream).feed_all([RawBatch.of(records)])
    pieces = Pipeline(BUNDLE, stream)
    for batch in cut(RawBatch.of(records), size):
        pieces.feed(batch)
    expected = whole.finish()
    assert len(expected) == 7
    _poses_equal(pieces.finish(), expected)
    assert pieces.counts == whole.counts
    assert pieces.seconds == whole.seconds
    assert pieces.first_host_ns == whole.first_host_ns == T0_NS


def test_clean_records_are_counted_and_blamed_for_nothing(records: list[tuple[int, int, int, bytes]]) -> None:
    pipeline = Pipeline(BUNDLE, READINGS).feed_all([RawBatch.of(records)])
    assert pipeline.counts.pop("samples") == 2001
    assert set(pipeline.counts.values()) == {0}
    assert pipeline.data_quality() == []
    assert pipeline.seconds == pytest.approx(20.0, abs=0.01)


def test_lost_samples_are_counted_and_said(records: list[tuple[int, int, int, bytes]]) -> None:
    kept = [r for i, r in enumerate(records) if not 400 <= i < 440]  # ten samples, all their frames
    pipeline = Pipeline(BUNDLE, READINGS).feed_all([RawBatch.of(kept)])
    assert pipeline.counts["missing"] == 10
    assert pipeline.counts["samples"] == 1991
    assert pipeline.data_quality() == ["missing_samples: 10 of 2001"]


def test_half_a_sample_is_counted_and_not_used(records: list[tuple[int, int, int, bytes]]) -> None:
    kept = [r for i, r in enumerate(records) if i != 401]  # the second frame of sample 100
    pipeline = Pipeline(BUNDLE, READINGS).feed_all([RawBatch.of(kept)])
    assert pipeline.counts["samples"] == 2000
    assert pipeline.counts["incomplete"] + pipeline.counts["missing"] == 1
    assert pipeline.data_quality() == ["missing_samples: 1 of 2001"]


def test_a_sample_that_comes_twice_is_used_once_and_its_messages_are_counted(
    records: list[tuple[int, int, int, bytes]],
) -> None:
    twice = records[:404] + records[400:404] + records[404:]
    pipeline = Pipeline(BUNDLE, READINGS).feed_all([RawBatch.of(twice)])
    assert pipeline.counts["samples"] == 2001
    assert pipeline.counts["duplicates"] == 2
    assert pipeline.data_quality() == ["duplicate_samples: 2"]


@pytest.mark.slow
@pytest.mark.parametrize("size", [5, 1024])
def test_a_frozen_axis_is_said_however_the_records_are_cut(
    records: list[tuple[int, int, int, bytes]], size: int
) -> None:
    def frozen(i: int) -> bytes:  # x, the first three bytes of a sample's first frame, from sample 1000 to 1099
        own = records[i][3]
        return records[4000][3][:3] + own[3:] if 4000 <= i < 4400 and i % 4 == 0 else own

    held = [(t, source, flags, frozen(i)) for i, (t, source, flags, _) in enumerate(records)]
    whole = Pipeline(BUNDLE, READINGS).feed_all([RawBatch.of(held)])
    whole.finish()
    pieces = Pipeline(BUNDLE, READINGS).feed_all(cut(RawBatch.of(held), size))
    pieces.finish()
    found = [q for q in whole.data_quality() if q.startswith("stuck_output")]
    assert len(found) == 1
    assert found[0].startswith("stuck_output: x repeats ")
    assert " for 100 samples, first at 10.0 s" in found[0]
    assert pieces.data_quality() == whole.data_quality()


def test_the_same_samples_are_judged_once_for_poses_and_data_quality(
    records: list[tuple[int, int, int, bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    judged = []
    findings = QualityDetector.findings

    def counted(self: QualityDetector, *arguments: Any, **options: Any) -> list[QualityFinding]:
        judged.append(self.samples)
        return findings(self, *arguments, **options)

    monkeypatch.setattr(QualityDetector, "findings", counted)
    pipeline = Pipeline(BUNDLE, READINGS).feed_all([RawBatch.of(records[:6000])])
    assert pipeline.data_quality() == pipeline.data_quality() == []
    assert len(judged) == 1
    pipeline.feed(RawBatch.of(records[6000:]))
    pipeline.data_quality()
    assert len(judged) == 2
    pipeline.finish()
    pipeline.data_quality()
    assert len(judged) == 3
    assert judged[-1] == 2001


def test_what_was_counted_as_missing_is_not_said_again_by_the_times() -> None:
    seen = [MissingSamples(10, 2001, 1, 10, 3.0), StuckOutput(("x",), None, ())]
    assert together({"missing_samples": "10 of 2001"}, seen) == [
        "missing_samples: 10 of 2001",
        "stuck_output: x never changes",
    ]
    assert together({}, seen[:1]) == ["missing_samples: 10 of 2001 by the times, at 3.0 s"]


def test_nothing_fed_is_no_pose_and_no_window() -> None:
    pipeline = Pipeline(BUNDLE, READINGS)
    assert pipeline.windows is None
    assert pipeline.poses() == pipeline.finish() == []
    assert pipeline.seconds == 0.0
    assert pipeline.first_host_ns is None


@pytest.mark.slow
def test_poses_so_far_can_be_asked_for_at_any_time(records: list[tuple[int, int, int, bytes]]) -> None:
    pipeline = Pipeline(BUNDLE, READINGS)
    seen = []
    for batch in cut(RawBatch.of(records), 800):
        pipeline.feed(batch)
        seen.append(len(pipeline.poses()))
    assert seen == sorted(seen)
    assert seen[-1] == 7


def test_an_interruption_of_the_stream_is_counted_and_said(records: list[tuple[int, int, int, bytes]]) -> None:
    flagged = [(t, source, 16 if i == 400 else 0, data) for i, (t, source, _, data) in enumerate(records)]
    pipeline = Pipeline(BUNDLE, READINGS).feed_all([RawBatch.of(flagged)])
    assert pipeline.counts["receiver_overflows"] == 1
    assert pipeline.data_quality() == ["missing_samples: the stream was interrupted once"]


def test_what_is_counted_beside_samples_is_named_by_kind() -> None:
    counts = {"samples": 9, "missing": 1, "duplicates": 1, "incomplete": 0, "errors": 1, "receiver_overflows": 2}
    assert beside_samples(counts) == ["1 missing", "1 duplicate", "1 error", "2 interruptions"]
    seldom = {"out_of_order": 3, "not_finite": 1, "malformed": 2}
    assert beside_samples(seldom) == [
        "3 out of order", "1 not finite", "2 malformed (too short for the profile's message, or not as it is defined)"
    ]  # fmt: skip


def test_samples_that_are_not_valid_are_left_out_and_said(records: list[tuple[int, int, int, bytes]]) -> None:
    """By a status of which the third bit, over-range, is set in three samples."""
    text = BUNDLE.text.replace(
        b'counter = "Counter"', b'counter = "Counter"\nvalid = { signal = "Status", values = [0] }'
    )
    bundle = parse_bundle(text, BUNDLE.files, where="test")
    spoiled = [
        (t, source, flags, data[:7] + b"\x04" if source == 0x285 and i // 4 in (101, 203, 305) else data)
        for i, (t, source, flags, data) in enumerate(records)
    ]
    pipeline = Pipeline(bundle, READINGS).feed_all([RawBatch.of(spoiled)])
    assert (pipeline.counts["samples"], pipeline.counts["invalid"], pipeline.counts["missing"]) == (1998, 3, 0)
    assert "invalid_samples: 3 that the unit says are not valid, left out" in pipeline.data_quality()
    assert "invalid" not in Pipeline(BUNDLE, READINGS).feed_all([RawBatch.of(records)]).counts


def test_readings_of_many_g_by_the_nominal_scale_factor_are_said(records: list[tuple[int, int, int, bytes]]) -> None:
    assert not any(
        "implausible" in line for line in Pipeline(BUNDLE, READINGS).feed_all([RawBatch.of(records)]).data_quality()
    )
    small = BUNDLE.text.replace(b"nominal_scale_factor = [", b"nominal_scale_factor = [0.01, 0.01, 0.01] # [")
    pipeline = Pipeline(parse_bundle(small, BUNDLE.files, where="test"), READINGS).feed_all([RawBatch.of(records)])
    (line,) = [line for line in pipeline.data_quality() if line.startswith("implausible_readings: ")]
    assert "by output.nominal_scale_factor the poses span ±2" in line


def test_samples_without_a_number_are_left_out_and_said() -> None:
    def block(values: list[float]) -> SampleBlock:
        n = len(values)
        return SampleBlock(np.arange(n), np.arange(n), np.column_stack([values, np.ones((n, 2))]), {"t": np.arange(n)})

    kept = only_finite(block([1.0, np.nan, 2.0, np.inf, 1e200, 3.0]))
    assert (kept.readings[:, 0].tolist(), kept.channels["t"].tolist(), kept.not_finite) == ([1, 2, 3], [0, 2, 5], 3)
    assert only_finite(block([1.0])).not_finite == 0


def test_the_hosts_time_is_kept_beside_the_units(records: list[tuple[int, int, int, bytes]]) -> None:
    """As of a unit that is a quarter slower than its profile says."""
    slow = [(T0_NS + round((t - T0_NS) * 1.25), *rest) for t, *rest in records]
    stream = DecodedStream(BUNDLE, READINGS)
    stream.feed(RawBatch.of(slow))
    assert stream.seconds == pytest.approx(20.0, abs=0.05)
    assert stream.host_seconds == pytest.approx(25.0, abs=0.05)
    said = text.own_seconds(stream.seconds, stream.host_seconds)
    assert said == "20.0 s of the unit's own time (25.0 s by the host's clock)"
    assert text.own_seconds(20.0, 21.0) == "20.0 s"


def test_the_daemon_and_the_metrology_take_the_same_readings_for_sound() -> None:
    assert decoded.READING_MOST == tc.poses.READING_MOST
