"""record."""

from __future__ import annotations

import argparse
import asyncio
import json
import sys
import time
from collections.abc import Callable, Collection, Sequence
from contextlib import AsyncExitStack, nullcontext, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import triaxcal as tc
from triaxcald import text
from triaxcald.cli.bars import Bars
from triaxcald.cli.console import say
from triaxcald.cli.devices import of_a_journal, warn_of_a_journal
from triaxcald.cli.interrupt import run_interruptible
from triaxcald.cli.syntax import writable
from triaxcald.decoded import beside_samples
from triaxcald.errors import DISK, INTERRUPTED, InputError, severest
from triaxcald.files import require_new, require_recording, unused
from triaxcald.memory import little_garbage
from triaxcald.printable import printable_json
from triaxcald.provision.identity import IdentityRead
from triaxcald.recording.manifest import SUFFIX
from triaxcald.recording.schema import Phase
from triaxcald.schema.codes import Code, Stage
from triaxcald.station.buses import BusPlace
from triaxcald.station.config import Place, Station, changed, check_lines, load_station
from triaxcald.station.guidance import Guide
from triaxcald.station.tray import Instruction
from triaxcald.utc import iso_time

if TYPE_CHECKING:
    from triaxcald.run.record_only import AtRecording, Kept, Roster
    from triaxcald.run.session import Segments, UnitSession
    from triaxcald.station.config import SerialsSeen


# Progress as one JSON object a line, for whoever collects logs.


class JsonLines:
    """``time`` (UTC), ``level`` (``info``, ``warning``, ``error``), ``event``,
    ``unit`` where it is of one, and what else there is to say, to standard
    error by default."""

    def __init__(self, out: TextIO | None = None, clock_ns: Callable[[], int] = time.time_ns) -> None:
        self._out, self._clock_ns = out or sys.stderr, clock_ns

    def stage(self, unit: str, stage: Stage) -> None:
        self.note(unit, text.STAGES[stage])

    def note(self, unit: str, text: str) -> None:
        self.say("info", "stage", unit=unit, message=text)

    def lost(self, unit: str, code: Code, reason: str) -> None:
        self.say("warning", "lost", unit=unit, message=reason)

    def back(self, unit: str) -> None:
        self.note(unit, text.IS_BACK)

    def poses(self, unit: str, phase: Phase, guide: Guide) -> None:
        self.say("info", "poses", unit=unit, phase=phase, found=guide.found, wanted=guide.wanted, message=guide.text)

    def instruction(self, instruction: Instruction | None) -> None:
        if instruction is not None:
            self.say("info", "instruction", slots=instruction.slots, message=instruction.label)

    def say(self, level: str, event: str, **more: Any) -> None:
        """Nowhere, where nobody reads any more: no work may fail for it."""
        line = {"time": iso_time(self._clock_ns()), "level": level, "event": event, **more}
        with suppress(OSError, ValueError):
            self._out.write(printable_json(json.dumps(line, ensure_ascii=False, allow_nan=False)) + "\n")
            self._out.flush()


AGAIN_S = 60.0
"""Period in which a recording that a full disk ended is tried again while others go
on."""


@dataclass(frozen=True)
class _Chosen:
    """Units and buses of a station that are to be recorded."""

    station: Station
    places: Sequence[Place]
    buses: Sequence[BusPlace]

    @property
    def names(self) -> set[str]:
        return {place.unit.name for place in self.places} | {bus.name for bus in self.buses}

    def without(self, names: Collection[str]) -> _Chosen:
        places = [place for place in self.places if place.unit.name not in names]
        return replace(self, places=places, buses=[bus for bus in self.buses if bus.name not in names])


def record_command(a: argparse.Namespace) -> int:
    with little_garbage():
        return _recorded(a)


def _recorded(a: argparse.Namespace) -> int:
    a.folder = a.output.is_dir()
    if not a.folder:
        writable(a.output)
        require_new(a.output)  # before any device is asked
    chosen, hangup = _load(a), asyncio.Event()
    if not a.folder:
        if not a.output.suffix:
            raise InputError(f"{a.output}: there is no such folder, and the name of a recording ends in .mcap")
        require_recording(a.output)
    with Bars() if a.log_format == "text" else nullcontext(JsonLines()) as progress:
        # A single file is one recording, which cannot begin anew.
        kept = run_interruptible(_record(a, chosen, progress, hangup), hangup.set if a.folder else None)
    # None is left where it was stopped in the midst of a reload.
    return severest(k.exit_code for k in kept) if kept else INTERRUPTED


def _load(a: argparse.Namespace) -> _Chosen:
    """Raises InputError, ProfileError, DriverMissing."""
    station = load_station(a.station)
    places, buses = _of_station(station, a.unit, a.output, a.folder)
    chosen = _Chosen(station, [replace(place, start=not a.no_start) for place in places], buses)
    check_lines(chosen.places, chosen.buses, where=str(station.path))
    return chosen


