"""Which recordings are meant by files, folders, patterns, manifests and URLs."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import pytest

from triaxcald.many import Source, Unusable, sources_of

MCAP = (".mcap",)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("b.mcap", "a.mcap", "below/c.mcap", "notes.md", "t.csv"):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(name)
    return tmp_path


def names(asked: list[str], endings: tuple[str, ...] = MCAP, **more: object) -> list[str]:
    return [Path(of.name).name for of in sources_of(asked, endings, **more)]  # type: ignore[arg-type]


def test_a_folder_stands_for_the_recordings_in_it_and_below_in_order(folder: Path) -> None:
    found = sources_of([str(folder)], MCAP)
    assert [Path(of.name).relative_to(folder).as_posix() for of in found] == ["a.mcap", "b.mcap", "below/c.mcap"]
    assert found[0] == Source(str(folder / "a.mcap"), 6, str((folder / "a.mcap").stat().st_mtime_ns))


def test_each_recording_counts_once_where_it_was_first_given(folder: Path) -> None:
    assert names([str(folder / "b.mcap"), str(folder), str(folder / "*.mcap")]) == ["b.mcap", "a.mcap", "c.mcap"]


def test_the_table_itself_is_no_recording(folder: Path) -> None:
    assert names([str(folder)], (".mcap", ".csv")) == ["a.mcap", "b.mcap", "c.mcap", "t.csv"]
    assert names([str(folder)], (".mcap", ".csv"), without=[folder / "t.csv"]) == ["a.mcap", "b.mcap", "c.mcap"]


def test_a_manifest_lists_paths_from_its_own_folder(folder: Path) -> None:
    manifest = folder / "below" / "all.list"
    manifest.write_text(f"# two shifts\n\n  c.mcap\n../a.mcap\n{folder}/b.mcap\ngone.mcap\n")
    assert names([str(manifest)]) == ["c.mcap", "a.mcap", "b.mcap", "gone.mcap"]
    assert sources_of([str(manifest)], MCAP)[-1] == Source(str(folder / "below" / "gone.mcap"))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"# nothing\n\n", "no recording is in this list"),
        (b"\xff\xfe\n", "not UTF-8 text (byte 0)"),
        (b"a.mcap\n" + b"x" * 5000, "line 2: expected a path or URL of at most 4096 characters"),
        (b"a\0b\n", "line 1: expected a path or URL"),
    ],
)
def test_what_is_no_manifest_is_named_with_its_line(tmp_path: Path, content: bytes, words: str) -> None:
    manifest = tmp_path / "all.list"
    manifest.write_bytes(content)
    found = sources_of([str(manifest)], MCAP)[-1]
    assert isinstance(found, Unusable)
    assert words in found.error
    assert found.exit_code == 2


def test_what_names_no_recording_hides_no_other(folder: Path) -> None:
    (folder / "empty").mkdir()
    found = sources_of([str(folder / "empty"), str(folder / "x*"), str(folder / "a.mcap"), "odd://x"], MCAP)
    assert [type(of) for of in found] == [Unusable, Unusable, Source, Unusable]
    assert {of.exit_code for of in found if isinstance(of, Unusable)} == {2}


def test_a_manifest_of_segments_stands_for_its_segments(tmp_path: Path) -> None:
    for name in ("a.segments.json", "a-000001.mcap", "a-000002.mcap", "b-000001.mcap"):
        (tmp_path / name).touch()
    assert names([str(tmp_path)], (".mcap", ".segments.json")) == ["a.segments.json", "b-000001.mcap"]
    assert names([str(tmp_path)]) == ["a-000001.mcap", "a-000002.mcap", "b-000001.mcap"]


def test_a_bad_entry_of_a_list_hides_no_other(folder: Path) -> None:
    manifest = folder / "all.list"
    entries = ("odd://x/a.mcap", "a.mcap", "file://[x", "x" * 5000, "https://[x/a.mcap", "b.mcap")
    manifest.write_text("\n".join(entries))
    found = sources_of([str(manifest)], MCAP)
    assert [isinstance(of, Source) for of in found] == [False, True, False, False, False, True]
    assert {of.exit_code for of in found if isinstance(of, Unusable)} == {2}


def test_a_url_that_is_none_is_an_error_of_its_own(folder: Path) -> None:
    [bad, good] = sources_of(["file://[a", str(folder / "a.mcap")], MCAP)
    assert isinstance(bad, Unusable)
    assert (bad.name, bad.exit_code) == ("file://[a", 2)
    assert isinstance(good, Source)


@pytest.fixture
def below_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Root may look into every folder, so the system's answer is put in."""
    true = os.scandir

    def scandir(path: str = ".") -> Any:
        if Path(path).resolve().name == "below":
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
        return true(path)

    monkeypatch.setattr(os, "scandir", scandir)


