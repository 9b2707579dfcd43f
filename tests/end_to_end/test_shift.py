"""A shift at a station: fifty units through the interface, with every kind of trouble. Database, folder and receiver
say the same afterwards, and each run is there once."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import threading
import urllib.error
import urllib.request
import uuid
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from tests.daemon.service.conftest import postgresql as postgresql
from tests.end_to_end.conftest import Process, until
from tests.simulated_tray import DEVICE, UNIT
from triaxcald.schema.result import Result
from triaxcald.schema.station_state import StationState

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1500)]

SLOTS = ("a", "b", "c", "d")
SPEED = 30.0
STATION = """\
format = "triaxcal.station/1"
name = "line 1"
folder = "runs"
[plan]
poses = 9
hold_s = 0.8
check_poses = 2
comes_back_s = 0.5
patience_s = 60.0
repeat = false
[limits]
rms_g = 5e-4
verification_rms_g = 5e-4
[rules]
open_loopback = true
retest_reason = true
[fixture]
together = true
[[deliver]]
name = "mes"
url = "http://127.0.0.1:{receiver}/results"
token_file = "token"
"""


def free_ports(number: int) -> list[int]:
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(number)]
        for one in sockets:
            one.bind(("127.0.0.1", 0))
        return [one.getsockname()[1] for one in sockets]


class Receiver:
    """A factory's own system, which is down from time to time."""

    def __init__(self, port: int) -> None:
        self.port = port
        self.taken: list[tuple[str, bytes]] = []
        self.refused_tokens = 0
        self._server: ThreadingHTTPServer | None = None

    def up(self) -> None:
        receiver = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                if self.headers["Authorization"] != "Bearer secret":
                    receiver.refused_tokens += 1
                known = self.headers["Idempotency-Key"] in {key for key, _ in receiver.taken}
                if not known:
                    receiver.taken.append((self.headers["Idempotency-Key"], body))
                self.send_response(409 if known else 201)
                self.send_header("Content-Length", "0")
                self.end_headers()

            def log_message(self, format: str, *args: object) -> None: ...

        self._server = ThreadingHTTPServer(("127.0.0.1", self.port), Handler)
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def down(self) -> None:
        assert self._server is not None
        self._server.shutdown()
        self._server.server_close()
        self._server = None


@dataclass
class Shift:
    """The station's service in a process, and its simulated units in others."""

    folder: Path
    start: Callable[..., Process]
    ports: Mapping[str, int]
    port: int
    database: str | None
    receiver: Receiver
    service: Process | None = None
    sims: list[Process] = field(default_factory=list)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def open(self) -> None:
        more = () if self.database is None else ("--database", self.database)
        self.service = self.start("serve", self.folder / "station.toml", "--port", self.port, *more)
        self.service.says("serving line 1 at")

    def kill(self) -> None:
        assert self.service is not None
        self.service.send(signal.SIGKILL)
        self.service.wait()

    def call(self, method: str, path: str, body: Any = None) -> tuple[int, Any]:
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(f"{self.url}{path}", data, method=method)
        request.add_header("Content-Type", "application/json")
        try:
            with urllib.request.urlopen(request, timeout=180) as answer:
                return answer.status, json.loads(answer.read())
        except urllib.error.HTTPError as e:
            return e.code, json.loads(e.read())

    def state(self) -> dict[str, Any]:
        status, document = self.call("GET", "/api/1/station")
        assert status == 200
        assert StationState.model_validate(document).document() == document
        return dict(document)

    def slots(self) -> dict[str, dict[str, Any]]:
        return {slot["slot"]: slot for slot in self.state()["slots"]}

    def scan(self, text: str) -> dict[str, Any]:
        status, answer = self.call("POST", "/api/1/scan", {"text": text})
        assert status == 200, answer
        return dict(answer)

    def put_up(self, units: Mapping[str, Mapping[str, Any]], *, together: bool = True) -> None:
        """Simulate these units in their slots: in one process, or each in one of its own."""
        files = []
        for slot, unit in units.items():
            path = self.folder / f"{slot}-{unit['serial']}.toml"
            given = {"noise_g": 2e-4, **unit}
            path.write_text(DEVICE.format(slot=slot, port=self.ports[slot], speed=SPEED, **given))
            files.append(path)
        for some in [files] if together else [[path] for path in files]:
            sim = self.start("sim", *some, "--follow", self.url)
            self.sims.append(sim)
            for path in some:
                sim.says(f"serial {int(path.stem.partition('-')[2]):04d}, on ")
        until(lambda: self.call("GET", "/health")[1]["listeners"] >= len(self.sims))

    def take_down(self) -> None:
        for sim in self.sims:
            sim.send(signal.SIGKILL)
            sim.wait()
        self.sims = []

    def begin(self) -> dict[str, str]:
        """Start the tray, by a request that is sent twice."""
        body = {"request": str(uuid.uuid4())}
        answers = [self.call("POST", "/api/1/tray/start", body) for _ in range(2)]
        assert answers[0] == answers[1]
        assert answers[0][0] == 200, answers[0]
        return dict(answers[0][1]["runs"])

    def ended(self) -> dict[str, str]:
        """Wait for the end of the tray; the codes of its slots."""
        until(lambda: all(slot["state"] not in ("running", "lost") for slot in self.slots().values()))
        return {name: slot["code"] for name, slot in self.slots().items() if slot["run"]}

    def in_poses(self, slot: str, found: int = 2) -> None:
        until(lambda: (s := self.slots()[slot])["stage"] == "poses" and s["found"] >= found)


