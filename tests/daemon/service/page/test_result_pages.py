"""Runs, a run, a unit and quality in a real browser."""

from __future__ import annotations

import re
from pathlib import Path
from urllib.parse import parse_qs, quote, urlsplit

import pytest
from playwright.sync_api import expect

from tests.daemon.service.page.conftest import Opened
from tests.daemon.service.page.documents import FAILED, XSS, documents, rows
from tests.daemon.service.page.stage import Stage

pytestmark = pytest.mark.slow

RECORDING = Path(__file__).parents[4] / "recordings" / "can-second-order.mcap"


@pytest.fixture(autouse=True)
def _filled(stage: Stage) -> None:
    stage.documents = documents()
    stage.book.rows = rows()


def test_the_table_of_runs_names_verdict_and_reason(opened: Opened) -> None:
    page = opened("/runs")
    expect(page.locator("tbody tr")).to_have_count(48)
    row = page.locator("tbody tr", has_text="SN-1005")
    expect(row).to_contain_text("FAIL")
    expect(row).to_contain_text("The unit’s own output is outside its limit in the check poses.")
    expect(row.locator(".outside")).to_have_text("▲ 63 µg")
    expect(page.get_by_role("link", name="Older runs")).to_have_attribute("href", "?after=47")


def test_a_filter_goes_into_the_address_and_to_the_interface(opened: Opened) -> None:
    page = opened("/runs", timezone_id="Europe/Kyiv")
    expect(page.locator("tbody tr")).to_have_count(48)
    page.get_by_label("Part number").fill("TX & 3")
    page.get_by_label("Verdict").select_option("fail")
    page.get_by_label("From").fill("2026-01-20T08:00")
    with page.expect_request("**/api/1/runs?*") as asked:
        page.get_by_role("button", name="Show").click()
    query = parse_qs(urlsplit(asked.value.url).query)
    assert query == {
        "part_number": ["TX & 3"],
        "verdict": ["fail"],
        "since": ["2026-01-20T06:00:00.000Z"],
        "limit": ["50"],
    }
    expect(page.locator("tbody tr")).to_have_count(48)
    expect(page.get_by_label("Part number")).to_have_value("TX & 3")
    expect(page.get_by_label("From")).to_have_value("2026-01-20T08:00")
    csv = page.get_by_role("link", name=re.compile("CSV")).get_attribute("href")
    assert csv is not None
    assert parse_qs(urlsplit(csv).query) == {key: value for key, value in query.items() if key != "limit"}


def test_a_run_shows_figures_documents_trace_and_events(stage: Stage, opened: Opened) -> None:
    folder = stage.station.parent / "out"
    folder.mkdir(exist_ok=True)
    (folder / "SN-1005.mcap").write_bytes(RECORDING.read_bytes())
    run = rows()[5]["run"]
    page = opened(f"/runs/{run}")
    expect(page.locator(".banner .word")).to_have_text("FAIL")
    expect(page.get_by_role("heading", name="Run of SN-1005")).to_be_visible()
    expect(page.locator("tr", has_text="Error in the check poses")).to_contain_text("▲ 63 µg")
    expect(page.locator("tr", has_text="Bias x")).to_contain_text("mg")
    for name, end in (("Report", "report"), ("Outcome (JSON)", "outcome"), ("Recording", "recording")):
        expect(page.get_by_role("link", name=name)).to_have_attribute("href", f"/api/1/runs/{run}/{end}")
    expect(page.get_by_role("link", name="Certificate")).to_have_count(0)
    expect(page.locator("figure .chart .span")).to_have_count(27, timeout=60000)
    expect(page.locator("figure .chart path")).to_have_count(3)
    expect(page.locator("tbody tr", has_text="Unit lost: no answer for 2 s")).to_be_visible()


def test_a_run_without_a_recording_says_so(opened: Opened) -> None:
    page = opened(f"/runs/{rows()[6]['run']}")
    expect(page.get_by_text("There is no recording to draw.")).to_be_visible()


def test_a_run_that_is_not_known_says_so(opened: Opened) -> None:
    page = opened("/runs/nothing")
    expect(page.get_by_role("alert")).to_contain_text("This is not known here.")


