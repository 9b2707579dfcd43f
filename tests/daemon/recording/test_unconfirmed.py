"""Records of which nobody knows that they are the unit's: they stay in the file, and nothing is computed from them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from triaxcal_drivers.interface import RawBatch
from triaxcald.recording import schema
from triaxcald.recording.info import describe
from triaxcald.recording.manifest import load_manifest
from triaxcald.recording.reader import Recording, Series
from triaxcald.recording.recover import recover
from triaxcald.recording.segments import SegmentedWriter
from triaxcald.recording.survey import survey

BatchOf = Callable[..., RawBatch]
S = 1_000_000_000
WRONG = {"error": "the unit is serial 0888, expected 0777"}


def used(recording: Any) -> int:
    return sum(len(batch) for batch in recording.raw("calibration"))


def flagged(recording: Any) -> list[tuple[int, bool]]:
    return [(len(batch), batch.unconfirmed) for _, batch in recording.joined_batches()]


def write(new_writer: Any, batch_of: BatchOf, first: int, **options: Any) -> Any:
    writer = new_writer(**options)
    for i in range(4):
        writer.raw("calibration", batch_of(100 * i, 100))
    if first < 400:
        writer.unconfirmed(first, WRONG)
    return writer


@pytest.mark.parametrize("first", [0, 100, 200, 300, 400])
def test_what_came_after_the_last_confirmation_is_flagged_and_not_read(
    tmp_path: Path, new_writer: Any, batch_of: BatchOf, first: int
) -> None:
    write(new_writer, batch_of, first).close()
    with Recording.open(tmp_path / "rec.mcap") as recording:
        assert used(recording) == first
        assert recording.unconfirmed_records() == 400 - first
        assert flagged(recording) == [(n, flag) for n, flag in ((first, False), (400 - first, True)) if n]
        singly = [(len(batch), batch.unconfirmed) for _, batch in recording.raw_batches()]
        assert singly == [(100, 100 * i >= first) for i in range(4)]
        assert recording.raw_digest().records == 400, "the file is as it was written"
        assert recording.raw_digest().hexdigest() == recording.metadata[schema.RAW_RECORD]["sha256"]
        assert survey(recording, "").faults == []
    raw = describe(tmp_path / "rec.mcap")["raw"]["calibration"]
    assert (raw["records"], raw.get("unconfirmed", 0)) == (400, 400 - first)


def test_only_the_later_phase_is_unconfirmed_where_the_earlier_one_ended_confirmed(
    tmp_path: Path, new_writer: Any, batch_of: BatchOf
) -> None:
    with new_writer() as writer:
        writer.raw("calibration", batch_of(0, 100))
        confirmed = writer.offered
        writer.raw("verification", batch_of(100, 50))
        writer.unconfirmed(confirmed, WRONG)
    with Recording.open(tmp_path / "rec.mcap") as recording:
        assert used(recording) == 100
        assert list(recording.raw("verification")) == []


def test_the_event_says_what_is_unconfirmed(tmp_path: Path, new_writer: Any, batch_of: BatchOf) -> None:
    write(new_writer, batch_of, 100).close()
    with Recording.open(tmp_path / "rec.mcap") as recording:
        (detail,) = (e.detail for e in recording.events() if e.kind == schema.UNCONFIRMED)
    assert detail == {"first": 100, "records": 300, **WRONG}


def test_a_recording_that_was_killed_after_that_says_so_too_and_so_does_its_mended_copy(
    tmp_path: Path, new_writer: Any, batch_of: BatchOf
) -> None:
    writer = write(new_writer, batch_of, 200)
    writer.drain()
    cut, mended = tmp_path / "cut.mcap", tmp_path / "mended.mcap"
    cut.write_bytes((tmp_path / "rec.mcap").read_bytes())
    recover(cut, mended)
    for path in (cut, mended):
        with Recording.open(path, unfinished=True) as recording:
            assert (used(recording), recording.unconfirmed_records()) == (200, 200)


def test_a_recording_that_was_killed_before_anything_was_noticed_is_used_as_it_is(
    tmp_path: Path, new_writer: Any, batch_of: BatchOf
) -> None:
    writer = write(new_writer, batch_of, 400)
    writer.drain()
    with Recording.open(tmp_path / "rec.mcap", unfinished=True) as recording:
        assert (used(recording), recording.unconfirmed_records()) == (400, 0)


def segmented(tmp_path: Path, clock: Any, batch_of: BatchOf, first: int | None) -> SegmentedWriter:
    """Three segments of ten records each, and the fourth under way."""
    writer = SegmentedWriter(
        tmp_path / "rec.mcap", metadata={"unit": {"serial": "42"}}, clock_ns=clock, steady_ns=clock, time_s=60.0
    )
    begun = writer.offered
    for i in range(4):
        writer.raw("calibration", batch_of(begun + 10 * i, 10))
        writer.drain()
        if i < 3:
            clock.now_ns += 60 * S
            writer.event("minute")
            writer.drain()
    if first is not None:
        writer.unconfirmed(begun + first, WRONG)
        writer.drain()
    return writer


def test_segments_that_were_closed_since_the_last_confirmation_are_flagged_too(
    tmp_path: Path, clock: Any, batch_of: BatchOf
) -> None:
    segmented(tmp_path, clock, batch_of, 10).close()
    manifest = tmp_path / "rec.segments.json"
    listed = load_manifest(manifest).segments
    assert [s.unconfirmed for s in listed] == [None, 10, 20, 30]
    with Series(manifest) as series:
        assert (used(series), series.unconfirmed_records()) == (10, 30)
    for segment, records in zip(listed, (10, 0, 0, 0), strict=True):
        with Recording.open(tmp_path / segment.file) as alone:
            assert used(alone) == records, "also one that is read by itself, beside its manifest"
    recover(tmp_path / listed[1].file, tmp_path / "mended.mcap")
    with Recording.open(tmp_path / "mended.mcap") as mended:
        assert used(mended) == 0


def test_what_is_recorded_later_under_the_same_name_is_used(tmp_path: Path, clock: Any, batch_of: BatchOf) -> None:
    segmented(tmp_path, clock, batch_of, 10).close()
    clock.now_ns += 60 * S
    segmented(tmp_path, clock, batch_of, None).close()
    with Series(tmp_path / "rec.segments.json") as series:
        assert (used(series), series.unconfirmed_records()) == (50, 30)
    clock.now_ns += 60 * S
    segmented(tmp_path, clock, batch_of, 20).close()
    with Series(tmp_path / "rec.segments.json") as series:
        assert (used(series), series.unconfirmed_records()) == (70, 50)


def test_a_kill_between_the_file_and_the_manifest_loses_no_mark(tmp_path: Path, clock: Any, batch_of: BatchOf) -> None:
    writer = segmented(tmp_path, clock, batch_of, None)
    before = (tmp_path / "rec.segments.json").read_bytes()
    writer.unconfirmed(10, WRONG)
    writer.drain()
    files = {p: p.read_bytes() for p in tmp_path.glob("*.mcap")}
    writer.close()
    for path, data in files.items():
        path.write_bytes(data)
    (tmp_path / "rec.segments.json").write_bytes(before)
    clock.now_ns += 60 * S
    segmented(tmp_path, clock, batch_of, None).close()
    listed = load_manifest(tmp_path / "rec.segments.json").segments
    assert [s.unconfirmed for s in listed] == [None, 10, 20, 30, None, None, None, None]
    with Series(tmp_path / "rec.segments.json") as series:
        assert (used(series), series.unconfirmed_records()) == (50, 30)


def test_manifests_of_old_say_nothing_of_it(tmp_path: Path, clock: Any, batch_of: BatchOf) -> None:
    segmented(tmp_path, clock, batch_of, None).close()
    manifest = tmp_path / "rec.segments.json"
    manifest.write_text(manifest.read_text().replace(',\n   "unconfirmed": null', ""))
    assert "unconfirmed" not in manifest.read_text()
    with Series(manifest) as series:
        assert used(series) == 40
