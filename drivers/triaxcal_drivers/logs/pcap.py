"""pcap and pcapng of SocketCAN: frames alone, or after the header of a cooked capture
of Linux.

Libraries for pcap are not used: they support little of CAN and trust the lengths in a
file.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import chain, islice
from typing import BinaryIO, NamedTuple

from triaxcal_drivers.logs.can_frames import (
    CLASSIC_MOST,
    ERROR,
    EXTENDED,
    EXTENDED_MOST,
    FD,
    FD_MOST,
    REMOTE,
    SENT,
    STANDARD_MOST,
    SWITCHED,
    Account,
    LoggedFrame,
    Placed,
    timed,
)

PACKET_MOST = 2**20  # bytes of a packet or a block; tcpdump stores 256 KiB of a packet
INTERFACES_MOST = 1000
VOTERS = 1000  # frames that tell the byte order of identifiers

_PCAP = {b"\xa1\xb2\xc3\xd4": (">", 1000), b"\xd4\xc3\xb2\xa1": ("<", 1000),
         b"\xa1\xb2\x3c\x4d": (">", 1), b"\x4d\x3c\xb2\xa1": ("<", 1)}  # fmt: skip
"""Byte order, and unit of the fraction [ns], by the first four bytes."""
_SECTION = b"\x0a\x0d\x0d\x0a"
_ORDERS = {b"\x1a\x2b\x3c\x4d": ">", b"\x4d\x3c\x2b\x1a": "<"}
MAGICS = (*_PCAP, _SECTION)

_SOCKETCAN, _SLL, _SLL2 = 227, 113, 276  # of tcpdump's link types
_CAN, _CANFD = 0x000C, 0x000D  # Linux' protocols
_SENT_BY_US = 4
_EXTENDED_BIT, _REMOTE_BIT, _ERROR_BIT = 0x80000000, 0x40000000, 0x20000000
_BRS, _ESI, _FDF = 1, 2, 4
_CLASSIC_BYTES = 16  # of SocketCAN's struct can_frame; a canfd_frame has 72


class _Packet(NamedTuple):
    time_ns: int | None
    link: int
    data: bytes
    channel: str
    order: str
    where: str


class _Inner(NamedTuple):
    """Content after a cooked header. ``order`` is the byte order of the identifier."""

    frame: bytes
    protocol: int | None
    sent: bool
    channel: str
    order: str


def frames(stream: BinaryIO, account: Account) -> Iterator[LoggedFrame]:
    yield from timed(_frames(stream, account), account)


def _frames(stream: BinaryIO, account: Account) -> Iterator[Placed]:
    magic = stream.read(4)
    packets = _pcapng(stream, account) if magic == _SECTION else _pcap(stream, magic, account)
    found = ((packet, inner) for packet in packets if (inner := _inner(packet, account)))
    head = list(islice(found, VOTERS))
    swapped = _swapped([inner for _, inner in head])
    for packet, inner in chain(head, found):
        frame = _frame(packet, inner, swapped)
        yield packet.where, frame or "a packet that is no CAN frame"


def _pcap(stream: BinaryIO, magic: bytes, account: Account) -> Iterator[_Packet]:
    order, unit_ns = _PCAP[magic]
    head = stream.read(20)
    if len(head) < 20:
        account.note("byte 0", "the file ends in its header")
        return
    link = struct.unpack(order + "I", head[16:])[0] & 0x0FFFFFFF
    record, read = struct.Struct(order + "IIII"), 24
    while start := stream.read(record.size):
        where = f"byte {read}"
        if len(start) < record.size:
            account.note(where, "the file ends in a packet")
            return
        seconds, fraction, kept, _ = record.unpack(start)
        if kept > PACKET_MOST:
            account.note(where, f"a packet of {kept} bytes, expected at most {PACKET_MOST}")
            return
        data = stream.read(kept)
        if len(data) < kept:
            account.note(where, "the file ends in a packet")
            return
        read += record.size + kept
        yield _Packet(seconds * 1_000_000_000 + fraction * unit_ns, link, data, "1", order, where)


class _Interface(NamedTuple):
    link: int
    units: tuple[int, int]  # nanoseconds are the time times the first, divided by the second
    offset_ns: int
    name: str


@dataclass
class _Section:
    order: str
    interfaces: list[_Interface] = field(default_factory=list)


def _pcapng(stream: BinaryIO, account: Account) -> Iterator[_Packet]:
    section = _Section("<")
    read, kind = 0, _SECTION
    while kind:
        where = f"byte {read}"
        rest = stream.read(4)
        early = stream.read(4) if kind == _SECTION else b""
        if kind == _SECTION:
            if early not in _ORDERS:
                account.note(where, "expected a section (0x1A2B3C4D)")
                return
            section = _Section(_ORDERS[early])
        if len(kind) + len(rest) < 8:
            account.note(where, "the file ends in a block")
            return
        (length,) = struct.unpack(section.order + "I", rest)
        least = 12 + len(early)
        if length % 4 or not least <= length <= PACKET_MOST:
            account.note(where, f"a block of {length} bytes, expected {least} to {PACKET_MOST}")
            return
        body = stream.read(length - 8 - len(early))
        if len(body) < length - 8 - len(early):
            account.note(where, "the file ends in a block")
            return
        if kind != _SECTION and (packet := _block(kind, body[:-4], section, where, account)):
            yield packet
        read += length
        kind = stream.read(4)


def _block(kind: bytes, body: bytes, section: _Section, where: str, account: Account) -> _Packet | None:
    (number,) = struct.unpack(section.order + "I", kind)
    try:
        if number == 1:
            if len(section.interfaces) < INTERFACES_MOST:
                section.interfaces.append(_interface(body, section.order, len(section.interfaces)))
        elif number == 6:
            interface, high, low, kept, _ = struct.unpack_from(section.order + "IIIII", body)
            return _packet(section, interface, high << 32 | low, body[20 : 20 + kept], where)
        elif number == 2:
            interface, _, high, low, kept, _ = struct.unpack_from(section.order + "HHIIII", body)
            return _packet(section, interface, high << 32 | low, body[20 : 20 + kept], where)
        elif number == 3:
            return _packet(section, 0, None, body[4:], where)
    except (struct.error, IndexError):
        account.note(where, f"a block of type {number} that cannot be read")
    return None


def _packet(section: _Section, number: int, time: int | None, data: bytes, where: str) -> _Packet:
    """Raises IndexError if there is no such interface."""
    interface = section.interfaces[number]
    over, under = interface.units
    time_ns = None if time is None else time * over // under + interface.offset_ns
    return _Packet(time_ns, interface.link, data, interface.name, section.order, where)


def _interface(body: bytes, order: str, number: int) -> _Interface:
    """Raises struct.error."""
    (link,) = struct.unpack_from(order + "H", body)
    units, offset_s, name = (1000, 1), 0, f"if{number}"
    at = 8
    while at + 4 <= len(body):
        code, length = struct.unpack_from(order + "HH", body, at)
        value = body[at + 4 : at + 4 + length]
        at += 4 + length + -length % 4
        if code == 0:
            break
        if code == 2:
            name = value.decode("utf-8", "replace").rstrip("\0")[:64]
        elif code == 9 and length == 1:
            power = value[0] & 0x7F
            units = (10**9, 2**power) if value[0] & 0x80 else (10**9, 10**power)
        elif code == 14 and length == 8:
            (offset_s,) = struct.unpack(order + "q", value)
    return _Interface(link, units, offset_s * 1_000_000_000, name)


def _inner(packet: _Packet, account: Account) -> _Inner | None:
    """The frame in a packet. Identifiers are in network order; after a cooked header
    they are in the host's order."""
    data = packet.data
    if packet.link == _SOCKETCAN:
        return _Inner(data, None, False, packet.channel, ">")
    if packet.link == _SLL and len(data) >= 16:
        sent, protocol = struct.unpack(">H", data[:2])[0] == _SENT_BY_US, struct.unpack(">H", data[14:16])[0]
        inner, channel = data[16:], packet.channel
    elif packet.link == _SLL2 and len(data) >= 20:
        protocol, index = struct.unpack(">HxxI", data[:8])
        sent, inner, channel = data[10] == _SENT_BY_US, data[20:], f"if{index}"
    else:
        account.other(f"packet of link type {packet.link}")
        return None
    if protocol not in (_CAN, _CANFD):
        account.other(f"packet of protocol 0x{protocol:04X}")
        return None
    return _Inner(inner, protocol, sent, channel, packet.order)


