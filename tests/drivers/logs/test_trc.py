"""Lines of PEAK's TRC by its description of the format, one of each version."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from triaxcal_drivers.interface import RawFlag
from triaxcal_drivers.logs.can_frames import LoggedFrame, Remark
from triaxcal_drivers.logs.trc import frames

Read = Callable[..., tuple[list[LoggedFrame], Any]]
DAY = ";$STARTTIME=43008.5\n"  # 2017-09-30 12:00
NOON_NS = 1_506_772_800_000_000_000
V = {
    "1.1": ";$FILEVERSION=1.1\n" + DAY,
    "1.2": ";$FILEVERSION=1.2\n" + DAY,
    "1.3": ";$FILEVERSION=1.3\n" + DAY,
    "2.0": ";$FILEVERSION=2.0\n" + DAY + ";$COLUMNS=N,O,T,I,d,l,D\n",
    "2.1": ";$FILEVERSION=2.1\n" + DAY + ";$COLUMNS=N,O,T,B,I,d,R,L,D\n",
}
SENT, FD, BRS, EXT, REMOTE = RawFlag.SENT, RawFlag.FD, RawFlag.BIT_RATE_SWITCH, RawFlag.EXTENDED_ID, RawFlag.REMOTE


@pytest.mark.parametrize(
    ("version", "line", "source", "flags", "data", "channel"),
    [
        ("1.1", "     1)      1059.9  Rx         0300  3  01 02 03", 0x300, 0, "010203", "1"),
        ("1.1", "     1)      1059.9  Tx     0018EEFF  8  RTR", 0x18EEFF, EXT | SENT | REMOTE, "00" * 8, "1"),
        ("1.2", "     1)      1059.900 2  Rx     0300  3  01 02 03", 0x300, 0, "010203", "2"),
        ("1.3", "     1)      1059.900 2  Rx     0300 -  3  01 02 03", 0x300, 0, "010203", "2"),
        ("2.0", "     1      1059.900 DT     0300 Rx 3    01 02 03", 0x300, 0, "010203", "1"),
        ("2.0", "     1      1059.900 FB     0300 Tx 12   " + "0A " * 12, 0x300, FD | BRS | SENT, "0A" * 12, "1"),
        ("2.0", "     1      1059.900 RR     0300 Rx 4", 0x300, REMOTE, "00" * 4, "1"),
        ("2.1", "     1      1059.900 BI 1  18EBFF00 Rx -  9    " + "0A " * 12, 0x18EBFF00, FD | REMOTE | EXT,
         "0A" * 12, "1"),
        ("2.1", "     1      1059.900 ER 1         - Rx -  5    04 00 02 00 00", 0, RawFlag.ERROR, "", "1"),
    ],
)  # fmt: skip
def test_a_line_is_a_frame(
    read: Read, version: str, line: str, source: int, flags: int, data: str, channel: str
) -> None:
    (frame,), account = read(frames, f"{V[version]}{line}\n".encode())
    assert frame == LoggedFrame(NOON_NS + 1_059_900_000, source, int(flags), bytes.fromhex(data), channel)
    assert account.damaged == 0
    assert account.remarks == {Remark.DATE_WITHOUT_ZONE}


def test_version_1_0_has_no_head_and_no_date(read: Read) -> None:
    found, account = read(frames, b"     1)     1841 0001 2 00 11\n     2)     1851 FFFFFFFF 4 00 00 00 04 status\n")
    assert found == [LoggedFrame(1_841_000_000, 1, 0, b"\x00\x11", "1")]
    assert account.remarks == {Remark.NO_DATE}
    assert account.others == {"status": 1}


@pytest.mark.parametrize(
    "line", ["     1)      1059.9  Rx  0300  3  01 02", "     1)  x  Rx  0300  3  01 02 03", "what"]
)
def test_a_damaged_line_is_counted_with_its_place(read: Read, line: str) -> None:
    good = "     1)      1059.9  Rx  0300  1  01\n"
    found, account = read(frames, f"{V['1.1']}{good}{line}\n{good}".encode())
    assert len(found) == 2
    assert (account.damaged, account.damage) == (1, "line 4: expected a message of the columns N,O,d,I,l,D")
