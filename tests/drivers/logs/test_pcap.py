"""pcap and pcapng by literal bytes, by their specifications and that of SocketCAN's link types."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import pytest

from triaxcal_drivers.interface import RawFlag
from triaxcal_drivers.logs.can_frames import LoggedFrame, Remark
from triaxcal_drivers.logs.pcap import frames

Read = Callable[..., tuple[list[LoggedFrame], Any]]
T_S, T_US = 1_700_000_000, 123_456
T_NS = T_S * 10**9 + T_US * 1000
SOCKETCAN, SLL, SLL2 = 227, 113, 276

CLASSIC = bytes.fromhex("00000123 03 00 00 00 010203 0000000000")
EXTENDED = bytes.fromhex("98EEFF03 01 00 00 00 AA 00000000000000")
REMOTE = bytes.fromhex("40000123 04 00 00 00 0000000000000000")
ERRONEOUS = bytes.fromhex("20000004 08 00 00 00 0008000000000000")
FLEXIBLE = bytes.fromhex("00000123 0C 05 00 00") + bytes(range(12)) + bytes(52)
WANTED = [
    (0x123, 0, b"\1\2\3"),
    (0x18EEFF03, int(RawFlag.EXTENDED_ID), b"\xaa"),
    (0x123, int(RawFlag.REMOTE), bytes(4)),
    (0x4, int(RawFlag.ERROR), bytes.fromhex("0008000000000000")),
    (0x123, int(RawFlag.FD | RawFlag.BIT_RATE_SWITCH), bytes(range(12))),
]
PACKETS = [CLASSIC, EXTENDED, REMOTE, ERRONEOUS, FLEXIBLE]


def pcap(packets: list[bytes], order: str = "<", link: int = SOCKETCAN, *, nano: bool = False) -> bytes:
    magic, fraction = (0xA1B23C4D, T_US * 1000) if nano else (0xA1B2C3D4, T_US)
    data = struct.pack(order + "IHHiIII", magic, 2, 4, 0, 0, 262144, link)
    for packet in packets:
        data += struct.pack(order + "IIII", T_S, fraction, len(packet), len(packet)) + packet
    return data


def block(kind: int, body: bytes, order: str) -> bytes:
    body += bytes(-len(body) % 4)
    length = struct.pack(order + "I", 12 + len(body))
    return struct.pack(order + "I", kind) + length + body + length


def pcapng(packets: list[bytes], order: str = "<", link: int = SOCKETCAN, options: bytes = b"") -> bytes:
    data = block(0x0A0D0D0A, struct.pack(order + "IHHq", 0x1A2B3C4D, 1, 0, -1), order)
    data += block(1, struct.pack(order + "HHI", link, 0, 262144) + options, order)
    stamp = T_S * 10**6 + T_US
    for packet in packets:
        head = struct.pack(order + "IIIII", 0, stamp >> 32, stamp & 0xFFFFFFFF, len(packet), len(packet))
        data += block(6, head + packet, order)
    return data


def cooked(packet: bytes, order: str, *, sent: bool = False) -> bytes:
    """A Linux cooked header round the frame, whose identifier is in the host's order."""
    protocol = b"\x00\x0d" if len(packet) == 72 else b"\x00\x0c"
    identifier = packet[:4] if order == ">" else packet[3::-1]
    return (b"\x00\x04" if sent else b"\x00\x01") + b"\x01\x18\x00\x00" + bytes(8) + protocol + identifier + packet[4:]


def cooked_2(packet: bytes, order: str) -> bytes:
    protocol = b"\x00\x0d" if len(packet) == 72 else b"\x00\x0c"
    identifier = packet[:4] if order == ">" else packet[3::-1]
    return protocol + b"\x00\x00\x00\x00\x00\x05\x01\x18\x01\x00" + bytes(8) + identifier + packet[4:]


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("nano", [False, True])
def test_socketcan_in_pcap(read: Read, order: str, nano: bool) -> None:
    found, account = read(frames, pcap(PACKETS, order, nano=nano))
    assert found == [LoggedFrame(T_NS, *wanted, "1") for wanted in WANTED]
    assert account.damaged == 0


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(("link", "wrap", "channel"), [(SLL, cooked, "1"), (SLL2, cooked_2, "if5")])
def test_cooked_headers_hold_identifiers_in_the_hosts_order(
    read: Read, order: str, link: int, wrap: Callable[[bytes, str], bytes], channel: str
) -> None:
    found, account = read(frames, pcap([wrap(p, order) for p in PACKETS], order, link))
    assert found == [LoggedFrame(T_NS, *wanted, channel) for wanted in WANTED]
    assert account.damaged == 0


def test_identifiers_that_make_sense_in_the_other_order_alone_are_read_in_it(read: Read) -> None:
    packets = [cooked(CLASSIC, ">"), cooked(FLEXIBLE, ">"), cooked(EXTENDED, ">")]
    found, _ = read(frames, pcap(packets, "<", SLL))
    assert [f.source for f in found] == [0x123, 0x123, 0x18EEFF03]


