"""The service's interface and pages over a tray that a test plays: floor, desk, stream and routes are the real ones,
only the units are not there."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Generator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import uvicorn
from fastapi import FastAPI, Request
from starlette.datastructures import MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from triaxcald.run.events import Events
from triaxcald.schema.codes import Code
from triaxcald.service.api import answer_errors, station_router
from triaxcald.service.errors import ApiError, Problem
from triaxcald.service.floor import Floor
from triaxcald.service.page import page_router
from triaxcald.service.stream import Stream
from triaxcald.software import new_run_id
from triaxcald.station.config import Station, load_station

FACES = {"+x": "A", "-x": "B", "+y": "C", "-y": "D", "+z": "Lid", "-z": "Base"}
STATION = """format = "triaxcal.station/1"
name = '{name}'
folder = "out"

[plan]
poses = 14

[limits]
verification_rms_g = 5e-5

[fixture]
together = {together}
faces = {{ {faces} }}

[rules]
operator = {operator}
"""
UNIT = """
[[units]]
name = "{slot}"
profile = "triax-ref-can"
bus = {{ interface = "udp_multicast", channel = "239.74.163.2", node_id = {node} }}
"""


def station_file(
    folder: Path, slots: str = "abcd", *, name: str = "Line 3", together: bool = True, operator: bool = True
) -> Path:
    faces = ", ".join(f'"{axis}" = "{face}"' for axis, face in FACES.items())
    text = STATION.format(name=name, together=str(together).lower(), operator=str(operator).lower(), faces=faces)
    text += "".join(UNIT.format(slot=slot, node=5 + i) for i, slot in enumerate(slots))
    path = folder / "station.toml"
    path.write_text(text, encoding="utf-8")
    return path


@dataclass
class Book:
    """What the service keeps, across its restarts."""

    settings: dict[str, Any] = field(default_factory=dict)
    events: list[dict[str, Any]] = field(default_factory=list)
    rows: list[dict[str, Any]] = field(default_factory=list)

    def take(self) -> list[str]:
        return []

    def setting(self, key: str) -> Any | None:
        return self.settings.get(key)

    def put_setting(self, key: str, value: Any) -> None:
        self.settings[key] = json.loads(json.dumps(value))

    def append(self, events: list[dict[str, Any]]) -> None:
        self.events += events

    def events_after(self, seq: int, limit: int) -> list[dict[str, Any]]:
        return [event for event in self.events if event["seq"] > seq][:limit]

    def last_seq(self) -> int:
        return self.events[-1]["seq"] if self.events else 0

    def run_of(self, run: str) -> dict[str, Any] | None:
        return next((row for row in self.rows if row["run"] == run), None)


@dataclass
class PlayedUnit:
    run: str
    ended: bool = False
    reason: str | None = None

    def stop(self, reason: str) -> None:
        self.reason = reason


class PlayedTray:
    """Goes on until the test lets it end."""

    def __init__(self, slots: list[str]) -> None:
        self.id = new_run_id()
        self.units = {slot: PlayedUnit(new_run_id()) for slot in slots}
        self.over = asyncio.Event()

    def __await__(self) -> Generator[Any, None, Any]:
        return self.over.wait().__await__()


class PlayedFloor(Floor):
    """``passed`` are serial numbers whose re-test needs a reason."""

    passed: frozenset[str] = frozenset()
    played: PlayedTray | None = None
    starts = 0

    async def _made(self, due: Mapping[str, str | None]) -> Any:
        if self.passed & set(due.values()) and not self.desk.work["reason"]:
            raise ApiError(
                Problem.REASON_MISSING, "a unit of this tray has passed before; give the reason of the re-test"
            )
        self.played = PlayedTray(list(due))
        self.starts += 1
        return self.played


@dataclass
class Who:
    name: str = "this computer"
    role: str = "engineer"
    by: str = "loopback"


class OpenAccess:
    """Lets everybody in, or nobody."""

    def __init__(self) -> None:
        self.closed = False

    async def require(self, request: Request, role: str) -> Who:
        if self.closed:
            raise ApiError(Problem.NOT_SIGNED_IN, "sign in first")
        return Who()

    async def trail(self, who: Any, action: str, what: Any, *, ok: bool = True, code: str | None = None) -> None:
        pass


@dataclass
class Service:
    floor: Floor
    ledger: Book
    access: OpenAccess

    @property
    def station(self) -> Station:
        return self.floor.station


class _Strict:
    """The policy that a browser enforces, on every answer."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def marked(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).setdefault("Content-Security-Policy", "default-src 'self'")
            await send(message)

        await self.app(scope, receive, marked)


