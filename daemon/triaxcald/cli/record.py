"""record."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from contextlib import AsyncExitStack, nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from triaxcald import text
from triaxcald.cli.arguments import writable
from triaxcald.cli.console import Bars, say
from triaxcald.cli.interrupt import run_interruptible
from triaxcald.cli.journals import of_a_journal, warn_of_a_journal
from triaxcald.cli.json_lines import JsonLines
from triaxcald.errors import InputError
from triaxcald.exit_codes import severest
from triaxcald.provision.identity import IdentityRead
from triaxcald.recording.manifest import SUFFIX
from triaxcald.station.buses import BusPlace
from triaxcald.station.config import Place, Station, load_station
from triaxcald.station.lines import check_lines

if TYPE_CHECKING:  # matplotlib and all come once the file is known to be good
    from triaxcald.run.recording import AtRecording, Kept, UnitStatus
    from triaxcald.run.session import Segments, UnitSession


def record_command(a: argparse.Namespace) -> int:
    folder = a.output.is_dir()
    if not folder:
        writable(a.output)
    station = load_station(a.station)
    places, buses = _chosen(station, a.unit, a.output, folder)
    check_lines(places, buses, where=str(station.path))
    with Bars() if a.log_format == "text" else nullcontext(JsonLines()) as progress:
        kept = run_interruptible(_record(a, station, places, buses, progress))
    return severest(k.exit_code for k in kept)


async def _record(
    a: argparse.Namespace,
    station: Station,
    places: Sequence[Place],
    buses: Sequence[BusPlace],
    progress: Bars | JsonLines,
) -> list[Kept]:
    from triaxcald.run.recording import State, record_units
    from triaxcald.service.supervisor import Supervisor
    from triaxcald.station.coming_back import Patience

    folder = a.output.is_dir()
    recordings = [*_of_units(a, station, places, progress), *_of_buses(a, station, buses, progress)]

    def statuses() -> list[UnitStatus]:
        return [recording.status for recording in recordings]

    def in_a_line() -> str:
        there = statuses()
        lost = [u.unit for u in there if u.state is State.WAITING]
        return text.recorded(len(places), len(buses), lost, sum(u.records for u in there))

    async with AsyncExitStack() as stack:
        if a.metrics is not None:
            from triaxcald.service.metrics import served

            port = stack.enter_context(served(a.metrics, statuses, a.output if folder else a.output.parent))
            progress.stage("record", text.metrics_at(port))
        await stack.enter_async_context(Supervisor().kept_informed(in_a_line))
        patience = Patience(most_s=a.give_up_after)
        return await record_units(recordings, a.seconds, patience, lambda kept: _ended(kept, progress))


def _of_units(
    a: argparse.Namespace, station: Station, places: Sequence[Place], progress: Bars | JsonLines
) -> list[AtRecording]:
    from triaxcald.run.recording import UnitRecording
    from triaxcald.run.session import UnitSession
    from triaxcald.station.serials import SerialsSeen

    def path_of(session: UnitSession) -> Callable[[IdentityRead], Path]:
        if not a.output.is_dir():
            return lambda _: Path(a.output)
        if segments is not None:  # the next start goes on behind it
            return lambda identity: Path(a.output) / f"{session.name}-{identity.serial or 'unknown'}{SUFFIX}"
        return lambda identity: Path(a.output) / session.recording_name(identity)

    def identified(session: UnitSession, identity: IdentityRead) -> None:
        if not isinstance(progress, JsonLines):
            warn_of_a_journal(session.station, session.name, identity.serial)
        elif warning := of_a_journal(session.station, session.name, identity.serial):
            progress.say("warning", "journal", unit=session.name, message=warning)

    segments, serials = _segments(a), SerialsSeen()
    sessions = [UnitSession(station, place, progress, serials=serials) for place in places]
    return [UnitRecording(session, path_of(session), identified, segments) for session in sessions]


def _of_buses(
    a: argparse.Namespace, station: Station, buses: Sequence[BusPlace], progress: Bars | JsonLines
) -> list[AtRecording]:
    from triaxcald.run.bus_recording import BusRecording, bus_recording_name

    def path_of(bus: BusPlace) -> Path:
        if not a.output.is_dir():
            return Path(a.output)
        name = f"{bus.name}{SUFFIX}" if segments is not None else bus_recording_name(bus.name, time.time_ns())
        return Path(a.output) / name

    segments = _segments(a)
    return [BusRecording(station, bus, progress, partial(path_of, bus), segments) for bus in buses]


def _segments(a: argparse.Namespace) -> Segments | None:
    """Where anything about them was said."""
    from triaxcald.recording.retention import Retention
    from triaxcald.recording.segments import SEGMENT_BYTES, SEGMENT_S
    from triaxcald.run.session import Segments

    if all(given is None for given in (a.segment_size, a.segment_time, a.keep, a.keep_free)):
        return None
    retention = None if a.keep is a.keep_free is None else Retention(a.keep, a.keep_free or 0)
    return Segments(a.segment_size or SEGMENT_BYTES, a.segment_time or SEGMENT_S, retention)


def _chosen(
    station: Station, name: str | None, output: Path, folder: bool
) -> tuple[Sequence[Place], Sequence[BusPlace]]:
    """What is to be recorded. Raises InputError."""
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
        level = "info" if kept.error is None else "error"
        told = {"message": kept.error, **counts, "lost": kept.lost}
        progress.say(level, "ended", unit=kept.unit, kind=kept.kind, recording=path, **told)
        return
    if kept.path is not None:
        say(_summary(kept))
    if kept.error is not None:
        say(f"triaxcal: {kept.error}")


def _summary(kept: Kept) -> str:
    if kept.kind == "bus":
        parts = [text.bus_recorded(kept.unit, kept.counts, kept.seconds), str(kept.path)]
    else:
        parts = [f"{kept.path}: {kept.counts['samples']} samples in {kept.seconds:.1f} s"]
        of_samples = ("samples", "receiver_overflows")
        parts += [f"{n} {kind}" for kind, n in kept.counts.items() if n and kind not in of_samples]
    if kept.gaps:
        parts.append(f"{kept.gaps} gaps of {kept.gaps_s:.1f} s in all")
    if kept.lost:
        parts.append(f"{kept.lost} records lost between bus and disk")
    return ", ".join(parts)
