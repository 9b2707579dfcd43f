"""A small application behind the real access control, on a free port."""

from __future__ import annotations

import asyncio
import json
import socket
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
from fastapi import FastAPI, Request
from fastapi.responses import JSONResponse
from sqlalchemy import select
from starlette.exceptions import HTTPException

from triaxcald.service import tables
from triaxcald.service.access import Access, session_router
from triaxcald.service.errors import ApiError, Problem
from triaxcald.service.gate import Gate, StationServer, configured, known_hosts
from triaxcald.service.ledger import Ledger
from triaxcald.service.people import People, Role, hashed
from triaxcald.station.config import load_station

PIN = "4711 ä"
JSON = {"Content-Type": "application/json"}


def application(access: Access) -> FastAPI:
    """Reads for readers, writes for operators, and what engineers may do."""
    app = FastAPI()
    app.include_router(session_router(access))

    @app.get("/api/1/station")
    async def station(request: Request) -> JSONResponse:
        who = await access.require(request, "reader")
        return JSONResponse({"name": who.name, "role": who.role, "by": who.by})

    @app.post("/api/1/scan")
    async def scan(request: Request) -> JSONResponse:
        who = await access.require(request, "operator")
        body = await request.json()
        if "<" in body["text"]:
            raise ApiError(Problem.INVALID, "no serial number")
        await access.trail(who, "scan", body)
        return JSONResponse({"size": len(await request.body())})

    @app.post("/api/1/reload")
    async def reload(request: Request) -> JSONResponse:
        await access.trail(await access.require(request, "engineer"), "reload", {})
        return JSONResponse({})

    @app.get("/")
    async def page() -> JSONResponse:
        return JSONResponse("hello", headers={"Content-Security-Policy": "default-src 'none'"})

    async def ours(_: Request, e: Exception) -> JSONResponse:
        assert isinstance(e, ApiError)
        return JSONResponse(e.body, e.problem.status, headers=e.headers)

    async def framework(_: Request, e: Exception) -> JSONResponse:
        assert isinstance(e, HTTPException)
        return JSONResponse({"code": "unknown", "message": e.detail}, e.status_code)

    app.add_exception_handler(ApiError, ours)
    app.add_exception_handler(HTTPException, framework)
    return app


class Clock:
    """Time that passes when it is told to."""

    def __init__(self) -> None:
        self.now_s = 1_800_000_000.0

    def __call__(self) -> float:
        return self.now_s


@dataclass
class Guarded:
    ledger: Ledger
    access: Access
    clock: Clock
    port: int
    client: httpx.AsyncClient
    secure: bool = False

    @property
    def url(self) -> str:
        return f"{'https' if self.secure else 'http'}://127.0.0.1:{self.port}"

    def people(self) -> People:
        """As another process has them: the command line."""
        return People(self.ledger)

    def add(self, name: str, role: str, pin: str = PIN) -> None:
        self.people().add(name, Role(role), hashed(pin))

    def token(self, name: str, role: str) -> dict[str, str]:
        return {"Authorization": f"Bearer {self.people().new_token(name, Role(role))}"}

    async def sign_in(self, name: str, pin: str = PIN, **more: Any) -> httpx.Response:
        return await self.client.post("/api/1/session", json={"name": name, "pin": pin}, **more)

    def cookie(self) -> dict[str, str]:
        """The header that the client sends, to send it again when the client has forgotten it."""
        return {"Cookie": "; ".join(f"{name}={value}" for name, value in self.client.cookies.items())}

    def rows(self) -> list[dict[str, Any]]:
        return trail_of(self.ledger)

    def refusals(self) -> list[tuple[Any, ...]]:
        """Code, path and name of whom it was, of each refused request."""
        return [(r["code"], r["what"].get("path"), r["who"]) for r in self.rows() if r["action"] == "request"]

    def from_elsewhere(self, address: str = "192.0.2.7") -> httpx.AsyncClient:
        """A client whose peer address is another machine's."""
        transport = httpx.ASGITransport(Gate(application(self.access), self.access), client=(address, 40000))
        return httpx.AsyncClient(transport=transport, base_url=self.url)


@asynccontextmanager
async def guarded(
    path: Path, *, clock: Clock | None = None, names: Sequence[str] = (), tls: tuple[Path, Path] | None = None,
    first_s: float = 10.0, url: str | None = None,
) -> AsyncIterator[Guarded]:  # fmt: skip
    """The service of the station file ``path``, until the context ends."""
    station = load_station(path)
    ledger = await asyncio.to_thread(Ledger.open, station, url)
    clock = clock or Clock()
    listening = socket.create_server(("127.0.0.1", 0))
    port = listening.getsockname()[1]
    hosts = known_hosts("127.0.0.1", port, secure=tls is not None, names=names)
    access = Access(ledger, station, secure=tls is not None, hosts=hosts, clock=clock, ticks=clock)
    cert, key = tls or (None, None)
    server = StationServer(configured(application(access), access, cert=cert, key=key, first_s=first_s))
    serving = asyncio.create_task(server.serve(sockets=[listening]))
    base = f"{'https' if tls else 'http'}://127.0.0.1:{port}"
    try:
        # A connection that the service is about to end is not used again.
        kept = None if first_s >= 10.0 else 0
        limits = httpx.Limits(max_keepalive_connections=kept)
        async with httpx.AsyncClient(
            base_url=base, verify=False, trust_env=False, timeout=180, limits=limits
        ) as client:
            yield Guarded(ledger, access, clock, port, client, tls is not None)
    finally:
        server.should_exit = True
        await serving
        await access.close()
        ledger.close()


def trail_of(ledger: Ledger) -> list[dict[str, Any]]:
    """The rows of the trail in the order of time."""
    with ledger.reading() as db:
        rows = db.execute(select(tables.trail).order_by(tables.trail.c.id)).mappings()
        return [{**row, "what": json.loads(row["what"])} for row in rows]