@pytest.mark.usefixtures("below_is_closed")
@pytest.mark.parametrize(
    ("pattern", "names", "closed"),
    [
        ("**/*.mcap", ["a.mcap", "b.mcap"], True),
        ("**", ["a.mcap", "b.mcap"], True),
        ("*", ["a.mcap", "b.mcap"], True),
        ("*/c.mcap", ["c.mcap"], False),
        ("below/*.mcap", [], True),
        ("b*/c.mcap", ["c.mcap"], False),
        ("[ab].mcap", ["a.mcap", "b.mcap"], False),
        ("a*/c.mcap", [], False),
        ("*/*/c.mcap", [], True),
    ],
)
def test_a_pattern_names_the_folders_that_it_cannot_look_into(
    folder: Path, pattern: str, names: list[str], closed: bool
) -> None:
    found = sources_of([f"{folder}/{pattern}"], MCAP)
    assert [Path(of.name).name for of in found if of.name.endswith(".mcap") and isinstance(of, Source)] == names
    told = [of.error for of in found if isinstance(of, Unusable)]
    if closed:
        assert told == [f"{folder / 'below'}: cannot be looked into: {os.strerror(errno.EACCES)}"]
    else:
        assert not any("cannot be looked into" in error for error in told)


@pytest.mark.usefixtures("below_is_closed")
@pytest.mark.parametrize("pattern", ["**/*.mcap", "link/*.mcap", "li*/*.mcap", "**/link/**"])
def test_a_closed_folder_behind_a_link_is_named(folder: Path, pattern: str) -> None:
    (folder / "link").symlink_to(folder / "below")
    told = [of.name for of in sources_of([f"{folder}/{pattern}"], MCAP) if isinstance(of, Unusable)]
    assert str(folder / "link") in told or str(folder / "below") in told
    assert len(told) == len(set(told))


@pytest.mark.usefixtures("below_is_closed")
def test_a_relative_pattern_names_a_closed_folder_once(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    for pattern in ("**", "*", "**/*.mcap", "be*/*.mcap"):
        assert [of.name for of in sources_of([pattern], MCAP) if isinstance(of, Unusable)] == ["below"]


def test_links_that_go_round_and_fit_nothing_are_no_errors(folder: Path) -> None:
    (folder / "self").symlink_to(folder / "self")
    (folder / "below" / "up").symlink_to(folder)
    for pattern in ("*/c.mcap", "b*/c.mcap", "b*/*.mcap", "**/c.mcap"):
        found = sources_of([f"{folder}/{pattern}"], MCAP)
        assert found
        assert all(isinstance(of, Source) for of in found)


def test_an_empty_folder_hides_no_other_of_a_pattern(folder: Path) -> None:
    (folder / "empty").mkdir()
    assert names([str(folder / "[be]*[wy]")]) == ["c.mcap"]
    [none] = sources_of([str(folder / "empt*")], MCAP)
    assert isinstance(none, Unusable)
    assert none.exit_code == 2


@pytest.mark.usefixtures("below_is_closed")
def test_a_folder_that_cannot_be_looked_into_is_named(folder: Path) -> None:
    *found, closed = sources_of([str(folder)], MCAP)
    assert [Path(of.name).name for of in found] == ["a.mcap", "b.mcap"]
    assert closed == Unusable(
        str(folder / "below"), f"{folder / 'below'}: cannot be looked into: {os.strerror(errno.EACCES)}", 2
    )
    assert [type(of) for of in sources_of([str(folder / "below")], MCAP)] == [Unusable]


def test_paths_for_workers_are_absolute(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    found = sources_of(["a.mcap", "below", "memory://x/c.mcap"], MCAP, absolute=True)
    assert [of.name for of in found] == [str(folder / "a.mcap"), str(folder / "below" / "c.mcap"), "memory://x/c.mcap"]
    assert isinstance(found[0], Source)
    assert found[0].size == 6
