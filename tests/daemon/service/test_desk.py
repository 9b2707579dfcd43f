"""The tray of a station as a value: scans, orders and events become the station state."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest

from triaxcald.schema.station_state import StationState
from triaxcald.service.desk import Desk
from triaxcald.service.errors import ApiError
from triaxcald.station.faces import OWN_NAMES

AT = "2026-01-31T12:00:00.000+00:00"
LATER = "2026-01-31T12:00:01.000+00:00"


@pytest.fixture
def desk() -> Desk:
    return Desk("line 1", [("a", None), ("b", None), ("c", None)], {"order": "WO 1"}, OWN_NAMES, AT)


def states(desk: Desk) -> dict[str, tuple[str, str | None]]:
    document = desk.document(0)
    assert StationState.model_validate(document).document() == document
    return {slot["slot"]: (slot["state"], slot["serial"]) for slot in document["slots"]}


def refused(work: Any) -> str:
    with pytest.raises(ApiError) as caught:
        work()
    assert "\n" not in caught.value.message
    return caught.value.problem.value


def begin(desk: Desk) -> dict[str, str]:
    due = desk.due()
    runs = {slot: f"run-{slot}" for slot in due}
    desk.started("tray", runs, due, AT)
    return runs


def event(kind: str, unit: str | None = None, **more: Any) -> dict[str, Any]:
    return {"event": kind, "unit": unit, "time": LATER, **more}


def outcome(run: str, verdict: str = "pass", **more: Any) -> dict[str, Any]:
    return {"run": run, "verdict": verdict, "serial": None, "code": "within_limits", "reason": "good", **more}


def test_each_serial_number_takes_the_next_empty_slot(desk: Desk) -> None:
    taken = [desk.scan(text, AT).document() for text in ("1001", "1002")]
    assert taken == [
        {"taken_for": "serial", "serial": "1001", "slot": "a"},
        {"taken_for": "serial", "serial": "1002", "slot": "b"},
    ]
    assert states(desk) == {"a": ("scanned", "1001"), "b": ("scanned", "1002"), "c": ("empty", None)}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("OP:A. Smith", {"taken_for": "operator", "operator": "A. Smith"}),
        ("WO:42", {"taken_for": "order", "order": "42"}),
        ("SLOT:c", {"taken_for": "slot", "slot": "c"}),
        ("CMD:start", {"taken_for": "command", "command": "START"}),
        (" 1001\r", {"taken_for": "serial", "serial": "1001", "slot": "a"}),
        ("SN:7", {"taken_for": "serial", "serial": "SN:7", "slot": "a"}),
    ],
)
def test_a_scan_is_taken_for_what_its_beginning_says(desk: Desk, text: str, expected: Mapping[str, str]) -> None:
    assert desk.scan(text, AT).document() == expected


def test_badge_and_order_are_of_the_work(desk: Desk) -> None:
    desk.scan("OP:A. Smith", AT)
    desk.scan("WO:42", AT)
    document = desk.document(7)
    assert (document["operator"], document["work"]["order"], document["seq"]) == ("A. Smith", "42", 7)


def test_a_chosen_slot_takes_the_next_serial_number_though_it_has_one(desk: Desk) -> None:
    desk.scan("1001", AT)
    desk.scan("SLOT:c", AT)
    desk.scan("1003", AT)
    desk.scan("SLOT:a", AT)
    desk.scan("1001", AT)  # the same once more
    desk.scan("SLOT:a", AT)
    desk.scan("1000", AT)
    assert states(desk) == {"a": ("scanned", "1000"), "b": ("empty", None), "c": ("scanned", "1003")}


def test_the_state_names_the_chosen_slot_also_after_a_restart(desk: Desk) -> None:
    assert desk.document(0)["chosen"] is None
    desk.scan("SLOT:c", AT)
    assert desk.document(0)["chosen"] == "c"
    again = Desk("line 1", [("a", None), ("b", None), ("c", None)], {}, OWN_NAMES, LATER)
    again.restore(desk.kept(), LATER)
    assert again.document(0)["chosen"] == "c"
    smaller = Desk("line 1", [("a", None)], {}, OWN_NAMES, LATER)
    smaller.restore(desk.kept(), LATER)
    assert smaller.document(0)["chosen"] is None
    again.scan("1001", LATER)
    assert (again.document(0)["chosen"], states(again)["c"]) == (None, ("scanned", "1001"))


@pytest.mark.parametrize("same", ["1001", "001001"])
def test_one_unit_is_in_one_slot(desk: Desk, same: str) -> None:
    desk.scan("1001", AT)
    assert refused(lambda: desk.scan(same, AT)) == "serial_twice"
    assert refused(lambda: desk.put({"b": same}, {}, AT)) == "serial_twice"
    assert refused(lambda: desk.put({"b": "7", "c": "7"}, {"order": "x"}, AT)) == "serial_twice"
    assert states(desk)["b"] == ("empty", None)
    assert desk.document(0)["work"]["order"] == "WO 1"
    desk.put({"a": None, "b": same}, {}, AT)  # it was moved
    assert states(desk) == {"a": ("empty", None), "b": ("scanned", same), "c": ("empty", None)}


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("", "invalid"), ("  ", "invalid"), ("x" * 65, "invalid"), ("a\x00b", "invalid"), ("OP:", "invalid"),
        ("CMD:JUMP", "invalid"), ("SLOT:z", "unknown"),
    ],
)  # fmt: skip
def test_a_scan_that_makes_no_sense_changes_nothing(desk: Desk, text: str, code: str) -> None:
    before = desk.document(0)
    assert refused(lambda: desk.scan(text, LATER)) == code
    assert desk.document(0) == before


def test_a_full_tray_takes_no_more(desk: Desk) -> None:
    for serial in "123":
        desk.scan(serial, AT)
    assert refused(lambda: desk.scan("4", AT)) == "invalid"


def test_a_start_is_of_the_scanned_slots_alone(desk: Desk) -> None:
    assert refused(desk.due) == "invalid"
    desk.scan("SLOT:b", AT)
    desk.scan("1002", AT)
    assert desk.due() == {"b": "1002"}
    begin(desk)
    assert states(desk) == {"a": ("empty", None), "b": ("running", "1002"), "c": ("empty", None)}


def test_without_a_scan_a_start_is_of_the_units_that_the_station_file_names() -> None:
    desk = Desk("line 1", [("a", "7"), ("b", None)], {}, OWN_NAMES, AT)
    assert desk.due() == {"a": "7"}
    desk.scan("1002", AT)
    assert desk.due() == {"a": "1002"}  # a number of the station file does not occupy its slot


@pytest.mark.parametrize("verdict", ["pass", "fail", "aborted"])
def test_a_unit_that_has_its_verdict_is_not_started_again_before_a_scan_or_a_clear(verdict: str) -> None:
    desk = Desk("line 1", [("a", "7"), ("b", None)], {}, OWN_NAMES, AT)
    runs = begin(desk)
    desk.ended("a", outcome(runs["a"], verdict), LATER)
    assert refused(desk.due) == "invalid"
    assert desk.waiting == {}
    desk.clear(LATER)
    assert desk.due() == {"a": "7"}


def test_while_units_are_at_work_nothing_is_scanned(desk: Desk) -> None:
    desk.scan("1001", AT)
    begin(desk)
    for text in ("1002", "OP:x", "WO:x", "SLOT:b"):
        assert refused(lambda text=text: desk.scan(text, AT)) == "running"
    assert refused(lambda: desk.put({"b": "1002"}, {}, AT)) == "running"
    assert refused(lambda: desk.clear(AT)) == "running"
    assert desk.scan("CMD:STOP", AT).value == "STOP"


def test_events_move_a_slot_through_its_states(desk: Desk) -> None:
    desk.scan("1001", AT)
    desk.scan("1002", AT)
    runs = begin(desk)
    following = {"label": "+X", "vector": [1.0, 0.0, 0.0], "once_more": False}
    desk.apply(event("stage", "a", stage="poses"))
    desk.apply(event("poses", "a", found=3, wanted=26, next=following))
    slot = desk.document(0)["slots"][0]
    assert (slot["stage"], slot["found"], slot["wanted"], slot["next"]) == ("poses", 3, 26, following)
    desk.apply(event("lost", "a", code="lost", reason="no answer"))
    assert states(desk)["a"] == ("lost", "1001")
    assert desk.running
    desk.apply(event("back", "a"))
    slot = desk.document(0)["slots"][0]
    assert (slot["state"], slot["code"], slot["reason"], slot["since"]) == ("running", None, None, LATER)
    for name, verdict, state in ("a", "pass", "passed"), ("b", "fail", "failed"):
        desk.apply(event("ended", name, outcome=outcome(runs[name], verdict)))
        assert states(desk)[name][0] == state
    assert not desk.running


def test_results_stay_until_the_next_scan(desk: Desk) -> None:
    desk.scan("1001", AT)
    runs = begin(desk)
    desk.apply(event("ended", "a", outcome=outcome(runs["a"], "aborted", serial="1009", code="stopped")))
    desk.scan("OP:B", AT)
    assert states(desk)["a"] == ("aborted", "1009")
    desk.scan("1002", AT)
    assert states(desk) == {"a": ("scanned", "1002"), "b": ("empty", None), "c": ("empty", None)}


def test_the_instruction_is_of_the_fixture_or_of_the_only_unit(desk: Desk) -> None:
    desk.scan("1001", AT)
    begin(desk)
    pose = {"label": "13", "vector": [0.0, 0.0, 1.0], "once_more": True}
    desk.apply(event("poses", "a", found=1, wanted=9, next=pose))
    told = desk.document(0)["instruction"]
    assert (told["face"], told["slots"], told["label"]) == ("+Z", ["a"], "+Z up once more")
    fixture = {"label": "A up", "face": "A", "vector": [1.0, 0.0, 0.0], "slots": ["a"]}
    desk.apply(event("instruction", **fixture))
    assert desk.document(0)["instruction"] == fixture
    desk.apply(event("tray", state="ended"))
    desk.apply(event("ended", "a", outcome=outcome("run-a")))
    assert desk.document(0)["instruction"] is None


def test_the_reason_of_a_retest_is_of_one_tray(desk: Desk) -> None:
    desk.put({"a": "1001"}, {"reason": "dropped"}, AT)
    begin(desk)
    assert desk.document(0)["work"]["reason"] == "dropped"
    desk.apply(event("tray", state="ended"))
    assert desk.document(0)["work"]["reason"] is None


def test_a_restart_keeps_scans_results_and_requests_and_ends_what_was_at_work(desk: Desk) -> None:
    desk.scan("OP:A", AT)
    desk.scan("1001", AT)
    desk.scan("1002", AT)
    runs = begin(desk)
    desk.remember_start("request", {"tray": "tray"})
    desk.apply(event("ended", "a", outcome=outcome(runs["a"])))
    again = Desk("line 1", [("b", None), ("a", None), ("d", None)], {}, OWN_NAMES, AT)
    again.restore(desk.kept(), LATER)
    assert states(again) == {"b": ("aborted", "1002"), "a": ("passed", "1001"), "d": ("empty", None)}
    assert again.document(0)["operator"] == "A"
    assert again.starts == {"request": {"tray": "tray"}}
    again.ended("b", outcome(runs["b"], "aborted", code="killed", reason="killed"), LATER)
    assert again.document(0)["slots"][0]["code"] == "killed"


def test_what_the_station_file_no_longer_has_is_not_restored(desk: Desk) -> None:
    desk.scan("1001", AT)
    kept = desk.kept()
    kept["slots"][0]["strange"] = 1
    kept["work"]["strange"] = 1
    again = Desk("line 1", [("b", None)], {}, OWN_NAMES, AT)
    again.restore(kept, LATER)
    assert states(again) == {"b": ("empty", None)}
