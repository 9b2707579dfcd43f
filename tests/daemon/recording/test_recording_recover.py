from __future__ import annotations

import io
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer as McapWriter
from mcap_protobuf.decoder import DecoderFactory

from triaxcal.errors import Refused
from triaxcal_drivers.interface import RawBatch
from triaxcald.errors import RecordingError
from triaxcald.recording.reader import Recording
from triaxcald.recording.recover import Recovery, recover
from triaxcald.recording.writer import RecordingWriter

BatchOf = Callable[..., RawBatch]


def mend(data: bytes, folder: Path) -> tuple[Recovery, Path]:
    source, out = folder / "damaged.mcap", folder / "mended.mcap"
    out.unlink(missing_ok=True)
    source.write_bytes(data)
    recovery = recover(source, out)
    assert source.read_bytes() == data
    return recovery, out


def raw_rows(path: Path) -> list[tuple[int, int, str]]:
    """(time, source, phase) of every raw record, as our reader and the stock one agree on."""
    rows = []
    with Recording.open(path) as rec:
        for phase, batch in rec.raw_batches():
            rows += [(t, s, phase) for t, s in zip(batch.time_ns.tolist(), batch.source.tolist(), strict=True)]
    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        stock = [m.decoded_message for m in reader.iter_decoded_messages(topics="/raw", log_time_order=False)]
    assert [(t, s, m.phase) for m in stock for t, s in zip(m.time_ns, m.source, strict=True)] == rows
    return rows


def chunk_spans(data: bytes) -> list[tuple[int, int]]:
    """(start, end) of each chunk record; the compression's name stands 37 bytes into one."""
    starts = [m.start() - 37 for m in re.finditer(rb"\x04\0\0\0zstd", data) if data[m.start() - 37] == 6]
    return [(at, at + 9 + int.from_bytes(data[at + 1 : at + 9], "little")) for at in starts]


def test_a_whole_recording_is_carried_over_without_loss(recording: Path, tmp_path: Path) -> None:
    recovery, out = mend(recording.read_bytes(), tmp_path)
    assert recovery == Recovery(raw_records=300, messages=16, attachments=2)
    assert recovery.lossless
    assert raw_rows(out) == raw_rows(recording)
    with Recording.open(recording) as old, Recording.open(out) as new:
        assert dict(new.attachments) == dict(old.attachments)
        assert list(new.events()) == list(old.events())
        assert list(new.register_accesses()) == list(old.register_accesses())
        assert {n: r for n, r in new.metadata.items() if n != "recovery"} == old.metadata
        assert new.metadata["recovery"]["of"] == "damaged.mcap"
        assert new.metadata["recovery"]["sha256_when_written"] == old.metadata["raw"]["sha256"]


@pytest.mark.slow
def test_a_file_cut_anywhere_is_mended_and_holds_only_what_was_written(recording: Path, tmp_path: Path) -> None:
    whole = recording.read_bytes()
    rows = raw_rows(recording)
    ends = [end for _, end in chunk_spans(whole)]
    attached = whole.index(b"name = 'bench'\n") + len(b"name = 'bench'\n") + 4  # with its CRC
    for length in range(attached, len(whole), 17):
        recovery, out = mend(whole[:length], tmp_path)
        kept = raw_rows(out)
        assert kept == rows[: len(kept)]
        chunks_there = sum(end <= length for end in ends)
        assert len(kept) >= 50 * min(max(chunks_there - 1, 0), 6)
        assert recovery.raw_records == len(kept)
        assert recovery.raw_missing == recovery.chunks_failed == 0


@pytest.mark.parametrize("length", [0, 1, 8, 9, 40])
def test_of_a_file_cut_before_its_first_whole_record_nothing_is_mended(
    recording: Path, tmp_path: Path, length: int
) -> None:
    with pytest.raises(
        Refused, match=r"damaged\.mcap: nothing to recover, as there is no whole message or attachment in it$"
    ):
        mend(recording.read_bytes()[:length], tmp_path)
    assert not (tmp_path / "mended.mcap").exists()


def test_a_damaged_chunk_is_given_up_and_its_records_counted(recording: Path, tmp_path: Path) -> None:
    whole = bytearray(recording.read_bytes())
    rows = raw_rows(recording)
    start, end = chunk_spans(bytes(whole))[3]
    whole[start + 80] ^= 0x01
    recovery, out = mend(bytes(whole), tmp_path)
    assert recovery.chunks_failed == 1
    assert recovery.raw_missing == 50
    assert recovery.bytes_dropped == end - start
    assert not recovery.lossless
    assert raw_rows(out) == rows[:100] + rows[150:]
    with Recording.open(out) as rec:
        assert rec.metadata["recovery"]["raw_missing"] == "50"


