"""Recordings of all frames of a bus, for later: of no unit, and without a
profile."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

import triaxcal_drivers as td
from triaxcald.errors import RecordingError
from triaxcald.recording.reader import Contents
from triaxcald.recording.schema import BUS_PHASE, BUS_RECORD, RAW

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


def describe_bus(recording: Contents) -> dict[str, Any]:
    """What a bus recording holds, channel by channel. ``identifiers`` counts
    the different ones; ``lost`` are frames that did not get to the disk, of all
    channels; ``gaps`` of a channel are the places where its receiver lost
    some. Raises RecordingError."""
    channels: dict[str, _Channel] = {}
    for phase, batch in recording.joined_batches():
        if phase.startswith(BUS_PHASE) and len(batch):
            channels.setdefault(phase.removeprefix(BUS_PHASE), _Channel()).feed(batch)
    return {
        **recording.metadata.get(BUS_RECORD, {}),
        "channels": {name: channel.document() for name, channel in channels.items()},
        "lost": sum(loss.records for loss in recording.losses() if loss.where == RAW),
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
