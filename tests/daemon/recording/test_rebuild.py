"""A manifest that cannot be used is rebuilt from the segments beside it."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from triaxcal_drivers.interface import RawBatch
from triaxcald.recording import rebuild
from triaxcald.recording.manifest import Segment, load_manifest
from triaxcald.recording.reader import Recording, Series
from triaxcald.recording.segments import SegmentedWriter
from triaxcald.recording.writer import RecordingWriter

S = 1_000_000_000
METADATA = {"station": {"name": "bench"}, "unit": {"serial": "42"}}
MANIFEST = "rec.segments.json"
BatchOf = Callable[..., RawBatch]
Record = Callable[..., SegmentedWriter]


@pytest.fixture
def record(tmp_path: Path, clock: Any, batch_of: BatchOf) -> Iterator[Record]:
    """Records so many segments of ten records, and closes or only drains."""
    writers = []

    def make(count: int, first: int = 0, *, close: bool = True) -> SegmentedWriter:
        writer = SegmentedWriter(tmp_path / "rec.mcap", metadata=METADATA, clock_ns=clock, steady_ns=clock, time_s=60.0)
        writers.append(writer)
        for i in range(count):
            writer.raw("calibration", batch_of(first + 10 * i, 10))
            writer.drain()
            if i < count - 1:
                clock.now_ns += 60 * S
                writer.event("minute")
                writer.drain()
        if close:
            writer.close()
        return writer

    yield make
    for writer in writers:
        if not writer.closed:
            writer.close()


def listed(folder: Path) -> list[Segment]:
    """Without the time of the file, which is not the recording's."""
    return [replace(s, closed_ns=None) for s in load_manifest(folder / MANIFEST).segments]


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.glob("*.mcap")}


def edited(change: Callable[[Any], Any]) -> Callable[[Path], None]:
    def spoil(path: Path) -> None:
        document = json.loads(path.read_text())
        path.write_text(json.dumps(change(document) or document))

    return spoil


def written(data: bytes) -> Callable[[Path], None]:
    return lambda path: path.write_bytes(data) and None


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def zeros(path: Path) -> None:
    path.write_bytes(bytes(path.stat().st_size))


def a_folder(path: Path) -> None:
    path.unlink()
    (path / "inside").mkdir(parents=True)


def a_pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def a_link_to_nothing(path: Path) -> None:
    path.unlink()
    path.symlink_to("nowhere")


def huge(path: Path) -> None:
    with path.open("r+b") as file:
        file.truncate(70 * 2**20)


SPOILED: dict[str, Callable[[Path], None]] = {
    "empty": written(b""),
    "cut": cut,
    "zeros": zeros,
    "garbage": written(bytes(range(256)) * 20),
    "not JSON": written(b"segments:\n- rec-000001.mcap\n"),
    "deep": written(b"[" * 100_000),
    "no object": written(b"null"),
    "other format": edited(lambda d: d | {"format": "triaxcal.segments/9"}),
    "no segments": edited(lambda d: {"format": d["format"]}),
    "segments of another kind": edited(lambda d: d | {"segments": {}}),
    "a field missing": edited(lambda d: d["segments"][1].pop("number") and None),
    "a field of another kind": edited(lambda d: d["segments"][1].update(first="0")),
    "a state that there is not": edited(lambda d: d["segments"][0].update(state="fine")),
    "a number that no file has": edited(lambda d: d["segments"][2].update(number=2**62)),
    "an end before the first": edited(lambda d: d["segments"][2].update(end=3)),
    "deleted without end": edited(lambda d: d | {"deleted": {"age": 2**63 - 1}}),
    "numbers that fall": edited(lambda d: d["segments"].reverse()),
    "a file twice": edited(lambda d: d["segments"][1].update(file="rec-000001.mcap")),
    "a file elsewhere": edited(lambda d: d["segments"][1].update(file="../rec-000002.mcap")),
    "a name that no file has": edited(lambda d: d["segments"][1].update(file="rec\0.mcap")),
    "half a character": edited(lambda d: d["segments"][1].update(file="\ud800.mcap")),
    "a folder": a_folder,
    "a pipe": a_pipe,
    "a link to nothing": a_link_to_nothing,
    "huge": huge,
}
STALE: dict[str, Callable[[Path], None]] = {
    "names files that are gone": edited(
        lambda d: d["segments"].append(d["segments"][2] | {"number": 7, "file": "rec-000007.mcap"})
    ),
    "does not name the last": edited(lambda d: d["segments"].pop() and None),
    "does not name the first": edited(lambda d: d["segments"].pop(0) and None),
    "names none": edited(lambda d: d | {"segments": []}),
    "has one open that is closed": edited(lambda d: d["segments"][1].update(state="open", end=0, sha256="")),
}


