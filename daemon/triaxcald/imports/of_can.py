"""Logs of a CAN bus, through a profile of the driver ``can``: of other programs, and
the frames of a bus that triaxcal itself recorded."""

from __future__ import annotations

import gzip
import io
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, cast

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald.errors import InputError
from triaxcald.imports.importing import Imported, Importing, Record, Ticks, Times, no_samples, write_recording
from triaxcald.recording.bus import frame_rows, is_of_bus
from triaxcald.recording.manifest import is_manifest
from triaxcald.recording.reader import open_recording
from triaxcald.recording.schema import PROFILE

# Which frames of a log are those of one unit: by the identifiers of its profile,
# its node and its bus.

_EXTENDED, _ERROR = int(td.RawFlag.EXTENDED_ID), int(td.RawFlag.ERROR)
SHOWN = 8  # identifiers or channels in a message

KEPT_APART = 4096
"""Identifiers, and channels, that are counted each by itself: a bus has no more,
and a file of random ones shall take no memory."""
_OTHER_CHANNELS = "others"

Key = tuple[int, int]
"""An identifier, and `RawFlag.EXTENDED_ID` where it is one."""


_FURTHER: Key = (0, -1)  # none that there is


@dataclass
class Selection:
    """Takes the frames of one unit and counts the rest. ``node`` and
    ``channel`` are what the user asked for; ``layouts`` are those of all
    streams, ``readings`` among them."""

    layouts: Mapping[str, td.can.Layout]
    node: int | None = None
    channel: str | None = None
    frames: int = 0
    taken: int = 0
    error_frames: int = 0
    elsewhere: int = 0  # of the unit's identifiers, on another channel or of another node
    others: Counter[Key] = field(default_factory=Counter)
    channels: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        self._nodes: dict[Key, int | None] = {}  # by identifier; None where it does not shift
        self._groups = [(m.group, name) for name, of in self.layouts.items() for m in of.messages if m.j1939]
        for layout in self.layouts.values():
            for message in layout.messages:
                self._nodes |= _identifiers(message)
        self._streams: dict[Key, list[str]] = {}
        for name, layout in self.layouts.items():
            for key in dict.fromkeys(key for m in layout.messages for key in _identifiers(m)):
                self._streams.setdefault(key, []).append(name)
        readings = self.layouts[td.READINGS]
        self._samples = readings.messages[: readings.sample]  # what makes a sample; others are beside it
        self._readings = {key for m in self._samples for key in _identifiers(m)}
        counted = (
            m for layout in self.layouts.values() if _is_counted(layout) for m in layout.messages[: layout.sample]
        )
        self._counted = {key for m in counted for key in _identifiers(m)}
        self._seen: Counter[tuple[Key, str]] = Counter()
        self._strangers: Counter[int] = Counter()  # frames of other nodes than the one asked for
        self._of_unit: set[str] = set()  # channels

    def takes(self, frame: td.logs.LoggedFrame) -> bool:
        self.frames += 1
        name = frame.channel
        self.channels[name if name in self.channels or len(self.channels) < KEPT_APART else _OTHER_CHANNELS] += 1
        if self.channel is not None and frame.channel != self.channel:
            self.elsewhere += 1
            return False
        if frame.flags & _ERROR:
            if frame.channel not in self._of_unit:  # nobody knows yet whose bus that is
                self.elsewhere += 1
                return False
            self.error_frames += 1
            return True
        key = frame.source, frame.flags & _EXTENDED
        if self._groups and key not in self._nodes:
            self._meet(key)
        if key not in self._nodes:
            self.others[key if key in self.others or len(self.others) < KEPT_APART else _FURTHER] += 1
            return False
        node = self._nodes[key]
        if self.node is not None and node is not None and node != self.node:
            self._strangers[node] += 1
            self.elsewhere += 1
            return False
        self._seen[key, frame.channel] += 1
        self._of_unit.add(frame.channel)
        self.taken += 1
        return True

    def _meet(self, key: Key) -> None:
        """Note the identifier where it is of a parameter group of J1939: its source
        address is the node."""
        source, extended = key
        names = [name for (bits, group), name in self._groups if extended and source & bits == group]
        if not names:
            return
        self._nodes[key] = source & 0xFF
        self._streams[key] = names
        if any(source & m.group[0] == m.group[1] for m in self._samples if m.j1939):
            self._readings.add(key)
        of = [self.layouts[name] for name in names if _is_counted(self.layouts[name])]
        if any(source & m.group[0] == m.group[1] for o in of for m in o.messages[: o.sample] if m.j1939):
            self._counted.add(key)

    def streams_of(self, source: int, flags: int) -> list[str]:
        """The streams that use a frame."""
        if self._groups and (source, flags & _EXTENDED) not in self._nodes:
            self._meet((source, flags & _EXTENDED))
        return [] if flags & _ERROR else self._streams.get((source, flags & _EXTENDED), [])

    def is_reading(self, frame: td.logs.LoggedFrame) -> bool:
        """Whether it is one of the messages that make a sample of the
        readings."""
        return not frame.flags & _ERROR and (frame.source, frame.flags & _EXTENDED) in self._readings

    def is_counted(self, frame: td.logs.LoggedFrame) -> bool:
        """Whether it is a message of a stream with a counter."""
        return not frame.flags & _ERROR and (frame.source, frame.flags & _EXTENDED) in self._counted

    def settle(self, name: str) -> None:
        """The node and the channels that the frames came by, once all have been
        seen. Raises InputError where that is not one unit's, or none."""
        if self.channel is not None and self.channel not in self.channels:
            raise InputError(f"--channel {self.channel}: {name} has {_listed(self.channels)}")
        if self.node is not None and not self._groups and all(node is None for node in self._nodes.values()):
            raise InputError(f"--node {self.node}: the identifiers of the profile are the same for all nodes")
        nodes = Counter(self._strangers)
        for (key, _), count in self._seen.items():
            if (node := self._nodes[key]) is not None:
                nodes[node] += count
        if self.node is not None and nodes and self.node not in nodes:
            raise InputError(f"--node {self.node}: {name} has frames of {_listed(nodes)}")
        if self.node is None and len(nodes) > 1:
            raise InputError(f"{name}: frames of the nodes {_listed(nodes)}; --node says which is the unit's")
        if self.node is None and nodes:
            self.node = next(iter(nodes))
        self._require_one_channel(name)
        if not self.taken:
            known = identifiers_shown(key for key, _ in self.others.most_common(SHOWN) if key != _FURTHER)
            elsewhere = f"frames of other channels or nodes, or in error ({self.elsewhere})" if self.elsewhere else ""
            there = ", ".join(filter(None, (known, elsewhere))) or "no frame"
            wanted = ", ".join(self._wanted()[:SHOWN])
            where = "in it" if self.channel is None else f"on its channel {self.channel}"
            raise InputError(f"{name}: none of the profile's identifiers ({wanted}) is {where}; found: {there}")

    def _require_one_channel(self, name: str) -> None:
        places: dict[Key, Counter[str]] = {}
        for (key, channel), count in self._seen.items():
            places.setdefault(key, Counter())[channel] += count
        for key, found in places.items():
            if len(found) > 1:
                shown = identifiers_shown([key])
                raise InputError(f"{name}: {shown} comes on {_listed(found)}; --channel says which is the unit's")

    def _wanted(self) -> list[str]:
        shown = []
        for message in (m for layout in self.layouts.values() for m in layout.messages):
            key = message.identifier_of(self.node or 0), _EXTENDED if message.extended else 0
            shifts = message.per_node and self.node is None
            any_source = message.j1939 and self.node is None
            shown.append(identifiers_shown([key]) + (" + node" if shifts else " of any source" if any_source else ""))
        return list(dict.fromkeys(shown))

    @property
    def from_channels(self) -> list[str]:
        """Those that the unit's frames came on."""
        return sorted({channel for _, channel in self._seen})


