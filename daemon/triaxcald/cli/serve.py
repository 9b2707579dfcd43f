"""serve: the service and the page of a station."""

from __future__ import annotations

import argparse
import asyncio
import signal
import socket
import webbrowser
from collections.abc import Mapping
from contextlib import suppress
from typing import TYPE_CHECKING

import triaxcal_drivers as td
from triaxcald.cli.console import say
from triaxcald.cli.interrupt import Interrupted, run_interruptible
from triaxcald.cli.stations import simulated
from triaxcald.errors import InputError
from triaxcald.memory import little_garbage
from triaxcald.station.config import Station, check_lines, load_station

if TYPE_CHECKING:
    from triaxcald.service.server import Address, StationService
    from triaxcald.simulation.tray import Tray

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
    if station.file.rules.golden is not None:
        from triaxcald.run.golden_unit import golden_calibration

        golden_calibration(station)
    if station.file.odds is not None:
        from triaxcald.learned_odds import odds_of_station

        odds_of_station(station)
    from triaxcald.signing.station import signing_of

    signing_of(station)
    from triaxcald.service.gate import require_safe
    from triaxcald.service.server import Address, serve

    require_safe(a.host, a.cert, a.key)
    reload = asyncio.Event()
    address = Address(a.host, a.port, a.cert, a.key)
    work = serve(
        station, address, a.database, log=say, reload=reload,
        ready=lambda url, _: say(f"serving {station.file.name} at {url}; Ctrl-C stops it"),
    )  # fmt: skip
    try:
        with little_garbage():  # a full collection would delay the event loop
            run_interruptible(work, reload.set)
    except Interrupted as e:
        if e.number == signal.SIGINT:
            raise
        say("triaxcal: stopped")
    return 0


# The demo: a station with simulated units, an operator who follows the page, and a
# tray that is scanned and started by itself.

DEMO_SLOTS = {"left": "+x+y+z", "right": "-x+y-z"}
"""Slots, with how a unit sits in them."""
DEMO_DEVICE = """\
format = "triaxcal.device/1"
profile = "triax-ref-{driver}"
serial = {serial}
seed = {seed}
slot = "{slot}"
mounting = "{mounting}"
speed = 20.0
bus = {bus}

[sensor.effects.{effect}]
{sizes}
"""
DEMO_STATION = """\
format = "triaxcal.station/1"
name = "demo"
folder = "runs"

[plan]
poses = 26
hold_s = 3.0
check_poses = 6

[limits]
rms_g = 5e-5
verification_rms_g = 5e-5

[rules]
open_loopback = true

[fixture]
together = true
faces = {{ "+x" = "A", "-x" = "B", "+y" = "C", "-y" = "D", "+z" = "top", "-z" = "base" }}
"""
DEMO_UNIT = """
[[units]]
name = "{slot}"
profile = "triax-ref-{driver}"
mounting = "{mounting}"
bus = {bus}
"""
LISTENER_S = 8.0
"""The tray begins once a page is open, or after so long."""


def demo_page(a: argparse.Namespace) -> int:
    """A station with two simulated units, its page, and a tray that runs by itself."""
    require_web("demo --page")
    from triaxcald.demo import demo_effects, make_key
    from triaxcald.files import write_text
    from triaxcald.service.server import Address
    from triaxcald.simulation.tray import load_tray

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        modbus = free.getsockname()[1]
    buses = {
        "can": f'{{ interface = "virtual", channel = "demo-{modbus}", node_id = 5 }}',
        "modbus": f'{{ host = "127.0.0.1", port = {modbus}, unit_id = 1 }}',
    }
    station_text, files, serials = DEMO_STATION.format(), [], {}
    try:
        a.out.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise InputError(f"{a.out}: {e.strerror}") from e
    make_key(a.out)
    described = zip(DEMO_SLOTS.items(), buses.items(), demo_effects(a.seed), strict=True)
    for number, ((slot, mounting), (driver, bus), (effect, sizes)) in enumerate(described):
        serials[slot] = str(1001 + number)
        of = {"slot": slot, "mounting": mounting, "driver": driver, "bus": bus}
        device = DEMO_DEVICE.format(
            **of, serial=serials[slot], seed=a.seed + number, effect=effect,
            sizes="\n".join(f"{axis} = {size}" for axis, size in sizes.items()),
        )  # fmt: skip
        files.append(write_text(a.out / f"{slot}.toml", device))
        station_text += DEMO_UNIT.format(**of)
    path = write_text(a.out / "station.toml", station_text)
    station, tray = load_station(path), load_tray(files, followed=True)
    work = _demonstrated(station, tray, Address("127.0.0.1", a.port), serials)
    try:
        run_interruptible(work)
    except Interrupted as e:
        if e.number == signal.SIGINT:
            raise
        say("triaxcal: stopped")
    return 0


async def _demonstrated(station: Station, tray: Tray, address: Address, serials: Mapping[str, str]) -> None:
    from triaxcald.service.server import serve
    from triaxcald.simulation.follow import ServiceEvents

    tasks: list[asyncio.Future[None]] = []

    def ready(url: str, service: StationService) -> None:
        say(f"the page of the station: {url}; Ctrl-C stops it")
        tasks.append(asyncio.ensure_future(_open(url)))
        tasks.append(asyncio.ensure_future(simulated(tray, ServiceEvents(url))))
        tasks.append(asyncio.ensure_future(_run_a_tray(service, serials)))

    try:
        await serve(station, address, None, log=say, reload=asyncio.Event(), ready=ready)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def _open(url: str) -> None:
    await asyncio.to_thread(webbrowser.open, url)


async def _run_a_tray(service: StationService, serials: Mapping[str, str]) -> None:
    """Scan and start, once the operator's events and a page are listened to."""
    with suppress(TimeoutError):
        async with asyncio.timeout(LISTENER_S):
            while service.floor.stream.listeners < 2:
                await asyncio.sleep(0.2)
    await service.floor.put(serials, {"operator": "demo"})
    await service.floor.start(None)