def test_a_unit_has_its_full_history(opened: Opened) -> None:
    page = opened("/units/SN-1005")
    expect(page.locator("tbody tr")).to_have_count(3)
    assert page.locator("tbody .verdict").all_inner_texts() == ["PASS", "PASS", "FAIL"]
    expect(page.locator("figure")).to_have_count(12)
    expect(page.locator("figure", has_text="Error in the check poses").locator(".point")).to_have_count(3)


def test_a_serial_number_with_a_script_is_text_everywhere(opened: Opened) -> None:
    page = opened("/runs")
    page.get_by_role("link", name=XSS).click()
    expect(page.get_by_role("heading", name=f"Unit {XSS}")).to_be_visible()
    assert page.url.endswith(f"/units/{quote(XSS, safe='')}")
    page.locator("tbody a").first.click()
    expect(page.get_by_role("heading", name=f"Run of {XSS}")).to_be_visible()
    page.goto(page.url.partition("/runs")[0] + "/quality")
    expect(page.locator("figure")).to_have_count(2)
    assert page.evaluate("window.caught") is None


def test_quality_shows_yield_reasons_and_charts(opened: Opened) -> None:
    page = opened("/quality")
    assert page.locator(".figures dd").all_inner_texts() == ["46", "48", "87%", "93%"]
    assert page.locator(".pareto tbody tr").count() == len(set(FAILED.values()))
    first = page.locator(".pareto tbody tr").first
    expect(first).to_contain_text("The unit’s own output is outside its limit")
    expect(first.get_by_role("link")).to_have_attribute("href", "/runs?code=verification_outside")
    charts = page.locator("figure")
    expect(charts).to_have_count(2)
    expect(charts.nth(0).locator(".point.out")).to_have_count(4)
    expect(charts.nth(0).locator(".spec")).to_have_count(1)
    expect(charts.nth(0).locator(".control")).to_have_count(2)
    page.get_by_role("button", name="Bias x").click()
    expect(charts.nth(0)).to_contain_text("Bias x, mg: Individuals")
    row = page.locator("tr", has=page.get_by_role("button", name="Error in the check poses"))
    expect(row).to_contain_text("50 µg")
    expect(page.locator("tr", has=page.get_by_role("button", name="Bias x"))).to_contain_text("no limit")


def test_quality_gives_no_ppk_below_30_units(stage: Stage, opened: Opened) -> None:
    few = dict(stage.documents["quality"])
    few["characteristics"] = [c | {"n": 29, "ppk": None, "ppk_interval": None} for c in few["characteristics"]]
    stage.documents["quality"] = few
    page = opened("/quality")
    expect(page.locator("tr", has=page.get_by_role("button", name="Error in the check poses"))).to_contain_text(
        "from 30 units"
    )


@pytest.mark.parametrize("path", ["/runs", "/runs/{run}", "/units/SN-1005", "/quality", "/sign-in"])
@pytest.mark.parametrize("language", ["en", "de", "uk"])
def test_nothing_is_wider_than_a_telephone(opened: Opened, path: str, language: str) -> None:
    page = opened(f"{path.format(run=rows()[5]['run'])}?lang={language}", viewport={"width": 400, "height": 800})
    expect(page.locator("#content[aria-busy]")).to_have_count(0)
    assert page.evaluate("document.documentElement.scrollWidth") <= 400


def test_signing_in_leads_back(stage: Stage, opened: Opened) -> None:
    stage.access.closed = True
    page = opened("/runs?order=4711")
    expect(page.get_by_role("heading", name="Sign in")).to_be_visible()
    sent: list[object] = []

    def answer(route: object) -> None:
        sent.append(route.request.post_data_json)  # type: ignore[attr-defined]
        if len(sent) == 1:
            route.fulfill(status=401, json={"code": "not_signed_in", "message": "name or PIN is wrong"})  # type: ignore[attr-defined]
        else:
            stage.access.closed = False
            route.fulfill(json={"name": "olena", "role": "operator"})  # type: ignore[attr-defined]

    page.route("**/api/1/session", answer)
    page.get_by_label("Name").fill("olena")
    page.get_by_label("PIN").fill("1111")
    page.get_by_role("button", name="Sign in").click()
    expect(page.get_by_role("alert")).to_contain_text("wrong")
    page.get_by_label("PIN").fill("2222")
    page.keyboard.press("Enter")
    expect(page.locator("tbody tr")).to_have_count(48)
    assert page.url.endswith("/runs?order=4711")
    assert sent == [{"name": "olena", "pin": "1111"}, {"name": "olena", "pin": "2222"}]
