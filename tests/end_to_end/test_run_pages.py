"""The pages of runs that really failed, were stopped, were killed and passed: one unit, four attempts."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.request import Request, urlopen

import pytest
from playwright.sync_api import Browser, Page, expect

from tests.daemon.service.page.conftest import browser  # noqa: F401 - a fixture
from tests.end_to_end.conftest import Process, until
from tests.end_to_end.test_serving import STATION as PLAIN
from tests.end_to_end.test_serving import Served
from tests.end_to_end.test_shift import DEVICE, UNIT

pytestmark = pytest.mark.slow

SERIAL = "1001"
SLOW = 6.0
"""Times real time: samples reach the disk before the run ends."""
HEAD_BYTES = 40_000
"""More than a recording has before its first samples: profile and station."""
TIGHT, WIDE = 1e-7, 1e-2
FILES = ("report", "certificate", "outcome", "recording")


class Line(Served):
    def limit(self, rms_g: float) -> None:
        """The limit of the next runs."""
        self.path.write_text(f"{PLAIN}[limits]\nrms_g = {rms_g}\n" + UNIT.format(slot="a", port=self.unit))

    def begin(self, reason: str) -> None:
        self.ask("/api/1/scan", {"text": SERIAL})
        self.put({"reason": reason})
        self.ask("/api/1/tray/start", {})

    def put(self, work: dict[str, str]) -> None:
        head = {"Content-Type": "application/json"}
        url = f"http://127.0.0.1:{self.port}/api/1/tray"
        with urlopen(Request(url, json.dumps(work).encode(), head, method="PUT"), timeout=180) as answer:
            answer.read()

    def recorded(self) -> int:
        """Bytes of the recording that is under way."""
        return max(self.folder.glob("runs/*.mcap")).stat().st_size

    def ended(self, state: str) -> None:
        until(lambda: self.slots()["a"]["state"] == state)


def shown(page: Page, url: str, run: dict[str, Any]) -> dict[str, int]:
    """Opens the page of the run; the status of what each of its documents links to."""
    page.goto(f"{url}/runs/{run['run']}")
    expect(page.locator("#content[aria-busy]")).to_have_count(0)
    links = page.locator(".papers a").evaluate_all("all => all.map(a => a.getAttribute('href'))")
    return {str(link).rpartition("/")[2]: page.request.get(url + link).status for link in links}


def test_each_end_of_a_run_has_its_page(
    tmp_path: Path,
    start: Callable[..., Process],
    browser: Browser,  # noqa: F811
) -> None:
    line = Line(tmp_path, start)
    line.limit(TIGHT)
    service = line.open()
    device = tmp_path / "a.toml"
    device.write_text(DEVICE.format(slot="a", serial=int(SERIAL), port=line.unit, speed=SLOW, noise_g=2e-4))
    url = f"http://127.0.0.1:{line.port}"
    start("sim", device, "--follow", url).says(f"serial {SERIAL}, on ")
    line.begin("first article")
    line.ended("failed")
    line.begin("after cleaning")
    until(lambda: line.slots()["a"]["found"] >= 2)
    line.ask("/api/1/slots/a/stop", {"reason": "loose cable"})
    line.ended("aborted")
    line.begin("after a new cable")
    until(lambda: line.slots()["a"]["found"] >= 2 and line.recorded() > HEAD_BYTES)
    service.send(signal.SIGKILL)
    service.wait()
    line.limit(WIDE)
    line.open()
    line.begin("after a power failure")
    line.ended("passed")
    until(lambda: len(line.ask("/api/1/runs")["runs"]) == 4)
    runs = {run["code"]: run for run in line.ask("/api/1/runs")["runs"]}
    assert set(runs) == {"fit_outside", "stopped", "killed", "within_limits"}

    page = browser.new_page(locale="en-GB")
    for code, run in runs.items():
        found = shown(page, url, run)
        assert found == {file: 200 for file in FILES if run[file]}, code
        assert ("certificate" in found) == (code == "within_limits")
        assert ("report" in found) == (code in ("within_limits", "fit_outside"))
        expect(page.locator(".lacking")).to_have_count(0 if set(found) == set(FILES) else 1)
        expect(page.locator(f".banner.{run['verdict']}")).to_contain_text(run["reason"])
        expect(page.locator("figure .chart path")).to_have_count(3)
        expect(page.locator("section", has_text="Events").locator("tr").last).to_contain_text("Ended")
        expect(page.locator(".facts")).to_contain_text(run["work_reason"])
    page.goto(f"{url}/units/{SERIAL}")
    rows = page.locator("tbody tr")
    expect(rows).to_have_count(4)
    assert page.locator("tbody .verdict").all_inner_texts() == ["PASS", "STOPPED", "STOPPED", "FAIL"]
    told = rows.all_inner_texts()
    for row, attempt, reason in zip(
        told, "4321", ("a power failure", "a new cable", "cleaning", "first article"), strict=True
    ):
        assert reason in row
        assert f"\t{attempt}\t" in row
    assert "loose cable" in told[2]
    page.close()
