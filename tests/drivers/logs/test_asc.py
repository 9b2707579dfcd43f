"""Lines of Vector's ASC, as CANoe and CANalyzer write them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from triaxcal_drivers.interface import RawFlag
from triaxcal_drivers.logs.asc import frames
from triaxcal_drivers.logs.can_frames import LoggedFrame, Remark
from triaxcal_drivers.logs.dates import date_ns, utc_ns

Read = Callable[..., tuple[list[LoggedFrame], Any]]
HEAD = "date Sat Sep 30 10:06:13.191 pm 2017\nbase hex  timestamps absolute\ninternal events logged\n// version 9.0.0\n"
START_NS = 1_506_809_173_191_000_000
FD = RawFlag.FD


@pytest.mark.parametrize(
    ("line", "source", "flags", "data"),
    [
        ("   2.500000 1  12D             Rx   d 8 01 02 03 04 05 06 07 08", 0x12D, 0, "0102030405060708"),
        ("   2.500000 1  12D             Tx   d 2 01 02  Length = 107000 BitCount = 56 ID = 301", 0x12D,
         RawFlag.SENT, "0102"),
        ("   2.500000 1  18EBFF00x       Rx   d 1 ff", 0x18EBFF00, RawFlag.EXTENDED_ID, "ff"),
        ("   2.500000 1  Engine_State    Rx   d 1 ff Length = 0 BitCount = 0 ID = 301", 301, 0, "ff"),
        ("   2.500000 1  EngineStateLong Rx   d 1 ff ID = 217997090x", 217997090, RawFlag.EXTENDED_ID, "ff"),
        ("   2.500000 1  300             Rx   r 8", 0x300, RawFlag.REMOTE, "00" * 8),
        ("   2.500000 1  300             TxRq r", 0x300, RawFlag.REMOTE | RawFlag.SENT, ""),
        ("   2.500000 1  ErrorFrame      ECC: 10100010", 0, RawFlag.ERROR, ""),
        ("   2.500000 CANFD 1 Rx  115  1 1 8 8 06 ff fc ff fc ff 00 00 95000 135 3000 0 0 0 0 0", 0x115,
         FD | RawFlag.BIT_RATE_SWITCH | RawFlag.REMOTE, "06fffcfffcff0000"),
        ("   2.500000 CANFD 1 Tx  18EBFF00x  Symbol_1  0 0 9 12 " + "0a " * 12 + " 130 0 1000 0 0 0 0 0", 0x18EBFF00,
         FD | RawFlag.SENT | RawFlag.EXTENDED_ID, "0a" * 12),
        ("   2.500000 CANFD 1 Rx  115  0 0 2 2 06 ff 95000 135 0 0 0 0 0 0", 0x115, 0, "06ff"),
        ("   2.500000 CANFD 1 Rx  ErrorFrame  Not Acknowledge error", 0, RawFlag.ERROR, ""),
    ],
)  # fmt: skip
def test_a_line_is_a_frame(read: Read, line: str, source: int, flags: int, data: str) -> None:
    (frame,), account = read(frames, f"{HEAD}{line}\n".encode())
    assert frame == LoggedFrame(START_NS + 2_500_000_000, source, int(flags), bytes.fromhex(data), "1")
    assert (account.damaged, account.others) == (0, {})
    assert account.remarks == {Remark.DATE_WITHOUT_ZONE}


def test_numbers_may_be_decimal(read: Read) -> None:
    head = HEAD.replace("base hex", "base dec")
    (frame,), _ = read(frames, f"{head}  0.0100 2  301  Rx   d 3 10 255 7\n".encode())
    assert (frame.source, frame.data, frame.channel) == (301, bytes([10, 255, 7]), "2")


def test_relative_times_are_added_up_over_all_events(read: Read) -> None:
    head = HEAD.replace("absolute", "relative")
    lines = "  0.010 1  12D  Rx d 0\n  0.020 1  Statistic: D 1 R 0\n  0.005 1  12D  Rx d 0\n"
    found, account = read(frames, (head + lines).encode())
    assert [(f.time_ns or 0) - START_NS for f in found] == [10_000_000, 35_000_000]
    assert Remark.TIMES_ADDED_UP in account.remarks
    assert account.others == {"event": 1}


BLOCK_2 = "End TriggerBlock\nBegin Triggerblock Sat Sep 30 10:06:18.191 pm 2017\n"  # 5 s later


@pytest.mark.parametrize(
    ("kind", "first", "second", "seconds"),
    [
        ("absolute", "4.990 5.000", "5.010 5.020", [4.99, 5.0, 5.01, 5.02]),  # one measurement
        ("absolute", "4.990 5.005", "5.001 5.010", [4.99, 5.005, 5.001, 5.01]),  # the same, out of step
        ("absolute", "4.980 4.990", "0.000 0.010", [4.98, 4.99, 5.0, 5.01]),  # one that was started again
        ("absolute", "0.980 0.990", "0.000 0.010", [0.98, 0.99, 5.0, 5.01]),  # and that after a pause
        ("absolute", "0.980 0.990", "5.001 5.010", [0.98, 0.99, 5.001, 5.01]),
        ("relative", "4.995 0.005", "0.005 0.010", [4.995, 5.0, 5.005, 5.015]),
        ("relative", "4.995 0.010", "0.000 0.010", [4.995, 5.005, 5.005, 5.015]),  # of a date a little early
        ("relative", "0.980 0.010", "0.000 0.010", [0.98, 0.99, 5.0, 5.01]),  # since the block's start
        ("relative", "0.980 0.010", "4.010 0.010", [0.98, 0.99, 5.0, 5.01]),  # since the event before
    ],
)
def test_a_later_block_goes_on_or_starts_again_as_its_date_says(
    read: Read, kind: str, first: str, second: str, seconds: list[float]
) -> None:
    block_1, block_2 = ("".join(f"  {t} 1  12D  Rx d 0\n" for t in times.split()) for times in (first, second))
    found, account = read(frames, (HEAD.replace("absolute", kind) + block_1 + BLOCK_2 + block_2).encode())
    assert [(f.time_ns or 0) - START_NS for f in found] == [round(s * 1000) * 1_000_000 for s in seconds]
    assert account.damaged == 0


def test_the_first_block_counts_from_its_own_date(read: Read) -> None:
    lines = BLOCK_2 + "  5.000 1  12D  Rx d 0\n"
    (frame,), _ = read(frames, (HEAD + lines).encode())
    assert frame.time_ns == START_NS + 10_000_000_000


def test_clocks_that_are_set_back_between_blocks_take_no_time_back(read: Read) -> None:
    lines = "  5.000 1  12D  Rx d 0\n" + BLOCK_2.replace("10:06:18", "09:06:18") + "  5.010 1  12D  Rx d 0\n"
    found, _ = read(frames, (HEAD + lines).encode())
    assert [(f.time_ns or 0) - START_NS for f in found] == [5_000_000_000, 5_010_000_000]


def test_without_a_date_times_count_from_zero(read: Read) -> None:
    (frame,), account = read(frames, b"base hex  timestamps absolute\n  1.000000 1  12D  Rx d 1 ff\n")
    assert frame.time_ns == 1_000_000_000
    assert account.remarks == {Remark.NO_DATE}


def test_a_german_date_is_one(read: Read) -> None:
    (frame,), _ = read(frames, "date Die M\xe4r 10 15:00:00 2020\n 0.5 1 1 Rx d 0\n".encode("cp1252"))
    assert frame.time_ns == 1_583_852_400_500_000_000


EVENING_NS = 1_715_883_410_884_000_000  # 2024-05-16 18:16:50.884 UTC


@pytest.mark.parametrize(
    "date",
    [
        "Thu May 16 06:16:50.884 pm 2024",
        "Thu May 16 06:16:50.884 PM 2024",
        "Thu May 16 18:16:50.884 2024",
        "Do Mai 16 06:16:50.884 nachm. 2024",
        "Do. Mai 16 18:16:50.884 2024",
        "Donnerstag Mai 16 18:16:50.884 2024",
        "Thu 16 May 2024 06:16:50.884 p.m.",
        "jeu. mai 16 18:16:50.884  2024",
        "jue may. 16 06:16:50.884 p. m. 2024",
        "gio mag 16 18:16:50.884 2024",
        "qui mai 16 18:16:50.884 2024",
        "do mei 16 06:16:50.884 p.m. 2024",
        "tor maj 16 06:16:50.884 em 2024",
        "czw maj 16 18:16:50.884 2024",
        "čt kvě 16 06:16:50.884 odp. 2024",
        "Per May 16 06:16:50.884 ÖS 2024",
        "to touko 16 06:16:50.884 ip. 2024",
        "Чт май 16 18:16:50.884 2024",
        "周四 5月 16 06:16:50.884 下午 2024",
        "木 5 16 06:16:50.884 午後 2024",
        "목 5월 16 06:16:50.884 오후 2024",
        "2024-05-16 18:16:50.884",
        "2024-05-16T18:16:50.884Z",
        "16.05.2024 18:16:50.884",
    ],
)
def test_dates_in_other_languages(read: Read, date: str) -> None:
    western = "cp1252" if date.encode("cp1252", "ignore").decode("cp1252") == date else "utf-8"
    for encoding in ("utf-8", western):
        head = f"date {date}\nbase hex  timestamps absolute\n".encode(encoding)
        (frame,), account = read(frames, head + b" 0.5 1 1 Rx d 0\n")
        assert frame.time_ns == EVENING_NS + 500_000_000
        assert account.remarks == {Remark.DATE_WITHOUT_ZONE}


@pytest.mark.parametrize(
    ("months", "number"),
    [
        ("Jan Januar janv. enero ene gennaio styczeń leden Ocak tammikuuta", 1),
        ("Feb févr. fev febbraio luty únor Şub helmi", 2),
        ("Mär Mrz März mars marzo mrt maart březen maalis", 3),
        ("June Juni juin giu czerwiec červen čvn Haziran kesä", 6),
        ("July juil. juillet lug lipiec červenec čvc Tem heinä", 7),
        ("août ago Ağu srpen sierpień elo", 8),
        ("Okt Oct ott out paź říj Ekim loka", 10),
        ("Dez déc. dic gru prosinec Aralık joulu des", 12),
    ],
)
def test_months_in_other_languages(months: str, number: int) -> None:
    for month in months.split():
        assert date_ns(f"xx {month} 10 15:00:00 2020") == utc_ns(2020, number, 10, 15, 0, 0), month


@pytest.mark.parametrize(
    "date",
    [
        "Thu Foo 16 06:16:50.884 pm 2024",
        "Thu May 16 06:16:50.884 xx 2024",
        "Thu May 32 06:16:50.884 pm 2024",
        "5/6/2024 6:16:50",
        "soon",
    ],
)
def test_a_date_that_is_not_understood_is_told_with_its_line(read: Read, date: str) -> None:
    lines = f"base hex  timestamps absolute\ndate {date}\n 0.5 1 1 Rx d 0\n"
    (frame,), account = read(frames, lines.encode())
    assert frame.time_ns == 500_000_000
    assert account.remarks == {Remark.DATE_NOT_UNDERSTOOD}
    assert account.unread_date == f"line 2: '{date}'"


def test_a_block_with_a_date_that_is_not_understood_goes_on(read: Read) -> None:
    lines = f"{HEAD}  1.0 1  12D  Rx d 0\nBegin Triggerblock Thu Foo 1 10:00:00 2017\n  1.5 1  12D  Rx d 0\n"
    found, account = read(frames, lines.encode())
    assert [(f.time_ns or 0) - START_NS for f in found] == [1_000_000_000, 1_500_000_000]
    assert account.remarks == {Remark.DATE_NOT_UNDERSTOOD, Remark.DATE_WITHOUT_ZONE}


@pytest.mark.parametrize("words", ["Start of measurement", "Start der Messung", "D\xe9but de la mesure", "测量开始"])
def test_the_start_of_a_measurement_is_no_event_in_any_language(read: Read, words: str) -> None:
    lines = (
        f"{HEAD}  0.000000 {words}\n  0.1 1  12D  Rx d 0\n  0.2 CAN 1 Status:chip status error active\n  0.3 Stopp\n"
    )
    _, account = read(frames, lines.encode())
    assert account.others == {"event": 2}


@pytest.mark.parametrize(
    "line",
    [
        "  1.0 1  12D  Rx d 8 01 02",
        "  1.0 1  12G  Rx d 1 01",
        "  1.0 1  800  Rx d 1 01",
        "  1.0 CANFD 1 Rx 115",
        "garbage",
    ],
)
def test_a_damaged_line_is_counted_with_its_place(read: Read, line: str) -> None:
    good = "  1.0 1  12D  Rx d 1 01\n"
    found, account = read(frames, f"{HEAD}{good}{line}\n{good}".encode())
    assert len(found) == 2
    assert account.damaged == 1
    assert account.damage.startswith("line 6: ")
