"""The operator of a simulated fixture: events in, attitudes and switches out."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from triaxcald.mounting import ALIGNED, ORIENTATIONS
from triaxcald.simulation.operating import PATIENCE_S, FollowedPath, Habits, Operator, Switch

REACTION_S, MOVE_S = 1.0, 1.5
TURNED_S = REACTION_S + MOVE_S
X, Y, Z = np.eye(3)
NEVER_WRONG = Habits(reaction_s=REACTION_S, wrong_turns=0.0, move_s=MOVE_S)
MOUNTED = {"left": ORIENTATIONS[ALIGNED], "right": ORIENTATIONS["+y-x+z"]}


def event(kind: str, unit: str | None = None, tray: str = "t1", **keys: Any) -> bytes:
    head = {"format": "triaxcal.event/1", "seq": 1, "time": "2026-01-31T12:00:00.123+00:00", "run": None}
    return json.dumps({**head, "tray": tray, "unit": unit, "event": kind, **keys}).encode()


def instruction(up: Sequence[float] | np.ndarray, tray: str = "t1") -> bytes:
    return event("instruction", tray=tray, label="A", face=None, vector=[float(v) for v in up], slots=["left"])


def poses(unit: str, up: np.ndarray | None, found: int = 0, wanted: int = 9, tray: str = "t1") -> bytes:
    following = None if up is None else {"label": "+X", "vector": up.tolist(), "once_more": False}
    return event("poses", unit, tray, found=found, wanted=wanted, next=following)


def stage(unit: str, name: str) -> bytes:
    return event("stage", unit, stage=name)


def up(operator: Operator, slot: str, t_s: float) -> np.ndarray:
    """In the fixture's axes."""
    return operator.paths[slot].specific_force(np.array([t_s]))[0]


def angle_deg(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b, -1, 1))))


@pytest.mark.parametrize("habits", [NEVER_WRONG, Habits(reaction_s=3.0, wrong_turns=0.0, move_s=0.5)])
def test_all_units_turn_by_an_instruction_after_the_reaction_time(habits: Habits) -> None:
    operator = Operator(MOUNTED, habits)
    assert operator.read(instruction(Y), 10.0)
    begins_s = 10.0 + habits.reaction_s
    for slot in MOUNTED:
        np.testing.assert_allclose(up(operator, slot, begins_s), Z, atol=1e-12)
        assert angle_deg(up(operator, slot, begins_s + habits.move_s / 2), Z) > 10
        np.testing.assert_allclose(up(operator, slot, begins_s + habits.move_s), Y, atol=1e-12)


@pytest.mark.parametrize("name", ORIENTATIONS)
def test_a_unit_without_a_common_fixture_turns_alone_to_the_pose_in_its_own_axes(name: str) -> None:
    mounted = {"left": ORIENTATIONS[name], "right": ORIENTATIONS[ALIGNED]}
    operator = Operator(mounted, NEVER_WRONG)
    wanted = np.array([0.6, 0.0, -0.8])
    operator.read(poses("left", wanted), 0.0)
    np.testing.assert_allclose(mounted["left"] @ up(operator, "left", TURNED_S), wanted, atol=1e-12)
    np.testing.assert_allclose(up(operator, "right", TURNED_S), Z, atol=1e-12)


def test_the_poses_of_units_turn_nothing_where_their_tray_has_instructions() -> None:
    operator = Operator(MOUNTED, NEVER_WRONG)
    operator.read(poses("left", X), 0.0)  # before the first instruction, and within the reaction time
    operator.read(instruction(Y), 0.2)
    operator.read(poses("right", -X), 0.4)
    for slot in MOUNTED:
        np.testing.assert_allclose(up(operator, slot, 5.0), Y, atol=1e-12)
    operator.read(event("tray", state="ended"), 6.0)
    operator.read(poses("right", X, tray="t2"), 7.0)
    np.testing.assert_allclose(MOUNTED["right"] @ up(operator, "right", 7.0 + TURNED_S), X, atol=1e-12)
    np.testing.assert_allclose(up(operator, "left", 7.0 + TURNED_S), Y, atol=1e-12)


