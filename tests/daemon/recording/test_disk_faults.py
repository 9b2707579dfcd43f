"""Real disks that fail: full, filled by somebody else, taken away, limited."""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from triaxcal_drivers.interface import RawBatch
from triaxcald.errors import DISK, DiskError
from triaxcald.recording import disk
from triaxcald.recording import writer as writer_module
from triaxcald.recording.manifest import Retention
from triaxcald.recording.reader import Recording
from triaxcald.recording.recover import recover
from triaxcald.recording.segments import SegmentedWriter
from triaxcald.recording.writer import RecordingWriter

S, MIB = 1_000_000_000, 2**20
T0_NS = 1_700_000_000_000_000_000
PIECE = 2000  # records of a batch, 64 bytes each, which nothing can compress


def noise(number: int) -> RawBatch:
    data = np.random.default_rng(number).bytes(64 * PIECE)
    time_ns = T0_NS + (number * PIECE + np.arange(PIECE)) * 500_000
    return RawBatch(
        time_ns,
        np.full(PIECE, 0x123, np.uint32),
        np.zeros(PIECE, np.uint8),
        np.full(PIECE, 64, np.uint16),
        data,
    )


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Callable[[int], Path]]:
    """A file system of so many bytes, which only the superuser can make."""
    made: list[Path] = []

    def make(size: int) -> Path:
        folder = tmp_path / f"disk{len(made)}"
        folder.mkdir()
        done = subprocess.run(
            ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", folder], capture_output=True, check=False
        )
        if done.returncode:
            pytest.skip("no file system may be mounted here")
        made.append(folder)
        return folder

    if shutil.which("mount") is None:
        pytest.skip("there is no mount")
    yield make
    for folder in made:
        subprocess.run(["umount", folder], check=True)


@pytest.fixture
def looks_when_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    """The writer's look at an idle file does not come before the next job, however
    slow the machine is."""
    monkeypatch.setattr(writer_module, "LOOK_S", 3600.0)


def record_until_the_disk_fails(writer: RecordingWriter, clock: Any, most: int = 500) -> str:
    def record() -> None:
        for number in range(most):
            writer.raw("bus/0", noise(number))
            clock.now_ns += S

    with pytest.raises(DiskError) as failed:
        record()
    assert failed.value.exit_code == DISK
    with pytest.raises(DiskError):
        writer.close()
    return str(failed.value)


def fill(folder: Path) -> None:
    with open(folder / "filler", "wb", buffering=0) as filler, suppress(OSError):
        while True:
            filler.write(bytes(4096))
    assert os.statvfs(folder).f_bfree == 0


def test_a_recording_is_ended_while_there_is_room_for_its_end(small_disk: Callable[[int], Path], clock: Any) -> None:
    path = small_disk(8 * MIB) / "rec.mcap"
    writer = RecordingWriter(path, metadata={"bus": {}}, preview_channels=None, clock_ns=clock, waits=True)
    said = record_until_the_disk_fails(writer, clock)
    assert said.startswith(f"{path}: ended, as ")
    assert "bytes are free on the disk; whole up to 2023-11-14T22:1" in said
    with Recording.open(path) as recording:  # finished, every byte under a CRC
        *_, last = recording.events()
        assert (last.kind, last.detail["reason"]) == ("ended", "disk")
        batches = [batch for _, batch in recording.raw_batches()]
    assert len(batches) > 10
    assert all(batch.payload == noise(i).payload for i, batch in enumerate(batches))


@pytest.mark.usefixtures("looks_when_asked")
def test_a_disk_that_others_fill_leaves_a_file_that_is_whole_up_to_the_second_stated(
    small_disk: Callable[[int], Path], clock: Any, tmp_path: Path
) -> None:
    folder = small_disk(16 * MIB)
    writer = RecordingWriter(folder / "rec.mcap", metadata={"bus": {}}, preview_channels=None, clock_ns=clock)
    writer.raw("bus/0", noise(0))
    writer.drain()
    fill(folder)
    clock.now_ns += S // 2
    writer.raw("bus/0", noise(1))
    with pytest.raises(DiskError) as failed:
        writer.drain()
    said = f"{folder / 'rec.mcap'}: writing failed: No space left on device; sound up to 2023-11-14T22:13:20Z"
    assert str(failed.value) == said
    os.unlink(folder / "filler")
    with pytest.raises(DiskError):
        writer.close()
    with Recording.open(folder / "rec.mcap", unfinished=True) as recording:
        assert [batch.payload for _, batch in recording.raw_batches()] == [noise(0).payload]
    recovery = recover(folder / "rec.mcap", tmp_path / "mended.mcap")
    assert (recovery.raw_records, recovery.bytes_dropped, recovery.cut_short) == (PIECE, 0, True)