class Stage:
    """The service in a thread, on a port of the loopback. Methods are called by the test's thread."""

    def __init__(self, station: Path, documents: Mapping[str, Any] | None = None) -> None:
        self.station, self.documents = station, dict(documents or {})
        self.book, self.access = Book(), OpenAccess()
        self.port = 0
        self._thread: threading.Thread | None = None

    # The service.

    def begin(self) -> None:
        up = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve(up)), name="service", daemon=True)
        self._thread.start()
        assert up.wait(20)

    def end(self) -> None:
        self._server.should_exit = True
        self._server.force_exit = True
        assert self._thread is not None
        self._thread.join(20)
        assert not self._thread.is_alive()

    async def _serve(self, up: threading.Event) -> None:
        self._loop = asyncio.get_running_loop()
        path = self.station
        self.floor = PlayedFloor(
            load_station(path), self.book, lambda state: Stream(self.book, state),
            load=lambda: load_station(path), log=lambda _: None,
        )  # fmt: skip
        await self.floor.stream.begin()
        forwarding = asyncio.ensure_future(self.floor.stream.run())
        await self.floor.begin()
        service = Service(self.floor, self.book, self.access)
        app = FastAPI()
        app.add_middleware(_Strict)
        answer_errors(app)
        app.include_router(station_router(service))
        app.include_router(page_router(service))

        @app.get("/api/1/{path:path}")
        async def document(path: str) -> Any:
            for name, found in self.documents.items():
                if path == name:
                    return found
            raise ApiError(Problem.UNKNOWN, f"no {path}")

        config = uvicorn.Config(app, "127.0.0.1", self.port, log_level="warning", lifespan="off")
        self._server = uvicorn.Server(config)
        serving = asyncio.ensure_future(self._server.serve())
        while not self._server.started:
            await asyncio.sleep(0.01)
        self.port = self._server.servers[0].sockets[0].getsockname()[1]
        up.set()
        await serving
        forwarding.cancel()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def hang(self) -> threading.Event:
        """The service stops doing anything until the event is set."""
        go_on = threading.Event()
        self._loop.call_soon_threadsafe(go_on.wait)
        return go_on

    # The tray.

    def do(self, work: Any) -> Any:
        """In the service's loop."""

        async def done() -> Any:
            found = work()
            return await found if asyncio.iscoroutine(found) else found

        return asyncio.run_coroutine_threadsafe(done(), self._loop).result(20)

    def scan(self, *texts: str) -> None:
        for text in texts:
            self.do(lambda text=text: self.floor.scan(text))

    def say(self, kind: str, unit: str | None = None, **more: Any) -> None:
        tray = self.floor.played
        assert tray is not None
        runs = {slot: of.run for slot, of in tray.units.items()}
        events = Events(self.floor._took, tray.id, runs, number=self.floor.stream.number)
        self.do(lambda: events._say(kind, unit, **more))

    def stage(self, stage: str, *slots: str) -> None:
        for slot in slots or tuple(self.floor.desk.slots):
            self.say("stage", slot, stage=stage)

    def poses(self, slot: str, found: int, wanted: int = 14, vector: list[float] | None = None) -> None:
        following = None if vector is None else {"label": "+X", "vector": vector, "once_more": False}
        self.say("poses", slot, found=found, wanted=wanted, next=following)

    def instruct(self, vector: list[float], *slots: str) -> None:
        size = sum(v * v for v in vector) ** 0.5
        up = [round(v / size, 6) for v in vector]
        self.say("instruction", None, label="", face=None, vector=up, slots=list(slots or self.floor.desk.slots))

    def live(self, slots: dict[str, dict[str, Any]]) -> None:
        self.do(lambda: self.floor.stream.live({"slots": slots}))

    def finish(self, slot: str, code: str = "within_limits", reason: str = "within the limits") -> None:
        tray = self.floor.played
        assert tray is not None
        serial = self.floor.desk.slots[slot].serial
        outcome = {
            "unit": slot, "run": tray.units[slot].run, "serial": serial, "code": code, "reason": reason,
            "verdict": Code(code).verdict.value,
        }  # fmt: skip
        self.say("ended", slot, outcome=outcome)
        if not self.floor.desk.running:
            self.say("tray", None, state="ended")
            self.do(lambda: tray.over.set())