@pytest.fixture(params=["sqlite", "postgresql"])
def shift(request: pytest.FixtureRequest, tmp_path: Path, start: Callable[..., Process]) -> Shift:
    database = None
    if request.param == "postgresql":
        import psycopg

        server: str = request.getfixturevalue("postgresql")
        with psycopg.connect(f"{server}/postgres", autocommit=True) as connection:
            connection.execute("CREATE DATABASE shift")
        database = f"{server}/shift"
    port, receiver, *ports = free_ports(2 + len(SLOTS))
    of_slots = dict(zip(SLOTS, ports, strict=True))
    units = "".join(UNIT.format(slot=slot, port=of_slots[slot]) for slot in SLOTS)
    (tmp_path / "station.toml").write_text(STATION.format(receiver=receiver) + units)
    (tmp_path / "token").write_text("secret\n")
    return Shift(tmp_path, start, of_slots, port, database, Receiver(receiver))


def good(serials: Sequence[int]) -> dict[str, dict[str, Any]]:
    return {slot: {"serial": serial} for slot, serial in zip(SLOTS, serials, strict=False)}


def test_database_folder_and_receiver_agree_after_a_shift(shift: Shift, triaxcal: Any) -> None:
    receiver = shift.receiver
    receiver.up()
    shift.open()
    shift.scan("OP:Ada")
    shift.scan("WO:4711")
    units = int(os.environ.get("SHIFT_UNITS", "28"))  # every kind of trouble; with 50 the long rest of a shift as well
    serials = iter(range(1001, 1001 + units))
    codes: list[str] = []

    def tray(number: int = 4) -> list[int]:
        return [next(serials) for _ in range(number)]

    def run(of: Sequence[int], **changes: Any) -> dict[str, str]:
        shift.put_up(good(of) | changes)
        for serial in of:
            shift.scan(str(serial))
        runs = shift.begin()
        found = shift.ended()
        assert set(runs) == set(found)
        codes.extend(found.values())
        shift.take_down()
        return found

    # A tray as it should be; a badge in the midst of it is refused.
    first = tray()
    shift.put_up(good(first))
    for serial in first:
        shift.scan(str(serial))
    shift.begin()
    assert shift.call("POST", "/api/1/scan", {"text": "OP:Bob"})[0] == 409
    assert shift.call("POST", "/api/1/tray/start", {"request": str(uuid.uuid4())})[1]["code"] == "running"
    codes += shift.ended().values()
    assert codes == ["within_limits"] * 4
    shift.take_down()

    # A wrong unit, and one whose noise no calibration mends.
    of = tray()
    found = run(of, b={"serial": 9999}, c={"serial": of[2], "noise_g": 0.06})
    assert found["b"] == "wrong_unit"
    assert found["c"] in ("fit_outside", "verification_outside")

    # The receiver goes down, and is killed in the midst of it.
    receiver.down()

    # Nobody is in slot d; one unit is stopped.
    of = tray()
    shift.put_up(dict(list(good(of).items())[:3]))
    for serial in of:
        shift.scan(str(serial))
    shift.begin()
    shift.in_poses("a")
    assert shift.call("POST", "/api/1/slots/a/stop", {"reason": "dropped"}) == (200, {"stopped": ["a"]})
    found = shift.ended()
    assert found == {"a": "stopped", "b": "within_limits", "c": "within_limits", "d": "absent"}
    codes += found.values()
    shift.take_down()

    # The service is killed while poses are taken.
    of = tray()
    shift.put_up(good(of))
    for serial in of:
        shift.scan(str(serial))
    shift.begin()
    shift.in_poses("b")
    shift.kill()
    shift.take_down()
    shift.open()
    assert {slot["code"] for slot in shift.slots().values()} == {"killed"}
    codes += ["killed"] * 4
    receiver.up()
    receiver.down()

    # The service is killed between a write and its end.
    of = tray()
    shift.put_up(good(of))
    for serial in of:
        shift.scan(str(serial))
    shift.begin()
    journals = shift.folder / "runs" / "journal"
    until(lambda: any(journals.glob("*.json")))
    shift.kill()
    shift.open()
    killed = {slot["serial"]: slot["code"] for slot in shift.slots().values()}
    assert "killed" in killed.values()
    codes += killed.values()
    left = [json.loads(path.read_text()) for path in journals.glob("*.json")]
    assert left
    for journal in left:
        settled = triaxcal("provision", "--resume", shift.folder / "station.toml", "--unit", journal["unit"])
        assert settled.code == 0, settled.err
    shift.take_down()

    # A tray that is scanned and cleared.
    shift.scan("7777")
    shift.scan("CMD:CLEAR")
    assert {slot["state"] for slot in shift.slots().values()} == {"empty"}

    # Two units once more: after a pass only for a reason.
    again = first[:2]
    shift.put_up(good(again))
    for serial in again:
        shift.scan(str(serial))
    status, refused = shift.call("POST", "/api/1/tray/start", {"request": str(uuid.uuid4())})
    assert (status, refused["code"]) == (409, "reason_missing")
    assert shift.call("PUT", "/api/1/tray", {"reason": "customer return"})[0] == 200
    shift.begin()
    codes += shift.ended().values()
    shift.take_down()

    # The rest of the fifty; a unit falls silent for good.
    of = tray()
    shift.put_up(good(of), together=False)
    for serial in of:
        shift.scan(str(serial))
    shift.begin()
    shift.in_poses("c", 1)
    shift.sims[2].send(signal.SIGKILL)
    found = shift.ended()
    assert found["c"] == "lost"
    codes += found.values()
    shift.take_down()
    receiver.up()
    while of := [serial for _, serial in zip(range(4), serials, strict=False)]:
        run(of)

    # The end of the shift.
    until(lambda: shift.call("GET", "/health")[1]["outbox"][0]["waiting"] == 0)
    assert shift.service is not None
    shift.service.send(signal.SIGTERM)
    assert shift.service.wait() == 0
    receiver.down()
    _agree(shift, units, codes, triaxcal)


