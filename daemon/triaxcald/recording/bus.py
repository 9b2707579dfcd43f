"""Recordings of all frames of a bus, for later: of no unit, and without a profile; and
python-can's messages as raw records of a bus, and back."""

from __future__ import annotations

import heapq
import json
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

import triaxcal_drivers as td
from triaxcald.errors import RecordingError
from triaxcald.recording.reader import Contents
from triaxcald.recording.schema import BUS_PHASE, BUS_RECORD, RAW

if TYPE_CHECKING:
    import can


Channel = str | int | None
"""As python-can names them; None where a bus has but one, of no name."""
_NUMBER = re.compile(r"-?[0-9]{1,9}")


def bus_record(interface: str, channel: Channel = None, **settings: str) -> dict[str, str]:
    """What stands in the metadata of a recording, under `BUS_RECORD`, of the
    bus it was made on."""
    named = {"interface": interface, "channel": _name_of(channel)}
    return {key: value for key, value in {**named, **settings}.items() if value}


def phase_of(channel: Channel) -> str:
    """The phase that the frames of a channel have."""
    return BUS_PHASE + _name_of(channel)


def channel_of(phase: str) -> Channel:
    """The channel whose frames have that phase; None for a phase of a unit."""
    name = phase.removeprefix(BUS_PHASE) if phase.startswith(BUS_PHASE) else ""
    if _NUMBER.fullmatch(name):
        return int(name)
    if name.startswith('"'):
        try:
            return str(json.loads(name))
        except ValueError:
            return name
    return name or None


def _name_of(channel: Channel) -> str:
    """A number as it is, and names too, unless they would read as something
    else."""
    if channel is None:
        return ""
    name = str(channel)
    plain = isinstance(channel, int) or not (name == "" or name.startswith('"') or _NUMBER.fullmatch(name))
    return name if plain else json.dumps(name)


def is_of_bus(recording: Contents) -> bool:
    return BUS_RECORD in recording.metadata


def bus_frames(recording: Contents) -> Iterator[tuple[Channel, td.RawBatch]]:
    """The frames of a bus recording by channel, in the order in which they were
    recorded. Raises RecordingError."""
    return ((channel_of(phase), batch) for phase, batch in recording.raw_batches() if phase.startswith(BUS_PHASE))


def frame_rows(recording: Contents) -> Iterator[tuple[int, int, int, bytes, str]]:
    """The same frame by frame: time in ns, source, flags, data, and the name of
    the channel. Raises RecordingError."""
    for channel, batch in bus_frames(recording):
        ends = np.cumsum(batch.length, dtype=np.int64).tolist()
        begin, name = 0, "" if channel is None else str(channel)
        columns = (batch.time_ns.tolist(), batch.source.tolist(), batch.flags.tolist())
        for time_ns, source, flags, end in zip(*columns, ends, strict=True):
            yield time_ns, source, flags, batch.payload[begin:end], name
            begin = end


def require_of_unit(recording: Contents) -> None:
    """Raises RecordingError where it holds the frames of a bus."""
    if is_of_bus(recording):
        raise RecordingError(
            f"{recording.name}: all frames of a bus, of no unit; "
            f"'triaxcal log import {recording.name} --profile P -o OUT.mcap' makes a unit's recording of it"
        )


def describe_bus(recording: Contents, counted: Mapping[str, Mapping[str, Any]] | None = None) -> dict[str, Any]:
    """What a bus recording holds, channel by channel. ``identifiers`` counts
    the different ones; ``lost`` are frames that did not get to the disk, of all
    channels; ``gaps`` of a channel are the places where its receiver lost
    some. Where ``counted`` has the numbers of each phase, no frame is read, and a
    channel has these. Raises RecordingError."""
    return {
        **recording.metadata.get(BUS_RECORD, {}),
        "channels": _read_channels(recording) if counted is None else _counted_channels(counted),
        "lost": sum(loss.records for loss in recording.losses() if loss.where == RAW),
    }


def _read_channels(recording: Contents) -> dict[str, dict[str, Any]]:
    channels: dict[str, _Channel] = {}
    for phase, batch in recording.joined_batches():
        if phase.startswith(BUS_PHASE) and len(batch):
            channels.setdefault(phase.removeprefix(BUS_PHASE), _Channel()).feed(batch)
    return {name: channel.document() for name, channel in channels.items()}


def _counted_channels(phases: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    return {
        phase.removeprefix(BUS_PHASE): {key: found[key] for key in ("records", "start_ns", "end_ns", "duration_s")}
        for phase, found in phases.items()
        if phase.startswith(BUS_PHASE)
    }


class _Channel:
    def __init__(self) -> None:
        self._identifiers: NDArray[np.int64] = np.zeros(0, dtype=np.int64)
        self._counts: dict[str, int] = dict.fromkeys(("frames", "remote", "errors", "sent", "gaps"), 0)
        self._span_ns: tuple[int, int] | None = None

    def feed(self, batch: td.RawBatch) -> None:
        error = (batch.flags & td.RawFlag.ERROR) != 0
        fd = (batch.flags & td.RawFlag.FD) != 0
        self._identifiers = np.union1d(self._identifiers, batch.identifiers[~error])
        seen: Mapping[str, Any] = {
            "frames": ~error,
            "remote": ((batch.flags & td.RawFlag.REMOTE) != 0) & ~fd & ~error,
            "errors": error,
            "sent": (batch.flags & td.RawFlag.SENT) != 0,
            "gaps": (batch.flags & td.RawFlag.LOST_BEFORE) != 0,
        }
        for name, which in seen.items():
            self._counts[name] += int(np.count_nonzero(which))
        first, last = int(batch.time_ns.min()), int(batch.time_ns.max())
        start, end = self._span_ns or (first, last)
        self._span_ns = min(start, first), max(end, last)

    def document(self) -> dict[str, Any]:
        start, end = self._span_ns or (0, 0)
        return {
            **self._counts,
            "identifiers": len(self._identifiers),
            "start_ns": start,
            "end_ns": end,
            "duration_s": (end - start) / 1e9,
        }


# python-can's messages as raw records of a bus, and back.

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
    import can  # a recording without its messages needs no python-can

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
