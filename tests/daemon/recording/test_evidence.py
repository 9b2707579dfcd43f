"""Which segments documents rest on, by an index that reads each document once."""

from __future__ import annotations

import json
import os
import random
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from triaxcald.recording import segments as evidence_module
from triaxcald.recording.manifest import Manifest, Segment
from triaxcald.recording.segments import NAMES_MOST, EvidenceIndex, evidence_in

SHA = [f"{i:064x}" for i in range(0xABC0, 0xABC0 + 40)]


def segment(number: int, **fields: str) -> Segment:
    return Segment(f"unit-777-{number:06d}.mcap", number, 0, "closed", **{"sha256": SHA[number], **fields})  # type: ignore[arg-type]


def manifest(folder: Path, *segments: Segment) -> Manifest:
    return Manifest(folder / "unit-777.segments.json", segments or tuple(segment(n) for n in range(1, 6)))


def put(folder: Path, name: str, text: str, *, age_s: float = 60.0) -> Path:
    """A document that was written some time ago."""
    path = folder / name
    path.write_text(text)
    at_ns = time.time_ns() - round(age_s * 1e9)
    os.utime(path, ns=(at_ns, at_ns))
    return path


@pytest.fixture
def settled(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if nothing had been written lately: a file's time of change cannot be set."""
    monkeypatch.setattr(evidence_module, "SETTLED_NS", -1)


def numbers(kept: frozenset[str]) -> list[int]:
    return sorted(int(name[-11:-5]) for name in kept)


@pytest.mark.parametrize(
    ("name", "text", "kept"),
    [
        ("a.outcome.json", "{}", []),
        ("a.outcome.json", json.dumps({"recording": "unit-777-000002.mcap"}), [2]),
        ("a.certificate.json", json.dumps({"recording": "/data/unit-777-000002.mcap"}), [2]),
        ("a.outcome.json", json.dumps({"recording_sha256": SHA[3]}), [3]),
        ("a.outcome.json", f"{SHA[1]} unit-777-000004.mcap {SHA[5]}", [1, 4, 5]),
        ("a.outcome.json", f"beef{SHA[3]}beef", [3]),
        ("a.outcome.json", SHA[3].upper(), []),
        ("a.outcome.json", SHA[3][:-1], []),
        ("a.outcome.json", "my-unit-777-000002.mcap", [2]),
        ("a.outcome.json", "unit-777-000002.mcap.mcap", [2]),
        ("a.outcome.json", f"{'x' * 400}unit-777-000002.mcap", [2]),
        ("a.outcome.json", "777-000002.mcap", []),
        ("a.json", json.dumps({"recording": "unit-777-000002.mcap"}), []),
        ("unit-777-000004.outcome.json", "{}", [4]),
        ("unit-777-0000041.outcome.json", "{}", []),
        (".outcome.json", SHA[2], [2]),
        ("a.outcome.json", "x.mcap " * (NAMES_MOST + 1), []),
        ("a.outcome.json", "".join(f"{n}.mcap " for n in range(NAMES_MOST + 1)) + SHA[2], [2]),
    ],
)
def test_a_document_keeps_what_it_names(tmp_path: Path, name: str, text: str, kept: list[int]) -> None:
    put(tmp_path, name, text)
    index = EvidenceIndex(tmp_path)
    for _ in range(2):
        found = index.of(manifest(tmp_path))
        assert (numbers(found.kept), found.unread) == (kept, None)


def test_the_digest_of_raw_records_and_one_of_another_form_keep_a_segment_too(tmp_path: Path) -> None:
    segments = segment(1, raw_sha256=SHA[9]), segment(2, sha256="an older digest"), segment(3, raw_sha256="AB" * 32)
    put(tmp_path, "a.outcome.json", f"{SHA[9]} an older digest {'AB' * 32}")
    assert numbers(EvidenceIndex(tmp_path).of(manifest(tmp_path, *segments, segment(4))).kept) == [1, 2, 3]


@pytest.mark.usefixtures("settled")
def test_a_document_is_read_once_and_again_when_it_is_another(tmp_path: Path) -> None:
    index = EvidenceIndex(tmp_path)
    path = put(tmp_path, "a.outcome.json", SHA[1])
    put(tmp_path, "b.outcome.json", SHA[2])

    def look() -> tuple[list[int], int]:
        before = index.reads
        return numbers(index.of(manifest(tmp_path)).kept), index.reads - before

    assert look() == ([1, 2], 2)
    assert look() == ([1, 2], 0)
    put(tmp_path, "c.certificate.json", "unit-777-000004.mcap")
    assert look() == ([1, 2, 4], 1)
    times = path.stat().st_atime_ns, path.stat().st_mtime_ns
    path.write_text(SHA[3])  # of the same length
    os.utime(path, ns=times)
    assert look() == ([2, 3, 4], 1)
    put(tmp_path, "new", SHA[5]).replace(path)
    assert look() == ([2, 4, 5], 1)
    path.unlink()
    assert look() == ([2, 4], 0)
    (tmp_path / "c.certificate.json").rename(tmp_path / "c.outcome.json")
    assert look() == ([2, 4], 1)


def test_a_document_that_has_just_been_written_is_read_again(tmp_path: Path) -> None:
    """Its file system may have coarse times."""
    index = EvidenceIndex(tmp_path)
    (tmp_path / "a.outcome.json").write_text(SHA[1])
    for expected in (1, 2):
        assert numbers(index.of(manifest(tmp_path)).kept) == [1]
        assert index.reads == expected


@pytest.mark.usefixtures("settled")
@pytest.mark.parametrize("spoil", [Path.mkdir, lambda path: path.symlink_to("nowhere"), lambda path: os.mkfifo(path)])
def test_a_document_that_cannot_be_read_keeps_all_until_it_can_be(
    tmp_path: Path, spoil: Callable[[Path], object]
) -> None:
    index, path = EvidenceIndex(tmp_path), tmp_path / "b.outcome.json"
    put(tmp_path, "a.outcome.json", SHA[1])
    assert index.of(manifest(tmp_path)).unread is None
    spoil(path)
    for _ in range(2):
        found = index.of(manifest(tmp_path))
        assert (numbers(found.kept), found.unread) == ([1, 2, 3, 4, 5], "b.outcome.json")
    path.rmdir() if path.is_dir() and not path.is_symlink() else path.unlink()
    put(tmp_path, "b.outcome.json", SHA[2])
    found = index.of(manifest(tmp_path))
    assert (numbers(found.kept), found.unread) == ([1, 2], None)


def test_a_folder_that_cannot_be_read_keeps_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(_: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "scandir", refused)
    found = EvidenceIndex(tmp_path).of(manifest(tmp_path))
    assert (numbers(found.kept), found.unread) == ([1, 2, 3, 4, 5], str(tmp_path))


def test_writers_of_one_folder_share_an_index(tmp_path: Path) -> None:
    index = evidence_in(tmp_path)
    assert evidence_in(tmp_path) is index
    assert evidence_in(tmp_path / "other") is not index


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.usefixtures("settled")
def test_the_index_finds_what_a_search_through_all_texts_does(tmp_path: Path, seed: int) -> None:
    """Documents come, change and go at random."""
    rng = random.Random(seed)
    pieces = [
        *SHA,
        *(s.upper() for s in SHA),
        *(f"unit-777-{n:06d}.mcap" for n in range(12)),
        "/",
        '"',
        " ",
        "e",
        ".mcap",
    ]
    index, texts = EvidenceIndex(tmp_path), dict[str, str]()
    segments = tuple(segment(n, raw_sha256=rng.choice([SHA[-n], ""])) for n in range(1, 12))
    for _ in range(15):
        name = f"{rng.choice(['a', 'b', 'c', 'unit-777-000003'])}.{rng.choice(['outcome', 'certificate'])}.json"
        if name in texts and rng.random() < 0.4:
            (tmp_path / name).unlink()
            del texts[name]
        else:
            texts[name] = "".join(rng.choices(pieces, k=rng.randrange(6)))
            put(tmp_path, name, texts[name])
        wanted = {
            s.file
            for s in segments
            if any(name.startswith(f"{s.file[:-5]}.") for name in texts)
            or any(t and t in text for text in texts.values() for t in (s.file, s.sha256, s.raw_sha256))
        }
        assert index.of(manifest(tmp_path, *segments)).kept == wanted
