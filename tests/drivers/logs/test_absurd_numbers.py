"""Numbers that no log has: each is damage in its place, or a refusal, and what is read is within bounds."""

from __future__ import annotations

import random
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from triaxcal_drivers.logs import asc, blf, candump, pcap, trc
from triaxcal_drivers.logs.can_frames import (
    EXTENDED_MOST,
    FD_MOST,
    LoggedFrame,
    Remark,
    whole,
)
from triaxcal_drivers.logs.dates import LONGEST_NS, date_ns, utc_ns
from triaxcal_drivers.logs.mf4 import _times_ns

Read = Callable[..., tuple[list[LoggedFrame], Any]]
ASC = b"""date Wed Nov 25 04:38:43.000 pm 2026
base dec  timestamps absolute
internal events logged
Begin Triggerblock Wed Nov 25 04:38:43.000 pm 2026
   0.100000 1  257             Rx   d 8 00 01 02 03 04 05 06 07
   0.110000 1  300             Rx   r 8
   0.120000 CANFD 1 Rx  115  1 1 8 8 06 00 00 00 00 00 00 00 95000 135 3000 0 0 0 0 0
   0.130000 1  ErrorFrame
"""
TRC = b""";$FILEVERSION=2.1
;$STARTTIME=46348.9
;$COLUMNS=N,O,T,B,I,d,R,L,D
      1         1.000 DT 1      0101 Rx -  8    00 01 02 03 04 05 06 07
      2         2.000 FB 1  18EBFF00 Rx -  9    0A 0A 0A 0A 0A 0A 0A 0A 0A 0A 0A 0A
      3         3.000 RR 1      0101 Rx -  8
"""
TRC_1 = b""";$FILEVERSION=1.1
;$STARTTIME=46348.9
     1)         1.0  Rx         0101  8  00 01 02 03 04 05 06 07
     2)         2.0  Rx         0101  2  00 01
"""
CANDUMP = b"""(1790000000.000426) can0 101#740AADE6C84B0000
 (1790000000.100426)  can0  101   [8]  00 01 02 03 04 05 06 07
 (2026-11-25 06:17:32.249713)  can0  101   [2]  00 01
 (000.100000)  can0  RX - -  101  [02]  00 01
"""
TOKENS = [
    *("0", "-1", "+1", "1_0", "0x10", "F", "99", "0000", "999999999999", "FFFFFFFF", "9" * 401, "9" * 4090),
    *("NaN", "-NaN", "sNaN", "Infinity", "-inf", "1E999999", "1E5000", "1e999", "-5.5", "\xb2", "\u0663"),
    *("0000-00-00", "9999-99-99", "12:00", "Feb", "31", "dec", "hex", "relative", "Rx", "d", "r", "R", ".", "#", ";"),
]


@pytest.mark.parametrize(
    ("reader", "text"),
    [
        (asc.frames, ASC),
        (asc.frames, ASC.replace(b"dec", b"hex")),
        (trc.frames, TRC),
        (trc.frames, TRC_1),
        (candump.frames, CANDUMP),
    ],
)
def test_any_word_may_stand_in_any_place_of_a_text(read: Read, reader: Any, text: bytes) -> None:
    places = [m.span() for m in re.finditer(rb"[^\s=#:.]+", text)]
    for start, end in places:
        for token in TOKENS:
            within_bounds(*read(reader, text[:start] + token.encode("utf-8") + text[end:]))
    dice = random.Random(7)
    for _ in range(1000):
        damaged = text
        for start, end in sorted(dice.sample(places, 4), reverse=True):
            damaged = damaged[:start] + dice.choice(TOKENS).encode("cp1252", "ignore") + damaged[end:]
        within_bounds(*read(reader, damaged))


@pytest.mark.parametrize("reader", [blf.frames, pcap.frames])
def test_any_byte_may_stand_in_any_place_of_a_head(read: Read, reader: Any) -> None:
    dice = random.Random(8)
    whole_file = {
        blf.frames: b"LOGG" + (144).to_bytes(4, "little") + bytes(136),
        pcap.frames: bytes.fromhex("a1b2c3d4 00020004 00000000 00000000 00040000 000000e3")
        + bytes.fromhex("6553f100 0001e240 00000010 00000010 00000123 03000000 0102030000000000"),
    }[reader]
    for _ in range(1000):
        damaged = bytearray(whole_file)
        for _ in range(6):
            damaged[dice.randrange(4, len(damaged))] = dice.choice((0, 1, 127, 128, 255, dice.randrange(256)))
        within_bounds(*read(reader, bytes(damaged)))


