"""What a command that writes nothing owes to whoever reads a device in between."""

from __future__ import annotations

from triaxcald import text
from triaxcald.cli.console import say
from triaxcald.provision.journal import open_journal
from triaxcald.station.config import Station


def warn_of_a_journal(station: Station, unit: str, serial: str | None) -> None:
    """To standard error, where an earlier provisioning of the unit is not
    settled."""
    if journal := open_journal(station.folder, unit, serial):
        say(f"warning: unit {unit}: {text.unfinished(journal, unit, station.path)}")
