"""Logs of a CAN bus, through a profile of the driver ``can``."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

from triaxcal.number_format import number_of
from triaxcal_drivers.can.description import stream_layout
from triaxcal_drivers.can.model import CanProfile
from triaxcal_drivers.interface import RawFlag
from triaxcal_drivers.logs.frames import EXTENDED, Account, LoggedFrame, Remark
from triaxcal_drivers.logs.kinds import Kind, Log
from triaxcal_drivers.logs.times import LONGEST_NS
from triaxcal_drivers.profile import Bundle
from triaxcald.errors import InputError
from triaxcald.imports import text
from triaxcald.imports.importing import Imported, Importing, Record, write_recording
from triaxcald.imports.selection import Selection
from triaxcald.imports.times import Ticks, Times


def import_can(log: Log, bundle: Bundle, out: Path, *, node: int | None, channel: str | None) -> Imported:
    """Raises InputError, RecordingError, LogError, ProfileError."""
    profile = cast(CanProfile, bundle.profile)
    assert isinstance(log.kind, Kind)
    layouts = {
        name: stream_layout(stream, bundle.files, where=f"profile {profile.name}, streams.{name}")
        for name, stream in profile.streams.items()
    }
    period_ns = 1e9 / profile.sampling.rate_hz
    work = _Work(Selection(layouts, node, channel), Account(), Times(period_ns), Ticks(period_ns))

    def describe(importing: Importing) -> dict[str, Any]:
        return work.described(log, importing)

    detail, seconds = write_recording(out, bundle, work.records(log), Path(log.name), describe)
    return Imported(out, detail, seconds)


_LOST_BEFORE = int(RawFlag.LOST_BEFORE)


class _Work:
    """What is counted on the way."""

    def __init__(self, selection: Selection, account: Account, times: Times, ticks: Ticks) -> None:
        self._selection, self._account, self._times, self._ticks = selection, account, times, ticks
        self._readings = Times(times.period_ns)
        self._latest_ns: dict[tuple[int, int], int] = {}  # by identifier
        self._marked_ns = -1  # where a pause was marked last

    def records(self, log: Log) -> Iterator[Record]:
        """A loss before a frame that is not taken was before the next that is:
        it may have been of the unit's. A pause is such a loss, as counters may
        have wrapped meanwhile."""
        lost: set[str] = set()  # channels
        for frame in log.frames(self._account):
            if frame.flags & _LOST_BEFORE:
                lost.add(frame.channel)
            if not self._selection.takes(frame):
                continue
            time_ns = self._time_ns(frame)
            if not 0 <= time_ns < LONGEST_NS:
                self._account.note(f"frame {self._selection.frames}", f"a time of {time_ns} ns")
                continue
            self._times.note(time_ns)
            paused = self._paused(frame, time_ns)
            flags = frame.flags | _LOST_BEFORE if paused or frame.channel in lost else frame.flags
            lost.discard(frame.channel)
            yield time_ns, frame.source, flags, frame.data

    def _paused(self, frame: LoggedFrame, time_ns: int) -> bool:
        """Whether this is the first frame of a stream with a counter after a
        pause of that."""
        if self._selection.is_reading(frame):
            self._readings.note(time_ns)
        if not self._selection.is_counted(frame):
            return False
        key = frame.source, frame.flags & EXTENDED
        before_ns, self._latest_ns[key] = self._latest_ns.get(key, time_ns), time_ns
        if not self._times.is_pause(time_ns - before_ns) or self._marked_ns > before_ns:
            return False
        self._marked_ns = time_ns
        return True

    def _time_ns(self, frame: LoggedFrame) -> int:
        if Remark.NO_TIMES in self._account.remarks:
            return self._ticks.of((frame.source, frame.flags & EXTENDED), self._selection.is_reading(frame))
        return -1 if frame.time_ns is None else frame.time_ns

    def described(self, log: Log, importing: Importing) -> dict[str, Any]:
        """Raises InputError."""
        chosen, account, counts = self._selection, self._account, importing.counts
        try:
            chosen.settle(log.name)
            if not counts["samples"]:
                why = ", ".join(text.no_samples(counts)) or "no sample is whole"
                raise InputError(
                    f"{log.name}: no sample in its {number_of(chosen.taken, 'frame')} of the profile: {why}"
                )
        except InputError as e:
            others = "".join(f"; {count} of kind '{kind}'" for kind, count in account.others.items())
            raise InputError(f"{e}{others}" + (f"; damaged: {account.damage}" if account.damaged else "")) from e
        assert isinstance(log.kind, Kind)
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
            "remarks": [*sorted(account.remarks), *(["two_senders"] if importing.two_senders else [])],
            "seconds_by_log": self._readings.seconds,
            "times": self._times.document() | {"equal": importing.times.equal},
        }
