"""What a command that writes nothing owes to whoever reads a device in between."""

from __future__ import annotations

from triaxcald import text
from triaxcald.cli.console import say
from triaxcald.provision.journal import open_journal
from triaxcald.station.config import Station


def of_a_journal(station: Station, unit: str, serial: str | None) -> str | None:
    """What there is to warn of, where an earlier provisioning of the unit is
    not settled."""
    journal = open_journal(station.folder, station.place(unit).bundle.profile, unit, serial)
    return text.unfinished(journal, unit, station.path) if journal else None


def warn_of_a_journal(station: Station, unit: str, serial: str | None) -> None:
    """To standard error."""
    if warning := of_a_journal(station, unit, serial):
        say(f"warning: unit {unit}: {warning}")
