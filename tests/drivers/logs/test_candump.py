"""Lines as candump writes them with its options, by hand from its manual."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable
from itertools import accumulate
from typing import Any

import pytest

from triaxcal_drivers.interface import RawFlag
from triaxcal_drivers.logs.can_frames import LoggedFrame, Remark
from triaxcal_drivers.logs.candump import frames

Read = Callable[..., tuple[list[LoggedFrame], Any]]
T = 1436509052249713000


@pytest.mark.parametrize(
    ("line", "source", "flags", "data"),
    [
        ("(1436509052.249713) vcan0 044#2A366C2B", 0x44, 0, "2A366C2B"),
        ("(1436509052.249713) vcan0 044#2a366c2b R", 0x44, 0, "2A366C2B"),
        ("(1436509052.249713) vcan0 044# T", 0x44, RawFlag.SENT, ""),
        ("(1436509052.249713) vcan0 00000044#2A", 0x44, RawFlag.EXTENDED_ID, "2A"),
        ("(1436509052.249713) vcan0 18FF1234#R8", 0x18FF1234, RawFlag.EXTENDED_ID | RawFlag.REMOTE, "00" * 8),
        ("(1436509052.249713) vcan0 7FF#R", 0x7FF, RawFlag.REMOTE, ""),
        ("(1436509052.249713) vcan0 123##0AB", 0x123, RawFlag.FD, "AB"),
        ("(1436509052.249713) vcan0 123##3AB", 0x123, RawFlag.FD | RawFlag.BIT_RATE_SWITCH | RawFlag.REMOTE, "AB"),
        ("(1436509052.249713) vcan0 123##4" + "AB" * 64, 0x123, RawFlag.FD, "AB" * 64),
        ("(1436509052.249713) vcan0 123#0011223344556677_B", 0x123, 0, "0011223344556677"),
        ("(1436509052.249713) vcan0 20000080#0000000000000000", 0x80, RawFlag.ERROR, "00" * 8),
        (" (1436509052.249713)  vcan0  044   [4]  2A 36 6C 2B", 0x44, 0, "2A366C2B"),
        (" (1436509052.249713)  vcan0  RX - -  044   [4]  2A 36 6C 2B", 0x44, 0, "2A366C2B"),
        (" (1436509052.249713)  vcan0  TX B E  044  [04]  2A 36 6C 2B", 0x44,
         RawFlag.SENT | RawFlag.FD | RawFlag.BIT_RATE_SWITCH | RawFlag.REMOTE, "2A366C2B"),
        (" (1436509052.249713)  vcan0  044   [4]  2A 36 6C 2B   '*6l+'", 0x44, 0, "2A366C2B"),
        (" (1436509052.249713)  vcan0  044   [8]  remote request", 0x44, RawFlag.REMOTE, "00" * 8),
        (" (1436509052.249713)  vcan0  20000004   [8]  00 08 00 00 00 00 00 00   ERRORFRAME", 0x4, RawFlag.ERROR,
         "0008000000000000"),
        (" (2015-07-10 06:17:32.249713)  vcan0  044   [0]", 0x44, 0, ""),
    ],
)  # fmt: skip
def test_a_line_is_a_frame(read: Read, line: str, source: int, flags: int, data: str) -> None:
    (frame,), account = read(frames, f"{line}\n".encode())
    assert frame == LoggedFrame(T, source, int(flags), bytes.fromhex(data), "vcan0")
    assert account.damaged == 0


@pytest.mark.parametrize(
    "line",
    [
        "(1436509052.249713) vcan0 044#2A366C2",  # half an octet
        "(1436509052.249713) vcan0 0445#2A",
        "(1436509052.249713) vcan0 044#" + "00" * 9,
        "(1436509052) vcan0 044#00",
        " vcan0  044   [4]  2A 36 6C",
        "vcan0",
        "(1436509052.249713) vcan0 00242#81:00:12345678#112233",  # CAN XL
        "\x00" * 100,
    ],
)
def test_a_line_that_is_no_frame_is_counted_with_its_place_and_the_rest_is_read(read: Read, line: str) -> None:
    good = "(1436509052.249713) vcan0 044#2A\n"
    found, account = read(frames, f"{good}{line}\n{good}".encode())
    assert len(found) == 2
    assert (account.damaged, account.damage) == (1, "line 2: expected a frame as candump writes it")


def test_without_times_it_is_said(read: Read) -> None:
    found, account = read(frames, b"  can0  123   [2]  11 22\n  can0  124   [2]  11 22\n")
    assert [f.time_ns for f in found] == [None, None]
    assert account.remarks == {Remark.NO_TIMES}


def test_times_from_zero_and_times_between_lines_are_told_apart(read: Read) -> None:
    def lines(*times: str) -> bytes:
        return "".join(f" ({t})  can0  123   [2]  11 22\n" for t in times).encode()

    found, account = read(frames, lines("000.000000", "000.010000", "000.021000"))
    assert [f.time_ns for f in found] == [0, 10_000_000, 21_000_000]
    assert account.remarks == {Remark.NO_DATE}
    found, account = read(frames, lines("000.000000", "000.010000", "000.009000"))
    assert [f.time_ns for f in found] == [0, 10_000_000, 19_000_000]
    assert account.remarks == {Remark.NO_DATE, Remark.TIMES_ADDED_UP}


def shown(times_ns: Iterable[int]) -> bytes:
    return "".join(f" ({t // 10**9:03d}.{t // 1000 % 10**6:06d})  can0  123   [2]  11 22\n" for t in times_ns).encode()


def test_a_line_that_goes_back_makes_no_log_of_differences(read: Read) -> None:
    given = [i * 5_000_000 for i in range(400)]
    given[200] -= 6_000_000
    found, account = read(frames, shown(given))
    assert [f.time_ns for f in found] == given
    assert account.remarks == {Remark.NO_DATE}


def test_channels_out_of_step_and_logs_joined_are_no_differences(read: Read) -> None:
    dice = random.Random(3)
    for given in (
        [i * 1_000_000 + dice.randrange(3) * 1_000_000 for i in range(1200)],
        [i % 300 * 5_000_000 for i in range(900)],
        [i // 10 * 10_000_000 for i in range(1200)],
    ):
        found, account = read(frames, shown(given))
        assert [f.time_ns for f in found] == given
        assert account.remarks == {Remark.NO_DATE}


def test_differences_are_told_by_their_having_no_trend(read: Read) -> None:
    dice = random.Random(4)
    for steps in (
        [5_000_000] * 400,
        [5_000_000] * 500 + [6_000_000] * 500,
        [round(dice.gauss(5_000, 300)) * 1000 for _ in range(1200)],
        [round(dice.expovariate(0.0002)) * 1000 for _ in range(1200)],
        [100_000 * (1 + i % 10) for i in range(1200)],
        [5_000_000] * 300 + [3_000_000_000] + [5_000_000] * 10,
    ):
        found, account = read(frames, shown([0, *steps]))
        assert [f.time_ns for f in found] == list(accumulate([0, *steps]))
        assert account.remarks == {Remark.NO_DATE, Remark.TIMES_ADDED_UP}


@pytest.mark.parametrize("place", [0, 1, 1500, 2999])
def test_a_line_without_a_time_is_damage_wherever_it_stands(read: Read, place: int) -> None:
    lines = [f" (1790000000.{i:06d})  can0  101   [1]  74\n" for i in range(2999)]
    lines.insert(place, "  can0  101   [1]  75\n")
    found, account = read(frames, "".join(lines).encode())
    assert [f.time_ns for f in found] == [1_790_000_000_000_000_000 + i * 1000 for i in range(2999)]
    assert (account.damaged, account.damage) == (
        1,
        f"line {place + 1}: a frame without a time, in a log that has times",
    )
    assert account.remarks == set()


def test_lines_without_times_before_the_first_that_has_one_are_damage_in_order(read: Read) -> None:
    untimed, timed = "  can0  101   [1]  75\n", " (1790000000.000001)  can0  101   [1]  74\n"
    found, account = read(frames, (untimed * 1500 + "garbage\n" + timed * 2).encode())
    assert (len(found), account.damaged, account.damage[:7]) == (2, 1501, "line 1:")
    assert account.remarks == set()


def test_a_log_of_more_lines_without_times_than_are_held_has_none(read: Read, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("triaxcal_drivers.logs.can_frames.UNTIMED_MOST", 10)
    untimed, timed = "  can0  101   [1]  75\n", " (1790000000.000001)  can0  101   [1]  74\n"
    found, account = read(frames, (untimed * 12 + timed).encode())
    assert [f.time_ns for f in found] == [None] * 13
    assert account.remarks == {Remark.NO_TIMES}


def test_a_byte_order_mark_costs_no_line(read: Read) -> None:
    found, account = read(frames, b"\xef\xbb\xbf(1436509052.249713) vcan0 044#2A\n")
    assert ([f.time_ns for f in found], account.damaged) == ([T], 0)


def test_a_line_without_an_end_takes_no_memory(read: Read) -> None:
    good = b"(1436509052.249713) vcan0 044#2A\n"
    found, account = read(frames, good + b"(" * 3_000_000 + b"\n" + good)
    assert len(found) == 2
    assert account.damage == "line 2: more than 4096 bytes"