@pytest.mark.parametrize("how", [*SPOILED, *STALE])
def test_recording_goes_on_behind_the_segments_that_are_there(
    tmp_path: Path, record: Record, batch_of: BatchOf, how: str
) -> None:
    record(3)
    before, files = listed(tmp_path), contents(tmp_path)
    (SPOILED | STALE)[how](tmp_path / MANIFEST)
    spoiled = (tmp_path / MANIFEST).read_bytes() if (tmp_path / MANIFEST).is_file() else None

    writer = record(1, first=30)

    after = listed(tmp_path)
    assert after[:3] == before
    assert (after[3].first, after[3].end, after[3].records, after[3].state) == (30, 40, 10, "closed")
    assert {name: data for name, data in contents(tmp_path).items() if name in files} == files
    assert writer.warning is not None
    assert f"it is kept as {MANIFEST}.replaced" in writer.warning
    kept = tmp_path / f"{MANIFEST}.replaced"
    assert os.path.lexists(kept)
    assert spoiled is None or kept.read_bytes() == spoiled
    with Series(tmp_path / MANIFEST) as series:
        times = [t for batch in series.raw("calibration") for t in batch.time_ns.tolist()]
        [told] = [e.detail for e in series.events() if e.kind == "manifest_rebuilt"]
    assert times == batch_of(0, 40).time_ns.tolist()
    assert told == {"because": writer.warning, "kept_as": kept.name}


@pytest.mark.parametrize("how", [h for h in SPOILED if h not in ("a link to nothing", "a pipe")])
def test_a_command_that_reads_says_in_one_line_what_to_do(
    tmp_path: Path, record: Record, triaxcal: Callable[..., Any], how: str
) -> None:
    record(3)
    SPOILED[how](tmp_path / MANIFEST)
    for command in (("log", "info"), ("poses",), ("audit",)):
        done = triaxcal(*command, tmp_path / MANIFEST)
        assert (done.code, done.err.count("\n") + done.out.count("\n")) == (2, 1), command
        assert MANIFEST in done.err + done.out
        if command != ("audit",):
            assert "segments can be read one by one" in done.err


def test_a_manifest_that_is_sound_stays_as_it_is(tmp_path: Path, record: Record) -> None:
    record(2)
    (tmp_path / "rec-000099.mcap").touch()
    (tmp_path / "other-000001.mcap").write_bytes((tmp_path / "rec-000001.mcap").read_bytes())
    assert record(1, first=20).warning is None
    assert [s.number for s in listed(tmp_path)] == [1, 2, 3]
    assert not list(tmp_path.glob("*.replaced*"))


def test_each_manifest_that_is_replaced_is_kept(tmp_path: Path, record: Record) -> None:
    for i in range(3):
        record(1, first=10 * i)
        (tmp_path / MANIFEST).write_text(f"spoiled {i}")
    record(1, first=30)
    assert sorted(path.read_text() for path in tmp_path.glob("*.replaced")) == ["spoiled 0", "spoiled 1", "spoiled 2"]


def test_a_file_of_that_name_that_is_no_segment_is_neither_listed_nor_overwritten(
    tmp_path: Path, record: Record, clock: Any
) -> None:
    record(1)
    with RecordingWriter(tmp_path / "whole.mcap", metadata=METADATA, clock_ns=clock):
        pass
    (tmp_path / "whole.mcap").rename(tmp_path / "rec-000002.mcap")
    (tmp_path / "rec-000003.mcap").write_bytes((tmp_path / "rec-000001.mcap").read_bytes())
    (tmp_path / "rec-000004.mcap").mkdir()
    (tmp_path / "rec-000005.mcap").touch()
    before = {path.name: path.read_bytes() for path in tmp_path.glob("*.mcap") if path.is_file()}
    (tmp_path / MANIFEST).write_text("{")
    record(1, first=10)
    assert [(s.number, s.first) for s in listed(tmp_path)] == [(1, 0), (6, 10)]
    assert {name: (tmp_path / name).read_bytes() for name in before} == before


