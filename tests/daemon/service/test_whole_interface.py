"""The whole interface of a service: what fails or is odd is an answer with `code` and `message`."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.daemon.service.conftest import put_outcome
from triaxcald.documents import to_text
from triaxcald.service import page
from triaxcald.service.access import Access
from triaxcald.service.floor import Floor
from triaxcald.service.gate import Gate, known_hosts
from triaxcald.service.ledger import Ledger
from triaxcald.service.outbox import Outbox
from triaxcald.service.server import StationService, app_of
from triaxcald.service.stream import Stream
from triaxcald.station.config import Station
from triaxcald.store import FILE_NAME

MakeStation = Callable[..., Station]


@asynccontextmanager
async def served(station: Station) -> AsyncIterator[httpx.AsyncClient]:
    ledger = await asyncio.to_thread(Ledger.open, station)
    floor = Floor(station, ledger, partial(Stream, ledger), load=lambda: station, log=lambda _: None)
    access = Access(ledger, station, secure=False, hosts=known_hosts("127.0.0.1", 8484, secure=False))
    streaming = asyncio.ensure_future(floor.stream.run())
    await floor.begin()
    service = StationService(floor, ledger, access, Outbox(ledger, station))
    transport = httpx.ASGITransport(Gate(app_of(service), access))
    try:
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1:8484", timeout=180) as client:
            yield client
    finally:
        await floor.end()
        await access.close()
        streaming.cancel()
        ledger.close()


async def test_a_database_that_is_away_is_told_by_every_address(make_station: MakeStation, tmp_path: Path) -> None:
    async with served(make_station('[[deliver]]\nname = "files"\nfolder = "out"\n')) as client:
        assert (await client.get("/health")).json()["healthy"] is True
        (tmp_path / FILE_NAME).rename(tmp_path / "elsewhere")
        (tmp_path / FILE_NAME).mkdir()
        for address in ("/health", "/metrics", "/runs/x/trace", "/api/1/runs/x", "/api/1/quality"):
            answer = await client.get(address)
            assert (answer.status_code, answer.json()["code"]) == (503, "database"), address
        (tmp_path / FILE_NAME).rmdir()
        (tmp_path / "elsewhere").rename(tmp_path / FILE_NAME)
        assert (await client.get("/health")).json()["healthy"] is True


@pytest.mark.parametrize(
    ("method", "address", "body"),
    [
        ("PUT", "/tray", r'{"slots": {"\ud800": "1001"}}'),
        ("PUT", "/tray", r'{"slots": {"a": "\udfff"}}'),
        ("PUT", "/tray", r'{"\ud800": 1}'),
        ("POST", "/scan", r'{"text": "SLOT:\ud800"}'),
        ("POST", "/slots/%ED%A0%80/stop", "{}"),
        ("POST", "/session", r'{"name": "\ud800", "pin": "1234"}'),
    ],
)
async def test_half_of_a_character_is_refused_like_any_other_text(
    make_station: MakeStation, method: str, address: str, body: str
) -> None:
    async with served(make_station("[rules]\nopen_loopback = true\n")) as client:
        answer = await client.request(
            method, f"/api/1{address}", content=body, headers={"Content-Type": "application/json"}
        )
        assert answer.status_code in (400, 404)
        assert set(answer.json()) == {"code", "message"}


async def test_one_recording_at_a_time_is_drawn(
    make_station: MakeStation, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Others wait outside the threads, which the tray needs."""
    document = put_outcome(tmp_path, 1) | {"recording": "a.mcap"}
    next(tmp_path.glob("*.outcome.json")).write_text(to_text(document))
    (tmp_path / "a.mcap").write_bytes(b"no recording")
    drawing, second = threading.Semaphore(1), threading.Event()
    trace_of = page.trace_of

    def drawn(path: Path) -> Any:
        if not drawing.acquire(blocking=False):
            second.set()
        second.wait(0.2)  # for another that comes meanwhile
        try:
            return trace_of(path)
        finally:
            drawing.release()

    monkeypatch.setattr(page, "trace_of", drawn)
    async with served(make_station()) as client:
        answers = await asyncio.gather(*(client.get(f"/runs/{document['run']}/trace") for _ in range(3)))
    assert [answer.status_code for answer in answers] == [404] * 3
    assert not second.is_set()