def test_a_damaged_last_chunk_of_raw_records_is_counted_too(recording: Path, tmp_path: Path) -> None:
    whole = bytearray(recording.read_bytes())
    whole[chunk_spans(bytes(whole))[6][0] + 80] ^= 0x01
    recovery, _ = mend(bytes(whole), tmp_path)
    assert (recovery.raw_records, recovery.raw_missing) == (250, 50)


def test_records_behind_a_wrong_length_are_found_again(recording: Path, tmp_path: Path) -> None:
    whole = recording.read_bytes()
    rows = raw_rows(recording)
    start, _ = chunk_spans(whole)[2]
    for length in (0, 5, 2**20, 2**40):
        wrong = whole[: start + 1] + length.to_bytes(8, "little") + whole[start + 9 :]
        recovery, out = mend(wrong, tmp_path)
        assert raw_rows(out) == rows  # the chunk's own length and CRC still vouch for it
        assert recovery.raw_missing == 0
    overwritten = whole[: start - 20] + bytes(200) + whole[start + 180 :]
    recovery, out = mend(overwritten, tmp_path)
    assert raw_rows(out) == rows[:50] + rows[100:]
    assert recovery.raw_missing == 50


def test_a_record_of_the_wrong_type_or_length_swallows_no_other(recording: Path, tmp_path: Path) -> None:
    whole = recording.read_bytes()
    rows = raw_rows(recording)
    spans = chunk_spans(whole)
    start, index = spans[3]  # a chunk, and the index of its messages
    for opcode in set(range(16)) - {6}:
        wrong = whole[:start] + bytes([opcode]) + whole[start + 1 :]
        recovery, out = mend(wrong, tmp_path)
        assert raw_rows(out) == rows[:100] + rows[150:]
        assert recovery.raw_missing == 50
    swallowing = (spans[5][0] - index - 9).to_bytes(8, "little")
    recovery, out = mend(whole[: index + 1] + swallowing + whole[index + 9 :], tmp_path)
    assert raw_rows(out) == rows


def test_without_its_first_chunk_raw_records_registers_and_events_are_still_known(
    recording: Path, tmp_path: Path
) -> None:
    whole = recording.read_bytes()
    spans = chunk_spans(whole)
    unfinished = bytearray(whole[: spans[-1][1]])
    unfinished[spans[0][0] + 80] ^= 0xFF
    recovery, out = mend(bytes(unfinished), tmp_path)
    assert raw_rows(out) == raw_rows(recording)
    assert recovery.undeclared_messages == 6  # previews, whose fields differ from recording to recording
    with Recording.open(out) as rec:
        assert [e.kind for e in rec.events()] == ["pose_done"]
        assert [r.register for r in rec.register_accesses()] == ["scale_factor_x", "store"]
    finished = bytearray(whole)
    finished[spans[0][0] + 80] ^= 0xFF
    assert mend(bytes(finished), tmp_path)[0].undeclared_messages == 0  # the summary declares them too


@pytest.mark.slow
def test_a_flipped_bit_anywhere_never_makes_a_record(recording: Path, tmp_path: Path) -> None:
    whole = recording.read_bytes()
    rows = raw_rows(recording)
    for at in range(8, len(whole), 29):
        flipped = bytearray(whole)
        flipped[at] ^= 1 << at % 8
        recovery, out = mend(bytes(flipped), tmp_path)
        kept = raw_rows(out)
        assert set(kept) <= set(rows)
        assert len(kept) + recovery.raw_missing == 300


def test_a_wrong_byte_in_the_metadata_is_at_least_noticed(recording: Path, tmp_path: Path) -> None:
    recovery, _ = mend(recording.read_bytes().replace(b"bench", b"bunch", 1), tmp_path)
    assert recovery.unlocated_damage
    assert recovery.raw_records == 300


def test_a_damaged_attachment_is_given_up_and_counted(recording: Path, tmp_path: Path) -> None:
    recovery, out = mend(recording.read_bytes().replace(b"name = 'bench'", b"name = 'lunch'", 1), tmp_path)
    assert recovery.attachments_failed == 1
    with Recording.open(out) as rec:
        assert list(rec.attachments) == ["result.json"]


def test_zeros_after_a_power_cut_are_dropped(recording: Path, tmp_path: Path) -> None:
    whole = recording.read_bytes()
    cut = chunk_spans(whole)[4][1]
    recovery, out = mend(whole[:cut] + bytes(4096), tmp_path)
    assert recovery.cut_short
    assert recovery.bytes_dropped == 4096
    assert raw_rows(out) == raw_rows(recording)[:200]