def _is_counted(layout: td.can.Layout) -> bool:
    return bool(layout.counters or layout.count)


def _identifiers(message: td.can.Message) -> dict[Key, int | None]:
    flag = _EXTENDED if message.extended else 0
    if message.j1939:
        return {}
    if not message.per_node:
        return {(message.identifier, flag): None}
    return {(message.identifier + node, flag): node for node in range(1, td.can.NODES + 1)}


def identifiers_shown(keys: Iterable[Key]) -> str:
    shown = [f"0x{source:X}{'x' if extended else ''}" for source, extended in keys]
    return ", ".join(shown[:SHOWN]) + (", …" if len(shown) > SHOWN else "")


def _listed(counted: Mapping[Any, int]) -> str:
    shown = [
        f"{td.hints.clipped(what)} ({tc.number_format.number_of(count, 'frame')})" for what, count in counted.items()
    ]
    return ", ".join(shown[:SHOWN]) + (", …" if len(shown) > SHOWN else "")


def import_can(log: td.logs.Log, bundle: td.Bundle, out: Path, *, node: int | None, channel: str | None) -> Imported:
    """Raises InputError, RecordingError, LogError, ProfileError."""
    work = work_on(bundle, node=node, channel=channel)

    def describe(importing: Importing) -> dict[str, Any]:
        return work.described(log, importing)

    detail, seconds = write_recording(out, bundle, work.records(log), Path(log.name), describe)
    return Imported(out, detail, seconds)