def test_segments_that_were_cut_short_or_damaged_are_listed_as_what_they_are(
    tmp_path: Path, record: Record, batch_of: BatchOf
) -> None:
    record(4)
    sound = listed(tmp_path)
    short, damaged, last = (tmp_path / f"rec-00000{n}.mcap" for n in (2, 3, 4))
    summary = 700  # bytes, at most: what follows the raw records is cut off
    short.write_bytes(short.read_bytes()[:-summary])
    data = bytearray(damaged.read_bytes()[:-summary])
    data[len(data) // 2 :] = b"\xff" * (len(data) - len(data) // 2)
    damaged.write_bytes(data)
    last.write_bytes(last.read_bytes()[:12])
    (tmp_path / MANIFEST).unlink()
    record(1, first=40)
    states = [(s.number, s.state, s.first) for s in listed(tmp_path)]
    assert states == [(1, "closed", 0), (2, "cut_short", 10), (3, "damaged", 20), (4, "damaged", 20), (5, "closed", 20)]
    assert listed(tmp_path)[0] == sound[0]
    assert listed(tmp_path)[1].sha256 == sound[1].sha256, "the next one knew it whole: the change is found"


def test_numbers_that_retention_has_freed_are_not_given_again(tmp_path: Path, record: Record) -> None:
    record(4)
    for number in (1, 2):
        (tmp_path / f"rec-00000{number}.mcap").unlink()
    (tmp_path / MANIFEST).write_text("{")
    record(1, first=40)
    manifest = load_manifest(tmp_path / MANIFEST)
    assert ([s.number for s in manifest.segments], manifest.deleted) == ([3, 4, 5], {"unknown": 2})
    (tmp_path / "rec-000003.mcap").unlink()
    record(1, first=50)
    manifest = load_manifest(tmp_path / MANIFEST)
    assert ([s.number for s in manifest.segments], manifest.deleted) == ([4, 5, 6], {"unknown": 2, "missing": 1})


def test_losses_count_where_the_last_segment_ends(
    tmp_path: Path, record: Record, batch_of: BatchOf, clock: Any
) -> None:
    with SegmentedWriter(tmp_path / "rec.mcap", metadata=METADATA, clock_ns=clock, queue_batches=1) as writer:
        writer.drain()
        writer._room.acquire()  # as if a batch were on its way to a slow disk
        writer.raw("calibration", batch_of(0, 10))
        writer._room.release()
        writer.drain()
        writer.raw("calibration", batch_of(10, 10))
    before = listed(tmp_path)
    (tmp_path / MANIFEST).unlink()
    record(1, first=20)
    assert listed(tmp_path)[0] == before[0]
    assert listed(tmp_path)[1].first == 20


def test_a_sound_segment_is_not_read_whole(tmp_path: Path, record: Record, monkeypatch: pytest.MonkeyPatch) -> None:
    """A week of them would keep the station from recording for minutes."""
    record(3)
    (tmp_path / MANIFEST).unlink()
    monkeypatch.setattr(rebuild, "_by_records", lambda *_: pytest.fail("it was read whole"))
    monkeypatch.setattr(rebuild, "digest_of", digests := Counted(rebuild.digest_of))
    record(1, first=30)
    assert digests.names == ["rec-000003.mcap"], "the others are known to the one that follows"


class Counted:
    def __init__(self, digest_of: Callable[[Path], str]) -> None:
        self._digest_of, self.names = digest_of, list[str]()

    def __call__(self, path: Path) -> str:
        self.names.append(path.name)
        return self._digest_of(path)


def test_the_events_of_the_new_segment_are_in_it_alone(tmp_path: Path, record: Record) -> None:
    record(1)
    (tmp_path / MANIFEST).write_text("{")
    record(1, first=10)
    record(1, first=20)
    kinds = []
    for number in (1, 2, 3):
        with Recording.open(tmp_path / f"rec-00000{number}.mcap") as recording:
            kinds.append([e.kind for e in recording.events()].count("manifest_rebuilt"))
    assert kinds == [0, 1, 0]
