"""Files of whoever made them: nothing is waited for, nothing is read beyond a size or outside of a folder."""

import os
from pathlib import Path

import pytest

from triaxcal_drivers.files import inside, open_file, read_whole, size


def test_a_file_is_read_up_to_its_size_and_not_beyond(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"0123456789")
    assert read_whole(path, 10) == b"0123456789"
    with pytest.raises(OSError, match="larger than the 0 KiB") as caught:
        read_whole(path, 9)
    assert caught.value.strerror == "larger than the 0 KiB that such a file may have"


@pytest.mark.parametrize("pipe", [False, True])
@pytest.mark.parametrize("path", ["/dev/zero", "/dev/tty", "/dev"])
def test_a_device_or_a_folder_is_not_opened(path: str, pipe: bool) -> None:
    with pytest.raises(OSError, match=r"a device or a pipe|Is a directory|No such device or file") as caught:
        read_whole(Path(path), 10, pipe=pipe)
    assert caught.value.strerror


def test_a_pipe_is_read_only_where_the_user_named_it(tmp_path: Path) -> None:
    path = tmp_path / "pipe"
    os.mkfifo(path)
    with pytest.raises(OSError, match="a device or a pipe, expected a file"):
        read_whole(path, 10)
    with open_file(path, pipe=True) as file:  # nobody writes to it
        assert file.read() == b""


def test_what_a_pipe_holds_is_waited_for_while_there_is_a_writer() -> None:
    reading, writing = os.pipe()
    os.write(writing, b"first ")
    with open_file(Path(f"/dev/fd/{reading}"), pipe=True) as file:
        assert file.read(6) == b"first "
        os.write(writing, b"second")
        os.close(writing)
        assert file.read() == b"second"
    os.close(reading)


def test_a_name_with_a_nul_is_an_error_of_the_system(tmp_path: Path) -> None:
    for read in (lambda: read_whole(tmp_path / "a\0b", 1), lambda: inside(tmp_path, "a\0b")):
        with pytest.raises(OSError, match="no file has such a name"):
            read()


@pytest.mark.parametrize("name", ["../x", "/etc/passwd", "sub/../../x", "sub/../a", "link", "folder/x"])
def test_a_name_that_leads_out_of_the_folder_is_refused(tmp_path: Path, name: str) -> None:
    own = tmp_path / "own"
    own.mkdir()
    (own / "link").symlink_to("../x")
    (own / "folder").symlink_to("..")
    with pytest.raises(OSError, match="outside the profile's folder"):
        inside(own, name)


def test_a_link_within_the_folder_is_followed_also_where_the_folder_is_one(tmp_path: Path) -> None:
    own = tmp_path / "own"
    (own / "sub").mkdir(parents=True)
    (own / "sub" / "a").touch()
    (own / "b").symlink_to("sub/a")
    (tmp_path / "again").symlink_to("own")
    assert inside(tmp_path / "again", "b") == (own / "sub" / "a").resolve()


def test_a_size_is_told_in_its_unit() -> None:
    assert [size(2**24), size(2**18), size(512)] == ["16 MiB", "256 KiB", "0 KiB"]