_LOST_BEFORE = int(td.RawFlag.LOST_BEFORE)


def layouts_of(bundle: td.Bundle) -> dict[str, td.can.Layout]:
    """Of each stream of a profile on CAN. Raises ProfileError."""
    profile = cast(td.can.CanProfile, bundle.profile)
    return {
        name: td.can.stream_layout(stream, bundle.files, where=f"profile {profile.name}, streams.{name}")
        for name, stream in profile.streams.items()
    }


def work_on(bundle: td.Bundle, *, node: int | None, channel: str | None) -> Work:
    """For one log. Raises ProfileError."""
    period_ns = 1e9 / bundle.profile.sampling.rate_hz
    selection = Selection(layouts_of(bundle), node, channel)
    return Work(selection, td.logs.Account(), Times(period_ns), Ticks(period_ns))


class Work:
    """One log on its way into raw records, and what is counted of it."""

    def __init__(self, selection: Selection, account: td.logs.Account, times: Times, ticks: Ticks) -> None:
        self.selection, self.account, self._times, self._ticks = selection, account, times, ticks
        self._readings = Times(times.period_ns)
        self._latest_ns: dict[tuple[int, int], int] = {}  # by identifier
        self._marked_ns = -1  # where a pause was marked last

    def records(self, log: td.logs.Log) -> Iterator[Record]:
        """A loss before a frame that is not taken was before the next that is:
        it may have been of the unit's. A pause is such a loss, as counters may
        have wrapped meanwhile."""
        lost: set[str] = set()  # channels
        for frame in log.frames(self.account):
            if frame.flags & _LOST_BEFORE:
                lost.add(frame.channel)
            if not self.selection.takes(frame):
                continue
            time_ns = self._time_ns(frame)
            if not 0 <= time_ns < td.logs.LONGEST_NS:
                self.account.note(f"frame {self.selection.frames}", f"a time of {time_ns} ns")
                continue
            self._times.note(time_ns)
            paused = self._paused(frame, time_ns)
            flags = frame.flags | _LOST_BEFORE if paused or frame.channel in lost else frame.flags
            lost.discard(frame.channel)
            yield time_ns, frame.source, flags, frame.data

    def _paused(self, frame: td.logs.LoggedFrame, time_ns: int) -> bool:
        """Whether this is the first frame of a stream with a counter after a
        pause of that."""
        if self.selection.is_reading(frame):
            self._readings.note(time_ns)
        if not self.selection.is_counted(frame):
            return False
        key = frame.source, frame.flags & td.logs.EXTENDED
        before_ns, self._latest_ns[key] = self._latest_ns.get(key, time_ns), time_ns
        if not self._times.is_pause(time_ns - before_ns) or self._marked_ns > before_ns:
            return False
        self._marked_ns = time_ns
        return True

    def _time_ns(self, frame: td.logs.LoggedFrame) -> int:
        if td.logs.Remark.NO_TIMES in self.account.remarks:
            return self._ticks.of((frame.source, frame.flags & td.logs.EXTENDED), self.selection.is_reading(frame))
        return -1 if frame.time_ns is None else frame.time_ns

    def described(self, log: td.logs.Log, importing: Importing) -> dict[str, Any]:
        """Raises InputError."""
        chosen, account, counts = self.selection, self.account, importing.counts
        try:
            chosen.settle(log.name)
            if not counts["samples"]:
                why = ", ".join(no_samples(counts)) or "no sample is whole"
                raise InputError(
                    f"{log.name}: no sample in its {tc.number_format.number_of(chosen.taken, 'frame')} of the "
                    f"profile: {why}"
                )
        except InputError as e:
            others = "".join(f"; {count} of kind '{kind}'" for kind, count in account.others.items())
            raise InputError(f"{e}{others}" + (f"; damaged: {account.damage}" if account.damaged else "")) from e
        assert isinstance(log.kind, td.logs.Kind)
        return {
            "kind": log.kind.name,
            "channels": chosen.from_channels,
            "node": chosen.node,
            "frames": chosen.frames,
            "taken": chosen.taken,
            "error_frames": chosen.error_frames,
            "elsewhere": chosen.elsewhere,
            "other_frames": sum(chosen.others.values()),
            "other_records": dict(account.others),
            "damaged": account.damaged,
            "damage": account.damage,
            "unread_date": account.unread_date,
            "remarks": [*sorted(account.remarks), *(["two_senders"] if importing.two_senders else [])],
            "seconds_by_log": self._readings.seconds,
            "times": self._times.document() | {"equal": importing.times.equal},
        }


