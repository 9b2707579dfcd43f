"""A file is written whole or not at all, and never in the place of what is no file."""

from __future__ import annotations

import os
import stat
import threading
from pathlib import Path

import pytest

from triaxcald.errors import InputError
from triaxcald.files import write_text


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
    with pytest.raises(UnicodeEncodeError):
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
    reader.join(timeout=10)
    assert read == ["through"]


def test_a_full_device_is_an_error_of_one_line(tmp_path: Path) -> None:
    path = tmp_path / "full"
    path.symlink_to("/dev/full")
    with pytest.raises(InputError, match="full: cannot be written: No space left on device"):
        write_text(path, "text")
    assert path.is_symlink()


def test_a_link_stays_a_link_and_its_file_is_written(tmp_path: Path) -> None:
    target, link = tmp_path / "target.json", tmp_path / "link.json"
    target.write_text("old")
    link.symlink_to(target)
    write_text(link, "new")
    assert link.is_symlink()
    assert target.read_text() == "new"
