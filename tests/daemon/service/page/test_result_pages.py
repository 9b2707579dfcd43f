"""Runs, a run, a unit and quality in a real browser, over a folder of runs."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, quote, urlsplit

import pytest
from playwright.sync_api import Browser, expect

from tests.daemon.service.page.conftest import Opened
from tests.daemon.service.page.results import FAILED, RETESTED, RUNS, SLASHED, XSS, written
from tests.daemon.service.page.stage import Stage, station_file
from triaxcald.schema.codes import Code, Verdict
from triaxcald.service.people import People, Role, hashed

pytestmark = pytest.mark.slow

RECORDING = Path(__file__).parents[4] / "recordings" / "can-second-order.mcap"
PIN = "4711 ä"


@pytest.fixture
def runs(stage: Stage) -> list[dict[str, Any]]:
    """The outcomes, oldest first."""
    folder = stage.station.parent / "out"
    found = written(folder)
    (folder / "run-005.mcap").write_bytes(RECORDING.read_bytes())
    for name in ("run-005.report.html", "run-006.certificate.json"):
        (folder / name).write_text("{}", encoding="utf-8")
    stage.ledger.take()
    return found


def test_the_table_of_runs_names_verdict_and_reason_page_by_page(runs: list[dict[str, Any]], opened: Opened) -> None:
    page = opened("/runs")
    expect(page.locator("tbody tr")).to_have_count(50)
    page.get_by_role("link", name="Older runs").click()
    expect(page.locator("tbody tr")).to_have_count(RUNS - 50)
    page.get_by_role("link", name="Newest runs").click()
    row = page.locator("tbody tr", has_text="SN-1018")
    expect(row).to_contain_text("FAIL")
    expect(row).to_contain_text("The unit’s own output is outside its limit in the check poses.")
    expect(row.locator(".outside")).to_have_text("▲ 63 µg")
    row = page.locator("tbody tr", has_text="SN-1024")
    expect(row).to_contain_text("STOPPED")


def test_a_filter_goes_into_the_address_and_to_the_interface(runs: list[dict[str, Any]], opened: Opened) -> None:
    page = opened("/runs", timezone_id="Europe/Kyiv")
    expect(page.locator("tbody tr")).to_have_count(50)
    page.get_by_label("Part number").fill("TX & 3")
    page.get_by_label("Verdict").select_option("fail")
    page.get_by_label("From").fill("2030-01-01T02:10")
    with page.expect_request("**/api/1/runs?*") as asked:
        page.get_by_role("button", name="Show").click()
    query = parse_qs(urlsplit(asked.value.url).query)
    wanted = {"part_number": ["TX & 3"], "verdict": ["fail"], "since": ["2030-01-01T00:10:00.000Z"]}
    assert query == {**wanted, "limit": ["50"]}
    failed = [i for i, code in FAILED.items() if code.verdict is Verdict.FAIL and i >= 10]
    expect(page.locator("tbody tr")).to_have_count(len(failed))
    expect(page.get_by_label("Part number")).to_have_value("TX & 3")
    expect(page.get_by_label("From")).to_have_value("2030-01-01T02:10")
    with page.expect_download() as download:
        page.get_by_role("link", name=re.compile("CSV")).click()
    table = Path(download.value.path()).read_text(encoding="utf-8").splitlines()
    assert len(table) == 1 + len(failed)
    page.get_by_role("link", name="All", exact=True).click()
    expect(page.locator("tbody tr")).to_have_count(50)


def test_a_filter_is_on_paper_and_goes_on_to_the_runs_of_a_reason(runs: list[dict[str, Any]], opened: Opened) -> None:
    page = opened("/quality?slot=a&since=2030-01-01T00:10:00.000Z", timezone_id="Europe/Kyiv")
    expect(page.get_by_label("From")).to_have_value("2030-01-01T02:10")
    filtered = page.locator("#filtered")
    expect(filtered).to_be_hidden()
    page.emulate_media(media="print")
    expect(filtered).to_have_text("Slot: a; From: 2030-01-01 02:10")
    expect(filtered).to_be_visible()
    page.emulate_media(media="screen")
    with page.expect_request("**/api/1/runs?*") as asked:
        page.locator(".pareto tbody tr").first.get_by_role("link").click()
    query = parse_qs(urlsplit(asked.value.url).query)
    assert (query["slot"], query["since"]) == (["a"], ["2030-01-01T00:10:00.000Z"])
    chosen = page.get_by_label("Code").locator("option:checked")
    expect(chosen).to_have_text(re.compile(r"\w+ .*\."))


def test_a_filter_that_no_run_fits_says_so(runs: list[dict[str, Any]], opened: Opened) -> None:
    page = opened("/runs?order=none")
    expect(page.get_by_text("No run fits this filter.")).to_be_visible()


def test_a_run_shows_figures_documents_trace_and_events(
    stage: Stage, runs: list[dict[str, Any]], opened: Opened
) -> None:
    run = runs[5]["run"]
    head = {"format": "triaxcal.event/1", "run": run, "tray": "t", "unit": "b", "time": "2030-01-01T00:05:00.000+00:00"}
    following = {"label": "+X", "vector": [1, 0, 0], "once_more": False}
    stage.ledger.append([
        {**head, "seq": 1, "event": "stage", "stage": "poses"},
        {**head, "seq": 2, "event": "poses", "found": 1, "wanted": 14, "next": following},
        {**head, "seq": 3, "event": "lost", "code": "lost", "reason": "no answer for 2 s"},
        {**head, "seq": 4, "event": "back"},
        {**head, "seq": 5, "event": "ended", "outcome": {"verdict": "fail"}},
    ])  # fmt: skip
    page = opened(f"/runs/{run}")
    expect(page.locator(".facts div", has_text="Terms of the calibration").locator("dd")).to_have_text("linear")
    expect(page.locator(".banner .word")).to_have_text("FAIL")
    expect(page.get_by_role("heading", name=f"Run of {RETESTED}")).to_be_visible()
    expect(page.locator("tr", has_text="Error in the check poses")).to_contain_text("▲ 63 µg")
    expect(page.locator("tr", has_text="Bias x")).to_contain_text("mg")
    for name, end in (("Report", "report"), ("Outcome (JSON)", "outcome"), ("Recording", "recording")):
        expect(page.get_by_role("link", name=name)).to_have_attribute("href", f"/api/1/runs/{run}/{end}")
    expect(page.get_by_role("link", name="Certificate")).to_have_count(0)
    expect(page.locator("figure .chart .span")).to_have_count(27)
    expect(page.locator("figure .chart path")).to_have_count(3)
    events = page.locator("section", has=page.get_by_role("heading", name="Events")).locator("tr td:last-child")
    assert events.all_inner_texts() == [
        "Taking poses", "Pose 1 of 14. Next: +X up", "Unit lost: no answer for 2 s", "Unit is back", "Ended: FAIL",
    ]  # fmt: skip


def test_a_run_without_a_recording_says_so(runs: list[dict[str, Any]], opened: Opened) -> None:
    page = opened(f"/runs/{runs[6]['run']}")
    expect(page.get_by_text("There is no recording to draw.")).to_be_visible()
    expect(page.get_by_role("link", name="Certificate")).to_have_count(1)
    expect(page.get_by_text("Its events are no longer kept.")).to_be_visible()


def test_a_unit_with_any_characters_in_its_serial_number_is_found(runs: list[dict[str, Any]], opened: Opened) -> None:
    page = opened("/runs")
    page.get_by_role("link", name=SLASHED).click()
    expect(page.get_by_role("heading", name=f"Unit {SLASHED}")).to_be_visible()
    expect(page.locator("tbody tr")).to_have_count(1)


@pytest.mark.parametrize("path", ["/runs/nothing", "/units/nobody"])
def test_what_is_not_known_is_said(opened: Opened, path: str) -> None:
    page = opened(path)
    expect(page.get_by_role("alert")).to_contain_text("This is not known here.")


def test_a_unit_has_its_full_history(runs: list[dict[str, Any]], opened: Opened) -> None:
    page = opened(f"/units/{RETESTED}")
    expect(page.locator("tbody tr")).to_have_count(3)
    assert page.locator("tbody .verdict").all_inner_texts() == ["PASS", "PASS", "FAIL"]
    expect(page.locator("figure")).to_have_count(12)
    checked = page.locator("figure", has_text="Error in the check poses")
    expect(checked.locator(".point")).to_have_count(3)
    expect(checked.locator(".point.outside")).to_have_count(1)
    expect(checked.locator(".spec")).to_have_count(1)


def test_a_serial_number_with_a_script_is_text_everywhere(runs: list[dict[str, Any]], opened: Opened) -> None:
    page = opened("/runs")
    page.get_by_role("link", name=XSS).click()
    expect(page.get_by_role("heading", name=f"Unit {XSS}")).to_be_visible()
    assert page.url.endswith(f"/units/{quote(XSS, safe='')}")
    page.locator("tbody a").first.click()
    expect(page.get_by_role("heading", name=f"Run of {XSS}")).to_be_visible()
    page.goto(page.url.partition("/runs")[0] + "/quality")
    expect(page.locator("figure")).to_have_count(2)
    assert page.evaluate("window.caught") is None


def test_quality_shows_yield_reasons_and_charts(runs: list[dict[str, Any]], opened: Opened) -> None:
    page = opened("/quality")
    figures = page.locator(".figures dd")
    expect(figures).to_have_count(4)
    attempts = page.locator(".figures div", has_text="Attempts").locator("dd")
    expect(attempts).to_have_text(str(RUNS))
    expect(page.locator(".figures div", has_text="First-pass yield").locator("small")).to_contain_text(
        re.compile(r"\d+ of \d+; 95 %:")
    )
    bars = page.locator(".pareto tbody tr")
    expect(bars).to_have_count(len(set(FAILED.values())))
    first = bars.first
    expect(first).to_contain_text("The unit’s own output is outside its limit")
    expect(first.locator("td.n").first).to_have_text(str(list(FAILED.values()).count(Code.VERIFICATION_OUTSIDE)))
    expect(first.get_by_role("link")).to_have_attribute("href", "/runs?code=verification_outside")
    expect(bars.last.locator("td.n").last).to_have_text("100%")
    page.get_by_label("Control chart").select_option("verification_rms_g")
    charts = page.locator("figure")
    expect(charts).to_have_count(2)
    expect(charts.nth(0)).to_contain_text("Error in the check poses, µg: Individuals")
    expect(charts.nth(0).locator(".point.outside")).to_have_count(3)  # a unit's last run counts, and RETESTED passed
    expect(charts.nth(0).locator(".spec")).to_have_count(1)
    expect(charts.nth(0).locator(".control")).to_have_count(2)
    numbers = re.compile(
        r"Mean [\d.]+ µg; control limits (?:–|[\d.]+ µg) and [\d.]+ µg .*mean [\d.]+ µg, limit [\d.]+ µg"
    )
    expect(page.locator("p.control-told")).to_have_text(numbers)
    page.get_by_role("button", name="Bias x").click()
    expect(charts.nth(0)).to_contain_text("Bias x, mg: Individuals")
    row = page.locator("tr", has=page.get_by_role("button", name="Error in the check poses"))
    expect(row).to_contain_text("50 µg")
    expect(row).to_contain_text(re.compile(r"0\.\d+ \(0\.\d+–"))
    expect(page.locator("tr", has=page.get_by_role("button", name="Bias x"))).to_contain_text("no limit")


def test_quality_tells_and_marks_what_is_outside_and_where_the_limit_changed(stage: Stage, opened: Opened) -> None:
    written(stage.station.parent / "out", changed=True)
    stage.ledger.take()
    page = opened("/quality")
    page.get_by_label("Control chart").select_option("verification_rms_g")
    chart = page.locator("figure").first
    outside = [i for i, code in FAILED.items() if code is Code.VERIFICATION_OUTSIDE and f"SN-{1000 + i}" != RETESTED]
    expect(chart.locator(".beyond")).to_have_count(len(outside) + 1)  # FIT_OUTSIDE has check poses here, too
    expect(page.locator("[data-outside]")).to_have_attribute("data-outside", str(len(outside) + 1))
    expect(page.locator(".beside.changed")).to_have_count(1)
    expect(chart.locator(".spec")).to_have_count(2)
    expect(chart.locator("line.change")).to_have_count(1)
    expect(chart.locator("text.change")).to_have_text("50")
    row = page.locator("tr", has=page.get_by_role("button", name="Error in the check poses"))
    expect(row.locator(".outside")).to_have_text(f"▲ {len(outside) + 1}")
    # In black on white as well: a shape with an outline, over the point.
    page.emulate_media(media="print")
    expect(page.locator(".beside.changed")).to_be_visible()
    for mark, least_px in ((chart.locator(".beyond").first, 8), (chart.locator("line.change"), 150)):
        stroke, height = mark.evaluate("e => [getComputedStyle(e).stroke, e.getBoundingClientRect().height]")
        assert (stroke, height >= least_px) == ("rgb(0, 0, 0)", True)
    page.emulate_media(media="screen")
    page.get_by_role("button", name="Bias x").click()
    expect(page.locator(".beside")).to_have_count(0)
    expect(chart.locator(".beyond, .spec, .change")).to_have_count(0)


def test_quality_of_one_limit_speaks_of_no_change(runs: list[dict[str, Any]], opened: Opened) -> None:
    page = opened("/quality")
    page.get_by_label("Control chart").select_option("verification_rms_g")
    expect(page.locator("[data-outside]")).to_have_count(1)
    expect(page.locator("figure").first.locator(".beyond")).to_have_count(3)
    expect(page.locator(".change, .changed")).to_have_count(0)


def test_quality_gives_no_ppk_below_30_units(runs: list[dict[str, Any]], opened: Opened) -> None:
    page = opened("/quality?slot=a")
    row = page.locator("tr", has=page.get_by_role("button", name="Error in the check poses"))
    expect(row).to_contain_text("from 30 units")


@pytest.mark.parametrize("path", ["/runs", "/runs/{run}", f"/units/{RETESTED}", "/quality", "/sign-in"])
@pytest.mark.parametrize("language", ["en", "de", "uk"])
def test_nothing_is_wider_than_a_telephone(
    runs: list[dict[str, Any]], opened: Opened, path: str, language: str
) -> None:
    page = opened(f"{path.format(run=runs[5]['run'])}?lang={language}", viewport={"width": 400, "height": 800})
    expect(page.locator("#content[aria-busy]")).to_have_count(0)
    assert page.evaluate("document.documentElement.scrollWidth") <= 400


@pytest.fixture
def guarded(tmp_path: Path) -> Iterator[Stage]:
    """A station that takes orders of people who have signed in alone."""
    stage = Stage(station_file(tmp_path, open_loopback=False))
    stage.begin()
    people = People(stage.ledger)
    people.add("olena", Role.OPERATOR, hashed(PIN))
    people.add("petro", Role.READER, hashed(PIN))
    yield stage
    stage.end()


def test_an_operator_signs_in_works_and_signs_out(guarded: Stage, browser: Browser) -> None:
    page = browser.new_context(locale="en-GB").new_page()
    page.goto(guarded.url)
    expect(page.locator("#task-title")).to_have_text("Scan your badge")
    page.keyboard.type("SN-1")
    page.keyboard.press("Enter")
    expect(page.locator("#error")).to_contain_text("Nobody is signed in.")
    page.locator("#error").get_by_role("link", name="Sign in").click()
    for pin in ("1234", PIN):
        page.get_by_label("Name").fill("OP:olena")  # as a badge is scanned
        page.get_by_label("PIN").fill(pin)
        expect(page.get_by_role("button", name="Sign in")).to_be_enabled()
        page.keyboard.press("Enter")
        if pin != PIN:
            expect(page.get_by_role("alert")).to_contain_text("wrong")
    expect(page.locator("#work")).to_contain_text("olena")  # needs no badge
    expect(page.locator("#task-title")).to_have_text("Scan a unit")
    page.keyboard.type("SN-1")
    page.keyboard.press("Enter")
    expect(page.locator(".card.scanned")).to_have_count(1)
    page.locator("details.settings summary").click()
    expect(page.locator(".menu")).to_contain_text("olena, operator")
    with page.expect_navigation():
        page.get_by_role("button", name="Sign out").click()
    page.locator("details.settings summary").click()
    expect(page.locator(".menu").get_by_role("link", name="Sign in")).to_be_visible()
    page.context.close()


def test_a_reader_is_told_what_the_role_lacks(guarded: Stage, browser: Browser) -> None:
    page = browser.new_context(locale="uk-UA").new_page()
    page.goto(guarded.url + "/sign-in")
    page.locator("#name").fill("petro")
    page.locator("#pin").fill(PIN)
    expect(page.locator("#sign-in button")).to_be_enabled()
    page.keyboard.press("Enter")
    expect(page.locator("#task-title")).to_have_text("Відскануйте перепустку")
    page.keyboard.type("SN-1")
    page.keyboard.press("Enter")
    expect(page.locator("#error")).to_contain_text("Вам це не дозволено.")
    page.context.close()
