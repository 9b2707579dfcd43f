"""The operator's page in a real browser: a tray by scanner alone, and whatever happens to page, browser and service."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Locator, Page, expect

from tests.daemon.service.page.conftest import Opened
from tests.daemon.service.page.stage import Stage, direction, station_file

pytestmark = pytest.mark.slow

SERIALS = ("SN-1", "SN-2", "SN-3", "SN-4")
XSS = "<img src=x onerror=window.caught=1>"


def scan(page: Page, *texts: str) -> None:
    """As a scanner does: characters without a pause, then Enter, wherever the focus is."""
    for text in texts:
        page.keyboard.type(text)
        page.keyboard.press("Enter")


def task(page: Page) -> str:
    return page.locator("#task-title").inner_text()


def card(page: Page, slot: str) -> Locator:
    return page.locator(f'.card[aria-label="Slot {slot}"]')


def shown(page: Page) -> dict[str, str]:
    """Of each slot: its state as a class, and what its card says."""
    return dict(
        page.eval_on_selector_all(
            ".card", "cards => cards.map(c => [c.querySelector('.slot').innerText, c.className + '|' + c.innerText])"
        )
    )


def in_poses(stage: Stage) -> None:
    stage.scan("OP:Olena", *SERIALS, "CMD:START")
    stage.stage("poses")
    for slot in "abcd":
        stage.poses(slot, 3)
    stage.instruct([1, 0, 1])


def ended(stage: Stage) -> None:
    in_poses(stage)
    stage.finish("a")
    stage.finish("b", "verification_outside", "63 µg off, limit 50 µg")
    stage.finish("c", "no_poses", "no new still pose came")
    stage.finish("d", "no_limit", "the station has no limit")


def test_a_tray_by_scanner_alone(stage: Stage, opened: Opened) -> None:
    page = opened()
    expect(page.locator("#task-title")).to_have_text("Scan your badge")
    scan(page, "OP:Olena")
    expect(page.locator("#task-title")).to_have_text("Scan a unit")
    expect(page.locator("#work")).to_contain_text("Olena")
    page.locator("#clear").focus()  # a scanner does not care where the focus is
    scan(page, "WO:4711", SERIALS[0], "SLOT:c", SERIALS[1])
    expect(page.locator("#taken")).to_contain_text("SN-2 → c")
    expect(page.locator("#task-title")).to_have_text("Scan the next unit, or START")
    scan(page, SERIALS[2], SERIALS[3])
    expect(page.locator("#task-title")).to_have_text("START")
    assert [slot.serial for slot in stage.floor.desk.slots.values()] == ["SN-1", "SN-3", "SN-2", "SN-4"]
    scan(page, "CMD:START")
    expect(page.locator("#task-title")).to_have_text("Wait, do not touch")
    stage.stage("poses")
    for slot in "abcd":
        stage.poses(slot, 0)
    stage.instruct([0, 0, 1])
    expect(page.locator("#task-title")).to_have_text("Lid up")
    expect(page.locator("#drawing svg")).to_have_attribute("aria-label", "Drawing: Lid up")
    stage.live({slot: direction(2, 2, [0.0, 0.0, 1.0], 1.5) for slot in "abcd"})
    expect(page.locator("#still")).to_contain_text("Still for 1.5 of 3.0 s")
    expect(page.locator(".card .sphere .taken")).to_have_count(8)
    expect(page.locator(".card .sphere .missing")).to_have_count(48)
    stage.poses("a", 1)
    expect(card(page, "a")).to_contain_text("Pose 1 of 14")
    for slot in "abcd":
        stage.finish(slot)
    expect(page.locator(".card.passed .big")).to_have_count(4)
    expect(page.locator("#task-title")).to_have_text("Take the units out")
    expect(page.locator("#verdicts")).to_contain_text("Slot d: PASS.")
    scan(page, "SN-5")
    expect(page.locator(".card.passed")).to_have_count(0)
    expect(card(page, "a")).to_contain_text("SN-5")
    scan(page, "CMD:CLEAR")
    expect(page.locator(".card.empty")).to_have_count(4)
    assert stage.floor.starts == 1


def test_a_tray_by_keyboard_alone(stage: Stage, opened: Opened) -> None:
    page = opened()
    expect(page.locator("#task-title")).to_have_text("Scan your badge")
    for kind, text in (("OP:", "Petro"), ("WO:", "77"), ("batch", "B 9"), ("SLOT:", "b"), ("", "S-8")):
        page.locator("#kind").select_option(kind)
        page.locator("#text").press_sequentially(text, delay=5)
        page.keyboard.press("Enter")
        expect(page.locator("#taken")).to_contain_text(text)
    expect(page.locator("#work")).to_contain_text("B 9")
    assert stage.floor.desk.slots["b"].serial == "S-8"
    page.locator("#start").press("Space")
    expect(page.locator(".card.running")).to_have_count(1)
    page.get_by_role("button", name="Stop slot b").press("Enter")
    expect(page.locator("#stop-dialog")).to_contain_text("Stop slot b?")
    page.locator("#stop-reason").press_sequentially("wrong cable")
    with page.expect_response("**/slots/b/stop"):
        page.locator("#stop-dialog").get_by_role("button", name="STOP").press("Enter")
    assert stage.floor.played is not None
    assert stage.floor.played.units["b"].reason == "wrong cable"


def test_stopping_the_tray_can_be_taken_back(stage: Stage, opened: Opened) -> None:
    in_poses(stage)
    page = opened()
    page.locator("#stop").click()
    page.locator("#stop-dialog").get_by_role("button", name="Go on measuring").click()
    page.locator("#stop").click()
    with page.expect_response("**/tray/stop"):
        page.locator("#stop-dialog").get_by_role("button", name="STOP").click()
    assert stage.floor.played is not None
    assert {unit.reason for unit in stage.floor.played.units.values()} == {"stopped"}


@pytest.mark.parametrize("pause_ms", [4, 60, 150])
def test_a_scanner_does_not_answer_whether_to_stop(stage: Stage, opened: Opened, pause_ms: int) -> None:
    in_poses(stage)
    page = opened()
    page.locator("#stop").click()
    page.keyboard.type("SN-9", delay=pause_ms)
    page.keyboard.press("Enter")
    expect(page.locator("#stop-reason")).to_have_value("SN-9")
    expect(page.locator("#stop-dialog")).to_be_visible()
    assert stage.floor.played is not None
    assert {unit.reason for unit in stage.floor.played.units.values()} == {None}
    assert {slot.serial for slot in stage.floor.desk.slots.values()} == set(SERIALS)


def test_a_question_about_a_slot_ends_with_its_run_and_one_about_the_tray_with_the_tray(
    stage: Stage, opened: Opened
) -> None:
    in_poses(stage)
    page, other = opened(), opened()
    page.locator("#stop").click()
    other.get_by_role("button", name="Stop slot a").click()
    stage.finish("a")
    expect(other.locator("#stop-dialog")).to_be_hidden()
    expect(page.locator("#stop-dialog")).to_be_visible()
    for slot in "bcd":
        stage.finish(slot)
    expect(page.locator("#stop-dialog")).to_be_hidden()
    expect(page.locator(".card.passed")).to_have_count(4)


def test_a_tray_that_has_its_verdicts_is_not_started_again_before_a_scan(stage: Stage, opened: Opened) -> None:
    ended(stage)
    page = opened()
    expect(page.locator(".card.passed")).to_have_count(1)
    expect(page.locator("#start")).to_be_disabled()
    scan(page, "SN-9")
    expect(page.locator("#start")).to_be_enabled()


@pytest.mark.parametrize("language", ["en", "de", "uk"])
def test_an_error_is_said_in_words_with_what_to_do(stage: Stage, opened: Opened, language: str) -> None:
    page = opened(f"/?lang={language}")
    scan(page, "SN-1", "SN-1")
    error = page.locator("#error")
    expect(error).to_be_visible()
    said = {
        "en": ("This serial number is already in the tray.", "Scan the other unit, or press CLEAR and begin again."),
        "de": (
            "Diese Seriennummer ist schon im Satz.",
            "Das andere Gerät scannen, oder LEEREN drücken und neu beginnen.",
        ),
        "uk": (
            "Цей серійний номер уже є в наборі.",
            "Відскануйте інший виріб або натисніть ОЧИСТИТИ і почніть спочатку.",
        ),
    }
    for text in said[language]:
        expect(error).to_contain_text(text)
    assert page.locator("#error-title").evaluate("e => parseFloat(getComputedStyle(e).fontSize)") >= 24
    scan(page, "SN-2")
    expect(error).to_be_hidden()


def test_a_missing_reason_is_asked_for_and_starts_the_tray(stage: Stage, opened: Opened) -> None:
    stage.floor.passed = frozenset({"SN-1"})
    stage.scan("OP:Olena", "SN-1")
    page = opened()
    scan(page, "CMD:START")
    dialog = page.locator("#retest-dialog")
    expect(dialog).to_be_visible()
    expect(page.locator("#retest-reason")).to_be_focused()
    page.keyboard.type("WO:4712")  # a scan while it is asked is neither an order nor an answer
    page.keyboard.press("Enter")
    expect(page.locator("#retest-reason")).to_have_value("WO:4712")
    expect(dialog).to_be_visible()
    page.locator("#retest-reason").fill("customer return")
    dialog.locator("button[value=start]").click()
    expect(page.locator(".card.running")).to_have_count(1)
    expect(page.locator("#work")).not_to_contain_text("4712")
    expect(page.locator("#work")).to_contain_text("customer return")
    expect(dialog).to_be_hidden()
    assert stage.floor.starts == 1


def test_starting_twice_starts_once(stage: Stage, opened: Opened) -> None:
    stage.scan("OP:Olena", "SN-1")
    first, second = opened(), opened()
    for page in (first, second):
        expect(page.locator("#start")).to_be_enabled()
    first.locator("#start").evaluate("b => { b.click(); b.click(); b.click(); }")
    second.locator("#start").evaluate("b => b.click()")
    for page in (first, second):
        expect(page.locator(".card.running")).to_have_count(1)
    assert stage.floor.starts == 1
    expect(first.locator("#error")).to_be_hidden()


def test_a_lost_answer_to_a_start_does_no_harm(stage: Stage, opened: Opened) -> None:
    stage.scan("OP:Olena", "SN-1")
    page = opened()
    requests: list[str] = []

    def lose(route: object) -> None:
        requests.append(route.request.post_data_json["request"])  # type: ignore[attr-defined]
        if len(requests) == 1:
            route.fetch()  # type: ignore[attr-defined]
            route.abort()  # type: ignore[attr-defined]
        else:
            route.continue_()  # type: ignore[attr-defined]

    page.route("**/tray/start", lose)
    page.locator("#start").evaluate("b => { b.click(); b.click(); }")
    expect(page.locator(".card.running")).to_have_count(1)
    expect(page.locator("#taken")).to_have_text("Taken")
    assert stage.floor.starts == 1
    assert len(requests) == 2
    assert len(set(requests)) == 1


def prepare(stage: Stage, name: str) -> None:
    if name == "scanned":
        stage.scan("OP:Olena", *SERIALS[:2])
    elif name == "poses":
        in_poses(stage)
    elif name == "lost":
        in_poses(stage)
        stage.say("lost", "b", code="lost", reason="no answer for 2 s")
    elif name == "supply":
        in_poses(stage)
        stage.stage("power_off", "a", "b")
    elif name == "fitting":
        in_poses(stage)
        stage.stage("fitting")
    elif name == "ended":
        ended(stage)


@pytest.mark.parametrize("name", ["empty", "scanned", "poses", "lost", "supply", "fitting", "ended"])
def test_a_reload_and_a_second_browser_show_the_same(stage: Stage, opened: Opened, name: str) -> None:
    page = opened()
    expect(page.locator(".card.empty")).to_have_count(4)
    prepare(stage, name)
    second = opened("/?theme=dark")
    expect(second.locator(".card")).to_have_count(4)
    expect(page.locator("#board")).to_have_text(second.locator("#board").inner_text(), use_inner_text=True)
    before = (task(page), shown(page))
    assert (task(second), shown(second)) == before
    page.reload()
    expect(page.locator(".card")).to_have_count(4)
    assert (task(page), shown(page)) == before


def test_a_verdict_is_readable_from_three_metres_with_sign_word_and_reason(stage: Stage, opened: Opened) -> None:
    ended(stage)
    page = opened(viewport={"width": 1920, "height": 1080})
    for slot, (state, word, why) in {
        "a": ("passed", "PASS", "All errors are within the limits."),
        "b": ("failed", "FAIL", "The unit’s own output is outside its limit in the check poses."),
        "c": ("aborted", "STOPPED", "No new still pose came. Turn the unit and hold it still."),
        "d": ("not_judged", "NO LIMIT", "The station has no limit to judge by."),
    }.items():
        found = page.locator(f'.card.{state}[aria-label="Slot {slot}"]')
        expect(found.locator(".big")).to_have_text(word)
        expect(found.locator(".why")).to_have_text(why)
        expect(found.locator(".big svg.icon")).to_have_count(1)
        # A letter of 1/200 of the distance is read at ease: 15 mm of 0.28 mm a pixel, 0.73 of the size for a capital.
        size = found.locator(".big").evaluate("e => parseFloat(getComputedStyle(e).fontSize)")
        assert 0.73 * size * 0.28 >= 15
        box, card_box = found.locator(".big b").bounding_box(), found.bounding_box()
        assert box is not None
        assert card_box is not None
        assert box["x"] + box["width"] <= card_box["x"] + card_box["width"]


@pytest.mark.parametrize("language", ["en", "de", "uk"])
@pytest.mark.parametrize("size", [(1920, 1080), (820, 1180), (400, 800)])
def test_nothing_is_wider_than_the_page(stage: Stage, opened: Opened, size: tuple[int, int], language: str) -> None:
    ended(stage)
    page = opened(f"/?lang={language}", viewport={"width": size[0], "height": size[1]})
    expect(page.locator(".card .big")).to_have_count(4)
    # The verdicts get their size once the cards have theirs.
    page.wait_for_function("width => document.documentElement.scrollWidth <= width", arg=size[0])
    boxes = page.eval_on_selector_all(
        ".card, .card .big b, .task h2, .command button, .command input",
        "all => all.map(e => [e.outerHTML, e.getBoundingClientRect().right])",
    )
    assert [html for html, right in boxes if right > size[0]] == []
    cards = page.eval_on_selector_all(
        ".card", "all => all.map(c => [c.querySelector('.big b'), c].map(e => e.getBoundingClientRect().right))"
    )
    assert [right for right, edge in cards if right > edge] == []


@pytest.mark.parametrize("language", ["en", "de", "uk"])
@pytest.mark.parametrize("size", [(1920, 1080), (1280, 720), (1180, 820), (820, 1180)])
def test_four_slots_at_work_are_in_sight_without_scrolling(
    stage: Stage, opened: Opened, size: tuple[int, int], language: str
) -> None:
    in_poses(stage)
    page = opened(f"/?lang={language}", viewport={"width": size[0], "height": size[1]})
    expect(page.locator(".card .count")).to_have_count(4)
    stage.live({slot: direction(3, 3, [0.0, 0.0, 1.0], 1.5) for slot in "abcd"})
    expect(page.locator(".sphere")).to_have_count(4)
    assert page.evaluate("document.documentElement.scrollHeight") <= size[1]


def test_a_service_that_hangs_greys_the_page_within_5_s(stage: Stage, opened: Opened) -> None:
    in_poses(stage)
    page = opened()
    expect(page.locator("#task-title")).to_have_text("Edge A/Lid up")
    page.evaluate(
        "() => { window.greyed = new Promise(done => new MutationObserver(() =>"
        " document.body.classList.contains('stale') && done(performance.now()))"
        ".observe(document.body, {attributes: true})); }"
    )
    began = page.evaluate("performance.now()")
    go_on = stage.hang()
    greyed = page.evaluate("window.greyed")
    assert 2000 < greyed - began <= 5000
    expect(page.locator("#stale")).to_contain_text("The station does not answer")
    expect(page.locator("#stop")).to_be_disabled()
    assert page.locator("#board").evaluate("e => getComputedStyle(e).filter") == "grayscale(1)"
    go_on.set()
    expect(page.locator("#stale")).to_be_hidden()
    expect(page.locator("#task-title")).to_have_text("Edge A/Lid up")
    expect(page.locator("#stop")).to_be_enabled()


def test_a_page_without_a_network_catches_up(stage: Stage, opened: Opened) -> None:
    """As on a tablet that slept, or lost its wireless network."""
    in_poses(stage)
    page = opened()
    expect(page.locator("#task-title")).to_have_text("Edge A/Lid up")
    page.context.set_offline(True)
    page.evaluate("window.stop()")  # ends the connections that are open
    expect(page.locator("#stale")).to_be_visible()
    for slot in "abc":
        stage.finish(slot)
    stage.poses("d", 9)
    page.context.set_offline(False)
    expect(page.locator(".card.passed")).to_have_count(3)
    expect(card(page, "d")).to_contain_text("Pose 9 of 14")
    expect(page.locator("#stale")).to_be_hidden()


def test_a_session_that_has_ended_leads_to_the_sign_in(opened: Opened) -> None:
    page = opened()
    expect(page.locator("#task-title")).to_have_text("Scan your badge")
    answer = {"code": "not_signed_in", "message": "sign in as reader"}
    page.route("**/api/1/events*", lambda route: route.fulfill(status=401, json=answer))
    page.route("**/api/1/station", lambda route: route.fulfill(status=401, json=answer))
    page.evaluate("window.stop()")
    page.wait_for_url("**/sign-in?next=%2F")


def test_other_slots_in_the_station_file_reach_the_page(stage: Stage, opened: Opened) -> None:
    page = opened()
    expect(page.locator(".card")).to_have_count(4)
    station_file(stage.station.parent, "pq")
    with page.expect_navigation():
        stage.do(stage.floor.reload)
    expect(page.locator(".card")).to_have_count(2)
    assert '"slots": ["p", "q"]' in (page.locator("body").get_attribute("data-page") or "")


def test_a_restarted_service_is_found_again_and_nothing_scanned_is_lost(stage: Stage, opened: Opened) -> None:
    stage.scan("OP:Olena", "WO:4711", *SERIALS[:2])
    page = opened()
    expect(page.locator(".card.scanned")).to_have_count(2)
    stage.end()
    expect(page.locator("#stale")).to_be_visible()
    scan(page, "SN-9")
    expect(page.locator("#error")).to_contain_text("The station did not answer.")
    stage.begin()
    expect(page.locator("#stale")).to_be_hidden()
    expect(page.locator(".card.scanned")).to_have_count(2)
    expect(page.locator("#work")).to_contain_text("4711")
    scan(page, "SN-3")
    expect(page.locator(".card.scanned")).to_have_count(3)
    expect(page.locator("#error")).to_be_hidden()


def test_a_text_with_a_script_is_text(stage: Stage, opened: Opened) -> None:
    page = opened()
    scan(page, f"OP:{XSS}", XSS)
    expect(page.locator(".card.scanned .serial")).to_have_text(XSS)
    expect(page.locator("#work")).to_contain_text(XSS)
    scan(page, XSS)
    expect(page.locator("#error-detail")).to_contain_text(XSS)
    assert page.evaluate("window.caught") is None


@pytest.mark.parametrize("slots", ["a", "ab"])
def test_units_without_a_common_fixture_have_poses_of_their_own(browser: Browser, tmp_path: Path, slots: str) -> None:
    stage = Stage(station_file(tmp_path, slots, together=False))
    stage.begin()
    try:
        stage.scan("OP:Olena", *SERIALS[: len(slots)], "CMD:START")
        stage.stage("poses")
        for slot, up in zip(slots, ([0.0, 0.0, 1.0], [1.0, 0.0, 0.0]), strict=False):
            stage.poses(slot, 2, 14, up)
        page = browser.new_page()
        page.goto(stage.url)
        expect(page.locator("#task-title")).to_have_text(
            "Lid up" if slots == "a" else "Turn each unit as its card says"
        )
        expect(page.locator(".card .next")).to_have_text([] if slots == "a" else ["Next: Lid up", "Next: A up"])
        expect(page.locator(".card .turn svg")).to_have_count(0 if slots == "a" else 2)
        page.close()
    finally:
        stage.end()


def test_what_blocks_the_next_start_is_said(stage: Stage, opened: Opened) -> None:
    stage.scan("OP:Olena", "SN-1")
    stage.floor.stream.trouble = "the disk is full"
    stage.scan("WO:1")
    page = opened()
    expect(page.locator("#task-title")).to_have_text("The next start is blocked")
    expect(page.locator("#task-more")).to_have_text(
        "The database does not answer. Try again. If it stays, call the engineer."
    )
    scan(page, "CMD:START")
    expect(page.locator("#error-title")).to_have_text("The database does not answer.")


GOLDEN = "G-17"
STILL_A_HYPHEN = "\u2011"


@pytest.fixture
def golden(tmp_path: Path) -> Iterator[Stage]:
    """A station where no slot has seen its golden unit."""
    stage = Stage(station_file(tmp_path, golden=GOLDEN))
    stage.begin()
    yield stage
    stage.end()


def read_at_3_m(found: Locator, mm: float) -> bool:
    """Whether capitals are that high on a screen with 0.28 mm a pixel."""
    size: float = found.evaluate("e => parseFloat(getComputedStyle(e).fontSize)")
    return 0.73 * size * 0.28 >= mm


def test_the_chosen_slot_has_a_frame_and_a_word(stage: Stage, opened: Opened) -> None:
    stage.scan("OP:Olena", *SERIALS[:2])
    page = opened(viewport={"width": 1920, "height": 1080})
    expect(page.locator(".card.chosen, .chosen-note")).to_have_count(0)
    scan(page, "SLOT:b")
    chosen = page.locator(".card.chosen")
    expect(chosen).to_have_attribute("aria-label", "Slot b")
    expect(chosen.locator(".chosen-note")).to_have_count(1)
    assert read_at_3_m(chosen.locator(".chosen-note"), 7)
    widths = page.locator(".card").evaluate_all("all => all.map(c => parseFloat(getComputedStyle(c).borderTopWidth))")
    assert [width >= 6 for width in widths] == [False, True, False, False]
    expect(page.locator("#task-title")).to_contain_text("slot b")
    expect(page.locator("#task-more")).to_contain_text(SERIALS[1].replace("-", STILL_A_HYPHEN))
    scan(page, "SLOT:d")
    expect(chosen).to_have_attribute("aria-label", "Slot d")
    page.reload()
    expect(chosen).to_have_attribute("aria-label", "Slot d")
    stage.end()
    stage.begin()
    page.reload()
    expect(chosen).to_have_attribute("aria-label", "Slot d")
    scan(page, "SN-9")
    expect(card(page, "d")).to_contain_text("SN-9")
    expect(chosen).to_have_count(0)


def test_a_choice_of_an_empty_tray_can_be_taken_back(stage: Stage, opened: Opened) -> None:
    stage.scan("OP:Olena", "SLOT:c")
    page = opened()
    expect(page.locator(".card.chosen")).to_have_count(1)
    page.locator("#clear").click()
    expect(page.locator(".card.chosen")).to_have_count(0)
    expect(page.locator("#clear")).to_be_disabled()


@pytest.mark.parametrize("language", ["en", "de", "uk"])
def test_a_blocked_slot_says_why_and_what_to_do(golden: Stage, browser: Browser, language: str) -> None:
    page = browser.new_page(viewport={"width": 1920, "height": 1080})
    page.goto(f"{golden.url}/?lang={language}")
    golden.scan("OP:Olena", "SN-1", "SLOT:c", "SN-3")
    blocked = page.locator(".card.blocked")
    expect(blocked).to_have_count(2)
    assert blocked.evaluate_all("all => all.map(c => c.querySelector('.slot').innerText)") == ["a", "c"]
    serial = GOLDEN.replace("-", STILL_A_HYPHEN)
    for note in blocked.locator(".blocked-note").all():
        expect(note).to_have_attribute("data-code", "golden_due")
        expect(note).to_contain_text(serial)
        assert read_at_3_m(note.locator(".stage"), 9)
        assert read_at_3_m(note.locator("p").last, 6)
    expect(page.locator("#task.warn #task-more")).to_contain_text(serial)
    expect(page.locator("#task-more")).to_contain_text("a, c")
    golden.scan("SLOT:a", GOLDEN)  # it may always run
    expect(blocked).to_have_count(1)
    expect(page.locator("#task.warn #task-more")).to_contain_text(serial)
    page.close()


@pytest.mark.parametrize("language", ["en", "de", "uk"])
@pytest.mark.parametrize("size", [(1920, 1080), (1180, 820), (820, 1180), (400, 800)])
def test_chosen_and_blocked_slots_fit_their_cards(
    golden: Stage, browser: Browser, size: tuple[int, int], language: str
) -> None:
    golden.scan("OP:Olena", *SERIALS, "SLOT:b")
    page = browser.new_page(viewport={"width": size[0], "height": size[1]})
    page.goto(f"{golden.url}/?lang={language}")
    expect(page.locator(".card.blocked")).to_have_count(4)
    expect(page.locator(".card.blocked.chosen")).to_have_count(1)
    assert page.evaluate("document.documentElement.scrollWidth") <= size[0]
    if size[0] > 400:
        assert page.evaluate("document.documentElement.scrollHeight") <= size[1]
    cut = page.eval_on_selector_all(
        ".card, .task, .command select, .command button",
        "all => all.filter(e => e.scrollWidth > e.clientWidth + 1 || e.scrollHeight > e.clientHeight + 1)"
        ".map(e => e.outerHTML)",
    )
    assert cut == []
    page.close()


def test_the_stream_alone_tells_the_state(stage: Stage, opened: Opened) -> None:
    """No request asks for it, and events between two states lead to what the service has."""
    asked: list[str] = []
    page = opened()
    expect(page.locator(".card.empty")).to_have_count(4)
    page.on("request", lambda request: asked.append(request.url))
    in_poses(stage)
    stage.say("lost", "b", code="lost", reason="no answer for 2 s")
    stage.say("back", "b")
    stage.stage("check_poses", "c")
    stage.poses("c", 2, 6)
    stage.finish("d")
    expect(card(page, "d")).to_contain_text("PASS")
    expect(card(page, "c")).to_contain_text("Check pose 2 of 6")
    assert [url for url in asked if "/api/" in url] == []