# Frames of a bus that triaxcal itself recorded, as those of any log.

_PROFILE = slice(len(td.logs.MCAP) + 13, len(td.logs.MCAP) + 13 + len(PROFILE))
"""Of an MCAP file, behind its header's type and length and its own."""


def is_own(path: Path) -> bool:
    """Whether it is a recording of ours, or the manifest of one in segments.
    Raises InputError where such a one is packed."""
    if is_manifest(path):
        return True
    try:
        with td.files.open_file(path) as file:
            head = file.read(_PROFILE.stop)
            packed = head.startswith(b"\x1f\x8b")
            if packed:
                file.seek(0)
                head = gzip.GzipFile(fileobj=file).read(_PROFILE.stop)
    except (OSError, EOFError, zlib.error):
        return False
    own = head.startswith(td.logs.MCAP) and head[_PROFILE] == PROFILE.encode()
    if own and packed:
        raise InputError(f"{path}: a recording of triaxcal, packed with gzip; unpack it first")
    return own


def own_log(path: Path) -> td.logs.Log:
    """Its frames raise RecordingError, InputError."""

    def frames(_: BinaryIO, account: td.logs.Account) -> Iterator[td.logs.LoggedFrame]:
        with open_recording(path) as recording:
            if not is_of_bus(recording):
                raise InputError(f"{path}: a recording of one unit already, expected one of all frames of a bus")
            for row in frame_rows(recording):
                yield td.logs.LoggedFrame(*row)

    return td.logs.Log(str(path), td.logs.Kind("triaxcal", frames), io.BytesIO())
