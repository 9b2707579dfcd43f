"""The service over a tray that a test plays: everything is the real one, only the units are not there."""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Generator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from triaxcald.run.events import Events
from triaxcald.schema.codes import Code
from triaxcald.service.access import Access
from triaxcald.service.errors import ApiError, Problem
from triaxcald.service.floor import Floor
from triaxcald.service.gate import StationServer, configured, known_hosts
from triaxcald.service.ledger import Ledger
from triaxcald.service.outbox import Outbox
from triaxcald.service.server import StationService, app_of
from triaxcald.service.stream import Stream
from triaxcald.software import new_run_id
from triaxcald.station.config import load_station

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
open_loopback = {open_loopback}
"""
UNIT = """
[[units]]
name = "{slot}"
profile = "triax-ref-can"
bus = {{ interface = "udp_multicast", channel = "239.74.163.2", node_id = {node} }}
"""


def station_file(
    folder: Path,
    slots: str = "abcd",
    *,
    name: str = "Line 3",
    together: bool = True,
    operator: bool = True,
    open_loopback: bool = True,
    golden: str | None = None,
) -> Path:
    faces = ", ".join(f'"{axis}" = "{face}"' for axis, face in FACES.items())
    given = {"together": together, "operator": operator, "open_loopback": open_loopback}
    text = STATION.format(name=name, faces=faces, **{key: str(value).lower() for key, value in given.items()})
    if golden is not None:
        rule = f'[rules]\ngolden = {{ serial = "{golden}", every_h = 24, calibration = "golden.json" }}'
        text = text.replace("[rules]", rule)
    text += "".join(UNIT.format(slot=slot, node=5 + i) for i, slot in enumerate(slots))
    path = folder / "station.toml"
    path.write_text(text, encoding="utf-8")
    return path


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

    async def _made(self, due: Mapping[str, str | None], person: str | None) -> Any:
        if self.passed & set(due.values()) and not self.desk.work["reason"]:
            raise ApiError(
                Problem.REASON_MISSING, "a unit of this tray has passed before; give the reason of the re-test"
            )
        self.played = PlayedTray(list(due))
        self.starts += 1
        return self.played


class Stage:
    """The service in a thread, on a port of the loopback. Methods are called by the test's thread."""

    def __init__(self, station: Path) -> None:
        self.station = station
        self.port = 0
        self.lines: list[str] = []
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
        station, log = load_station(self.station), self.lines.append
        listening = socket.create_server(("127.0.0.1", self.port))
        self.port = listening.getsockname()[1]
        self.ledger = Ledger.open(station)
        self.access = Access(
            self.ledger, station, secure=False, hosts=known_hosts("127.0.0.1", self.port, secure=False), log=log
        )
        self.floor = PlayedFloor(
            station, self.ledger, partial(Stream, self.ledger), load=lambda: load_station(self.station), log=log
        )
        await self.floor.stream.begin()
        forwarding = asyncio.ensure_future(self.floor.stream.run())
        await self.floor.begin()
        self.app = app_of(StationService(self.floor, self.ledger, self.access, Outbox(self.ledger, station, log)))
        self._server = StationServer(configured(self.app, self.access))
        serving = asyncio.ensure_future(self._server.serve(sockets=[listening]))
        while not self._server.started:
            await asyncio.sleep(0.01)
        up.set()
        await serving
        forwarding.cancel()
        await asyncio.wait([forwarding])
        await self.access.close()
        self.ledger.close()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def hang(self) -> threading.Event:
        """The service stops doing anything until the event is set."""
        go_on = threading.Event()
        self._loop.call_soon_threadsafe(go_on.wait)
        return go_on

    def events(self) -> list[dict[str, Any]]:
        self.do(self.floor.stream.drained)
        return self.ledger.events_after(0, 10_000)

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
