"""Files that somebody else may have made, and what a file is by its first bytes."""

from __future__ import annotations

import gzip
import io
import os
import zipfile
from pathlib import Path

import numpy as np
import pytest

from triaxcal_drivers.files import converter, document_kind, inside, kind, open_file, read_whole, size, special_kind


def _zipped(name: str = "a") -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        archive.writestr(name, "b")
    return out.getvalue()


def _array() -> bytes:
    out = io.BytesIO()
    np.save(out, np.zeros(3))
    return out.getvalue()


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (bytes.fromhex("89 4d 43 41 50 30 0d 0a 01"), "an MCAP file"),
        (gzip.compress(b"t_s,ux,uy,uz\n", mtime=0), "a gzip file"),
        (bytes.fromhex("50 41 52 31 15 04 15 00"), "a Parquet file"),
        (_zipped(), "a ZIP file, as spreadsheets are"),
        (_array(), "a NumPy file"),
        (_zipped("log.bin"), "an ActiGraph file (.gt3x)"),
        (_zipped("activity.bin"), "an ActiGraph file (.gt3x)"),
        (b"MD\xfc\x03" + bytes(1020), "an Axivity file (.cwa)"),
        (b"Device Identity\r\nDevice Unique Serial Code:012967\r\n", "a GENEActiv file (.bin)"),
        (b"SQLite format 3\0" + bytes(100), "an SQLite database, as ActiLife's .agd with counts of epochs"),
        (b'{"format": "triaxcal.calibration/1"}', "a JSON document of format triaxcal.calibration/1"),
        (b'\xef\xbb\xbf {\n "format" : "triaxcal.loop/1",', "a JSON document of format triaxcal.loop/1"),
        (b'{"result": {"format": "triaxcal.loop/1"}}', "a JSON document"),
        (b'{"format": "\x1b[31m/1"}', "a JSON document"),
        (b'[{"a": 1}]', "a JSON document"),
        (b'# A station.\nname = "x"\nformat = "triaxcal.station/1"\n', "a TOML file of format triaxcal.station/1"),
        (b"format='triaxcal.device/1'", "a TOML file of format triaxcal.device/1"),
        (b'[[units]]\nformat = "triaxcal.device/1"\n', "text"),
        (b"PAR1 = 1\nMDF = 2", "text"),
        (b"LOGGER,ux,uy,uz\n", "text"),
        ("temperature [°C]\n".encode() * 1000, "text"),
        (b"\xc2" + b"\xb0\xc2" * 5000, "text"),
        (b"\0\1\2", "a binary file of no known kind"),
        (b"\xff\xfe", "a binary file of no known kind"),
        (b"", "an empty file"),
    ],
)
def test_a_file_is_named_by_its_first_bytes(data: bytes, expected: str) -> None:
    assert kind(data) == expected
    special = expected.startswith("a") and "binary" not in expected and "empty" not in expected
    assert special_kind(data) == (expected if special else None)
    assert document_kind(data) == (expected if " of format " in expected else None)


@pytest.mark.parametrize(
    ("data", "package"),
    [
        (b"MD\xfc\x03" + bytes(1020), "actipy"),
        (b"Device Identity\nDevice Type:GENEActiv\n", "actipy"),
        (_zipped("log.bin"), "pygt3x"),
        (_zipped(), ""),
        (b"MD5 sums\n", ""),
        (b"Device Identity,x,y,z\n", ""),
    ],
)
def test_a_file_of_a_wearable_is_told_its_converter(data: bytes, package: str) -> None:
    assert package in converter(data)
    assert bool(converter(data)) == bool(package)


def test_a_reader_of_json_is_told_of_no_json_and_one_of_toml_of_no_toml() -> None:
    document, table = b'{"format": "triaxcal.plan/1"}', b'format = "triaxcal.device/1"'
    assert special_kind(document, json=False) is None
    assert special_kind(table, toml=False) is None
    assert special_kind(document, toml=False) == kind(document)
    assert special_kind(table, json=False) == kind(table)


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