def _swapped(inner: list[_Inner]) -> bool:
    """Whether more identifiers are plausible in the other byte order."""
    return sum(_plausible(i, _other(i.order)) for i in inner) > sum(_plausible(i, i.order) for i in inner)


def _other(order: str) -> str:
    return "<" if order == ">" else ">"


def _plausible(inner: _Inner, order: str) -> bool:
    if len(inner.frame) < 8:
        return False
    (word,) = struct.unpack_from(order + "I", inner.frame)
    return bool(word & (_EXTENDED_BIT | _ERROR_BIT)) or word & EXTENDED_MOST <= STANDARD_MOST


def _frame(packet: _Packet, inner: _Inner, swapped: bool) -> LoggedFrame | None:
    data = inner.frame
    if len(data) < 8:
        return None
    (word,) = struct.unpack_from((_other(inner.order) if swapped else inner.order) + "I", data)
    length, bits = data[4], data[5]
    source, flags = word & EXTENDED_MOST, SENT if inner.sent else 0
    fd = inner.protocol == _CANFD or (inner.protocol is None and (bits & _FDF or len(data) > _CLASSIC_BYTES))
    if word & _ERROR_BIT:
        flags = ERROR
    elif fd:
        flags |= FD | (SWITCHED if bits & _BRS else 0) | (REMOTE if bits & _ESI else 0)
    elif word & _REMOTE_BIT:
        flags |= REMOTE
    if word & _EXTENDED_BIT and not flags & ERROR:
        flags |= EXTENDED
    octets = bytes(min(length, CLASSIC_MOST)) if flags & (REMOTE | FD) == REMOTE else data[8 : 8 + length]
    if length > (FD_MOST if fd else CLASSIC_MOST) or len(octets) < length:
        return None
    if not flags & (EXTENDED | ERROR) and source > STANDARD_MOST:
        return None
    return LoggedFrame(packet.time_ns, source, flags, octets, inner.channel)
