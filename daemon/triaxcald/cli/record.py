"""record."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from triaxcald.cli.arguments import writable
from triaxcald.cli.console import Bars, say
from triaxcald.cli.interrupt import run_interruptible
from triaxcald.cli.journals import warn_of_a_journal
from triaxcald.errors import InputError
from triaxcald.exit_codes import severest
from triaxcald.provision.identity import IdentityRead
from triaxcald.station.config import Place, Station, check_lines, load_station

if TYPE_CHECKING:  # matplotlib and all come once the file is known to be good
    from triaxcald.run.recording import Kept
    from triaxcald.run.session import UnitSession


def record_command(a: argparse.Namespace) -> int:
    folder = a.output.is_dir()
    if not folder:
        writable(a.output)
    station = load_station(a.station)
    places = _places(station, a.unit, a.output, folder)
    check_lines(places, where=str(station.path))
    from triaxcald.run.recording import UnitRecording, record_units
    from triaxcald.run.session import UnitSession
    from triaxcald.station.coming_back import Patience
    from triaxcald.station.serials import SerialsSeen

    def path_of(session: UnitSession) -> Callable[[IdentityRead], Path]:
        if not folder:
            return lambda _: Path(a.output)
        return lambda identity: Path(a.output) / session.recording_name(identity)

    def identified(session: UnitSession, identity: IdentityRead) -> None:
        warn_of_a_journal(session.station, session.name, identity.serial)

    serials = SerialsSeen()
    with Bars() as bars:
        sessions = [UnitSession(station, place, bars, serials=serials) for place in places]
        recordings = [UnitRecording(session, path_of(session), identified) for session in sessions]
        patience = Patience(most_s=a.give_up_after)
        kept = run_interruptible(record_units(recordings, a.seconds, patience, _ended))
    return severest(k.exit_code for k in kept)


def _places(station: Station, unit: str | None, output: Path, folder: bool) -> Sequence[Place]:
    if unit is not None or len(station.places) == 1:
        return [station.place(unit)]
    if not folder:
        names = ", ".join(p.unit.name for p in station.places)
        raise InputError(
            f"{station.path}: there are {len(station.places)} units; name one of {names} with --unit, or record all "
            f"of them into a folder that exists: {output} is none"
        )
    return station.places


def _ended(kept: Kept) -> None:
    if kept.path is not None:
        say(_summary(kept))
    if kept.error is not None:
        say(f"triaxcal: {kept.error}")


def _summary(kept: Kept) -> str:
    parts = [f"{kept.path}: {kept.counts['samples']} samples in {kept.seconds:.1f} s"]
    parts += [f"{n} {kind}" for kind, n in kept.counts.items() if n and kind != "samples"]
    if kept.gaps_s:
        parts.append(f"{kept.gaps_s:.1f} s of gaps")
    if kept.lost:
        parts.append(f"{kept.lost} records lost between bus and disk")
    return ", ".join(parts)
