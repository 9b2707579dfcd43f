"""Frames by the literal bytes that a raw CAN socket gives, with its ancillary data; written for little-endian
machines, since the kernel writes in the machine's order."""

from __future__ import annotations

import sys

import pytest

from triaxcal_drivers.can.adapter import Frame
from triaxcal_drivers.can.socketcan import Reception, bytes_of, filters_of
from triaxcal_drivers.interface import RawFlag

pytestmark = pytest.mark.skipif(sys.byteorder != "little", reason="the bytes are of a little-endian machine")

SOCKET = 1  # SOL_SOCKET
STAMP = (SOCKET, 64, bytes.fromhex("00F1536500000000 15CD5B0700000000"))
STAMP_NS = 1_700_000_000_123_456_789
MINUTE_NS = 60_000_000_000


def lost(count: int) -> tuple[int, int, bytes]:
    return SOCKET, 40, count.to_bytes(4, "little")


def frame(raw: str, *ancillary: tuple[int, int, bytes], flags: int = 0) -> Frame:
    return Reception(lambda: 5).frame(bytes.fromhex(raw), ancillary, flags)


@pytest.mark.parametrize(
    ("raw", "expected"),
    [
        ("23010000 02 000000 AABB000000000000", (0x123, 0, "AABB")),
        ("F0DECB9A 08 000000 0102030405060708", (0x1ACBDEF0, RawFlag.EXTENDED_ID, "0102030405060708")),
        ("23010040 04 000000 0000000000000000", (0x123, RawFlag.REMOTE, "00000000")),
        ("F0DECBDA 00 000000 0000000000000000", (0x1ACBDEF0, RawFlag.EXTENDED_ID | RawFlag.REMOTE, "")),
        ("44000020 08 000000 0010000000000000", (0x44, RawFlag.ERROR, "0010000000000000")),
    ],
)
def test_classic_frames(raw: str, expected: tuple[int, int, str]) -> None:
    source, flags, data = expected
    assert frame(raw, STAMP) == (STAMP_NS, source, flags, bytes.fromhex(data), 0)


@pytest.mark.parametrize(
    ("fd_flags", "flags"),
    [
        ("00", RawFlag.FD),
        ("01", RawFlag.FD | RawFlag.BIT_RATE_SWITCH),
        ("02", RawFlag.FD | RawFlag.REMOTE),
        ("07", RawFlag.FD | RawFlag.BIT_RATE_SWITCH | RawFlag.REMOTE),
    ],
)
def test_can_fd_frames(fd_flags: str, flags: int) -> None:
    raw = "23010000 0C" + fd_flags + "0000" + "000102030405060708090A0B" + "00" * 52
    assert frame(raw, STAMP) == (STAMP_NS, 0x123, flags, bytes(range(12)), 0)


@pytest.mark.parametrize("message_flags", [0x04, 0x804])
def test_frames_of_this_host_are_flagged(message_flags: int) -> None:
    assert frame("23010000 00 000000 0000000000000000", flags=message_flags).flags == RawFlag.SENT


def test_stamps_of_all_kinds_are_read_and_the_hosts_time_taken_where_there_is_none() -> None:
    empty = "23010000 00 000000 0000000000000000"
    nothing = bytes(16)
    assert frame(empty).time_ns == 5
    assert frame(empty, (SOCKET, 35, STAMP[2])).time_ns == STAMP_NS
    assert frame(empty, (SOCKET, 65, STAMP[2] + nothing + nothing)).time_ns == STAMP_NS
    assert frame(empty, (SOCKET, 37, STAMP[2] + nothing + nothing)).time_ns == STAMP_NS


def test_an_adapters_clock_is_laid_on_the_hosts() -> None:
    reception = Reception()

    def time_ns(kernel_ns: int, hardware_ns: int) -> int:
        stamps = [divmod(ns, 1_000_000_000) for ns in (kernel_ns, 0, hardware_ns)]
        value = b"".join(part.to_bytes(8, "little") for stamp in stamps for part in stamp)
        return reception.frame(bytes(16), [(SOCKET, 65, value)], 0).time_ns

    assert time_ns(MINUTE_NS + 300, 1000) == MINUTE_NS + 300
    assert time_ns(MINUTE_NS + 2100, 3000) == MINUTE_NS + 2100
    assert time_ns(MINUTE_NS + 9000, 4000) == MINUTE_NS + 3100


def test_each_loss_is_told_once_by_the_frame_after_it() -> None:
    reception = Reception()
    raw = bytes.fromhex("23010000 00 000000 0000000000000000")
    told = [reception.frame(raw, given, 0) for given in ([], [lost(3)], [lost(3)], [lost(10)])]
    assert [f.lost for f in told] == [0, 3, 0, 7]
    assert [f.flags for f in told] == [0, RawFlag.LOST_BEFORE, 0, RawFlag.LOST_BEFORE]
    assert reception.missed(10) == 0
    assert reception.missed(14) == 4


def test_a_count_that_begins_anew_goes_on() -> None:
    reception = Reception()
    raw = bytes(16)
    assert reception.frame(raw, [lost(0xFFFF_FFFE)], 0).lost == 0xFFFF_FFFE
    assert reception.frame(raw, [lost(3)], 0).lost == 5
    assert reception.missed(2) == 0xFFFF_FFFF


def test_a_frame_to_be_sent_has_the_bytes_of_the_kernels_structure() -> None:
    assert bytes_of(0x123, b"\xaa\xbb", extended=False, fd=False) == bytes.fromhex("23010000 02000000 AABB000000000000")
    assert bytes_of(0x1ACBDEF0, b"", extended=True, fd=True) == bytes.fromhex("F0DECB9A 00000000 0000000000000000")
    assert bytes_of(0x7FF, bytes(12), extended=False, fd=True) == bytes.fromhex("FF070000 0C000000" + "00" * 64)


@pytest.mark.parametrize(
    ("identifier", "data", "extended", "message"),
    [
        (0x800, b"", False, "identifier 0x800: expected at most 0x7FF"),
        (0x2000_0000, b"", True, "identifier 0x20000000: expected at most 0x1FFFFFFF"),
        (0x1, bytes(9), False, "9 bytes of data: no length without CAN FD, which has up to 8"),
    ],
)
def test_what_no_frame_can_hold_is_refused(identifier: int, data: bytes, extended: bool, message: str) -> None:
    with pytest.raises(ValueError) as e:
        bytes_of(identifier, data, extended=extended, fd=False)
    assert str(e.value) == message


def test_filters_match_data_and_remote_frames_of_one_kind_of_identifier() -> None:
    assert filters_of([(0x1ACBDEF0, True), (0x123, False)]) == bytes.fromhex(
        "23010000 FF070080"  # whatever the remote bit is
        "F0DECB9A FFFFFF9F"
    )
    assert filters_of([]) == b""
    assert filters_of(None) == bytes(8)
    assert filters_of([(i, True) for i in range(513)]) == bytes(8)
    assert len(filters_of([(i, True) for i in range(512)])) == 512 * 8
