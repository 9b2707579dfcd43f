"""CAN frames as a raw socket of Linux gives and takes them (linux/can.h,
linux/can/raw.h). Bytes and numbers alone, no I/O."""

from __future__ import annotations

import struct
from collections.abc import Collection

from triaxcal_drivers.can.adapter import Identifier
from triaxcal_drivers.interface import RawFlag

FD_BYTES = 72  # of a CAN FD frame; a classic one has 16
FD_LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)
FILTERS_MOST = 512  # CAN_RAW_FILTER_MAX; the kernel refuses more

_EXTENDED, _EXTENDED_MASK, _STANDARD_MASK = 0x8000_0000, 0x1FFF_FFFF, 0x7FF
_BIT_RATE_SWITCH, _ERROR_PASSIVE = 0x01, 0x02
_LOCAL, _OWN = 0x04, 0x800  # MSG_DONTROUTE: of this host; MSG_CONFIRM: of this very socket

_HEADER = struct.Struct("=IBB")  # identifier with three flags, length, flags of a CAN FD frame
_FILTER = struct.Struct("=II")  # what the identifier has to be, where the mask has ones
_CLASSIC_FRAME, _FD_FRAME = struct.Struct("=IB3x8s"), struct.Struct("=IB3x64s")

_KINDS = tuple(
    int(RawFlag.ERROR if error else RawFlag.EXTENDED_ID * extended | RawFlag.REMOTE * remote)
    for extended in (0, 1)
    for remote in (0, 1)
    for error in (0, 1)
)
"""`RawFlag` by the three highest bits of the identifier."""
_REMOTE, _SENT = int(RawFlag.REMOTE), int(RawFlag.SENT)
_FD, _SWITCHED = int(RawFlag.FD), int(RawFlag.BIT_RATE_SWITCH)


def frame_of(raw: bytes, message_flags: int) -> tuple[int, int, bytes]:
    """Identifier, flags of `RawFlag` and data of what `recvmsg` gave."""
    word, length, fd_flags = _HEADER.unpack_from(raw)
    flags = _KINDS[word >> 29]
    if message_flags & (_LOCAL | _OWN):
        flags |= _SENT
    if len(raw) == FD_BYTES:
        flags |= _FD
        if fd_flags & _BIT_RATE_SWITCH:
            flags |= _SWITCHED
        if fd_flags & _ERROR_PASSIVE:
            flags |= _REMOTE
        return word & _EXTENDED_MASK, flags, raw[8 : 8 + length]
    if flags & _REMOTE:
        return word & _EXTENDED_MASK, flags, bytes(length)
    return word & _EXTENDED_MASK, flags, raw[8 : 8 + length]


def bytes_of(identifier: int, data: bytes, *, extended: bool, fd: bool) -> bytes:
    """A data frame to be sent; one of more than eight bytes is a CAN FD frame.
    Raises ValueError where it is none."""
    most = _EXTENDED_MASK if extended else _STANDARD_MASK
    if not 0 <= identifier <= most:
        raise ValueError(f"identifier 0x{identifier:X}: expected at most 0x{most:X}")
    longest = 64 if fd else 8
    if len(data) not in FD_LENGTHS or len(data) > longest:
        kind = "of a CAN FD frame" if fd else "without CAN FD"
        raise ValueError(f"{len(data)} bytes of data: no length {kind}, which has up to {longest}")
    word = identifier | _EXTENDED * extended
    return (_CLASSIC_FRAME if len(data) <= 8 else _FD_FRAME).pack(word, len(data), data)


def filters_of(identifiers: Collection[Identifier] | None) -> bytes:
    """For CAN_RAW_FILTER: data and remote frames of these identifiers; all of
    them where they are None, or more than the kernel takes."""
    if identifiers is None or len(identifiers) > FILTERS_MOST:
        return _FILTER.pack(0, 0)
    return b"".join(
        _FILTER.pack(identifier | _EXTENDED, _EXTENDED_MASK | _EXTENDED)
        if extended
        else _FILTER.pack(identifier, _STANDARD_MASK | _EXTENDED)
        for identifier, extended in sorted(identifiers)
    )
