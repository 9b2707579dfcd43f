"""axe-core finds nothing serious on any page, light and dark."""

from __future__ import annotations

from pathlib import Path

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, Page, expect

from tests.daemon.service.page.conftest import Opened
from tests.daemon.service.page.results import RETESTED, written
from tests.daemon.service.page.stage import Stage, direction, station_file
from tests.daemon.service.page.test_operator_page import ended, in_poses

pytestmark = pytest.mark.slow

THEMES = ("light", "dark")


def serious(page: Page) -> list[str]:
    """Rules that are broken, with the first place of each. axe-core is put in by the test: the page's policy, rightly,
    takes no script from elsewhere."""
    found = Axe().run(page).response["violations"]
    return [
        f"{rule['id']}: {rule['nodes'][0]['html'][:120]} {rule['nodes'][0]['failureSummary']}"
        for rule in found
        if rule["impact"] in ("serious", "critical")
    ]


@pytest.mark.parametrize("theme", THEMES)
@pytest.mark.parametrize("name", ["empty", "scanned", "poses", "ended", "stale", "error", "dialog"])
def test_the_operators_page(stage: Stage, opened: Opened, name: str, theme: str) -> None:
    page = opened(f"/?theme={theme}")
    expect(page.locator(".card")).to_have_count(4)
    if name == "scanned":
        stage.scan("OP:Olena", "SN-1")
        expect(page.locator(".card.scanned")).to_have_count(1)
    if name in ("poses", "dialog"):
        in_poses(stage)
        stage.say("lost", "b", code="lost", reason="no answer for 2 s")
        stage.live({slot: direction(3, 3, [0.0, 0.0, 1.0], 1.5) for slot in "acd"})
        expect(page.locator(".sphere")).to_have_count(3)
    if name == "dialog":
        page.locator("#stop").click()
    if name == "ended":
        ended(stage)
        expect(page.locator(".card .big")).to_have_count(4)
    if name == "error":
        page.locator("#text").fill("CMD:DANCE")
        page.keyboard.press("Enter")
        expect(page.locator("#error")).to_be_visible()
    if name == "stale":
        go_on = stage.hang()
        expect(page.locator("#stale")).to_be_visible()
        page.evaluate("document.body.classList.remove('stale')")  # grey on purpose: it is not to be read
        assert serious(page) == []
        go_on.set()
    assert serious(page) == []


@pytest.mark.parametrize("theme", THEMES)
def test_chosen_and_blocked_slots(tmp_path: Path, browser: Browser, theme: str) -> None:
    stage = Stage(station_file(tmp_path, golden="G-17"))
    stage.begin()
    stage.scan("OP:Olena", "SN-1", "SN-2", "SLOT:b")
    page = browser.new_page()
    page.goto(f"{stage.url}/?theme={theme}")
    expect(page.locator(".card.blocked")).to_have_count(2)
    assert serious(page) == []
    stage.scan("SLOT:c")
    expect(page.locator(".card.empty.chosen")).to_have_count(1)
    assert serious(page) == []
    page.close()
    stage.end()


@pytest.mark.parametrize("theme", THEMES)
@pytest.mark.parametrize(
    "path", ["/runs", "/runs/{run}", f"/units/{RETESTED}", "/quality", "/sign-in", "/runs/unknown"]
)
def test_the_other_pages(stage: Stage, opened: Opened, path: str, theme: str) -> None:
    runs = written(stage.station.parent / "out", changed=True)
    stage.ledger.take()
    page = opened(f"{path.format(run=runs[5]['run'])}?theme={theme}")
    expect(page.locator("#content[aria-busy]")).to_have_count(0)
    page.locator("details.settings summary").click()
    assert serious(page) == []
