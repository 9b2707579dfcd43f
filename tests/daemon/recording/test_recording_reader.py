from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer as McapWriter

from triaxcal_drivers.interface import RawBatch
from triaxcald.errors import RecordingError
from triaxcald.recording import reader, schema
from triaxcald.recording.mcap_records import MAGIC, UnparsedRecord
from triaxcald.recording.reader import Recording
from triaxcald.recording.schema import Fields
from triaxcald.recording.writer import RecordingWriter


def test_what_was_written_is_read(
    recording: Path, batch_of: Callable[..., RawBatch], metadata: dict[str, dict[str, str]]
) -> None:
    with Recording.open(recording) as rec:
        assert rec.finished
        assert rec.phases() == ["calibration", "verification"]
        for phase, first, n in (("calibration", 0, 200), ("verification", 200, 100)):
            batches = list(rec.raw(phase))  # type: ignore[arg-type]
            expected = batch_of(first, n)
            assert b"".join(b.payload for b in batches) == expected.payload
            for column in ("time_ns", "source", "flags", "length"):
                got = np.concatenate([getattr(b, column) for b in batches])
                np.testing.assert_array_equal(got, getattr(expected, column))
        assert [r.register for r in rec.register_accesses()] == ["scale_factor_x", "store"]
        assert next(rec.register_accesses()).raw == bytes.fromhex("c019999a")
        assert [e.kind for e in rec.events()] == ["recording_started", "pose_done"]
        assert list(rec.losses()) == []
        assert rec.metadata.items() >= metadata.items()
        assert dict(rec.attachments) == {"station.toml": b"name = 'bench'\n", "result.json": b"{}"}
        assert rec.attachments.media_types["result.json"] == "application/json"


def test_iterators_do_not_disturb_each_other(recording: Path) -> None:
    with Recording.open(recording) as rec:
        pairs = list(zip(rec.raw_batches(), rec.raw_batches(), strict=True))
        assert len(pairs) > 4
        for (_, a), (_, b) in pairs:
            np.testing.assert_array_equal(a.time_ns, b.time_ns)