def test_no_recording_begins_on_a_disk_that_is_full(small_disk: Callable[[int], Path]) -> None:
    folder = small_disk(4096)
    (folder / "filler").write_bytes(bytes(4096))
    with pytest.raises(DiskError, match=r"rec\.mcap: cannot be created: 0 bytes are free on the disk"):
        RecordingWriter(folder / "rec.mcap", metadata={})
    assert not (folder / "rec.mcap").exists()


@pytest.mark.usefixtures("looks_when_asked")
def test_a_folder_that_is_removed_is_said_within_a_second_of_the_clock(tmp_path: Path, clock: Any) -> None:
    (tmp_path / "folder").mkdir()
    writer = RecordingWriter(tmp_path / "folder" / "rec.mcap", metadata={"bus": {}}, clock_ns=clock)
    writer.raw("bus/0", noise(0))
    writer.drain()
    shutil.rmtree(tmp_path / "folder")
    writer.raw("bus/0", noise(1))
    clock.now_ns += S
    with pytest.raises(DiskError, match="writing failed: the file, or its folder, was removed; sound up to 2023"):
        writer.drain()
    with pytest.raises(DiskError):
        writer.close()


def test_a_folder_that_is_removed_in_silence_is_said_at_once(
    tmp_path: Path, wait_until: Callable[[Callable[[], bool]], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer_module, "LOOK_S", 0.001)
    folder = tmp_path / "folder"
    folder.mkdir()
    writer = RecordingWriter(folder / "rec.mcap", metadata={"bus": {}}, preview_channels=None)
    shutil.rmtree(folder)

    def told() -> bool:
        try:
            writer.check()
        except DiskError as e:
            return "the file, or its folder, was removed" in str(e)
        return False

    wait_until(told)
    with pytest.raises(DiskError):
        writer.close()


def test_a_disk_that_others_fill_in_silence_ends_the_file_while_there_is_room_for_its_end(
    tmp_path: Path, wait_until: Callable[[Callable[[], bool]], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer_module, "LOOK_S", 0.001)
    free = [10**12]
    monkeypatch.setattr(disk, "free_bytes", lambda _: free[0])
    path = tmp_path / "rec.mcap"
    writer = RecordingWriter(path, metadata={"bus": {}}, preview_channels=None)
    writer.raw("bus/0", noise(0))
    writer.drain()
    free[0] = 1000
    wait_until(lambda: not writer._thread.is_alive())
    with pytest.raises(DiskError, match="ended, as 1000 bytes are free"):
        writer.close()
    with Recording.open(path) as recording:
        *_, last = recording.events()
    assert (last.kind, last.detail["reason"]) == ("ended", "disk")


def test_the_oldest_segments_make_room_on_a_disk_that_is_nearly_full(
    small_disk: Callable[[int], Path], clock: Any
) -> None:
    folder = small_disk(24 * MIB)
    options = {"size_bytes": 2 * MIB, "retention": Retention(free_bytes=12 * MIB)}
    with SegmentedWriter(
        folder / "rec.mcap", metadata={"bus": {}}, preview_channels=None, clock_ns=clock, waits=True, **options
    ) as writer:
        for number in range(400):  # 50 MiB
            writer.raw("bus/0", noise(number))
            clock.now_ns += S
    assert {one.reason for one in writer.deleted} == {"disk"}
    assert shutil.disk_usage(folder).free > 8 * MIB
    left = sorted(p.name for p in folder.glob("*.mcap"))
    assert left[-1] > "rec-000015.mcap"
    with Recording.open(folder / left[-1]) as recording:
        *_, last = recording.events()
        assert last.detail == {"reason": "asked"}


def test_where_no_segment_may_go_a_full_disk_ends_the_recording(small_disk: Callable[[int], Path], clock: Any) -> None:
    folder = small_disk(8 * MIB)
    writer = SegmentedWriter(
        folder / "rec.mcap", metadata={"bus": {}}, preview_channels=None, clock_ns=clock, waits=True, size_bytes=MIB
    )
    assert ": ended, as " in record_until_the_disk_fails(writer, clock)
    assert len(list(folder.glob("*.mcap"))) >= 2
    for path in folder.glob("*.mcap"):
        Recording.open(path).close()  # each of them finished


@pytest.mark.slow
def test_record_ends_with_5_and_says_up_to_when_the_file_is_sound(workshop: Any, tmp_path: Path) -> None:
    path = tmp_path / "rec.mcap"
    with workshop.serve(workshop.device()) as served:
        station = workshop.station({"bus": served.bus})
        done = subprocess.run(
            [sys.executable, "-m", "triaxcald.cli", "record", station, "-o", path],
            capture_output=True, text=True, timeout=180, check=False,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)},
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (150_000, 150_000)),
        )  # fmt: skip
    assert done.returncode == DISK, done.stderr
    last = done.stderr.splitlines()[-1]
    assert last.startswith(f"triaxcal: unit unit0: {path}: writing failed: File too large; sound up to 20")
    with Recording.open(path, unfinished=True) as recording:
        assert recording.size <= 150_000
        assert recording.raw_digest().records > 0
