"""people, token."""

from __future__ import annotations

import argparse
import getpass
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from triaxcald.cli.console import show, table
from triaxcald.errors import InputError
from triaxcald.printable import printable
from triaxcald.service.ledger import Ledger
from triaxcald.service.people import PIN_MOST, People, Role, already, hashed, nobody, require_name
from triaxcald.station.config import load_station

PIN_BYTES_MOST = 4 * PIN_MOST + 2
"""Of a file with a PIN and the end of its line."""
COMMAND_LINE = "command line"
"""In place of an address in the trail."""


@contextmanager
def _opened(a: argparse.Namespace) -> Iterator[tuple[People, _Trail]]:
    """The people of a station, and the trail for what is done with them. Raises
    DaemonError."""
    station = load_station(a.station)
    ledger = Ledger.open(station, a.database)
    try:
        yield People(ledger), _Trail(ledger)
    finally:
        ledger.close()


class _Trail:
    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger

    def add(self, action: str, name: str, **what: str) -> None:
        """A row by the user of this machine, who may do everything to the database."""
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        done: dict[str, Any] = {"name": name, **what, "by": COMMAND_LINE}
        self._ledger.trail(now, _user(), Role.ENGINEER.value, action, done, True, None)


def _user() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError):  # a number without a name
        return "unknown"


def people_add(a: argparse.Namespace) -> int:
    require_name(a.name)
    with _opened(a) as (people, trail):
        if people.person(a.name) is not None:
            raise already(a.name)
        people.add(a.name, Role(a.role), hashed(_pin(a)))
        trail.add("person_add", a.name, role=a.role)
    return 0


def people_list(a: argparse.Namespace) -> int:
    with _opened(a) as (people, _):
        everyone = people.everyone()
    if everyone:
        table("people", ("name", "role", ""), [(p.name, p.role, "disabled" if p.disabled else "") for p in everyone])
    else:
        show("no people; triaxcal people add adds one")
    return 0


def people_pin(a: argparse.Namespace) -> int:
    with _opened(a) as (people, trail):
        if people.person(a.name) is None:
            raise nobody(a.name)
        people.set_pin(a.name, hashed(_pin(a)))
        trail.add("person_pin", a.name)
    return 0


def people_role(a: argparse.Namespace) -> int:
    with _opened(a) as (people, trail):
        people.set_role(a.name, Role(a.role))
        trail.add("person_role", a.name, role=a.role)
    return 0


def people_disable(a: argparse.Namespace) -> int:
    return _disable(a, True)


def people_enable(a: argparse.Namespace) -> int:
    return _disable(a, False)


def _disable(a: argparse.Namespace, disabled: bool) -> int:
    with _opened(a) as (people, trail):
        people.disable(a.name, disabled)
        trail.add("person_disable" if disabled else "person_enable", a.name)
    return 0


def token_new(a: argparse.Namespace) -> int:
    require_name(a.name)
    with _opened(a) as (people, trail):
        token = people.new_token(a.name, Role(a.role))
        trail.add("token_new", a.name, role=a.role)
    show(token)
    return 0


def token_list(a: argparse.Namespace) -> int:
    with _opened(a) as (people, _):
        tokens = people.tokens()
    if tokens:
        rows = [(t.name, t.role, t.created, "revoked" if t.revoked else "") for t in tokens]
        table("tokens", ("name", "role", "created", ""), rows)
    else:
        show("no tokens; triaxcal token new makes one")
    return 0


def token_revoke(a: argparse.Namespace) -> int:
    with _opened(a) as (people, trail):
        people.revoke(a.name)
        trail.add("token_revoke", a.name)
    return 0


def _pin(a: argparse.Namespace) -> str:
    """From --pin-file, else from the terminal, which does not show it. Raises
    InputError."""
    if a.pin_file is not None:
        return _pin_in(a.pin_file)
    if not sys.stdin.isatty():
        raise InputError("--pin-file: there is no terminal to ask for the PIN; give a file, or - for standard input")
    try:
        pin = getpass.getpass(printable(f"PIN for {a.name}: "))
        again = getpass.getpass("The same again: ")
    except EOFError:
        raise InputError("no PIN was given") from None
    if pin != again:
        raise InputError("the two PINs differ; nothing was changed")
    return pin


def _pin_in(name: str) -> str:
    """The only line of a file. Raises InputError, which does not repeat it."""
    try:
        if name == "-":
            data = sys.stdin.buffer.read(PIN_BYTES_MOST + 1)
        else:
            with Path(name).open("rb") as file:
                data = file.read(PIN_BYTES_MOST + 1)
    except (OSError, ValueError) as e:
        raise InputError(f"--pin-file: {name}: {getattr(e, 'strerror', None) or e}") from e
    try:
        pin = data.decode().removesuffix("\n").removesuffix("\r")
    except UnicodeDecodeError:
        raise InputError(f"--pin-file: {name}: expected text in UTF-8") from None
    if len(data) > PIN_BYTES_MOST or "\n" in pin:
        raise InputError(f"--pin-file: {name}: expected one line with the PIN")
    return pin