def test_what_the_host_sent_says_so(read: Read) -> None:
    (frame,), _ = read(frames, pcap([cooked(CLASSIC, "<", sent=True)], "<", SLL))
    assert frame.flags == RawFlag.SENT


@pytest.mark.parametrize("order", ["<", ">"])
def test_pcapng_with_cooked_headers_and_the_interfaces_name(read: Read, order: str) -> None:
    name = struct.pack(order + "HH", 2, 4) + b"can7"
    found, account = read(frames, pcapng([cooked(p, order) for p in PACKETS], order, SLL, name))
    assert found == [LoggedFrame(T_NS, *wanted, "can7") for wanted in WANTED]
    assert account.damaged == 0


@pytest.mark.parametrize(
    ("resolution", "time_ns"), [(b"\x09", T_NS // 1000), (b"\x03", T_NS * 1000), (b"\x80", T_NS * 10**6)]
)
def test_the_resolution_of_times_is_the_interfaces(read: Read, resolution: bytes, time_ns: int) -> None:
    option = struct.pack("<HH", 9, 1) + resolution + bytes(3)
    (frame,), _ = read(frames, pcapng([CLASSIC], options=option))
    assert frame.time_ns == time_ns


def test_a_time_offset_is_added(read: Read) -> None:
    (frame,), _ = read(frames, pcapng([CLASSIC], options=struct.pack("<HHq", 14, 8, 3600)))
    assert frame.time_ns == T_NS + 3600 * 10**9


def test_simple_packets_tell_no_times(read: Read) -> None:
    data = pcapng([]) + block(3, struct.pack("<I", len(CLASSIC)) + CLASSIC, "<")
    (frame,), account = read(frames, data)
    assert (frame.time_ns, frame.source) == (None, 0x123)
    assert account.remarks == {Remark.NO_TIMES}


@pytest.mark.parametrize("place", [0, 1, 3])
def test_a_packet_without_a_time_among_others_is_damage(read: Read, place: int) -> None:
    start, whole = len(pcapng([])), pcapng([CLASSIC] * 3)
    at = start + place * (len(whole) - start) // 3
    simple = block(3, struct.pack("<I", len(CLASSIC)) + CLASSIC, "<")
    found, account = read(frames, whole[:at] + simple + whole[at:])
    assert [f.time_ns for f in found] == [T_NS] * 3
    assert (account.damaged, account.damage) == (1, f"byte {at}: a frame without a time, in a log that has times")
    assert account.remarks == set()


def test_packets_that_are_no_can_are_counted(read: Read) -> None:
    ipv4 = bytes.fromhex("0000 0001 0006") + bytes(8) + b"\x08\x00" + bytes(40)
    found, account = read(frames, pcap([cooked(CLASSIC, "<"), ipv4], "<", SLL))
    assert len(found) == 1
    assert account.others == {"packet of protocol 0x0800": 1}
    found, account = read(frames, pcap([bytes(60)], "<", 1))
    assert (found, account.others) == ([], {"packet of link type 1": 1})


@pytest.mark.parametrize("make", [pcap, pcapng])
def test_of_a_capture_cut_anywhere_the_whole_packets_are_read(read: Read, make: Callable[..., bytes]) -> None:
    whole = make([CLASSIC] * 4)
    step = (len(whole) - len(make([]))) // 4
    for cut in range(24, len(whole)):
        found, account = read(frames, whole[:cut])
        assert len(found) == max(0, (cut - len(make([]))) // step)
        at_an_end = cut == len(make([])) or (cut > len(make([])) and (cut - len(make([]))) % step == 0)
        assert account.damaged == (0 if at_an_end or (make is pcapng and cut == 28) else 1)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (pcap([]) + struct.pack("<IIII", 0, 0, 2**31, 2**31), "a packet of 2147483648 bytes, expected at most 1048576"),
        (pcapng([]) + struct.pack("<II", 6, 2**31), "a block of 2147483648 bytes, expected 12 to 1048576"),
        (pcapng([]) + struct.pack("<II", 6, 8), "a block of 8 bytes, expected 12 to 1048576"),
        (pcapng([]) + block(6, struct.pack("<IIIII", 9, 0, 0, 0, 0), "<"), "a block of type 6 that cannot be read"),
        (pcap([b"\x00\x00\x01\x23\xff\x00\x00\x00"]), "a packet that is no CAN frame"),
        (pcap([b"\x00"]), "a packet that is no CAN frame"),
    ],
)
def test_lengths_are_not_believed(read: Read, data: bytes, words: str) -> None:
    found, account = read(frames, data)
    assert found == []
    assert words in account.damage
    assert account.damage.startswith("byte ")
