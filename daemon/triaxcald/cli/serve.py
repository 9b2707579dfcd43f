"""serve: the service and the page of a station."""

from __future__ import annotations

import argparse
import asyncio
import signal

import triaxcal_drivers as td
from triaxcald.cli.console import say
from triaxcald.cli.interrupt import Interrupted, run_interruptible
from triaxcald.errors import InputError
from triaxcald.station.config import Station, check_lines, load_station

WEB = ("fastapi", "uvicorn", "sse_starlette", "sqlalchemy", "alembic", "httpx", "argon2")


def require_web(command: str) -> None:
    """Raises InputError without the extra `serve`."""
    fault = td.hints.absent(WEB)
    if fault:
        raise InputError(f"{command}: {fault}")


def _backup(a: argparse.Namespace, station: Station) -> int:
    from triaxcald.service.ledger import Ledger

    ledger = Ledger.open(station, a.database)
    try:
        ledger.backup(a.backup)
    finally:
        ledger.close()
    say(f"{a.backup}: a copy of the database")
    return 0


def serve_command(a: argparse.Namespace) -> int:
    require_web("serve")
    station = load_station(a.station)
    station.require_units()
    check_lines(station.places, where=str(station.path))
    if a.backup is not None:
        return _backup(a, station)
    from triaxcald.service.gate import require_safe
    from triaxcald.service.server import Address, serve

    require_safe(a.host, a.cert, a.key)
    reload = asyncio.Event()
    address = Address(a.host, a.port, a.cert, a.key)
    work = serve(
        station, address, a.database, log=say, reload=reload,
        ready=lambda url: say(f"serving {station.file.name} at {url}; Ctrl-C stops it"),
    )  # fmt: skip
    try:
        run_interruptible(work, reload.set)
    except Interrupted as e:
        if e.number == signal.SIGINT:
            raise
        say("triaxcal: stopped")
    return 0
