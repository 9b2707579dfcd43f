"""`triaxcal serve` as a process: signals, a second service, a copy of the database, and what is wrong with it."""

from __future__ import annotations

import json
import signal
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.request import Request, urlopen

import pytest

from tests.end_to_end.conftest import Process, until
from tests.end_to_end.test_shift import DEVICE, SPEED, UNIT, free_ports

pytestmark = pytest.mark.slow
STATION = """\
format = "triaxcal.station/1"
name = "line 1"
folder = "runs"
[plan]
poses = 9
hold_s = 0.8
[rules]
open_loopback = true
"""


class Served:
    def __init__(self, folder: Path, start: Callable[..., Process]) -> None:
        self.folder, self.start = folder, start
        self.port, self.unit = free_ports(2)
        self.path = folder / "station.toml"
        self.describe("a")

    def describe(self, *slots: str) -> None:
        units = "".join(UNIT.format(slot=slot, port=self.unit + i) for i, slot in enumerate(slots))
        self.path.write_text(STATION + units)

    def open(self) -> Process:
        service = self.start("serve", self.path, "--port", self.port)
        service.says(f"serving line 1 at http://127.0.0.1:{self.port}")
        return service

    def ask(self, path: str, body: Any = None) -> Any:
        data = None if body is None else json.dumps(body).encode()
        request = Request(f"http://127.0.0.1:{self.port}{path}", data, {"Content-Type": "application/json"})
        with urlopen(request, timeout=180) as answer:
            return json.loads(answer.read())

    def slots(self) -> dict[str, dict[str, Any]]:
        return {slot["slot"]: slot for slot in self.ask("/api/1/station")["slots"]}


@pytest.fixture
def served(tmp_path: Path, start: Callable[..., Process]) -> Served:
    return Served(tmp_path, start)


def test_a_stop_ends_the_run_in_order(served: Served) -> None:
    service = served.open()
    device = served.folder / "a.toml"
    device.write_text(DEVICE.format(slot="a", serial=1001, port=served.unit, speed=SPEED, noise_g=2e-4))
    sim = served.start("sim", device, "--follow", f"http://127.0.0.1:{served.port}")
    sim.says("serial 1001, on ")
    served.ask("/api/1/scan", {"text": "1001"})
    served.ask("/api/1/tray/start", {})
    until(lambda: served.slots()["a"]["found"] >= 2)
    service.send(signal.SIGTERM)
    assert service.wait() == 0
    assert "Traceback" not in service.err
    (outcome,) = [json.loads(path.read_text()) for path in (served.folder / "runs").glob("*.outcome.json")]
    assert (outcome["code"], outcome["reason"]) == ("stopped", "stopped: the service was stopped")
    again = served.open()
    assert served.slots()["a"]["code"] == "stopped"
    assert [run["code"] for run in served.ask("/api/1/runs")["runs"]] == ["stopped"]
    again.send(signal.SIGINT)
    assert again.wait() == 130


def test_a_changed_station_file_is_read_again(served: Served) -> None:
    service = served.open()
    served.ask("/api/1/scan", {"text": "1001"})
    served.describe("a", "b")
    service.send(signal.SIGHUP)
    until(lambda: set(served.slots()) == {"a", "b"})
    assert served.slots()["a"]["serial"] == "1001"
    served.path.write_text("nonsense")
    service.send(signal.SIGHUP)
    service.says("the old station file stays in use")
    assert set(served.slots()) == {"a", "b"}


def test_two_services_do_not_share_a_folder_nor_a_port(served: Served, tmp_path: Path) -> None:
    served.open()
    second = served.start("serve", served.path, "--port", 0)
    assert second.wait() == 4
    assert "another `triaxcal serve` works there" in second.err
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "station.toml").write_text(served.path.read_text())
    third = served.start("serve", elsewhere / "station.toml", "--port", served.port)
    assert third.wait() == 4
    assert f"--port {served.port}: cannot listen" in third.err


def test_the_database_is_copied_while_the_service_works(served: Served) -> None:
    served.open()
    served.ask("/api/1/scan", {"text": "1001"})
    copy = served.folder / "copy.sqlite"
    copying = served.start("serve", served.path, "--backup", copy)
    assert copying.wait() == 0, copying.err
    with sqlite3.connect(copy) as db:
        (desk,) = db.execute("SELECT value FROM setting WHERE key = 'desk'").fetchone()
    db.close()
    assert json.loads(desk)["slots"][0]["serial"] == "1001"


@pytest.mark.parametrize(
    ("arguments", "code", "told"),
    [
        (("--host", "0.0.0.0"), 2, "--cert and --key"),
        (("--host", "192.0.2.1", "--cert", "x", "--key", "y"), 2, "--cert: x"),
        (("--port", "70000"), 2, "expected a port"),
        (("--database", "mysql://h/d"), 2, "expected postgresql://"),
        (("--database", "postgresql://127.0.0.1:1/d"), 4, "the database does not answer"),
        (("--backup", "/nowhere/copy"), 2, "--backup /nowhere/copy"),
    ],
)
def test_what_is_wrong_is_one_line(served: Served, arguments: tuple[str, ...], code: int, told: str) -> None:
    service = served.start("serve", served.path, "--port", served.port, *arguments)
    assert service.wait() == code, service.err
    assert told in service.err
    assert len(service.err.splitlines()) == 1
