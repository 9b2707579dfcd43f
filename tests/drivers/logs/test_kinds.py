"""The kind of a log is told by its first bytes."""

from __future__ import annotations

import gzip
from pathlib import Path

import pytest

from triaxcal_drivers.errors import LogError
from triaxcal_drivers.logs.can_frames import Account
from triaxcal_drivers.logs.kinds import NAMES, Kind, kind_of, opened


@pytest.mark.parametrize(
    ("head", "name"),
    [
        (b"LOGG\x90\x00\x00\x00", "BLF"),
        (b"MDF     4.11    ", "MF4"),
        (b"UnFinMF 4.11    ", "MF4"),
        (b"\xd4\xc3\xb2\xa1\x02\x00", "pcap"),
        (b"\xa1\xb2\x3c\x4d\x00\x02", "pcap"),
        (b"\x0a\x0d\x0d\x0a\x1c\x00", "pcap"),
        (b"\x89MCAP0\r\n\x01", "MCAP"),
        (b"date Wed Nov 25 04:38:43.125 pm 2026\nbase hex  timestamps absolute\n", "ASC"),
        (b"// version 9.0.0\n", "ASC"),
        (b";$FILEVERSION=1.1\n", "TRC"),
        (b";" + b"#" * 74 + b"\n;   C:\\log.trc\n", "TRC"),
        (b"     1)     1841 0001 8 00 00 00 00 00 00 00 00\n", "TRC"),
        (b"(1436509052.249713) vcan0 044#2A366C2B\n", "candump"),
        (b"\n  vcan0  044   [4]  2A 36 6C 2B\n", "candump"),
        (b"\xef\xbb\xbf(1436509052.249713) vcan0 044#2A366C2B\n", "candump"),
        (b"t_s,ux,uy,uz\n0,1,2,3\n", None),
        (b"", None),
        (b"\x7fELF\x02\x01\x01", None),
    ],
)
def test_the_first_bytes_tell(head: bytes, name: str | None) -> None:
    found = kind_of(head)
    assert (found.name if isinstance(found, Kind) else found) == name


def test_what_is_no_log_is_refused_with_the_kinds_that_there_are(tmp_path: Path) -> None:
    path = tmp_path / "log.blf"
    path.write_text("t_s,ux,uy,uz\n")
    with pytest.raises(LogError, match=NAMES), opened(path):
        pass
    path.write_bytes(b"")
    with pytest.raises(LogError, match="the file is empty"), opened(path):
        pass
    with pytest.raises(LogError, match="cannot be read: No such file"), opened(tmp_path / "none"):
        pass


def test_a_packed_log_that_is_cut_short_gives_what_is_whole(tmp_path: Path) -> None:
    lines = "".join(f"({1436509052 + i}.000000) can0 123#{i:04X}\n" for i in range(20_000))
    data = gzip.compress(lines.encode())
    path = tmp_path / "log.gz"
    path.write_bytes(data[: len(data) // 2])
    account = Account()
    with opened(path) as log:
        frames = list(log.frames(account))
    assert 1000 < len(frames) < 20_000
    assert account.damaged


@pytest.mark.slow
def test_a_packed_file_of_nothing_ends(tmp_path: Path) -> None:
    path = tmp_path / "log.gz"
    path.write_bytes(gzip.compress(b"(1436509052.249713) vcan0 044#2A\n" + b"\n" * 2**26))
    with pytest.raises(LogError, match="unpacks to more than 64 times the file"), opened(path) as log:
        list(log.frames(Account()))
