"""BLF by literal bytes, where python-can's writer makes none of it, and what is bounded."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from typing import Any

import pytest

from triaxcal_drivers.interface import RawFlag
from triaxcal_drivers.logs.blf import frames
from triaxcal_drivers.logs.can_frames import LoggedFrame, Remark

Read = Callable[..., tuple[list[LoggedFrame], Any]]
START = (2017, 9, 6, 30, 12, 0, 0, 500)  # 2017-09-30 12:00:00.5
START_NS = 1_506_772_800_500_000_000


def head(start: tuple[int, ...] = START) -> bytes:
    return b"LOGG" + struct.pack("<I", 144) + bytes(32) + struct.pack("<8H", *start) + bytes(88)


def thing(kind: int, body: bytes, *, ticks: int = 7, unit: int = 2, version: int = 1) -> bytes:
    size = 16 if version == 1 else 24
    body = struct.pack("<IHHQ", unit, 0, 0, ticks) + bytes(size - 16) + body
    return b"LOBJ" + struct.pack("<HHII", 16 + size, version, 16 + len(body), kind) + body


def container(data: bytes, *, method: int = 2, size: int | None = None) -> bytes:
    packed = zlib.compress(data) if method == 2 else data
    body = struct.pack("<H6xI4x", method, len(data) if size is None else size) + packed
    whole = b"LOBJ" + struct.pack("<HHII", 16, 1, 16 + len(body), 10) + body
    return whole + bytes(len(whole) % 4)


CLASSIC = struct.pack("<HBBI", 2, 0, 3, 0x123) + b"\1\2\3" + bytes(5)
FD_64 = (
    struct.pack("<BBBxIIIIIIIHBBI", 1, 9, 12, 0x98EEFF03, 0, 0x3000, 0, 0, 0, 0, 0, 0, 0, 0) + bytes(range(12))
)  # fmt: skip


@pytest.mark.parametrize("method", [0, 2])
def test_objects_in_a_container(read: Read, method: int) -> None:
    found, account = read(frames, head() + container(thing(1, CLASSIC) + thing(101, FD_64, ticks=9), method=method))
    assert found == [
        LoggedFrame(START_NS + 7, 0x123, 0, b"\1\2\3", "2"),
        LoggedFrame(
            START_NS + 9, 0x18EEFF03, int(RawFlag.EXTENDED_ID | RawFlag.FD | RawFlag.BIT_RATE_SWITCH),
            bytes(range(12)), "1",
        ),
    ]  # fmt: skip
    assert account.damaged == 0


def test_times_may_be_tens_of_microseconds_and_headers_of_version_2(read: Read) -> None:
    found, _ = read(frames, head() + container(thing(86, CLASSIC, unit=1) + thing(1, CLASSIC, version=2)))
    assert [f.time_ns for f in found] == [START_NS + 70_000, START_NS + 7]


def test_an_object_may_begin_in_one_container_and_end_in_the_next(read: Read) -> None:
    row = b"".join(thing(1, CLASSIC, ticks=i) for i in range(10))
    for cut in range(1, len(row)):
        found, account = read(frames, head() + container(row[:cut]) + container(row[cut:]))
        assert [f.time_ns for f in found] == [START_NS + i for i in range(10)]
        assert account.damaged == 0


def test_objects_may_stand_without_a_container(read: Read) -> None:
    found, account = read(frames, head() + thing(1, CLASSIC) + thing(1, CLASSIC))
    assert (len(found), account.damaged) == (2, 0)


def test_errors_and_other_objects(read: Read) -> None:
    found, account = read(frames, head() + container(thing(73, bytes(40)) + thing(65, bytes(40)) + thing(1, CLASSIC)))
    assert [f.flags for f in found] == [RawFlag.ERROR, 0]
    assert account.others == {"BLF object 65": 1}


def test_a_date_tells_no_zone(read: Read) -> None:
    _, account = read(frames, head() + container(thing(1, CLASSIC)))
    assert account.remarks == {Remark.DATE_WITHOUT_ZONE}


@pytest.mark.parametrize("start", [(0,) * 8, (2017, 2, 4, 31, 12, 0, 0, 0), (2017, 9, 6, 30, 65535, 0, 0, 0)])
def test_without_a_date_in_the_calendar_it_is_said(read: Read, start: tuple[int, ...]) -> None:
    (frame,), account = read(frames, head(start) + container(thing(1, CLASSIC)))
    assert frame.time_ns == 7
    assert account.remarks == {Remark.DATE_NOT_UNDERSTOOD if any(start) else Remark.NO_DATE}


def test_after_damage_in_a_container_the_next_object_is_found(read: Read) -> None:
    row = thing(1, CLASSIC) + b"what is this?!!!" + thing(1, CLASSIC)
    found, account = read(frames, head() + container(row))
    assert (len(found), account.damaged) == (2, 1)
    assert account.damage == "byte 144: bytes in a container that are no object"


def test_a_container_that_cannot_be_unpacked_hides_no_other(read: Read) -> None:
    bad = bytearray(container(thing(1, CLASSIC) * 20))
    bad[40] ^= 0xFF
    found, account = read(frames, head() + bytes(bad) + container(thing(1, CLASSIC)))
    assert len(found) >= 1
    assert account.damaged >= 1


def test_a_container_takes_no_more_memory_than_it_says(read: Read) -> None:
    bomb = struct.pack("<H6xI4x", 2, 2**31) + zlib.compress(bytes(2**20))
    whole = b"LOBJ" + struct.pack("<HHII", 16, 1, 16 + len(bomb), 10) + bomb
    found, account = read(frames, head() + whole)
    assert found == []
    assert "a container of 2147483648 bytes by method 2" in account.damage


def test_many_containers_of_nothing_end(read: Read) -> None:
    zeros = container(bytes(2**24))
    found, account = read(frames, head() + zeros * 200)
    assert found == []
    assert account.damaged < 10