def test_messages_of_one_topic_are_those_among_all_and_chunks_known_to_have_none_are_not_unpacked_again(
    recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    unpacked: list[int] = []
    unpack = reader.chunk_data

    def counted(unparsed: UnparsedRecord, name: str) -> bytes:
        unpacked.append(unparsed.offset)
        return unpack(unparsed, name)

    monkeypatch.setattr(reader, "chunk_data", counted)
    with Recording.open(recording) as rec:
        before = list(rec.messages(schema.EVENTS))
        every = list(rec.messages())
        assert unpacked == 2 * unpacked[: len(unpacked) // 2]
        unpacked.clear()
        assert list(rec.losses()) == []
        assert unpacked == []
        assert list(rec.messages(schema.EVENTS)) == before == [m for m in every if m.topic == schema.EVENTS]
        assert 0 < len(unpacked) <= rec.chunks


def test_records_of_a_phase_come_many_at_a_time_however_few_a_message_has(
    recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Recording.open(recording) as rec:
        single = [batch for phase, batch in rec.raw_batches() if phase == "calibration"]
        together = dict(rec.joined_batches())
        (joined,) = rec.raw("calibration")
        monkeypatch.setattr("triaxcald.recording.reader.JOINED", len(single[0]) + 1)
        parts = list(rec.raw("calibration"))
    assert len(single) == 4
    assert list(together) == ["calibration", "verification"]
    assert together["calibration"].payload == joined.payload
    assert [len(p) for p in parts] == [len(single[0]) + len(single[1]), len(single[2]) + len(single[3])]
    for column in ("time_ns", "source", "flags", "length"):
        whole = np.concatenate([getattr(b, column) for b in single])
        np.testing.assert_array_equal(getattr(joined, column), whole)
        np.testing.assert_array_equal(np.concatenate([getattr(p, column) for p in parts]), whole)
    assert joined.payload == b"".join(b.payload for b in single) == b"".join(p.payload for p in parts)


def test_of_messages_that_are_read_together_the_one_at_fault_is_named(
    recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Recording.open(recording) as rec:
        _, second, *_ = (message for topic, message in rec.messages() if topic == schema.RAW)
    read = reader.fields_of

    def spoilt(data: bytes) -> Fields:
        return read(data)._replace(payload=b"") if data == second.data else read(data)

    monkeypatch.setattr(reader, "fields_of", spoilt)
    with Recording.open(recording) as rec, pytest.raises(RecordingError, match=f"/raw at {second.log_time} ns: "):
        list(rec.raw("calibration"))


def test_messages_without_records_are_not_held_to_the_end_of_the_file(
    recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    held: list[int] = []

    def of_nothing(messages: Sequence[Fields]) -> RawBatch:
        held.append(len(messages))
        return RawBatch.of([])

    monkeypatch.setattr(reader, "fields_of", lambda _: Fields(phase=b"calibration", payload=bytes(500)))
    monkeypatch.setattr(reader, "batch_of", of_nothing)
    with Recording.open(recording) as rec:
        shortest = min(len(message.data) for topic, message in rec.messages() if topic == schema.RAW)
        monkeypatch.setattr(reader, "JOINED_BYTES", 2 * shortest)
        list(rec.raw("calibration"))
    assert max(held) <= 2


class Frugal(io.BytesIO):
    """Refuses to hand out more than ``limit`` bytes at once."""

    limit = 0

    def read(self, size: int | None = -1, /) -> bytes:
        assert size is not None
        assert 0 <= size <= self.limit, f"{size} bytes at once"
        return super().read(size)


def test_reading_never_takes_more_than_a_chunk_at_once(
    tmp_path: Path, new_writer: Callable[..., RecordingWriter], batch_of: Callable[..., RawBatch]
) -> None:
    big = batch_of(0, schema.MAX_RECORDS)
    with new_writer() as writer:
        for _ in range(40):
            writer.raw("calibration", big)
    stream = Frugal((tmp_path / "rec.mcap").read_bytes())
    stream.limit = len(stream.getvalue()) // 5
    rec = Recording(stream, "frugal")
    assert sum(len(b) for b in rec.raw("calibration")) == 40 * schema.MAX_RECORDS


@pytest.mark.slow
def test_every_flipped_bit_is_reported(recording: Path) -> None:
    whole = recording.read_bytes()
    for at in range(len(whole)):
        flipped = bytearray(whole)
        flipped[at] ^= 1 << at % 8
        with pytest.raises(RecordingError) as e:
            Recording(io.BytesIO(flipped), "rec.mcap")
        assert str(e.value).startswith("rec.mcap: ")
        assert "\n" not in str(e.value)


def test_a_damaged_chunk_is_named_with_its_offset_and_the_remedy(recording: Path) -> None:
    whole = bytearray(recording.read_bytes())
    chunks = list(_chunk_offsets(bytes(whole)))
    whole[chunks[3] + 80] ^= 0x10
    recording.write_bytes(whole)
    expected = rf"chunk 4 of 8: a chunk fails its CRC at byte {chunks[3]}; mend it with `triaxcal log recover`$"
    with pytest.raises(RecordingError, match=expected):
        Recording.open(recording)


def _chunk_offsets(data: bytes) -> list[int]:
    """Found by the compression's name, which stands 37 bytes into a chunk record."""
    offsets, at = [], data.find(b"\x04\0\0\0zstd")
    while at >= 0:
        if data[at - 37] == 6:
            offsets.append(at - 37)
        at = data.find(b"\x04\0\0\0zstd", at + 1)
    return offsets


@pytest.mark.slow
def test_a_recording_cut_short_is_an_error_at_every_length(recording: Path) -> None:
    whole = recording.read_bytes()
    with pytest.raises(RecordingError, match=r"^rec: the file is empty; nothing was recorded$"):
        Recording(io.BytesIO(b""), "rec")
    for length in range(1, len(whole)):
        with pytest.raises(RecordingError, match=r"^rec: .* at byte \d+; mend it with `triaxcal log recover`$"):
            Recording(io.BytesIO(whole[:length]), "rec")


def test_an_unfinished_recording_can_be_read_up_to_where_it_is(
    tmp_path: Path, new_writer: Callable[..., RecordingWriter], batch_of: Callable[..., RawBatch]
) -> None:
    writer = new_writer()
    writer.raw("calibration", batch_of(0, 30))
    writer.drain()
    with Recording.open(tmp_path / "rec.mcap", unfinished=True) as rec:
        assert not rec.finished
        assert [len(b) for b in rec.raw("calibration")] == [30]
    with pytest.raises(RecordingError, match="the file ends, not finished"):
        Recording.open(tmp_path / "rec.mcap")


def test_what_a_power_failure_left_as_zeros_is_the_end_of_an_unfinished_recording(
    tmp_path: Path, new_writer: Callable[..., RecordingWriter], batch_of: Callable[..., RawBatch]
) -> None:
    """From any byte on: a file may be longer than what of it reached the disk."""
    writer = new_writer()
    for i in range(3):
        writer.raw("calibration", batch_of(10 * i, 10))
        writer.drain()
    whole = (tmp_path / "rec.mcap").read_bytes()
    first = next(iter(_chunk_offsets(whole)))
    kept = set()
    for length in range(first, len(whole) + 1):
        cut = whole[:length] + bytes(len(whole) - length + 4096)
        with Recording(io.BytesIO(cut), "rec", unfinished=True) as rec:
            assert not rec.finished
            kept.add(sum(len(batch) for batch in rec.raw("calibration")))
        with pytest.raises(RecordingError):
            Recording(io.BytesIO(cut), "rec")
    assert kept == {0, 10, 20, 30}


def test_damage_before_the_zeros_of_a_power_failure_is_damage(
    tmp_path: Path, new_writer: Callable[..., RecordingWriter]
) -> None:
    new_writer().drain()
    whole = bytearray((tmp_path / "rec.mcap").read_bytes())
    whole[len(MAGIC)] = 0xFF  # the first record's type
    with pytest.raises(RecordingError, match="unknown record type 0xff at byte 8"):
        Recording(io.BytesIO(bytes(whole) + bytes(4096)), "rec", unfinished=True)


def test_what_is_not_mcap_is_called_that(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(b"t_s,ux,uy,uz\n0,1,2,3\n")
    with pytest.raises(RecordingError, match=r"x\.mcap: not an MCAP file but text"):
        Recording.open(path)


def test_another_programs_mcap_is_called_that(tmp_path: Path) -> None:
    path = tmp_path / "ros.mcap"
    with open(path, "wb") as file:
        mcap = McapWriter(file)
        mcap.start(profile="ros2")
        mcap.finish()  # type: ignore[no-untyped-call]
    with pytest.raises(RecordingError, match="not a recording of triaxcal: its header says profile 'ros2'"):
        Recording.open(path)


def test_a_later_format_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "later.mcap"
    with open(path, "wb") as file:
        mcap = McapWriter(file)
        mcap.start(profile="triaxcal")
        mcap.add_metadata("recording", {"format": "triaxcal.recording/2"})
        mcap.finish()  # type: ignore[no-untyped-call]
    with pytest.raises(RecordingError, match=r"format 'triaxcal.recording/2', expected 'triaxcal.recording/1'"):
        Recording.open(path)


def test_a_file_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"none\.mcap: cannot be read: No such file or directory$"):
        Recording.open(tmp_path / "none.mcap")
