from __future__ import annotations

import asyncio
import errno
import io
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import NonSeekingReader, make_reader
from mcap_protobuf.decoder import DecoderFactory

from triaxcal_drivers.interface import RawBatch, SampleBlock
from triaxcald.errors import DiskError, RecordingError
from triaxcald.recording import disk, schema
from triaxcald.recording import writer as writer_module
from triaxcald.recording.reader import Recording
from triaxcald.recording.writer import RecordingWriter

NewWriter = Callable[..., RecordingWriter]
BatchOf = Callable[..., RawBatch]
BlockOf = Callable[..., SampleBlock]


class Disk(io.FileIO):
    """A file whose writing can be held up, made to fail, and refuses more than ``limit`` bytes at once."""

    def __init__(self, path: Path, limit: int | None = None) -> None:
        super().__init__(path, "xb")
        self.ready = threading.Event()
        self.ready.set()
        self.error: OSError | None = None
        self.limit = limit

    def write(self, data: Any) -> int:
        self.ready.wait()
        if self.error is not None:
            raise self.error
        assert self.limit is None or len(data) <= self.limit, f"{len(data)} bytes at once"
        return super().write(data)


@pytest.fixture
def disks(monkeypatch: pytest.MonkeyPatch) -> list[Disk]:
    """Those on which recordings are written from here on."""
    made: list[Disk] = []

    def create(path: Path) -> io.BufferedWriter:
        made.append(Disk(path))
        return io.BufferedWriter(made[-1])

    monkeypatch.setattr(writer_module, "_create", create)
    return made