def _agree(shift: Shift, units: int, codes: Sequence[str], triaxcal: Any) -> None:
    receiver = shift.receiver
    folder = shift.folder / "runs"
    documents = [json.loads(path.read_text()) for path in folder.glob("*.outcome.json")]
    attempts = [document for document in documents if document["settles"] is None]
    assert Counter(document["code"] for document in attempts) == Counter(codes)
    assert {"within_limits", "wrong_unit", "stopped", "absent", "killed", "lost"} <= set(codes)
    assert len({document["serial"] or document["work"]["serial"] for document in attempts} - {"9999"}) == units

    by_run = {document["run"]: document for document in documents}
    assert len(by_run) == len(documents)
    assert receiver.refused_tokens == 0
    assert Counter(run for run, _ in receiver.taken) == Counter(list(by_run))
    for run, body in receiver.taken:
        result = json.loads(body)
        assert Result.model_validate(result).document() == result
        assert result["outcome"] == by_run[run]

    before = triaxcal("results", folder, "--json").json["runs"]
    assert {row["run"] for row in before} == set(by_run)
    kept = _kept(shift)
    assert {row["run"] for row in kept["run"]} == set(by_run)
    more = () if shift.database is None else ("--database", shift.database)
    rebuilt = triaxcal("results", folder, "--rebuild", *more)
    assert rebuilt.code == 0, rebuilt.err
    assert triaxcal("results", folder, "--json").json["runs"] == before
    assert _kept(shift) == kept
    audited = triaxcal("audit", folder)
    assert audited.code == 0, audited.out + audited.err


def _kept(shift: Shift) -> dict[str, list[dict[str, Any]]]:
    """The rows of runs, units and measurements."""
    from sqlalchemy import create_engine, text

    url = f"sqlite:///{shift.folder / 'runs' / 'triaxcal.sqlite'}"
    if shift.database is not None:
        url = shift.database.replace("postgresql://", "postgresql+psycopg://")
    engine = create_engine(url)
    with engine.connect() as db:
        found = {
            table: sorted((dict(row) for row in db.execute(text(f"SELECT * FROM {table}")).mappings()), key=repr)
            for table in ("run", "unit", "measurement")
        }
    engine.dispose()
    return found