def test_an_instruction_that_repeats_turns_nothing() -> None:
    operator = Operator(MOUNTED, Habits(reaction_s=REACTION_S, wrong_turns=0.0, attitude_error_deg=2.0))
    operator.read(instruction(X), 0.0)
    held = up(operator, "left", 5.0)
    assert 0.01 < angle_deg(held, X) < 12
    for t_s in (5.0, 6.0, 7.0):
        operator.read(instruction(X), t_s)
        operator.due(t_s)
    np.testing.assert_array_equal(up(operator, "left", 20.0), held)


def test_an_instruction_within_the_reaction_time_takes_the_place_of_the_one_before() -> None:
    operator = Operator(MOUNTED, NEVER_WRONG)
    operator.read(instruction(X), 0.0)
    operator.read(instruction(-Z), 0.5)
    times = np.linspace(0.0, 0.5 + TURNED_S, 200)
    way = operator.paths["left"].specific_force(times)
    np.testing.assert_allclose(way[-1], -Z, atol=1e-12)
    assert operator.paths["left"].turns == 1


def test_an_instruction_during_a_turn_waits_for_its_end() -> None:
    operator = Operator(MOUNTED, NEVER_WRONG)
    operator.read(instruction(X), 0.0)
    operator.read(instruction(Y), 1.2)
    np.testing.assert_allclose(up(operator, "left", TURNED_S), X, atol=1e-12)
    np.testing.assert_allclose(up(operator, "left", TURNED_S + MOVE_S), Y, atol=1e-12)


def test_one_turn_in_fifty_is_wrong_and_the_next_instruction_corrects_it() -> None:
    rng = np.random.default_rng(5)
    wrong, turns = 0, 2000
    operator = Operator({"left": np.eye(3)}, Habits(reaction_s=REACTION_S, move_s=MOVE_S), seed=7)
    for i in range(turns):
        asked = rng.standard_normal(3)
        asked /= np.linalg.norm(asked)
        t_s = 10.0 * i
        operator.read(instruction(asked), t_s)
        if angle_deg(up(operator, "left", t_s + TURNED_S), asked) > 1.0:
            wrong += 1
            assert angle_deg(up(operator, "left", t_s + TURNED_S), asked) > 30
            operator.read(instruction(asked), t_s + 5.0)
            np.testing.assert_allclose(up(operator, "left", t_s + 5.0 + TURNED_S), asked, atol=1e-9)
    assert 20 < wrong < 62  # 40 ± 6.3, binomial; three standard deviations


def test_a_wrong_turn_that_brings_no_event_is_noticed_in_the_end() -> None:
    operator = Operator({"left": np.eye(3)}, Habits(REACTION_S, wrong_turns=1.0, move_s=MOVE_S))
    operator.read(poses("left", X), 0.0)
    assert angle_deg(up(operator, "left", TURNED_S), X) > 30
    operator.due(TURNED_S + PATIENCE_S - 0.1)
    assert operator.paths["left"].turns == 1
    operator.due(TURNED_S + PATIENCE_S)
    np.testing.assert_allclose(up(operator, "left", 2 * TURNED_S + PATIENCE_S), X, atol=1e-12)


def test_a_wrong_turn_of_a_tray_is_corrected_once_a_unit_tells_of_its_pose() -> None:
    operator = Operator(MOUNTED, Habits(REACTION_S, wrong_turns=1.0, move_s=MOVE_S))
    operator.read(instruction(X), 0.0)
    operator.read(poses("left", X, found=1), 5.0)
    np.testing.assert_allclose(up(operator, "right", 5.0 + TURNED_S), X, atol=1e-12)