async def _record(
    a: argparse.Namespace, chosen: _Chosen, progress: Bars | JsonLines, hangup: asyncio.Event
) -> list[Kept]:
    from triaxcald.run.record_only import Roster, State
    from triaxcald.service.supervisor import Supervisor
    from triaxcald.station.config import SerialsSeen
    from triaxcald.station.reconnect import RetryPolicy

    roster = Roster(
        a.seconds, RetryPolicy(most_s=a.give_up_after, in_use=a.folder), lambda kept: _ended(kept, progress)
    )
    serials = SerialsSeen()

    def in_a_line() -> str:
        there = roster.statuses()
        lost, ended = ([one.unit for one in there if one.state is state] for state in (State.WAITING, State.ENDED))
        buses = sum(one.kind == "bus" for one in there)
        return text.recorded(len(there) - buses, buses, lost, ended, sum(one.records for one in there))

    async with AsyncExitStack() as stack:
        if a.metrics is not None:
            from triaxcald.service.supervisor import served

            folder = a.output if a.folder else a.output.parent
            port = stack.enter_context(served(a.metrics, roster.statuses, folder))
            progress.note("record", text.metrics_at(port))
        await stack.enter_async_context(Supervisor().kept_informed(in_a_line))
        roster.begin(_recordings(a, chosen, progress, serials))
        reloading = asyncio.ensure_future(_reload(a, chosen, roster, progress, serials, hangup))
        stack.callback(reloading.cancel)
        return await roster.finish()


async def _reload(
    a: argparse.Namespace,
    chosen: _Chosen,
    roster: Roster,
    progress: Bars | JsonLines,
    serials: SerialsSeen,
    hangup: asyncio.Event,
) -> None:
    """The station file, each time that it is asked for. What is as it was goes
    on; what ended, for whatever reason, begins again. What the disk ended does
    so now and then by itself."""
    from triaxcald.run.error_reasons import reason_of, trace_of

    while True:
        asked = await _is_set(hangup, AGAIN_S)
        hangup.clear()
        try:
            if not asked:
                names = roster.ended_with(DISK) if a.folder and a.seconds is None else set()
                roster.begin(_recordings(a, chosen, progress, serials, chosen.names - names))
                continue
            new = await asyncio.to_thread(_load, a)
            leaving = changed(chosen.station, new.station) & (chosen.names | new.names)
            beginning = _recordings(a, new, progress, serials, roster.at_work() - leaving)
        except Exception as e:  # noqa: BLE001 - a driver of anybody's reads its part; what is recorded goes on
            failed = text.not_reloaded if asked else text.not_begun_again
            _tell(progress, "error", failed(reason_of(e)), trace_of(e))
            continue
        _tell(progress, "info", text.reloaded(sorted(leaving)))
        chosen = new
        await roster.change(leaving, beginning)


async def _is_set(event: asyncio.Event, within_s: float) -> bool:
    with suppress(TimeoutError):
        async with asyncio.timeout(within_s):
            await event.wait()
    return event.is_set()


def _tell(progress: Bars | JsonLines, level: str, message: str, trace: str | None = None) -> None:
    if isinstance(progress, JsonLines):
        progress.say(level, "reload", message=message, **_traced(trace))
    else:
        say(f"record: {message}")
        _show(trace)


def _traced(trace: str | None) -> dict[str, str]:
    return {} if trace is None else {"trace": trace}


def _show(trace: str | None) -> None:
    for line in trace.rstrip().splitlines() if trace is not None else ():
        say(line)


def _recordings(
    a: argparse.Namespace,
    chosen: _Chosen,
    progress: Bars | JsonLines,
    serials: SerialsSeen,
    at_work: Collection[str] = (),
) -> list[AtRecording]:
    """Recordings of all units and buses that are not ``at_work``."""
    chosen = chosen.without(at_work)
    return [
        *_of_units(a, chosen.station, chosen.places, progress, serials),
        *_of_buses(a, chosen.station, chosen.buses, progress),
    ]


def _of_units(
    a: argparse.Namespace,
    station: Station,
    places: Sequence[Place],
    progress: Bars | JsonLines,
    serials: SerialsSeen,
) -> list[AtRecording]:
    from triaxcald.run.record_only import UnitRecording
    from triaxcald.run.session import UnitSession

    def path_of(session: UnitSession) -> Callable[[IdentityRead], Path]:
        if not a.folder:
            return lambda _: Path(a.output)
        if segments is not None:  # the next start goes on behind it
            return lambda identity: Path(a.output) / f"{session.name}-{identity.serial or 'unknown'}{SUFFIX}"
        return lambda identity: unused(Path(a.output) / session.recording_name(identity))

    def identified(session: UnitSession, identity: IdentityRead) -> None:
        if not isinstance(progress, JsonLines):
            warn_of_a_journal(session.station, session.name, identity.serial)
        elif warning := of_a_journal(session.station, session.name, identity.serial):
            progress.say("warning", "journal", unit=session.name, message=warning)

    segments = _segments(a, station)
    sessions = [UnitSession(station, place, progress, serials=serials) for place in places]
    return [UnitRecording(session, path_of(session), identified, segments) for session in sessions]


