"""A recording in segments: written one after the other, read as one."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from triaxcal_drivers.errors import DeviceSilent
from triaxcal_drivers.interface import Gap, RawBatch
from triaxcald.audit import audit
from triaxcald.errors import DiskError, RecordingError
from triaxcald.recording import disk, reader, schema
from triaxcald.recording import writer as writer_module
from triaxcald.recording.info import describe
from triaxcald.recording.manifest import Retention, load_manifest
from triaxcald.recording.reader import Recording, Series, digest_of
from triaxcald.recording.recover import recover
from triaxcald.recording.segments import AWAY, SegmentedWriter
from triaxcald.recording.survey import survey

T0_NS = 1_700_000_000_000_000_000
S = 1_000_000_000
GOLDEN = Path(__file__).parents[3] / "recordings" / "can-second-order.mcap"
METADATA = {"station": {"name": "bench"}, "unit": {"serial": "42"}}
BatchOf = Callable[..., RawBatch]
NewWriter = Callable[..., SegmentedWriter]


@pytest.fixture
def new(tmp_path: Path, clock: Any) -> Iterator[NewWriter]:
    writers: list[SegmentedWriter] = []

    def make(**options: Any) -> SegmentedWriter:
        settings = {"metadata": METADATA, "clock_ns": clock, "steady_ns": clock, "time_s": 60.0}
        writers.append(SegmentedWriter(tmp_path / "rec.mcap", **{**settings, **options}))
        return writers[-1]

    yield make
    for writer in writers:
        if not writer.closed:
            writer.close()


@pytest.fixture
def minutes(clock: Any, batch_of: BatchOf) -> Callable[..., None]:
    """Records a batch of ten in each of so many minutes, which are a segment each."""

    def record(writer: SegmentedWriter, count: int, first: int = 0) -> None:
        for i in range(count):
            writer.raw("calibration", batch_of(first + 10 * i, 10))
            writer.drain()
            clock.now_ns += 60 * S
            writer.event("minute")
            writer.drain()

    return record


def files(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.glob("*.mcap"))


def kinds(path: Path, *, unfinished: bool = False) -> list[str]:
    with Recording.open(path, unfinished=unfinished) as recording:
        return [e.kind for e in recording.events()]


def test_a_segment_begins_when_the_last_is_old_enough(
    tmp_path: Path, new: NewWriter, minutes: Callable[..., None]
) -> None:
    with new() as writer:
        writer.attach("station.toml", "application/toml", b"name = 'bench'\n")
        minutes(writer, 3)
    assert files(tmp_path) == ["rec-000001.mcap", "rec-000002.mcap", "rec-000003.mcap", "rec-000004.mcap"]
    listed = load_manifest(tmp_path / "rec.segments.json").segments
    assert [(s.first, s.end, s.records, s.state) for s in listed] == [
        (0, 10, 10, "closed"), (10, 20, 10, "closed"), (20, 30, 10, "closed"), (30, 30, 0, "closed"),
    ]  # fmt: skip
    assert (listed[1].start_ns, listed[1].end_ns) == (T0_NS + 10_000_000, T0_NS + 19_000_000)
    for segment in listed:
        path = tmp_path / segment.file
        assert (path.stat().st_size, digest_of(path)) == (segment.bytes, segment.sha256)


def test_a_segment_ends_in_silence_too_and_an_empty_one_goes_on(
    tmp_path: Path, new: NewWriter, batch_of: BatchOf, clock: Any, wait_until: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer_module, "LOOK_S", 0.001)
    with new() as writer:
        writer.raw("calibration", batch_of(0, 10))
        writer.drain()
        for _ in range(3):
            clock.now_ns += 60 * S
            wait_until(lambda: len(files(tmp_path)) == 2)
    assert files(tmp_path) == ["rec-000001.mcap", "rec-000002.mcap"]


def test_the_age_of_a_segment_counts_from_its_first_record(
    tmp_path: Path, new: NewWriter, batch_of: BatchOf, clock: Any
) -> None:
    with new() as writer:
        for first in (0, 10, 20):
            writer.raw("calibration", batch_of(first, 10))
            writer.drain()
            clock.now_ns += (90 if first == 0 else 30) * S
            writer.event("silence")
            writer.drain()
    assert [s.records for s in load_manifest(tmp_path / "rec.segments.json").segments] == [10, 20, 0]


def test_segments_grow_too_old_while_nothing_comes(
    tmp_path: Path, new: NewWriter, minutes: Callable[..., None], clock: Any, wait_until: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr(writer_module, "LOOK_S", 0.001)
    with new(retention=Retention(keep_s=150.0)) as writer:
        minutes(writer, 2)
        for _ in range(3):
            clock.now_ns += 60 * S
            writer.drain()
        wait_until(lambda: files(tmp_path) == ["rec-000003.mcap"])
    assert [one.reason for one in writer.deleted] == ["age", "age"]


def test_the_disk_is_watched_while_nothing_comes(
    tmp_path: Path, new: NewWriter, minutes: Callable[..., None], wait_until: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer_module, "LOOK_S", 0.001)
    others = [0]
    monkeypatch.setattr(disk, "free_bytes", lambda _: 100_000_000 - others[0])
    with new(retention=Retention(free_bytes=50_000_000)) as writer:
        minutes(writer, 2)
        others[0] = 60_000_000
        wait_until(lambda: files(tmp_path) == ["rec-000003.mcap"])
    assert {one.reason for one in writer.deleted} == {"disk"}


def test_a_segment_begins_when_the_last_is_large_enough(tmp_path: Path, new: NewWriter, batch_of: BatchOf) -> None:
    with new(size_bytes=200_000, time_s=1e6) as writer:
        for i in range(20):
            writer.raw("calibration", batch_of(3000 * i, 3000))
            writer.drain()
    sizes = [s.bytes for s in load_manifest(tmp_path / "rec.segments.json").segments]
    assert len(sizes) > 2
    assert all(200_000 <= size < 300_000 for size in sizes[:-1])


def test_each_segment_is_a_whole_recording_that_can_be_read_alone(
    tmp_path: Path, new: NewWriter, minutes: Callable[..., None], batch_of: BatchOf
) -> None:
    with new() as writer:
        writer.attach("station.toml", "application/toml", b"name = 'bench'\n")
        minutes(writer, 2)
        writer.attach("note.txt", "text/plain", b"later")
    with Recording.open(tmp_path / "rec-000002.mcap") as recording:
        assert recording.metadata["unit"] == {"serial": "42"}
        assert dict(recording.attachments) == {"station.toml": b"name = 'bench'\n"}
        assert [b.time_ns.tolist() for b in recording.raw("calibration")] == [batch_of(10, 10).time_ns.tolist()]
        assert recording.metadata["segment"] == {
            "number": "2", "first": "10", "of": "rec.segments.json",
            "previous": "rec-000001.mcap", "previous_sha256": digest_of(tmp_path / "rec-000001.mcap"),
        }  # fmt: skip
        assert survey(recording, "none").faults == []
    assert kinds(tmp_path / "rec-000002.mcap") == ["recording_started", "minute"]


def test_a_segment_is_mended_without_what_is_in_the_others_counting_as_missing(
    tmp_path: Path, new: NewWriter, minutes: Callable[..., None]
) -> None:
    with new() as writer:
        minutes(writer, 2)
    (tmp_path / "cut.mcap").write_bytes((tmp_path / "rec-000002.mcap").read_bytes()[:-200])
    recovery = recover(tmp_path / "cut.mcap", tmp_path / "mended.mcap")
    assert (recovery.raw_records, recovery.raw_missing) == (10, 0)


def test_the_segments_are_read_as_one_stream(
    tmp_path: Path, new: NewWriter, minutes: Callable[..., None], batch_of: BatchOf
) -> None:
    with new() as writer:
        writer.attach("station.toml", "application/toml", b"name = 'bench'\n")
        minutes(writer, 3)
    whole = schema.RawDigest()
    whole.update("calibration", batch_of(0, 30))
    with Series(tmp_path / "rec.segments.json") as series:
        assert series.raw_digest().hexdigest() == whole.hexdigest()
        assert series.phases() == ["calibration"]
        assert (series.metadata["unit"], "segment" in series.metadata) == ({"serial": "42"}, False)
        assert dict(series.attachments) == {"station.toml": b"name = 'bench'\n"}
        assert [e.kind for e in series.events()].count("minute") == 3


def test_the_index_of_each_segment_is_kept_for_when_it_is_opened_again(
    tmp_path: Path, new: NewWriter, minutes: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    with new() as writer:
        minutes(writer, 3)
    unpacked: list[str] = []
    real = reader.chunk_data
    monkeypatch.setattr(reader, "chunk_data", lambda unparsed, name: unpacked.append(name) or real(unparsed, name))
    with Series(tmp_path / "rec.segments.json") as series:
        index = series.index()
        assert index is not None
        assert sum(m.messages for m in index.topics.values()) == sum(1 for _ in series.messages())
        unpacked.clear()
        assert not list(series.messages("of no segment"))
        assert unpacked == []
        events = [(e.time_ns, e.kind) for e in series.events()]
    with Series(tmp_path / "rec.segments.json") as series:
        assert [(e.time_ns, e.kind) for e in series.events()] == events
        unpacked.clear()
        assert not list(series.messages("of no segment"))
        assert len(unpacked) >= 2


def test_a_recording_goes_on_behind_the_manifest_that_is_there(
    tmp_path: Path, new: NewWriter, minutes: Callable[..., None], batch_of: BatchOf
) -> None:
    with new() as writer:
        minutes(writer, 1)
    with new() as writer:
        minutes(writer, 1, first=10)
    listed = load_manifest(tmp_path / "rec.segments.json").segments
    assert [s.number for s in listed] == [1, 2, 3, 4]
    assert [(s.first, s.records) for s in listed] == [(0, 10), (10, 0), (10, 10), (20, 0)]
    with Series(tmp_path / "rec.segments.json") as series:
        times = [t for batch in series.raw("calibration") for t in batch.time_ns.tolist()]
    assert times == batch_of(0, 20).time_ns.tolist()


def test_who_goes_on_is_told_since_when_nothing_was_recorded(new: NewWriter, minutes: Callable[..., None]) -> None:
    with new() as writer:
        assert writer.resumes is None
        minutes(writer, 1)
    with new() as writer:
        assert writer.resumes == Gap(T0_NS + 9_000_000, None, AWAY)


def test_after_a_kill_the_segment_that_was_being_written_is_taken_as_it_lies(
    tmp_path: Path, new: NewWriter, batch_of: BatchOf, clock: Any
) -> None:
    killed = new()
    killed.raw("calibration", batch_of(0, 10))
    killed.drain()
    before = (tmp_path / "rec-000001.mcap").read_bytes(), (tmp_path / "rec.segments.json").read_text()
    killed.close()
    (tmp_path / "rec-000001.mcap").write_bytes(before[0])  # as a kill would have left them
    (tmp_path / "rec.segments.json").write_text(before[1])
    with Series(tmp_path / "rec.segments.json") as series:
        assert series.raw_digest().records == 10
    with new() as writer:
        writer.raw("calibration", batch_of(10, 10))
    first, second = load_manifest(tmp_path / "rec.segments.json").segments
    assert (first.state, first.first, first.end, first.records) == ("cut_short", 0, 10, 10)
    assert (second.state, second.first, second.end) == ("closed", 10, 20)
    with Series(tmp_path / "rec.segments.json") as series:
        assert series.raw_digest().records == 20


@pytest.mark.parametrize(("kept", "records"), [(1.0, 10), (0.9, 0), (0.0, 0)])
def test_after_a_power_failure_recording_goes_on_behind_what_reached_the_disk(
    tmp_path: Path, new: NewWriter, batch_of: BatchOf, kept: float, records: int
) -> None:
    """The rest of the file is zeros; where it is nothing else, nothing was recorded in it."""
    killed = new()
    killed.raw("calibration", batch_of(0, 10))
    killed.drain()
    path, manifest = tmp_path / "rec-000001.mcap", tmp_path / "rec.segments.json"
    before = path.read_bytes(), manifest.read_text()
    killed.close()
    path.write_bytes(before[0][: round(kept * len(before[0]))].ljust(len(before[0]) + 4096 if kept else 0, b"\0"))
    manifest.write_text(before[1])
    with new() as writer:
        writer.raw("calibration", batch_of(10, 10))
    assert [s.state for s in load_manifest(manifest).segments] == (["cut_short"] if kept else []) + ["closed"]
    with Series(manifest) as series:
        assert series.raw_digest().records == records + 10


def test_a_last_segment_that_is_damaged_is_no_reason_not_to_record(
    tmp_path: Path, new: NewWriter, minutes: Callable[..., None], batch_of: BatchOf
) -> None:
    killed, path, manifest = new(), tmp_path / "rec-000002.mcap", tmp_path / "rec.segments.json"
    minutes(killed, 1)
    killed.raw("calibration", batch_of(10, 10))
    killed.drain()
    spoilt, listed = bytearray(path.read_bytes()), manifest.read_text()
    killed.close()
    spoilt[len(spoilt) // 2] ^= 0xFF
    path.write_bytes(spoilt)  # as a kill would have left them, and the disk
    manifest.write_text(listed)
    with new() as writer:
        assert writer.resumes is not None
        assert "damaged" in writer.resumes.cause
        writer.raw("calibration", batch_of(20, 10))
    *_, second, third = load_manifest(manifest).segments
    assert (second.state, second.records, third.state, third.records) == ("damaged", 0, "closed", 10)
    assert second.sha256 == digest_of(path)
    with pytest.raises(RecordingError, match=r"rec-000002\.mcap: "), Series(manifest) as series:
        list(series.messages())
    with Recording.open(tmp_path / "rec-000003.mcap") as recording:
        assert sum(len(batch) for batch in recording.raw("calibration")) == 10


def test_what_the_queue_had_no_room_for_has_its_running_index_in_the_series(
    tmp_path: Path, new: NewWriter, batch_of: BatchOf, clock: Any
) -> None:
    with new(queue_batches=1) as writer:
        writer.drain()
        writer._room.acquire()  # as if a batch were on its way to a slow disk
        assert not writer.raw("calibration", batch_of(0, 10))
        writer._room.release()
        writer.drain()
        assert writer.raw("calibration", batch_of(10, 10))
        assert writer.losses == {"/raw": 10}
    [segment] = load_manifest(tmp_path / "rec.segments.json").segments
    assert (segment.end, segment.records) == (20, 10)


# Retention


def test_segments_older_than_they_are_kept_go_and_that_is_said(tmp_path: Path, new: NewWriter, clock: Any) -> None:
    with new(retention=Retention(keep_s=150.0)) as writer:
        for _ in range(5):
            writer.raw("calibration", RawBatch.of([(clock.now_ns, 0x181, 0, b"")]))
            writer.drain()
            clock.now_ns += 60 * S
            writer.event("minute")
            writer.drain()
    gone = [one.segment.file for one in writer.deleted]
    assert gone == ["rec-000001.mcap", "rec-000002.mcap"]
    assert files(tmp_path) == ["rec-000003.mcap", "rec-000004.mcap", "rec-000005.mcap", "rec-000006.mcap"]
    manifest = load_manifest(tmp_path / "rec.segments.json")
    assert ([s.number for s in manifest.segments], manifest.deleted) == ([3, 4, 5, 6], {"age": 2})
    with Series(tmp_path / "rec.segments.json") as series:
        told = [s["file"] for e in series.events() if e.kind == "deleted" for s in e.detail["segments"]]
    assert told == gone


def unreadable_folder(path: Path) -> None:
    path.mkdir()


def link_to_nowhere(path: Path) -> None:
    """As to a share that is not mounted."""
    path.symlink_to("nowhere")


@pytest.mark.parametrize("lay", [unreadable_folder, link_to_nowhere])
def test_a_document_that_cannot_be_read_keeps_all_and_is_named(
    tmp_path: Path, new: NewWriter, minutes: Callable[..., None], monkeypatch: pytest.MonkeyPatch,
    lay: Callable[[Path], None],
) -> None:  # fmt: skip
    lay(tmp_path / "other.outcome.json")
    writer = new(retention=Retention(keep_s=1.0, free_bytes=2**62))
    writer.drain()
    assert writer.keeps_for is None, "there is nothing yet that could go"
    minutes(writer, 2)
    assert (writer.deleted, writer.keeps_for) == ([], "other.outcome.json")
    monkeypatch.setattr(disk, "free_bytes", lambda _: 1000)
    with pytest.raises(DiskError, match=r"; nothing was deleted, as other\.outcome\.json cannot be read$"):
        minutes(writer, 1, first=40)
    with pytest.raises(DiskError):
        writer.close()
    with Recording.open(tmp_path / files(tmp_path)[-1]) as recording:
        assert [e.detail["unread"] for e in recording.events() if e.kind == "disk_low"] == ["other.outcome.json"]


def test_no_segment_begins_where_there_is_no_room_for_its_end(
    tmp_path: Path, new: NewWriter, minutes: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    with new() as writer:
        minutes(writer, 3)
    before = files(tmp_path)
    free = disk.END_BYTES - 1
    monkeypatch.setattr(disk, "free_bytes", lambda _: free)
    with pytest.raises(
        DiskError,
        match=rf"rec\.segments\.json: cannot be created: {free} bytes are free on the disk, 4194304 are needed$",
    ):
        new()
    assert files(tmp_path) == before
    free = disk.END_BYTES - 2**20
    with pytest.raises(DiskError):
        new(retention=Retention(free_bytes=2**23))
    assert files(tmp_path) == before, "all of them together would not make room"
    free = disk.END_BYTES - 1
    (tmp_path / "x.certificate.json").mkdir()
    with pytest.raises(DiskError, match=r"; nothing was deleted, as x\.certificate\.json cannot be read$"):
        new(retention=Retention(free_bytes=2**23))
    (tmp_path / "x.certificate.json").rmdir()
    monkeypatch.setattr(disk, "free_bytes", lambda _: 2**30 if len(files(tmp_path)) < 4 else free)
    with new(retention=Retention(free_bytes=2**23)) as writer:
        minutes(writer, 1, first=30)
    assert files(tmp_path)[0] == "rec-000005.mcap", "those before have made room"
    first = load_manifest(tmp_path / "rec.segments.json").segments[0]
    assert (first.number, first.first) == (5, 30), "as if they were there"
    assert kinds(tmp_path / "rec-000005.mcap").count("deleted") == 1


@pytest.mark.parametrize("step_s", [-3600, 3600])
def test_a_clock_that_is_set_takes_no_fresh_segment_away(
    tmp_path: Path, new: NewWriter, minutes: Callable[..., None], clock: Any, step_s: int
) -> None:
    begun_ns, stepped_ns = clock.now_ns, 0
    keep = {"retention": Retention(keep_s=600.0), "steady_ns": lambda: clock.now_ns - stepped_ns}
    with new(**keep) as writer:
        minutes(writer, 2)
        stepped_ns = step_s * S
        clock.now_ns += stepped_ns
        minutes(writer, 2, first=20)
    assert writer.deleted == []
    assert clock.now_ns - stepped_ns - begun_ns == 240 * S


def test_a_clock_that_was_years_behind_at_the_start_keeps_no_segment_for_ever(
    tmp_path: Path, new: NewWriter, minutes: Callable[..., None], clock: Any
) -> None:
    with new() as writer:
        minutes(writer, 2)
    right_ns, behind_ns = clock.now_ns, 10 * 365 * 86_400 * S
    clock.now_ns -= behind_ns
    steady = {"steady_ns": lambda: clock.now_ns - right_ns, "retention": Retention(keep_s=150.0)}
    with new(**steady) as writer:
        right_ns += behind_ns
        clock.now_ns += behind_ns  # a first contact with a time server; the steady line does not move
        minutes(writer, 6, first=20)
    assert [one.segment.number for one in writer.deleted] == [1, 2, 3, 4, 5, 6]


def test_a_segment_is_as_old_as_its_file_whatever_its_records_say(
    tmp_path: Path, new: NewWriter, minutes: Callable[..., None], clock: Any
) -> None:
    with new(retention=Retention(keep_s=600.0)) as writer:
        clock.now_ns += 86_400 * S  # the records' times stay behind
        minutes(writer, 3)
    assert writer.deleted == []


def test_the_oldest_make_room_where_too_little_of_the_disk_is_free(
    tmp_path: Path, new: NewWriter, minutes: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    def free(path: Path | int) -> int:
        return 100_000_000 - sum(p.stat().st_size for p in tmp_path.glob("*.mcap"))

    monkeypatch.setattr(disk, "free_bytes", free)
    with new() as writer:
        minutes(writer, 1)
    room = 4 * (tmp_path / "rec-000001.mcap").stat().st_size
    with new(retention=Retention(free_bytes=100_000_000 - room)) as writer:
        minutes(writer, 6)
    assert {one.reason for one in writer.deleted} == {"disk"}
    assert files(tmp_path)[0] > "rec-000003.mcap"
    assert sum(p.stat().st_size for p in tmp_path.glob("*.mcap")) < 2 * room


def test_no_segment_goes_that_an_outcome_names(tmp_path: Path, new: NewWriter, minutes: Callable[..., None]) -> None:
    with new() as writer:
        minutes(writer, 3)
    first, second, third, _ = load_manifest(tmp_path / "rec.segments.json").segments
    (tmp_path / "left-4711.outcome.json").write_text(json.dumps({"recording": first.file}))
    (tmp_path / "left-4711.certificate.json").write_text(json.dumps({"raw": {"sha256": second.raw_sha256}}))
    with new(retention=Retention(keep_s=1.0)) as writer:
        minutes(writer, 2, first=30)
    assert [one.segment.number for one in writer.deleted][:1] == [third.number]
    assert files(tmp_path)[:2] == [first.file, second.file]


def test_where_nothing_can_go_the_lack_of_room_is_said_once(
    tmp_path: Path, new: NewWriter, minutes: Callable[..., None]
) -> None:
    with new(retention=Retention(free_bytes=2**62), time_s=1e6) as writer:
        minutes(writer, 3)
    assert (writer.deleted, kinds(tmp_path / "rec-000001.mcap").count("disk_low")) == ([], 1)


# Its end


def test_a_segment_that_was_taken_away_meanwhile_is_a_fault_of_the_disk(
    tmp_path: Path, new: NewWriter, batch_of: BatchOf
) -> None:
    writer = new()
    writer.raw("calibration", batch_of(0, 10))
    writer.drain()
    (tmp_path / "archive").mkdir()
    (tmp_path / "rec-000001.mcap").rename(tmp_path / "archive" / "rec-000001.mcap")
    with pytest.raises(DiskError, match=r"rec-000001\.mcap: cannot be read: No such file") as e:
        writer.close()
    assert e.value.exit_code == 5


def test_a_manifest_that_was_lost_is_rebuilt_from_its_segments_alone(
    tmp_path: Path, new: NewWriter, minutes: Callable[..., None]
) -> None:
    with new() as writer:
        minutes(writer, 2)
    (tmp_path / "rec.segments.json").unlink()
    (tmp_path / "rec-0000xy.mcap").touch()
    (tmp_path / "other-000099.mcap").touch()
    with new() as writer:
        minutes(writer, 2)
    assert [s.number for s in load_manifest(tmp_path / "rec.segments.json").segments] == [1, 2, 3, 4, 5, 6]
    (tmp_path / "rec-20240517.mcap").touch()
    with new() as writer:
        minutes(writer, 1, first=20)
    assert load_manifest(tmp_path / "rec.segments.json").segments[-1].number == 8, "no file is in the way of that"


@pytest.mark.parametrize(
    ("error", "said"), [(None, "asked"), (KeyboardInterrupt(), "signal"), (DeviceSilent("a"), "unit gave up")]
)
def test_the_last_event_says_why_it_ended(
    tmp_path: Path, new: NewWriter, batch_of: BatchOf, error: BaseException | None, said: str
) -> None:
    def record() -> None:
        with new() as writer:
            writer.raw("calibration", batch_of(0, 10))
            if error is not None:
                raise error

    if error is None:
        record()
    else:
        with pytest.raises(type(error)):
            record()
    with Recording.open(tmp_path / "rec-000001.mcap") as recording:
        last = list(recording.events())[-1]
    assert (last.kind, last.detail) == ("ended", {"reason": said})


def test_a_recording_in_segments_ends_with_no_document(new: NewWriter) -> None:
    with new() as writer, pytest.raises(RecordingError, match="ends with no document"):
        writer.seal("outcome.json", "application/json", lambda contents: b"{}")


# Read by commands


@pytest.mark.parametrize(
    ("changed", "profile", "named"),
    [
        ({"unit": {"serial": "42", "signs": "1,1,1"}}, b"scale = 1", "signs of the unit"),
        ({"bus": {"channel": "can1"}}, b"scale = 1", "channel of the bus"),
        ({}, b"scale = 2", "profile.toml"),
        ({}, b"scale = 1 # as ever", None),
        ({"station": {"name": "another"}}, b"scale = 1", None),
    ],
)
def test_segments_that_mean_another_thing_are_not_read_as_one(
    tmp_path: Path, new: NewWriter, minutes: Callable[..., None], changed: dict[str, Any], profile: bytes,
    named: str | None,
) -> None:  # fmt: skip
    for metadata, text in ((METADATA, b"scale = 1"), (METADATA | changed, profile)):
        with new(metadata=metadata) as writer:
            writer.attach("profile.toml", "application/toml", text)
            writer.attach("station.toml", "application/toml", repr(metadata).encode())
            minutes(writer, 1)
    path = tmp_path / "rec.segments.json"
    assert len(describe(path)["segments"]) == 4, "what is in them is told all the same"
    with Series(path) as series:
        if named is None:
            assert sum(len(batch) for batch in series.raw("calibration")) == 20
            return
        with pytest.raises(RecordingError, match=rf"segment rec-000003\.mcap: {named}: not as in rec-000001\.mcap; "):
            list(series.raw("calibration"))


def test_a_manifest_is_not_mended(tmp_path: Path, new: NewWriter, minutes: Callable[..., None]) -> None:
    with new() as writer:
        minutes(writer, 1)
    with pytest.raises(RecordingError, match=r"rec\.segments\.json: is a manifest; mend each segment "):
        recover(tmp_path / "rec.segments.json", tmp_path / "out.mcap")


def test_info_tells_the_segments_and_what_is_in_them(
    tmp_path: Path, new: NewWriter, minutes: Callable[..., None], triaxcal: Callable[..., Any]
) -> None:
    with new() as writer:
        minutes(writer, 2)
    done = triaxcal("log", "info", tmp_path / "rec.segments.json", "--json")
    assert done.code == 0
    assert (done.json["finished"], done.json["ended"], done.json["deleted"]) == (True, {"reason": "asked"}, {})
    assert [s["file"] for s in done.json["segments"]] == files(tmp_path)
    assert done.json["raw"]["calibration"]["records"] == 20


@pytest.mark.slow
def test_poses_of_a_recording_in_segments_are_those_of_the_same_in_one_file(
    tmp_path: Path, triaxcal: Callable[..., Any]
) -> None:
    with Recording.open(GOLDEN) as whole:
        with SegmentedWriter(tmp_path / "rec.mcap", metadata=whole.metadata, size_bytes=50_000) as writer:
            for name in ("station.toml", "profile.toml", "profile/triax-ref-can.dbc"):
                writer.attach(name, "application/octet-stream", whole.attachments[name])
            for phase, batch in whole.raw_batches():
                assert writer.raw(phase, batch)
                writer.drain()
        names = files(tmp_path)
    assert len(names) > 3
    in_segments, in_one = (triaxcal("poses", p, "--json") for p in (tmp_path / "rec.segments.json", GOLDEN))
    assert (in_segments.code, in_segments.json["poses"]) == (0, in_one.json["poses"])


def spoilt(folder: Path, how: str) -> None:
    path = folder / "rec-000002.mcap"
    if how == "missing":
        path.unlink()
    elif how == "longer":
        path.write_bytes(path.read_bytes() + b"x")
    else:
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 1
        path.write_bytes(data)


@pytest.mark.parametrize(
    ("how", "said"),
    [("missing", "segment rec-000002.mcap: No such file or directory"),
     ("longer", "bytes, expected"), ("other", "segment rec-000002.mcap: was changed since it was recorded")],
)  # fmt: skip
def test_a_segment_that_is_missing_or_changed_is_one_line(
    tmp_path: Path, new: NewWriter, minutes: Callable[..., None], triaxcal: Callable[..., Any], how: str, said: str
) -> None:
    with new() as writer:
        minutes(writer, 3)
    spoilt(tmp_path, how)
    done = triaxcal("log", "info", tmp_path / "rec.segments.json")
    assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)
    assert said in done.err


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[]", "format null, expected 'triaxcal.segments/1'"),
        ("{", "not JSON, expected a triaxcal.segments/1 document"),
        ('{"format": "triaxcal.segments/1"}', "segments: expected a list"),
        ('{"format": "triaxcal.segments/1", "segments": []}', "no segment is left of this recording"),
        ('{"format": "triaxcal.segments/1", "segments": [{}]}', "segments[0]: file: expected a text"),
        ("[" * 100_000, "not JSON"),
    ],
)
def test_what_is_no_manifest_is_one_line(tmp_path: Path, triaxcal: Callable[..., Any], text: str, said: str) -> None:
    (tmp_path / "x.segments.json").write_text(text)
    done = triaxcal("poses", tmp_path / "x.segments.json")
    assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)
    assert said in done.err


def test_a_manifest_names_files_beside_it_alone(
    tmp_path: Path, new: NewWriter, minutes: Callable[..., None], triaxcal: Callable[..., Any]
) -> None:
    with new() as writer:
        minutes(writer, 1)
    text = (tmp_path / "rec.segments.json").read_text()
    (tmp_path / "rec.segments.json").write_text(text.replace("rec-000001", "../rec-000001"))
    done = triaxcal("poses", tmp_path / "rec.segments.json")
    assert done.code == 2
    assert "segments[0]: file: expected the name of an .mcap beside it" in done.err


def test_a_manifest_names_no_file_twice(
    tmp_path: Path, new: NewWriter, minutes: Callable[..., None], triaxcal: Callable[..., Any]
) -> None:
    with new() as writer:
        minutes(writer, 1)
    text = (tmp_path / "rec.segments.json").read_text()
    (tmp_path / "rec.segments.json").write_text(text.replace("rec-000002", "rec-000001"))
    done = triaxcal("poses", tmp_path / "rec.segments.json")
    assert done.code == 2
    assert "segments: a file is named twice" in done.err


def test_no_result_of_a_recording_in_segments_is_audited(
    tmp_path: Path, new: NewWriter, minutes: Callable[..., None]
) -> None:
    with new() as writer:
        minutes(writer, 1)
    with pytest.raises(RecordingError, match="a recording in segments, which holds no result to audit"):
        audit(tmp_path / "rec.segments.json")


def test_the_manifest_is_whole_at_any_moment(
    tmp_path: Path, new: NewWriter, minutes: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever reads it while it is replaced has the old one or the new one."""
    replace, seen = os.replace, []

    def watched(source: Any, target: Any) -> None:
        if str(target).endswith(".segments.json") and Path(target).exists():
            seen.append(len(load_manifest(Path(target)).segments))
        replace(source, target)

    monkeypatch.setattr(os, "replace", watched)
    with new() as writer:
        minutes(writer, 2)
    assert seen == [1, 1, 2, 2, 3]