def test_the_same_seed_turns_the_same_way() -> None:
    def run(seed: int) -> np.ndarray:
        operator = Operator(MOUNTED, Habits(attitude_error_deg=2.0, wrong_turns=0.3), seed=seed)
        for i, v in enumerate((X, Y, -Z, -X, -Y)):
            operator.read(instruction(v), 10.0 * i)
        return operator.paths["left"].specific_force(np.arange(0, 50, 0.1))

    np.testing.assert_array_equal(run(1), run(1))
    assert np.abs(run(1) - run(2)).max() > 0.01


@pytest.mark.parametrize("seed", range(5))
def test_where_any_pose_will_do_each_is_one_not_taken_yet(seed: int) -> None:
    operator = Operator({"left": ORIENTATIONS["-x+z+y"]}, NEVER_WRONG, seed=seed)
    operator.read(stage("left", "poses"), 0.0)
    taken = [Z]
    for found in range(12):
        t_s = 10.0 * found
        for repeat_s in (0.0, 0.4, 4.0):
            operator.read(poses("left", None, found=found, wanted=12), t_s + repeat_s)
        taken.append(up(operator, "left", t_s + 9.0))
    cosines = np.array(taken) @ np.array(taken).T - 2 * np.eye(len(taken))
    assert np.degrees(np.arccos(cosines.max())) > 20
    operator.read(poses("left", None, found=12, wanted=12), 200.0)
    assert operator.paths["left"].turns == 12


def test_any_pose_that_brings_nothing_gives_way_to_another() -> None:
    operator = Operator({"left": np.eye(3)}, NEVER_WRONG)
    operator.read(poses("left", None), 0.0)
    first = up(operator, "left", TURNED_S)
    operator.due(TURNED_S + PATIENCE_S)
    assert angle_deg(up(operator, "left", 2 * TURNED_S + PATIENCE_S), first) > 20


def test_a_tray_in_which_any_pose_will_do_for_all_turns_as_one() -> None:
    operator = Operator(MOUNTED, NEVER_WRONG)
    operator.read(instruction(X), 0.0)
    operator.read(poses("left", None, found=1), 5.0)
    operator.read(poses("right", Y, found=1), 5.1)
    turned = up(operator, "left", 5.0 + TURNED_S)
    assert angle_deg(turned, X) > 20
    operator.read(poses("left", None, found=2), 9.0)
    np.testing.assert_allclose(up(operator, "left", 9.0 + TURNED_S), turned, atol=1e-12)  # right has an instruction
    operator.read(poses("right", None, found=2), 10.0)
    both = [up(operator, slot, 10.0 + TURNED_S) for slot in MOUNTED]
    np.testing.assert_array_equal(both[0], both[1])
    assert angle_deg(both[0], turned) > 20


def test_supplies_are_switched_after_the_reaction_time_one_unit_at_a_time() -> None:
    operator = Operator(MOUNTED, NEVER_WRONG)
    operator.read(stage("right", "power_off"), 10.0)
    operator.read(stage("right", "power_off"), 10.2)
    assert operator.due(10.9) == []
    assert operator.due(11.0) == [Switch("right", on=False)]
    operator.read(stage("right", "power_on"), 20.0)
    operator.read(stage("left", "power_on"), 20.0)  # it was never off
    assert operator.due(21.0) == [Switch("right", on=True)]
    assert operator.due(1e9) == []


@pytest.mark.parametrize("end", ["ended", "tray", "another tray", "stream"])
def test_no_unit_stays_without_supply_after_its_run(end: str) -> None:
    operator = Operator(MOUNTED, NEVER_WRONG)
    operator.read(stage("right", "power_off"), 0.0)
    if end == "ended":
        operator.read(event("ended", "right", outcome={}), 0.5)
    elif end == "tray":
        operator.read(event("tray", state="ended"), 0.5)
    elif end == "another tray":
        operator.read(event("tray", tray="t2", state="started"), 0.5)
    else:
        operator.ended(0.5)
    assert operator.due(2.0) == [Switch("right", on=False), Switch("right", on=True)]


