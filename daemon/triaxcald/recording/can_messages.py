"""python-can's messages as raw records of a bus, and back."""

from __future__ import annotations

import heapq
import tomllib
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import can
import numpy as np
from numpy.typing import NDArray

import triaxcal_drivers as td
from triaxcald.errors import RecordingError
from triaxcald.recording.bus import Channel, channel_of, phase_of
from triaxcald.recording.reader import Contents

# As plain numbers: an IntFlag takes longer than all else that is done to a message.
_EXTENDED, _REMOTE, _ERROR, _FD = (
    int(f) for f in (td.RawFlag.EXTENDED_ID, td.RawFlag.REMOTE, td.RawFlag.ERROR, td.RawFlag.FD)
)
_SWITCH, _SENT = int(td.RawFlag.BIT_RATE_SWITCH), int(td.RawFlag.SENT)
_LATEST_S = 2**63 // 10**9  # what fits into nanoseconds of 64 bits: the year 2262

Row = tuple[float, int, int, bytes, Any]
"""Time in s, identifier, flags, data, channel."""
FIELDS = 5


def row_of(message: can.Message) -> Row:
    """What is recorded of a message, apart from it: its sender may change it.

    A remote frame has as many zero bytes as it asks for.
    """
    flags = _EXTENDED if message.is_extended_id else 0
    data = bytes(message.data)
    if message.is_fd:
        flags |= _FD | (_REMOTE if message.error_state_indicator else 0)
    elif message.is_remote_frame:
        flags |= _REMOTE
        data = bytes(message.dlc)
    if message.bitrate_switch:
        flags |= _SWITCH
    if message.is_error_frame:
        flags |= _ERROR
    if not message.is_rx:
        flags |= _SENT
    return message.timestamp, message.arbitration_id, flags, data, message.channel


def batches_of(values: Sequence[Any]) -> Iterator[tuple[str, td.RawBatch]]:
    """One batch for each channel, with its phase, of the values of all rows one
    after the other. Raises ValueError where a message has no time or no
    identifier that a recording can hold.

    Whoever holds messages holds bare values: a thousand tuples that outlive a
    pass of the garbage collector bring on the next one of everything.
    """
    *columns, channels = (values[field::FIELDS] for field in range(FIELDS))
    by_phase: dict[str, list[int]] = {}
    last, places = object(), list[int]()
    for place, channel in enumerate(channels):
        if channel is not last:  # mostly the very same object
            last, places = channel, by_phase.setdefault(phase_of(channel), [])
        places.append(place)
    for phase, places in by_phase.items():
        yield phase, _batch_of(*(columns if len(by_phase) == 1 else ([c[i] for i in places] for c in columns)))


def _batch_of(
    seconds: Sequence[float], sources: Sequence[int], flags: Sequence[int], data: Sequence[bytes]
) -> td.RawBatch:
    time_s = np.array(seconds, dtype=np.float64)
    if not np.all((time_s >= 0) & (time_s < _LATEST_S)):
        raise ValueError("a message without a time, expected seconds from 0 on")
    source = np.array(sources, dtype=np.int64)
    if not np.all((source >= 0) & (source < 2**32)):
        raise ValueError("a message with an identifier beyond 32 bits")
    whole = np.floor(time_s)
    # Apart, as their product has not the digits for both.
    time_ns = whole.astype(np.int64) * 10**9 + np.rint((time_s - whole) * 1e9).astype(np.int64)
    lengths = np.fromiter(map(len, data), dtype=np.uint16, count=len(data))
    return td.RawBatch(time_ns, source.astype(np.uint32), np.array(flags, dtype=np.uint8), lengths, b"".join(data))


def messages_of(recording: Contents) -> Iterator[can.Message]:
    """The frames of a bus, or of a unit on CAN, channel by channel in the order
    in which they came, channels among each other by their times; none that is
    unconfirmed. Raises RecordingError."""
    _require_can(recording)
    together: dict[str, td.RawBatch] = {}
    for phase, batch in recording.raw_batches():
        if batch.unconfirmed:
            continue
        if phase in together:
            yield from _merged(together)
            together = {}
        together[phase] = batch
    yield from _merged(together)


def _require_can(recording: Contents) -> None:
    """Raises RecordingError where its records are those of another bus."""
    try:
        driver = tomllib.loads(recording.attachments["profile.toml"].decode()).get("driver")
    except (KeyError, ValueError):
        return
    if driver != "can":
        raise RecordingError(f"{recording.name}: records of a unit on {driver}, expected CAN frames")


def _merged(batches: dict[str, td.RawBatch]) -> Iterator[can.Message]:
    each: list[Iterable[can.Message]] = [_messages(channel_of(phase), batch) for phase, batch in batches.items()]
    return heapq.merge(*each, key=lambda m: m.timestamp) if len(each) > 1 else iter(each[0] if each else ())


def _messages(channel: Channel, batch: td.RawBatch) -> Iterator[can.Message]:
    seconds, rest_ns = np.divmod(batch.time_ns, 10**9)
    ends = np.cumsum(batch.length, dtype=np.int64).tolist()
    begin, payload, message = 0, bytearray(batch.payload), can.Message
    kinds = {flags: _kind_of(flags) for flags in np.unique(batch.flags).tolist()}
    columns: Sequence[NDArray[Any]] = (seconds + rest_ns / 1e9, batch.source, batch.flags)
    for time_s, source, flags, end in zip(*(c.tolist() for c in columns), ends, strict=True):
        extended, remote, error, fd, rx, switch, passive = kinds[flags]
        data = payload[begin:end]
        # By place: by name takes half as long again.
        yield message(time_s, source, extended, remote, error, channel, end - begin, data, fd, rx, switch, passive)
        begin = end


def _kind_of(flags: int) -> tuple[bool, bool, bool, bool, bool, bool, bool]:
    """Extended, remote, error, FD, received, bit rate switched, error state
    passive."""
    fd, remote = bool(flags & _FD), bool(flags & _REMOTE)
    received, switch = not flags & _SENT, bool(flags & _SWITCH)
    return bool(flags & _EXTENDED), remote and not fd, bool(flags & _ERROR), fd, received, switch, remote and fd
