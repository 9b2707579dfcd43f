"""What a unit is measured for, the rules of a station, and the message for each wrong argument."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.virtual_line import described, virtual_line
from triaxcald.audit import audit
from triaxcald.errors import InputError
from triaxcald.outcome import Code, Verdict
from triaxcald.run.orders import require_allowed, require_serial, with_serials, works
from triaxcald.station.config import Rules, load_station
from triaxcald.store import History
from triaxcald.work import KEYS, Work

PLAN = {"poses": 9, "hold_s": 1.0, "check_poses": 3}
MODBUS = {"host": "127.0.0.1", "port": 502}
CAN = {"interface": "virtual", "channel": "orders", "node_id": 5}


@pytest.fixture
def station(workshop: Any) -> Path:
    path: Path = workshop.station(
        {"name": "left", "serial": "4711", "profile": "triax-ref-can", "bus": CAN},
        {"name": "right", "bus": MODBUS},
        plan=PLAN,
        rules={"serial": "[0-9]{4}", "attempts": 3, "retest_reason": True, "operator": True},
        work={"order": "WO 1", "fixture": "F2"},
    )
    return path


def test_the_command_line_goes_before_the_station_file(station: Path) -> None:
    made = works(with_serials(load_station(station), [("right", "4712")]), {"operator": "A", "order": "WO 2"})
    assert made == {
        "left": Work("left", "4711", operator="A", order="WO 2", fixture="F2"),
        "right": Work("right", "4712", operator="A", order="WO 2", fixture="F2"),
    }


def test_a_serial_number_of_the_command_line_replaces_that_of_the_station_file(station: Path) -> None:
    loaded = with_serials(load_station(station), [("left", "4799")])
    assert [place.unit.serial for place in loaded.places] == ["4799", None]
    assert loaded.text == station.read_bytes()


WRONG: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "unknown slot": (("--serial", "middle=4711"), ("--serial middle=4711", "left, right")),
    "slot twice": (("--serial", "left=4711", "--serial", "left=4712"), ("left", "two serial numbers")),
    "serial twice": (("--serial", "right=4711"), ("left and right", "4711")),
    "same serial, written otherwise": (("--serial", "right=04711"), ("left and right",)),
    "no slot": (("--serial", "=4711"), ("--serial", "expected SLOT=SERIAL")),
    "no equals sign": (("--serial", "4711"), ("--serial", "expected SLOT=SERIAL", "4711")),
    "no serial": (("--serial", "left="), ("--serial", "expected 1 to 64 characters, not 0")),
    "long serial": (("--serial", f"left={'1' * 65}"), ("--serial", "expected 1 to 64 characters, not 65")),
    "serial of another form": (("--serial", "right=47A1"), ("unit right", "47A1", "rules.serial")),
    "empty operator": (("--operator", ""), ("--operator", "expected 1 to 64 characters, not 0")),
    "long operator": (("--operator", "x" * 65), ("--operator", "not 65")),
    "line break": (("--order", "WO\n7"), ("--order", "printable")),
    "escape sequence": (("--batch", "\x1b[2J"), ("--batch", "printable")),
    "right to left": (("--part-number", "a\u202eb"), ("--part-number", "printable")),
    "empty fixture": (("--fixture", ""), ("--fixture", "expected 1 to 64")),
    "empty reason": (("--reason", ""), ("--reason", "expected 1 to 64")),
    "no value": (("--order",), ("--order", "expected one argument")),
    "unknown option": (("--opperator", "A"), ("--opperator", "did you mean --operator")),
    "events and json": (("--events", "--json"), ("--events", "--json")),
    "a calibration that is not there": (("--rezero", "none.json"), ("none.json",)),
}


@pytest.mark.parametrize("case", WRONG)
def test_each_wrong_argument_is_one_line_and_nothing_is_touched(station: Path, triaxcal: Any, case: str) -> None:
    options, words = WRONG[case]
    operator = () if any(option == "--operator" for option in options) else ("--operator", "A")
    before = sorted(station.parent.rglob("*"))
    triaxcal("run", station, *operator, *options).failed(2, *words)
    assert sorted(p for p in station.parent.rglob("*") if "triaxcal.sqlite" not in p.name) == before


def test_an_operator_is_asked_for_where_the_rules_want_one(station: Path, triaxcal: Any) -> None:
    triaxcal("run", station).failed(2, "rules.operator", "--operator")


@pytest.mark.parametrize(
    ("rules", "history", "reason", "words"),
    [
        ({}, History("", 9, True), None, None),
        ({"attempts": 2}, History("", 1, False), None, None),
        ({"attempts": 2}, History("", 2, False), None, "rules.attempts"),
        ({"retest_reason": True}, History("", 1, False), None, None),
        ({"retest_reason": True}, History("", 1, True), None, "--reason"),
        ({"retest_reason": True}, History("", 1, True), "customer return", None),
        ({"attempts": 1, "retest_reason": True}, History("", 1, True), "again", "rules.attempts"),
    ],
)
def test_the_rules_decide_on_another_attempt(
    rules: Any, history: History, reason: str | None, words: str | None
) -> None:
    work = Work("left", "4711", reason=reason)
    if words is None:
        require_allowed(Rules(**rules), work, "4711", history)
    else:
        with pytest.raises(InputError, match=words.replace(".", "[.]")):
            require_allowed(Rules(**rules), work, "4711", history)


@pytest.mark.parametrize(("serial", "good"), [("4711", True), ("47111", False), ("x4711", False), ("4711\n", False)])
def test_a_serial_number_matches_the_rule_as_a_whole(serial: str, good: bool) -> None:
    if good:
        require_serial(Rules(serial="[0-9]{4}"), serial, "left")
    else:
        with pytest.raises(InputError, match=r"rules.serial"):
            require_serial(Rules(serial="[0-9]{4}"), serial, "left")


@pytest.fixture
def retests(workshop: Any) -> Iterator[Path]:
    """A station of one unit that passes, whose serial number only the device tells."""
    device = workshop.device("modbus.toml", bus=MODBUS, serial=4712)
    station = workshop.station(
        {"name": "right", "serial": "4712", "bus": MODBUS},
        plan=PLAN, limits={"rms_g": 1e-3}, rules={"retest_reason": True},
    )  # fmt: skip
    with virtual_line(described(device)):
        yield station


@pytest.mark.slow
def test_a_retest_after_a_pass_needs_a_reason(retests: Path, triaxcal: Any) -> None:
    assert triaxcal("run", retests).code == 0
    outcomes = list(retests.parent.glob("*.outcome.json"))
    recordings = list(retests.parent.glob("*.mcap"))
    triaxcal("run", retests).failed(2, "unit right", "4712", "--reason")
    assert list(retests.parent.glob("*.outcome.json")) == outcomes
    assert list(retests.parent.glob("*.mcap")) == recordings
    assert triaxcal("run", retests, "--reason", "customer return", "--batch", "B 7").code == 0
    (second,) = set(retests.parent.glob("*.mcap")) - set(recordings)
    held = json.loads(second.with_suffix(".outcome.json").read_bytes())
    assert tuple(held["work"]) == KEYS
    assert (held["work"]["reason"], held["work"]["batch"], held["work"]["attempt"]) == ("customer return", "B 7", 2)
    assert audit(second).differences == ()
    rows = triaxcal("results", retests.parent, "--json").json["runs"]
    assert [(row["attempt"], row["work_reason"], row["batch"]) for row in rows] == [
        (1, None, None), (2, "customer return", "B 7"),
    ]  # fmt: skip


def test_every_code_has_one_verdict_and_one_exit_code() -> None:
    """As the contract has them."""
    expected: dict[tuple[str, int | None], set[str]] = {
        ("pass", 0): {"within_limits"},
        ("not_judged", 0): {"no_limit", "not_checked"},
        ("fail", 1): {"fit_outside", "cross_validated_outside", "verification_outside", "verification_worse"},
        ("aborted", 3): {"no_poses", "refused", "implausible"},
        ("aborted", 4): {"wrong_unit", "serial_twice", "two_answer", "absent", "lost", "in_use", "not_settled"},
        ("aborted", 5): {"disk", "memory"},
        ("aborted", 130): {"stopped"},
        ("aborted", None): {"killed", "internal"},
    }
    found: dict[tuple[str, int | None], set[str]] = {}
    for code in Code:
        found.setdefault((code.verdict.value, code.exit_code), set()).add(code.value)
    assert found == expected
    assert {verdict for verdict, _ in found} == {v.value for v in Verdict}