def _of_buses(
    a: argparse.Namespace, station: Station, buses: Sequence[BusPlace], progress: Bars | JsonLines
) -> list[AtRecording]:
    from triaxcald.run.record_only import BusRecording, bus_recording_name

    def path_of(bus: BusPlace) -> Path:
        if not a.folder:
            return Path(a.output)
        if segments is not None:
            return Path(a.output) / f"{bus.name}{SUFFIX}"
        return unused(Path(a.output) / bus_recording_name(bus.name, time.time_ns()))

    segments = _segments(a, station)
    return [BusRecording(station, bus, progress, partial(path_of, bus), segments) for bus in buses]


def _segments(a: argparse.Namespace, station: Station) -> Segments | None:
    """Segments by the options; None without any of these. A station with a key signs
    which it deletes. Raises InputError if it cannot."""
    from triaxcald.recording.manifest import SEGMENT_BYTES, SEGMENT_S, Retention
    from triaxcald.run.session import Segments

    if all(given is None for given in (a.segment_size, a.segment_time, a.keep, a.keep_free)):
        return None
    retention = None if a.keep is a.keep_free is None else Retention(a.keep, a.keep_free or 0)
    bury = None
    if retention is not None:
        from triaxcald.signing.station import signing_of

        signing = signing_of(station)
        bury = None if signing is None else signing.bury
    return Segments(a.segment_size or SEGMENT_BYTES, a.segment_time or SEGMENT_S, retention, bury)


def _of_station(
    station: Station, name: str | None, output: Path, folder: bool
) -> tuple[Sequence[Place], Sequence[BusPlace]]:
    """Units and buses to record. Raises InputError."""
    units, buses = [p.unit.name for p in station.places], [b.name for b in station.buses]
    if name is None:
        if not folder and len(units) + len(buses) > 1:
            raise InputError(f"{station.path}: {text.one_of_several(units, buses, output)}")
        return station.places, station.buses
    if name in buses:
        return [], [station.buses[buses.index(name)]]
    if name not in units and buses:
        there = "units and buses" if units else "buses"
        raise InputError(f"{station.path}: {there}: name one of {', '.join([*units, *buses])} with --unit")
    return [station.place(name)], []


def _ended(kept: Kept, progress: Bars | JsonLines) -> None:
    if isinstance(progress, JsonLines):
        counts = {name: n for name, n in kept.counts.items() if n}
        path = str(kept.path) if kept.path else None
        asked_to = kept.error is None or kept.exit_code == INTERRUPTED
        level = "error" if not asked_to else "warning" if kept.lost or kept.data_quality else "info"
        told: dict[str, Any] = {"message": kept.error, **_traced(kept.trace), **counts, "lost": kept.lost}
        told |= {"unconfirmed": kept.unconfirmed} if kept.unconfirmed else {}
        told |= {"data_quality": list(kept.data_quality)} if kept.data_quality else {}
        progress.say(level, "ended", unit=kept.unit, kind=kept.kind, recording=path, **told)
        return
    if kept.path is not None:
        say(_summary(kept))
        for line in kept.data_quality:
            say(f"warning: {kept.kind} {kept.unit}: {line}")
    if kept.error is not None:
        _show(kept.trace)
        say(f"triaxcal: {kept.error}")


def _summary(kept: Kept) -> str:
    if kept.kind == "bus":
        parts = [text.bus_recorded(kept.unit, kept.counts, kept.seconds), str(kept.path)]
    else:
        parts = [
            f"{kept.path}: {tc.number_format.number_of(kept.counts['samples'], 'sample')} in "
            f"{text.own_seconds(kept.seconds, kept.host_seconds)}"
        ]
        parts += beside_samples({kind: n for kind, n in kept.counts.items() if kind != "receiver_overflows"})
    if kept.gaps:
        parts.append(f"{tc.number_format.number_of(kept.gaps, 'gap')} of {kept.gaps_s:.1f} s in all")
    if kept.unconfirmed:
        parts.append(f"{tc.number_format.number_of(kept.unconfirmed, 'record')} unconfirmed")
    if kept.lost:
        parts.append(f"{tc.number_format.number_of(kept.lost, 'record')} lost between bus and disk")
    return ", ".join(parts)