HEAD = b'{"format": "triaxcal.event/1", "tray": "t", "unit": null, "event": '
NO_EVENTS = [
    b"hello", b"{}", b"[]", b"null", b"1", b'"x"', b"\xff\xfe", b"[" * 100_000, b"1" * 10_000,
    b'{"format": "triaxcal.event/2", "tray": "t", "unit": null, "event": "instruction", "vector": [1, 0, 0]}',
    HEAD + b"7}",
    HEAD + b'"instruction"}',
    *(HEAD + b'"instruction", "vector": ' + v + b"}" for v in (
        b"7", b"[1, 0]", b"[1, 0, 0, 0]", b"[0, 0, 0]",
        b'["1", 0, 0]', b"[NaN, 0, 1]", b"[1e999, 0, 0]", b"[true, 0, 0]",
        b"[1" + 400 * b"0" + b", 0, 0]",
    )),
    HEAD + b'"poses", "found": 1, "wanted": 2, "next": 3}',
    HEAD + b'"poses", "found": null, "wanted": 2, "next": null}',
    HEAD + b'"stage", "stage": "poses"}',
    HEAD.replace(b'"t"', b"3") + b'"tray", "state": "ended"}',
]  # fmt: skip


@pytest.mark.parametrize("line", NO_EVENTS, ids=lambda line: line[-40:])
def test_a_line_that_is_no_event_is_counted_and_does_nothing(line: bytes) -> None:
    operator = Operator(MOUNTED, NEVER_WRONG)
    operator.read(instruction(X), 0.0)
    assert not operator.read(line, 5.0)
    assert operator.ignored == 1
    assert operator.due(100.0) == []
    np.testing.assert_allclose(up(operator, "left", 100.0), X, atol=1e-12)


@pytest.mark.parametrize(
    "line",
    [
        event("poses", "elsewhere", found=0, wanted=9, next=None),
        event("stage", "elsewhere", stage="power_off"),
        event("lost", "left", code="lost", reason="nothing answers"),
        event("back", "left"),
        event("to_come", "left", what=1),
        event("tray", state="started", further=[1, 2]),
    ],
)
def test_an_event_that_tells_an_operator_nothing_is_no_fault(line: bytes) -> None:
    operator = Operator(MOUNTED, NEVER_WRONG)
    assert operator.read(line, 0.0)
    assert operator.due(100.0) == []
    assert all(path.turns == 0 for path in operator.paths.values())


def test_a_slot_that_no_unit_has_is_kept_for_the_operator_of_the_program() -> None:
    operator = Operator(MOUNTED, NEVER_WRONG)
    for slot in ("left", "third", "third", "fourth"):
        operator.read(poses(slot, X), 0.0)
    assert operator.strangers == ["third", "fourth"]


def test_the_pose_before_is_the_one_that_was_left() -> None:
    path = FollowedPath(Z, move_s=2.0)
    path.turn(X, 10.0, now_s=0.0)
    path.turn(Y, 20.0, now_s=15.0)
    path.turn(-X, 30.0, now_s=25.0)
    times = np.array([5.0, 11.0, 13.0, 21.0, 23.0, 31.0, 33.0])
    np.testing.assert_array_equal(path.before(times), [Z, Z, Z, Z, X, X, Y])
    np.testing.assert_array_equal(path.before(times[3:]), path.before(times)[3:])
    np.testing.assert_array_equal(path.specific_force(times[4:]), path.specific_force(times)[4:])


def test_there_are_24_right_handed_orientations() -> None:
    assert len(ORIENTATIONS) == 24
    for name, rotation in ORIENTATIONS.items():
        np.testing.assert_array_equal(rotation @ rotation.T, np.eye(3))
        assert np.linalg.det(rotation) == pytest.approx(1.0)
        for row, sign, axis in zip(rotation, name[::2], name[1::2], strict=True):
            assert row["xyz".index(axis)] == (1.0 if sign == "+" else -1.0)
