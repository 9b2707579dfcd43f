"""Vector's BLF: objects, most of them in compressed containers.

python-can's reader is not used: it unpacks a container of any size, ends at the first
damaged object without telling its place, and rounds times to a quarter of a
microsecond.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from typing import BinaryIO

from triaxcal_drivers.logs.can_frames import (
    CLASSIC_MOST,
    ERROR,
    EXTENDED,
    EXTENDED_MOST,
    FD,
    FD_LENGTHS,
    FD_MOST,
    REMOTE,
    SENT,
    SWITCHED,
    Account,
    LoggedFrame,
)
from triaxcal_drivers.logs.dates import utc_ns

MAGIC = b"LOGG"
OBJECT_MOST = 16 * 2**20
"""Most bytes of an object or a container, compressed or not. Usual containers have 128
KiB."""
EXPANSION_MOST = 64  # times its size, to which a file may unpack; usual files reach three to ten times

_FILE = struct.Struct("<4sI32x8H")  # signature, bytes of the header, start
_OBJECT = struct.Struct("<4sHHII")  # signature, bytes of the header, its version, bytes of the object, type
_STAMP = struct.Struct("<I4xQ")  # unit of the time, time
_CONTAINER = struct.Struct("<H6xI4x")  # method, bytes unpacked
_CLASSIC = struct.Struct("<HBBI8s")  # channel, flags, DLC, identifier, data
_ERROR, _ERROR_64 = struct.Struct("<H"), struct.Struct("<B")  # channel
_FD = struct.Struct("<HBBIIBBB5x64s")  # channel, flags, DLC, identifier, …, FD flags, valid bytes, data
_FD_64 = struct.Struct(
    "<BBB1xI4xI16xHBB4x"
)  # channel, DLC, valid bytes, identifier, flags, …, direction, data's offset
_BLF_EXTENDED = 0x80000000
_TEN_MICROSECONDS = 1
_CONTAINER_TYPE = 10


def frames(stream: BinaryIO, account: Account) -> Iterator[LoggedFrame]:
    """All frames from the start of an opened file. Damage raises no error; it is
    counted in the account."""
    head = stream.read(_FILE.size)
    if len(head) < _FILE.size:
        account.note("byte 0", "the file ends in its header")
        return
    _, header_bytes, *start = _FILE.unpack(head)
    reader = _Objects(_start_ns(start, account), account)
    stream.read(max(0, min(header_bytes, 4096) - _FILE.size))
    read = max(header_bytes, _FILE.size)
    unpacked = 0
    # Read one object after the other; most are containers of objects.
    while base := stream.read(_OBJECT.size):
        where = f"byte {read}"
        length = _OBJECT.unpack(base)[3] if len(base) == _OBJECT.size else 0
        if base[:4] != b"LOBJ" or not _OBJECT.size <= length <= OBJECT_MOST:
            cut = len(base) < _OBJECT.size
            account.note(where, "the file ends in an object" if cut else "expected an object (LOBJ)")
            return
        body = stream.read(length - _OBJECT.size)
        stream.read(length % 4)
        read += length + length % 4
        if len(body) < length - _OBJECT.size:
            account.note(where, "the file ends in an object")
        if _OBJECT.unpack(base)[4] != _CONTAINER_TYPE:
            yield from reader.frames(base + body, where)
            continue
        data = _unpacked(body, where, account)
        unpacked += len(data)
        if unpacked > EXPANSION_MOST * read + OBJECT_MOST:
            account.note(where, f"its containers unpack to more than {EXPANSION_MOST} times the file")
            return
        yield from reader.frames(data, where)
    reader.end(read)


def _start_ns(system_time: list[int], account: Account) -> int:
    year, month, _, day, hour, minute, second, ms = system_time
    time_ns = utc_ns(year, month, day, hour, minute, second)
    if any(system_time):
        account.date(time_ns, f"{year}-{month:02}-{day:02} {hour:02}:{minute:02}:{second:02}", "header")
    account.without_date()
    return 0 if time_ns is None else time_ns + ms * 1_000_000


def _unpacked(body: bytes, where: str, account: Account) -> bytes:
    """The readable part of a container."""
    if len(body) < _CONTAINER.size:
        return b""
    method, size = _CONTAINER.unpack_from(body)
    data = body[_CONTAINER.size :]
    if method == 0:
        return data
    if method != 2 or not 0 < size <= OBJECT_MOST:
        account.note(where, f"a container of {size} bytes by method {method}, expected at most {OBJECT_MOST} by 0 or 2")
        return b""
    try:
        return zlib.decompressobj().decompress(data, size)
    except zlib.error:
        account.note(where, "a container that cannot be unpacked")
        return b""


class _Objects:
    """Objects in a row of containers. An object may begin in one container and end in
    the next."""

    def __init__(self, start_ns: int, account: Account) -> None:
        self._start_ns, self._account = start_ns, account
        self._rest = b""

    def frames(self, data: bytes, where: str) -> Iterator[LoggedFrame]:
        data = self._rest + data
        at = 0
        while True:
            found = data.find(b"LOBJ", at, at + 8)  # between objects there is padding
            if found < 0 and at + 8 <= len(data):
                found = data.find(b"LOBJ", at)
                self._account.note(where, "bytes in a container that are no object")
            if found < 0:
                self._rest = data[max(at, len(data) - 8) :]
                return
            at = found
            if len(data) < at + _OBJECT.size:
                break
            _, header_bytes, version, length, kind = _OBJECT.unpack_from(data, at)
            if not _OBJECT.size <= header_bytes <= length <= OBJECT_MOST:
                self._account.note(where, f"an object of {length} bytes")
                at += 4
                continue
            if len(data) < at + length:
                break
            if frame := self._frame(data[at : at + length], header_bytes, version, kind, where):
                yield frame
            at += length
        self._rest = data[at:]

    def end(self, read: int) -> None:
        if len(self._rest.strip(b"\0")) >= 4:
            self._account.note(f"byte {read}", "the file ends in an object")

    def _frame(self, data: bytes, at: int, version: int, kind: int, where: str) -> LoggedFrame | None:
        make = _MAKERS.get(kind)
        if make is None or version not in (1, 2):
            self._account.other(f"BLF object {kind}")
            return None
        try:
            unit, stamp = _STAMP.unpack_from(data, _OBJECT.size)
            made = make(data, at)
        except (struct.error, IndexError):
            self._account.note(where, f"an object of type {kind} that is too short")
            return None
        time_ns = self._start_ns + stamp * (10_000 if unit == _TEN_MICROSECONDS else 1)
        return LoggedFrame(time_ns, *made)


_FrameFields = tuple[int, int, bytes, str]


def _classic(data: bytes, at: int) -> _FrameFields:
    channel, bits, dlc, identifier, octets = _CLASSIC.unpack_from(data, at)
    flags = (SENT if bits & 1 else 0) | (REMOTE if bits & 0x80 else 0)
    length = min(dlc, CLASSIC_MOST)
    return *_source(identifier, flags), bytes(length) if flags & REMOTE else octets[:length], str(channel)


def _fd(data: bytes, at: int) -> _FrameFields:
    channel, bits, dlc, identifier, _, _, fd_bits, valid, octets = _FD.unpack_from(data, at)
    flags = (SENT if bits & 1 else 0) | (REMOTE if bits & 0x80 else 0)
    if fd_bits & 1:
        flags = (flags & SENT) | FD | (SWITCHED if fd_bits & 2 else 0) | (REMOTE if fd_bits & 4 else 0)
    return *_source(identifier, flags), octets[: min(valid, FD_LENGTHS[dlc & 15])], str(channel)


def _fd_64(data: bytes, at: int) -> _FrameFields:
    channel, dlc, valid, identifier, bits, _, sent, data_end = _FD_64.unpack_from(data, at)
    flags = SENT if sent else 0
    if bits & 0x1000:
        flags |= FD | (SWITCHED if bits & 0x2000 else 0) | (REMOTE if bits & 0x4000 else 0)
    elif bits & 0x0010:
        flags |= REMOTE
    length = min(valid, FD_LENGTHS[dlc & 15], FD_MOST)
    end = min(data_end or len(data), len(data))
    octets = data[at + _FD_64.size : end][:length].ljust(length, b"\0")  # CANoe omits zeros at the end
    return *_source(identifier, flags), octets, str(channel)


def _error(data: bytes, at: int) -> _FrameFields:
    return 0, ERROR, b"", str(_ERROR.unpack_from(data, at)[0])


def _error_64(data: bytes, at: int) -> _FrameFields:
    return 0, ERROR, b"", str(_ERROR_64.unpack_from(data, at)[0])


def _source(identifier: int, flags: int) -> tuple[int, int]:
    return identifier & EXTENDED_MOST, flags | (EXTENDED if identifier & _BLF_EXTENDED else 0)


_MAKERS = {1: _classic, 86: _classic, 100: _fd, 101: _fd_64, 2: _error, 73: _error, 104: _error_64}
