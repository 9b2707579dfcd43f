"""A file is written whole or not at all, and never in the place of what is no file."""

from __future__ import annotations

import os
import stat
import threading
from pathlib import Path

import pytest

from triaxcald.errors import InputError
from triaxcald.files import new_beside, new_file, unused, write_text


def test_a_file_is_written_as_utf8_and_readable_by_all(tmp_path: Path) -> None:
    path = write_text(tmp_path / "a.json", "µg\n")
    assert path.read_bytes() == b"\xc2\xb5g\n"
    assert path.stat().st_mode & 0o777 == 0o644


def test_an_existing_file_is_replaced_and_nothing_stays_beside_it(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text("a longer text that was here before")
    write_text(path, "new")
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_a_text_that_cannot_be_encoded_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text("old")
    with pytest.raises(InputError, match="is no character"):
        write_text(path, "\ud800")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("where", ["missing/a.json", "file/a.json", "folder"])
def test_a_place_that_takes_no_file_is_named(tmp_path: Path, where: str) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError, match=f"{where}: cannot be written: "):
        write_text(tmp_path / where, "text")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "folder"]


def test_a_pipe_is_written_to_and_stays_a_pipe(tmp_path: Path) -> None:
    """So that -o /dev/stdout and -o /dev/null do what they say, also for root."""
    path = tmp_path / "pipe"
    os.mkfifo(path)
    read: list[str] = []
    reader = threading.Thread(target=lambda: read.append(path.read_text()), daemon=True)
    reader.start()
    write_text(path, "through")
    assert stat.S_ISFIFO(path.stat().st_mode)
    reader.join(timeout=180)
    assert read == ["through"]


def test_a_full_device_is_an_error_of_one_line(tmp_path: Path) -> None:
    path = tmp_path / "full"
    path.symlink_to("/dev/full")
    with pytest.raises(InputError, match="full: cannot be written: No space left on device"):
        write_text(path, "text")
    assert path.is_symlink()


@pytest.mark.parametrize("target", ["target.json", "nothing", "link.json", "folder"])
def test_no_symbolic_link_is_followed(tmp_path: Path, target: str) -> None:
    (tmp_path / "target.json").write_text("old")
    (tmp_path / "folder").mkdir()
    link = tmp_path / "link.json"
    link.symlink_to(target)
    with pytest.raises(InputError, match=r"link\.json: cannot be written: a symbolic link, expected a file of its own"):
        write_text(link, "new")
    assert link.is_symlink()
    assert (tmp_path / "target.json").read_text() == "old"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["folder", "link.json", "target.json"]


def test_a_link_in_a_folder_that_is_one_is_the_folders_affair(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "folder").symlink_to("real")
    write_text(tmp_path / "folder" / "a.json", "text")
    assert (tmp_path / "real" / "a.json").read_text() == "text"


def test_the_systems_names_of_a_descriptor_are_written_to(tmp_path: Path) -> None:
    with open(tmp_path / "out", "w") as file:
        write_text(Path(f"/dev/fd/{file.fileno()}"), "through")
    assert (tmp_path / "out").read_text() == "through"
    write_text(Path("/dev/null"), "away")


def test_a_new_file_is_gone_after_a_failure_and_never_replaces_one(tmp_path: Path) -> None:
    path = tmp_path / "new"
    with pytest.raises(TypeError), new_file(path) as file:
        file.write("half" + 1)  # type: ignore[operator]
    assert list(tmp_path.iterdir()) == []
    path.symlink_to("nothing")
    with pytest.raises(FileExistsError), new_file(path):
        pass


def test_a_pipe_or_a_device_is_not_replaced_by_a_file(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe.csv"
    os.mkfifo(pipe)
    with pytest.raises(OSError, match="no regular file"), new_beside(pipe):
        pass
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["pipe.csv"]


def test_a_name_that_is_taken_gets_the_next_number(tmp_path: Path) -> None:
    for name in ("a.mcap", "a-2.mcap"):
        (tmp_path / name).touch()
    assert unused(tmp_path / "a.mcap") == tmp_path / "a-3.mcap"
    assert unused(tmp_path / "b.mcap") == tmp_path / "b.mcap"