def direction(found: int, taken: int, up: list[float], held_s: float) -> dict[str, Any]:
    """A slot of `live`, with so many of fourteen poses taken."""
    from triaxcal.model.directions import directions

    plan = [[round(float(c), 3) for c in v] for _, v in directions(14)]
    return {
        "up": up, "held_s": held_s, "hold_s": 3.0, "taken": plan[:taken], "missing": plan[taken:], "found": found,
        "wanted": 14, "phase": "calibration", "too_short": False,
    }  # fmt: skip


START = datetime(2026, 1, 20, 6, 0, tzinfo=UTC)


def run_row(i: int, *, serial: str, code: str = "within_limits", **more: Any) -> dict[str, Any]:
    """A row of `triaxcal.results/1`."""
    from triaxcald.schema.columns import NAMES

    ended = START + timedelta(minutes=17 * i)
    measured = code in ("within_limits", "verification_outside", "fit_outside")
    wobble = [((i * k * 7919) % 101) / 50 - 1 for k in range(1, 16)]
    row: dict[str, Any] = dict.fromkeys(NAMES)
    row |= {
        "run": f"01890000-0000-7000-8000-{i:012d}", "station": "Line 3", "unit": "abcd"[i % 4], "slot": "abcd"[i % 4],
        "serial": serial, "work_serial": serial, "operator": "Olena", "order": "4711", "part_number": "TX-3",
        "fixture": "F2", "attempt": 1, "started": (ended - timedelta(minutes=9)).isoformat(),
        "ended": ended.isoformat(),
        "duration_s": 540.0, "verdict": Code(code).verdict.value, "code": code,
        "reason": "the device's own output in 6 check poses in other attitudes than the fit's is 21 µg ± 9 µg off",
        "exit_code": Code(code).exit_code, "device_state": "new_verified", "outcome": "x.outcome.json",
        "recording": f"{serial}.mcap", "report": f"{serial}.report.html",
        "certificate": f"{serial}.certificate.json" if code == "within_limits" else None,
        "rms_limit_g": None, "cross_validated_rms_limit_g": None, "verification_rms_limit_g": 5e-5,
    }  # fmt: skip
    if measured:
        row |= {"poses": 15, "rms_before_g": 2.4e-4, "rms_g": 1.2e-5, "cross_validated_rms_before_g": 3.1e-4,
                "cross_validated_rms_g": 2.2e-5, "verification_rms_before_g": 1.9e-3,
                "verification_rms_g": (6.3e-5 if code != "within_limits" else 2.1e-5 + 5e-6 * wobble[0])}  # fmt: skip
        for k, (name, typical, spread) in enumerate(
            [(f"scale_factor_{a}", 1.2, 0.01) for a in "xyz"] + [(f"misalignment_{a}", 0.0, 3e-3) for a in "xyz"]
            + [(f"bias_{a}", 0.0, 0.02) for a in "xyz"]
        ):  # fmt: skip
            row |= {name: typical + spread * wobble[k + 1], f"{name}_standard_error": spread * 1e-3}
    return row | more