def test_whole_blocks_of_a_chunk_that_was_cut_off_are_kept_and_marked_unverified(
    tmp_path: Path, new_writer: Callable[..., RecordingWriter], batch_of: BatchOf
) -> None:
    with new_writer() as writer:
        writer.drain()
        for i in range(20):
            writer.raw("calibration", batch_of(1000 * i, 1000))
    whole = (tmp_path / "rec.mcap").read_bytes()
    start, end = chunk_spans(whole)[1]
    recovery, out = mend(whole[: start + (end - start) * 3 // 4], tmp_path)
    rows = raw_rows(out)
    assert 0 < len(rows) < 20_000
    assert rows == raw_rows(tmp_path / "rec.mcap")[: len(rows)]
    assert recovery.unverified_messages == len(rows) // 1000
    assert recovery.cut_short


def test_dropped_records_are_not_mistaken_for_missing_ones(
    tmp_path: Path, new_writer: Callable[..., RecordingWriter], batch_of: BatchOf
) -> None:
    with new_writer(queue_batches=0) as writer:
        assert not writer.raw("calibration", batch_of(0, 70))
    recovery, _ = mend((tmp_path / "rec.mcap").read_bytes(), tmp_path)
    assert (recovery.raw_records, recovery.raw_dropped, recovery.raw_missing) == (0, 70, 0)


def test_a_mended_file_can_be_mended_again(recording: Path, tmp_path: Path) -> None:
    whole = recording.read_bytes()
    _, out = mend(whole[: chunk_spans(whole)[3][1]], tmp_path)
    rows = raw_rows(out)
    recovery, again = mend(out.read_bytes(), tmp_path)
    assert recovery.lossless
    assert raw_rows(again) == rows


def test_the_output_must_not_exist(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    out.write_bytes(b"precious")
    with pytest.raises(RecordingError, match=r"out\.mcap: exists already"):
        recover(recording, out)
    assert out.read_bytes() == b"precious"
    with pytest.raises(RecordingError, match=r"rec\.mcap: exists already"):
        recover(recording, recording)


def test_what_is_no_recording_of_ours_is_refused_and_nothing_written(tmp_path: Path) -> None:
    foreign = io.BytesIO()
    mcap = McapWriter(foreign)
    mcap.start(profile="")
    mcap.finish()  # type: ignore[no-untyped-call]
    for data, expected in (
        (b"t_s,ux,uy,uz\n", "not an MCAP file"),
        (foreign.getvalue(), "not a recording of triaxcal"),
    ):
        with pytest.raises(RecordingError, match=expected):
            mend(data, tmp_path)
        assert not (tmp_path / "mended.mcap").exists()


_WRITES_UNTIL_KILLED = """
import sys
from pathlib import Path
import numpy as np
from triaxcal_drivers.interface import RawBatch
from triaxcald.recording.reader import Recording
from triaxcald.recording.writer import RecordingWriter

T0_NS = 1_700_000_000_000_000_000
path, now_ns, offered = Path(sys.argv[1]), T0_NS, 0
writer = RecordingWriter(path, metadata={}, clock_ns=lambda: now_ns, queue_batches=10**6)

def give_a_batch():
    global now_ns, offered
    index = np.arange(offered, offered + 10)
    zeros = np.zeros(10, dtype=np.uint8)
    writer.raw("calibration", RawBatch(
        T0_NS + index, index.astype(np.uint32), zeros, zeros.astype(np.uint16) + 2, bytes(20)))
    offered += 10
    now_ns += 10_000_000

for _ in range(300):
    give_a_batch()
safe, held = offered, 0
while held < safe:
    now_ns += 1_000_000_000
    writer.event("another second")
    with Recording.open(path, unfinished=True) as recording:
        held = sum(len(batch) for batch in recording.raw("calibration"))
print(safe, flush=True)
while True:
    give_a_batch()
    print(offered, flush=True)
"""


def test_a_killed_recorder_loses_at_most_its_last_second(tmp_path: Path) -> None:
    path, out = tmp_path / "rec.mcap", tmp_path / "mended.mcap"
    command = [sys.executable, "-c", _WRITES_UNTIL_KILLED, str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        try:
            safe = int(child.stdout.readline())
            lines = [child.stdout.readline() for _ in range(40)]  # in the midst of its work
        finally:
            child.kill()
        offered = int((lines + child.stdout.readlines())[-1])
    assert child.returncode == -signal.SIGKILL
    with pytest.raises(RecordingError, match="triaxcal log recover"):
        Recording.open(path)
    recovery = recover(path, out)
    assert recovery.cut_short
    assert recovery.raw_missing == 0
    assert safe <= recovery.raw_records <= offered + 10
    sources = [source for _, source, _ in raw_rows(out)]
    assert sources == list(range(recovery.raw_records))