def test_the_stock_reader_reads_everything(recording: Path, metadata: dict[str, dict[str, str]]) -> None:
    with open(recording, "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "triaxcal"
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.chunk_count == len(summary.chunk_indexes) == 8
        decoded: dict[str, list[Any]] = {}
        for _, channel, _, message in reader.iter_decoded_messages(log_time_order=False):
            decoded.setdefault(channel.topic, []).append(message)
        found = {record.name: record.metadata for record in reader.iter_metadata()}
        attached = {record.name: record.data for record in reader.iter_attachments()}
    assert [message.first for message in decoded["/raw"]] == [0, 50, 100, 150, 200, 250]
    assert decoded["/raw"][5].phase == "verification"
    assert len(decoded["/raw"][5].payload) == 400
    assert [e.kind for e in decoded["/events"]] == ["recording_started", "pose_done"]
    assert [(r.register, r.operation, r.error) for r in decoded["/registers"]] == [
        ("scale_factor_x", "read", ""),
        ("store", "write", "refused"),
    ]
    assert found.items() >= {**metadata, "recording": {"format": "triaxcal.recording/1"}}.items()
    assert found["raw"]["records"] == "300"
    assert attached == {"station.toml": b"name = 'bench'\n", "result.json": b"{}"}


def test_the_crc_of_the_whole_holds_for_a_reader_that_streams(recording: Path) -> None:
    with open(recording, "rb") as file:
        messages = list(NonSeekingReader(file, validate_crcs=True).iter_messages(log_time_order=False))
    assert len(messages) == 16


def test_the_preview_is_thinned_and_bears_the_samples_time(
    tmp_path: Path, new_writer: NewWriter, block_of: BlockOf
) -> None:
    block = block_of(100)  # 100 a second
    with new_writer(preview_hz=20.0) as writer:
        writer.preview("/preview/readings", block)
    with open(tmp_path / "rec.mcap", "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        found = list(reader.iter_decoded_messages(topics="/preview/readings"))
    assert [m.message.log_time for m in found] == block.time_ns[::5].tolist()
    last = found[-1].decoded_message
    assert (last.x, last.y, last.z, last.temp_c, last.supply_v) == (95.0, 190.0, 285.0, 9.5, 47.5)
    assert found[0].channel.metadata == {"unit": "V"}


def test_an_existing_file_is_never_overwritten(tmp_path: Path, new_writer: NewWriter) -> None:
    (tmp_path / "rec.mcap").write_bytes(b"precious")
    with pytest.raises(RecordingError, match=r"rec\.mcap: exists already"):
        new_writer()
    assert (tmp_path / "rec.mcap").read_bytes() == b"precious"


def test_a_record_is_with_the_operating_system_after_one_second(
    tmp_path: Path,
    new_writer: NewWriter,
    clock: Any,
    batch_of: BatchOf,
    wait_until: Callable[[Callable[[], bool]], None],
) -> None:
    def in_the_file() -> int:
        with Recording.open(tmp_path / "rec.mcap", unfinished=True) as rec:
            return sum(len(b) for b in rec.raw("calibration"))

    writer = new_writer()
    writer.drain()
    expected = schema.RawDigest()
    expected.update("calibration", batch_of(0, 10))
    writer.raw("calibration", batch_of(0, 10))
    wait_until(lambda: writer.raw_sha256 == expected.hexdigest())
    assert in_the_file() == 0
    clock.now_ns += 1_000_000_000
    writer.event("tick")
    wait_until(lambda: in_the_file() == 10)


def test_the_disk_has_it_every_so_many_seconds_and_the_name_of_the_file_at_once(
    tmp_path: Path, new_writer: NewWriter, clock: Any, batch_of: BatchOf, monkeypatch: pytest.MonkeyPatch
) -> None:
    forced: list[str] = []
    real = os.fsync

    def fsync(descriptor: int) -> None:
        forced.append(os.path.basename(os.readlink(f"/proc/self/fd/{descriptor}")))
        real(descriptor)

    monkeypatch.setattr(os, "fsync", fsync)
    with new_writer(sync_s=10.0) as writer:
        assert forced == [tmp_path.name]
        for i in range(25):
            clock.now_ns += 1_000_000_000
            writer.raw("calibration", batch_of(10 * i, 10))
            writer.drain()
        assert forced == [tmp_path.name, "rec.mcap", "rec.mcap"]
    assert forced[3:] == ["rec.mcap", tmp_path.name]


def test_a_caller_that_waits_loses_nothing_however_slow_the_disk(
    tmp_path: Path, new_writer: NewWriter, disks: list[Disk], batch_of: BatchOf, wait_until: Callable[..., None]
) -> None:
    writer = new_writer(queue_batches=3, waits=True)
    writer.drain()
    disks[0].ready.clear()
    writer.attach("block", "text/plain", b"")
    given: list[int] = []

    def give() -> None:
        for i in range(20):
            writer.raw("calibration", batch_of(10 * i, 10))
            given.append(i)

    caller = threading.Thread(target=give)
    caller.start()
    wait_until(lambda: len(given) == 3)
    disks[0].ready.set()
    caller.join()
    writer.close()
    with Recording.open(tmp_path / "rec.mcap") as rec:
        assert rec.raw_digest().records == 200
        assert (list(rec.losses()), writer.losses) == ([], {})


def test_a_batch_that_finds_the_queue_full_is_dropped_and_counted(
    tmp_path: Path, new_writer: NewWriter, disks: list[Disk], batch_of: BatchOf
) -> None:
    writer = new_writer(queue_batches=3)
    writer.drain()
    disks[0].ready.clear()
    writer.attach("block", "text/plain", b"")  # its flush holds up the writer's thread
    accepted = [writer.raw("calibration", batch_of(10 * i, 10)) for i in range(20)]
    assert accepted == [True] * 3 + [False] * 17
    assert writer.losses == {"/raw": 170}
    disks[0].ready.set()
    writer.drain()
    assert writer.raw("calibration", batch_of(200, 10))
    writer.close()
    with Recording.open(tmp_path / "rec.mcap") as rec:
        assert [(x.where, x.first, x.records) for x in rec.losses()] == [("/raw", 30, 170)]
        times = [int(t) for b in rec.raw("calibration") for t in b.time_ns]
        assert times == batch_of(0, 30).time_ns.tolist() + batch_of(200, 10).time_ns.tolist()
        assert rec.raw_digest().hexdigest() == writer.raw_sha256 == rec.metadata["raw"]["sha256"]


def test_losses_at_two_places_are_two_records(
    tmp_path: Path, new_writer: NewWriter, disks: list[Disk], batch_of: BatchOf
) -> None:
    writer = new_writer(queue_batches=1)
    first = 0
    for _ in range(2):
        writer.drain()
        disks[0].ready.clear()
        writer.attach(f"block {first}", "text/plain", b"")
        for _ in range(3):
            writer.raw("calibration", batch_of(first, 10))
            first += 10
        disks[0].ready.set()
    writer.close()
    with Recording.open(tmp_path / "rec.mcap") as rec:
        assert [(x.first, x.records) for x in rec.losses()] == [(10, 20), (40, 20)]


def test_a_disk_is_behind_while_raw_records_are_lost_and_for_a_while_after(
    new_writer: NewWriter, disks: list[Disk], batch_of: BatchOf, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = 100.0
    monkeypatch.setattr(writer_module.time, "monotonic", lambda: now_s)
    with new_writer(queue_batches=1) as writer:
        writer.drain()
        disks[0].ready.clear()
        writer.attach("block", "text/plain", b"")
        assert writer.raw("calibration", batch_of(0, 10))
        assert not writer.is_behind
        assert not writer.raw("calibration", batch_of(10, 10))
        now_s += writer_module.BEHIND_S
        assert writer.is_behind, "the disk hangs, and nothing comes that could be lost"
        assert not writer.raw("calibration", batch_of(20, 10))
        disks[0].ready.set()
        writer.drain()
        assert writer.is_behind, "the loss is noted in the file, and the next may come"
        now_s += writer_module.BEHIND_S
        assert not writer.is_behind


def test_no_recording_begins_where_there_is_no_room_for_its_end(
    tmp_path: Path, new_writer: NewWriter, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(disk, "free_bytes", lambda _: disk.END_BYTES - 1)
    with pytest.raises(
        DiskError, match=r"rec\.mcap: cannot be created: 4194303 bytes are free on the disk, 4194304 are needed$"
    ):
        new_writer()
    assert list(tmp_path.glob("*.mcap")) == []


def test_registers_events_and_attachments_are_never_dropped(
    tmp_path: Path, new_writer: NewWriter, disks: list[Disk], batch_of: BatchOf
) -> None:
    writer = new_writer(queue_batches=1)
    writer.drain()
    disks[0].ready.clear()
    writer.attach("block", "text/plain", b"")
    for i in range(50):
        writer.raw("calibration", batch_of(10 * i, 10))
        writer.event("pose", {"n": i})
        writer.register("bias_x", "read", bytes([i]))
    disks[0].ready.set()
    writer.close()
    with Recording.open(tmp_path / "rec.mcap") as rec:
        assert [e.detail["n"] for e in rec.events() if e.kind == "pose"] == list(range(50))
        assert [r.raw for r in rec.register_accesses()] == [bytes([i]) for i in range(50)]


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO])
def test_a_disk_that_fails_reaches_the_caller_in_one_line(
    tmp_path: Path, new_writer: NewWriter, disks: list[Disk], batch_of: BatchOf, code: int
) -> None:
    writer = new_writer()
    writer.drain()
    disks[0].error = OSError(code, "no more of this")
    writer.raw("calibration", batch_of(0, 10))
    message = f"{tmp_path / 'rec.mcap'}: writing failed: no more of this; sound up to 2023-11-14T22:13:20Z"
    with pytest.raises(RecordingError) as drained:
        writer.drain()
    with pytest.raises(RecordingError) as next_one:
        writer.raw("calibration", batch_of(10, 10))
    with pytest.raises(RecordingError) as closed:
        writer.close()
    assert [str(e.value) for e in (drained, next_one, closed)] == [message] * 3
    assert disks[0].closed


@pytest.mark.parametrize("graver", [ValueError("NOT restored"), KeyboardInterrupt(), asyncio.CancelledError()])
def test_a_disk_that_fails_on_closing_does_not_hide_what_is_graver(
    tmp_path: Path, new_writer: NewWriter, disks: list[Disk], graver: BaseException
) -> None:
    def leave() -> None:
        with new_writer() as writer:
            writer.drain()
            disks[0].error = OSError(errno.ENOSPC, "No space left on device")
            raise graver

    with pytest.raises(type(graver)) as raised:
        leave()
    assert raised.value is graver
    [note] = graver.__notes__
    assert note.startswith(f"{tmp_path / 'rec.mcap'}: writing failed: No space left on device; sound up to ")


def test_a_disk_that_fails_on_closing_is_told_where_all_else_went_well(
    new_writer: NewWriter, disks: list[Disk]
) -> None:
    def leave() -> None:
        with new_writer() as writer:
            writer.drain()
            disks[0].error = OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(RecordingError, match=r"rec\.mcap: writing failed: No space left on device"):
        leave()


def test_no_write_is_larger_than_a_chunk_however_much_is_given(
    tmp_path: Path, new_writer: NewWriter, disks: list[Disk], batch_of: BatchOf
) -> None:
    big = batch_of(0, 3 * schema.MAX_RECORDS)
    with new_writer() as writer:
        writer.drain()
        disks[0].limit = 2 * 2**20
        for _ in range(10):
            writer.raw("calibration", big)
    with Recording.open(tmp_path / "rec.mcap") as rec:
        assert [len(b) for _, b in rec.raw_batches()] == [schema.MAX_RECORDS] * 30


def test_the_same_input_by_the_same_clock_is_the_same_file(write_recording: Callable[[str], Path]) -> None:
    assert write_recording("a.mcap").read_bytes() == write_recording("b.mcap").read_bytes()


def test_a_closed_recording_takes_no_more(new_writer: NewWriter) -> None:
    writer = new_writer()
    writer.close()
    writer.close()
    with pytest.raises(RecordingError, match="closed"):
        writer.event("late")


def test_an_attachment_cannot_come_twice(new_writer: NewWriter) -> None:
    with new_writer() as writer:
        writer.attach("station.toml", "text/plain", b"a")
        with pytest.raises(RecordingError, match=r"'station\.toml' already"):
            writer.attach("station.toml", "text/plain", b"b")
