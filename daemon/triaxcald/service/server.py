"""The service of a station as one process: floor, database, receivers and interface in
one event loop."""

from __future__ import annotations

import asyncio
import errno
import os
import socket
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Final

import uvicorn
from fastapi import FastAPI

from triaxcald.errors import InputError, StationError
from triaxcald.service.access import Access, session_router
from triaxcald.service.api import answer_errors, station_router
from triaxcald.service.api_data import data_router
from triaxcald.service.floor import Floor
from triaxcald.service.gate import StationServer, configured, known_hosts
from triaxcald.service.ledger import Ledger
from triaxcald.service.monitoring import LoopLateness, monitoring_router
from triaxcald.service.outbox import Outbox
from triaxcald.service.page import page_router
from triaxcald.service.stream import Stream
from triaxcald.service.supervisor import Supervisor
from triaxcald.station.config import Station, load_station
from triaxcald.station.lock import fcntl


@dataclass(frozen=True)
class Address:
    """Where the service listens; certificate and key are needed beyond the loopback."""

    host: str
    port: int
    certificate: Path | None = None
    key: Path | None = None

    @property
    def secure(self) -> bool:
        return self.certificate is not None

    def url(self, port: int) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{'https' if self.secure else 'http'}://{host}:{port}"


@dataclass
class StationService:
    """What the interface works with."""

    floor: Floor
    ledger: Ledger
    access: Access
    outbox: Outbox
    lateness: LoopLateness = field(default_factory=LoopLateness)

    @property
    def station(self) -> Station:
        return self.floor.station


def app_of(service: StationService) -> FastAPI:
    """The interface and the pages of a service."""
    app = FastAPI(title="triaxcal", version="1", docs_url=None, redoc_url=None, openapi_url="/api/1/openapi.json")
    app.include_router(session_router(service.access))
    for router in (station_router, data_router, monitoring_router, page_router):
        app.include_router(router(service))
    answer_errors(app)
    return app


async def serve(
    station: Station,
    address: Address,
    database: str | None,
    *,
    log: Callable[[str], None],
    reload: asyncio.Event,
    ready: Callable[[str, StationService], None],
) -> None:
    """Serve until cancelled; then end the runs in order. ``ready`` receives the URL and
    the service once it answers, ``reload`` asks for the station file to be read again.
    Raises DaemonError."""
    with alone(station.folder), bound(address) as listening:
        ledger = await asyncio.to_thread(Ledger.open, station, database)
        if ledger.lost is not None:
            log(f"triaxcal: {ledger.lost}")
        hosts = known_hosts(address.host, listening.getsockname()[1], secure=address.secure)
        try:
            async with _only_one(ledger), _working(station, ledger, address, hosts, log) as service:
                await _serve(service, address, listening, reload, ready)
        finally:
            await asyncio.to_thread(ledger.close)


@asynccontextmanager
async def _only_one(ledger: Ledger) -> AsyncIterator[None]:
    """As `Ledger.alone`, which blocks."""
    alone = ledger.alone()
    await asyncio.to_thread(alone.__enter__)
    try:
        yield
    finally:
        await asyncio.to_thread(alone.__exit__, None, None, None)


@asynccontextmanager
async def _working(
    station: Station, ledger: Ledger, address: Address, hosts: frozenset[str], log: Callable[[str], None]
) -> AsyncIterator[StationService]:
    """A service whose events are stored and whose results are delivered."""
    outbox = Outbox(ledger, station, log)
    access = Access(ledger, station, secure=address.secure, hosts=hosts, log=log)

    def loaded(again: Station) -> None:
        access.station = again
        ledger.receive(again)
        outbox.receive(again)
        outbox.news()

    floor = Floor(
        station, ledger, partial(Stream, ledger), load=partial(load_station, station.path), log=log,
        recorded=outbox.news, loaded=loaded,
    )  # fmt: skip
    service = StationService(floor, ledger, access, outbox)
    await asyncio.to_thread(ledger.begin_deliveries)
    await floor.stream.begin()
    streaming = asyncio.ensure_future(floor.stream.run())
    delivering = asyncio.ensure_future(outbox.run())
    watching = asyncio.ensure_future(service.lateness.watch())
    try:
        await floor.begin()
        yield service
    finally:
        # Cancelled or not: no device is left in between.
        await floor.end()
        await floor.stream.drained()
        for task in (watching, delivering, streaming):
            task.cancel()
            with suppress(asyncio.CancelledError):
                await task
        await access.close()


async def _serve(
    service: StationService,
    address: Address,
    listening: socket.socket,
    reload: asyncio.Event,
    ready: Callable[[str, StationService], None],
) -> None:
    port = listening.getsockname()[1]
    server = _Server(configured(app_of(service), service.access, cert=address.certificate, key=address.key))
    answering = asyncio.ensure_future(server.serve(sockets=[listening]))
    reloading = asyncio.ensure_future(_reloads(service.floor, reload))
    begun = asyncio.ensure_future(server.begun.wait())
    try:
        await asyncio.wait([answering, begun], return_when=asyncio.FIRST_COMPLETED)
        async with Supervisor().kept_informed(partial(status, service)):
            ready(address.url(port), service)
            await asyncio.wait([answering, reloading], return_when=asyncio.FIRST_COMPLETED)
            for task in (answering, reloading):
                if task.done():
                    task.result()  # raises what ended it
    finally:
        reloading.cancel()
        begun.cancel()
        # The page shows how the runs end; it goes last.
        await service.floor.end()
        await service.floor.stream.drained()
        service.floor.stream.close()
        server.should_exit = True
        await asyncio.wait([answering])


async def _reloads(floor: Floor, reload: asyncio.Event) -> None:
    while True:
        await reload.wait()
        reload.clear()
        await floor.reload()


def status(service: StationService) -> str:
    """One line for the supervisor."""
    at_work = sum(slot.at_work for slot in service.floor.desk.slots.values())
    return f"{at_work} of {len(service.floor.desk.slots)} slots at work"


class _Server(StationServer):
    """Signals belong to the command line. ``begun`` is set once it listens."""

    def __init__(self, config: uvicorn.Config) -> None:
        super().__init__(config)
        self.begun = asyncio.Event()

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        self.begun.set()

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield


LOCK: Final = "service.lock"
"""The kernel releases it at every end of the process; the file stays."""


@contextmanager
def alone(folder: Path) -> Iterator[None]:
    """Keep other services out of the folder, whose events they would number too. Raises
    StationError if one works there, InputError if the folder cannot be used."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    except OSError as e:
        raise InputError(f"{folder}: no folder for recordings: {e.strerror}") from e
    try:
        if fcntl is not None:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as e:
                raise StationError(f"{folder}: another `triaxcal serve` works there; stop it first") from e
        yield
    finally:
        os.close(descriptor)


@contextmanager
def bound(address: Address) -> Iterator[socket.socket]:
    """A socket at the address. Raises StationError if the port is taken, InputError if
    the address is none of this machine."""
    try:
        family, kind, protocol, _, place = socket.getaddrinfo(
            address.host, address.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
    except OSError as e:
        raise InputError(f"--host {address.host}: {e.strerror}") from e
    with socket.socket(family, kind, protocol) as listening:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listening.bind(place)
        except OSError as e:
            kind_of_error = StationError if e.errno == errno.EADDRINUSE else InputError
            raise kind_of_error(f"--port {address.port}: cannot listen on {address.host}: {e.strerror}") from e
        yield listening