def within_bounds(found: list[LoggedFrame], account: Any) -> None:
    for frame in found:
        assert frame.time_ns is None or 0 <= frame.time_ns < 2**80  # a time that can be shown; judged by whom it is for
        assert 0 <= frame.source <= EXTENDED_MOST
        assert len(frame.data) <= FD_MOST
    assert bool(account.damaged) == bool(account.damage)
    assert "\n" not in account.damage


@pytest.mark.parametrize("offset", ["Infinity", "NaN", "1E999999", "1E5000", "-1.0", "1_0.0", "9" * 40])
def test_a_line_with_such_a_time_is_damage(read: Read, offset: str) -> None:
    found, account = read(trc.frames, TRC.replace(b"2.000", offset.encode()))
    assert [f.source for f in found] == [0x101, 0x101]
    assert (account.damaged, account.damage[:8]) == (1, "line 5: ")


@pytest.mark.parametrize("identifier", [b"  -1", b"0x10", b"1_00", b"+101"])
def test_an_identifier_is_digits(read: Read, identifier: bytes) -> None:
    found, account = read(trc.frames, TRC_1.replace(b"0101", identifier, 1))
    assert (len(found), account.damaged) == (1, 1)


@pytest.mark.parametrize("start", [b"NaN", b"Infinity", b"1E999999", b"-3", b"999999"])
def test_a_start_that_is_no_day_is_not_understood(read: Read, start: bytes) -> None:
    found, account = read(trc.frames, TRC.replace(b"46348.9", start))
    assert found[0].time_ns == 1_000_000
    assert account.remarks == {Remark.DATE_NOT_UNDERSTOOD}
    assert account.unread_date.endswith(f": '{start.decode()}'")


def test_a_date_that_is_in_no_calendar_is_none() -> None:
    assert utc_ns(2024, 2, 29, 0, 0, 0) == 1_709_164_800_000_000_000
    for moment in (
        (0, 1, 1, 0),
        (2023, 2, 29, 0),
        (2026, 13, 1, 0),
        (2026, 1, 1, 24),
        (1969, 12, 31, 23),
        (2200, 1, 1, 0),
    ):
        assert utc_ns(*moment, 0, 0) is None
    assert date_ns("Wed Nov 25 04:38:43.000 pm 0000") is None
    assert date_ns("Sun Feb 30 04:38:43 2025") is None


@pytest.mark.parametrize("day", ["0000-01-01", "2026-02-30", "2026-13-01", "9999-01-01"])
def test_a_line_with_such_a_date_is_damage(read: Read, day: str) -> None:
    lines = f" (2026-11-25 06:17:32.2)  can0  101   [0]\n ({day} 06:17:32.3)  can0  101   [0]\n"
    found, account = read(candump.frames, lines.encode())
    assert (len(found), account.damage) == (1, "line 2: expected a frame as candump writes it")


def test_a_length_of_a_decimal_log_is_decimal(read: Read) -> None:
    found, account = read(asc.frames, ASC.replace(b"d 8", b"d F"))
    assert len(found) == 3
    assert account.damage == "line 5: a length of 'F', expected a decimal one"


def test_times_of_an_mf4_that_are_no_numbers_are_no_times() -> None:
    seconds = np.array([0.5, np.nan, np.inf, -np.inf, 1e300])
    with np.errstate(all="raise"):
        assert _times_ns(10**18, seconds).tolist() == [10**18 + 500_000_000, -1, -1, -1, -1]
    assert LONGEST_NS > 10**18


@pytest.mark.parametrize("text", ["-1", "+1", "1_0", " 1", "", "0x10", "\u0663", "G"])
def test_a_whole_number_is_its_digits(text: str) -> None:
    with pytest.raises(ValueError):
        whole(text, 16)
    assert (whole("1F", 16), whole(b"19")) == (31, 19)
