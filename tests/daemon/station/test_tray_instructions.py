"""One fixture turns all units: its instructions get every unit all its poses, in no more turns than one unit needs."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from triaxcal.model.directions import bias_directions, directions, elsewhere
from triaxcal.planning import magnitude_error
from triaxcal.poses.pose import Pose
from triaxcald.mounting import rotation
from triaxcald.station.faces import OWN_NAMES, described
from triaxcald.station.guidance import COVERED_DEG, Guide, NextPose, guide
from triaxcald.station.tray import WAIT_HOLDS, WAIT_S, Instruction, Tray

HOLD_S, APART_DEG, LOOK_S, TURN_S = 3.0, 10.0, 1.0, 1.5
PATIENCE_S = 30.0
PLAN = directions(14)
SLOTS = {"a": "+x+y+z", "b": "-x-y+z", "c": "+y+z+x", "d": "-z+y+x"}
NAMES = {"+x": "A", "-x": "B", "+y": "C", "-y": "D", "+z": "E", "-z": "F"}


@dataclass
class Unit:
    """A unit on the fixture: its poses as `guide` sees them, which begin and are found
    ``late_s`` after the fixture is still. ``short`` are turns in which it is disturbed."""

    mounting: str
    late_s: float = 0.0
    short: frozenset[int] = frozenset()
    poses: list[Pose] = field(default_factory=list)
    settings: dict[str, Any] = field(default_factory=dict)
    state: Guide | None = None
    there: bool = True

    def look(self, turn: int, up: np.ndarray | None, still_since_s: float, now_s: float) -> Guide:
        """``up`` is None while the fixture turns."""
        start_s = still_since_s + self.late_s
        end_s = now_s if turn not in self.short else min(now_s, start_s + 0.5 * HOLD_S)
        if up is not None and end_s > start_s:
            pose = Pose(start_s, end_s, 100, rotation(self.mounting).T @ up, np.eye(3) * 1e-10, 30.0)
            self.poses = [*(p for p in self.poses if p.start_s != start_s), pose]
        counted_s = self.state.counted_s if self.state else ()
        self.state = guide(
            self.poses, hold_s=HOLD_S, apart_deg=APART_DEG, now_s=now_s,
            nominal_scale_factor=(1, 1, 1), counted_s=counted_s, **self.settings,
        )  # fmt: skip
        return self.state


Event = Callable[["Line"], Any]


@dataclass
class Line:
    """An operator who turns the fixture as told, a little off, and holds it until told otherwise.

    ``events`` act when so many turns are made. ``instructions`` are those that were turned to.
    """

    units: dict[str, Unit]
    seed: int = 0
    events: Mapping[int, Event] = field(default_factory=dict)
    wrong_turn: Mapping[int, int] = field(default_factory=dict)
    turns_most: int = 60
    instructions: list[Instruction] = field(default_factory=list)
    begun_s: list[float] = field(default_factory=list)
    now_s: float = 0.0

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)
        mountings = {name: unit.mounting for name, unit in self.units.items()}
        self.tray = Tray(mountings, NAMES, hold_s=HOLD_S, apart_deg=APART_DEG)

    def calibrate(self, plan: Sequence[Any] = PLAN, *, repeat: bool = True) -> int:
        for name, unit in self.units.items():
            targets = self.tray.targets(name, plan)
            unit.settings = {"wanted": len(plan), "repeat": repeat, "targets": targets}
        return self.turn_until_done()

    def check(self, wanted: int) -> int:
        for name, unit in self.units.items():
            if unit.there:
                taken = np.array([p.mean for p in unit.poses if p.end_s - p.start_s >= HOLD_S])
                targets = self.tray.check_targets(name, wanted, taken)
                unit.settings = {"wanted": wanted, "plan": False, "apart_from": taken, "targets": targets}
                unit.poses, unit.state = [], None
        return self.turn_until_done()

    def turn_until_done(self) -> int:
        """The number of turns."""
        instruction = self.tray.instruction()
        made = len(self.instructions)
        while instruction is not None:
            turn = len(self.instructions)
            assert turn < made + self.turns_most, "no end"
            self.instructions.append(instruction)
            self.begun_s.append(self.now_s)
            self.now_s += TURN_S
            self._looked(turn, None, self.now_s)
            up = self._turned_to(turn, instruction)
            still_since_s = self.now_s
            if turn in self.events:
                instruction = self.events[turn](self)
            while instruction is not None and instruction.vector == self.instructions[-1].vector:
                if self.now_s - still_since_s > PATIENCE_S:  # put into the same pose anew
                    break
                self.now_s += LOOK_S
                instruction = self._looked(turn, up, still_since_s)
        return len(self.instructions) - made

    def _turned_to(self, turn: int, instruction: Instruction) -> np.ndarray:
        v = np.array(instruction.vector)
        if turn in self.wrong_turn:
            v = PLAN[self.wrong_turn[turn]][1]
        v = v + self.rng.normal(0, np.radians(2), 3)
        return np.asarray(v / np.linalg.norm(v))

    def _looked(self, turn: int, up: np.ndarray | None, still_since_s: float) -> Instruction | None:
        instruction = self.tray.instruction()
        for i in self.rng.permutation(len(self.units)):
            name = list(self.units)[i]
            unit = self.units[name]
            if unit.there:
                instruction = self.tray.poses(name, unit.look(turn, up, still_since_s, self.now_s))
        return instruction


def _units(**more: Any) -> dict[str, Unit]:
    return {name: Unit(mounting, **more.get(name, {})) for name, mounting in SLOTS.items()}


def _require_all_targets(unit: Unit) -> None:
    """Judged by the poses themselves: each target has one that is long enough, by another rule than the guide's."""
    assert unit.state is not None
    assert unit.state.complete
    held = np.array([p.mean for p in unit.poses if p.end_s - p.start_s >= HOLD_S])
    for label, v in unit.settings["targets"]:
        assert np.max(held @ v) > np.cos(np.radians(COVERED_DEG)), label


@pytest.mark.parametrize(("count", "seed"), [(9, 0), (14, 1), (14, 2), pytest.param(26, 3, marks=pytest.mark.slow)])
def test_four_units_need_as_many_turns_as_one(count: int, seed: int) -> None:
    plan = directions(count)
    one = Line({"a": Unit("+x+y+z")}, seed)
    late = {name: {"late_s": 0.4 * i} for i, name in enumerate(SLOTS)}
    four = Line(_units(**late), seed)
    assert one.calibrate(plan) == four.calibrate(plan) == count + 1
    assert [i.label for i in one.instructions] == [i.label for i in four.instructions]
    for (_, v), told in zip([*plan, plan[0]], four.instructions, strict=True):
        assert np.allclose(told.vector, v)
    assert four.instructions[-1].label == four.instructions[0].label + " once more"
    assert all(told.slots == tuple(SLOTS) for told in four.instructions)
    for unit in four.units.values():
        _require_all_targets(unit)


@pytest.mark.parametrize("wanted", [1, 6, 14])
@pytest.mark.parametrize("seed", range(3))
def test_check_poses_are_the_same_for_all_units_and_apart_from_those_of_the_fit(seed: int, wanted: int) -> None:
    line = Line(_units(), seed)
    line.calibrate()
    fitted = {name: np.array([p.mean for p in unit.poses]) for name, unit in line.units.items()}
    assert line.check(wanted) == wanted
    for name, unit in line.units.items():
        _require_all_targets(unit)
        ups = np.array([v for _, v in unit.settings["targets"]])
        assert np.max(ups @ fitted[name].T) < np.cos(np.radians(APART_DEG))


def test_a_unit_that_checks_later_checks_in_the_same_directions() -> None:
    line = Line(_units(), 3)
    line.calibrate()
    taken = {name: np.array([p.mean for p in unit.poses]) for name, unit in line.units.items()}
    of_fixture = []
    for name, mounting in SLOTS.items():
        targets = line.tray.check_targets(name, 4, taken[name])
        of_fixture.append([tuple(np.round(rotation(mounting) @ v, 9)) for _, v in targets])
    assert of_fixture == [of_fixture[0]] * 4


def test_a_unit_that_stood_near_a_check_pose_already_gets_another_and_all_its_targets() -> None:
    line = Line(_units(), 4)
    line.calibrate()
    plan = np.array([v for _, v in PLAN])
    first = line.tray.check_targets("a", 3, plan)
    near = rotation(SLOTS["b"]).T @ first[0][1]
    targets = line.tray.check_targets("b", 3, np.array([*(plan @ rotation(SLOTS["b"])), near]))
    assert len(targets) == 3
    assert all(v @ near < np.cos(np.radians(APART_DEG)) for _, v in targets)
    a, b = ({tuple(np.round(rotation(SLOTS[n]) @ v, 9)) for _, v in t} for n, t in (("a", first), ("b", targets)))
    assert len(a & b) == 2


@pytest.mark.parametrize("seed", range(5))
def test_a_unit_that_ends_in_the_middle_is_waited_for_no_more(seed: int) -> None:
    def ends(line: Line) -> Instruction | None:
        line.units["c"].there = False
        return line.tray.left("c")

    line = Line(_units(c={"short": frozenset(range(5, 50))}), seed, events={6: ends})
    assert line.calibrate() == 15
    assert [("c" in told.slots) for told in line.instructions] == [True] * 7 + [False] * 8
    for name in "abd":
        _require_all_targets(line.units[name])


@pytest.mark.parametrize("seed", range(5))
def test_a_unit_that_was_lost_gets_what_it_missed_at_the_end(seed: int) -> None:
    def lost(line: Line) -> Instruction | None:
        line.units["b"].there = False
        return line.tray.left("b")

    def back(line: Line) -> Instruction | None:
        line.units["b"].there = True
        return line.tray.back("b")

    line = Line(_units(), seed, events={4: lost, 7: back})
    turns = line.calibrate()
    missed = [told.vector for told in line.instructions[4:7]]
    again = [told for told in line.instructions[14:] if told.vector in missed]
    assert [told.slots for told in again] == [("b",)] * 3
    assert turns <= 15 + 3 + 1  # what it missed, and its own repeat
    for unit in line.units.values():
        _require_all_targets(unit)


@pytest.mark.parametrize("seed", range(5))
def test_a_pose_that_one_unit_held_too_shortly_is_repeated_for_it_alone(seed: int) -> None:
    line = Line(_units(d={"short": frozenset([3])}), seed)
    turns = line.calibrate()
    repeated = [told for told in line.instructions[4:] if told.vector == line.instructions[3].vector]
    assert [told.slots for told in repeated] == [("d",)]
    assert turns <= 15 + 2
    for unit in line.units.values():
        _require_all_targets(unit)


def test_a_unit_that_is_never_still_holds_up_the_others_for_a_bounded_time() -> None:
    line = Line(_units(d={"short": frozenset(range(1000))}), turns_most=12)
    with pytest.raises(AssertionError, match="no end"):  # that unit alone, until its own patience ends
        line.calibrate(directions(9))
    for name in "abc":
        _require_all_targets(line.units[name])
    alone = next(i for i, told in enumerate(line.instructions) if told.slots == ("d",))
    assert alone == 10
    assert line.begun_s[alone] <= 10 * (TURN_S + WAIT_HOLDS * HOLD_S + WAIT_S + 2 * LOOK_S)


@pytest.mark.parametrize("seed", range(20))
def test_every_unit_ends_with_all_its_targets_whatever_happens(seed: int) -> None:
    rng = np.random.default_rng([seed, 7])
    proper = [m for m in _mountings() if _is_rotation(m)]
    units = {
        name: Unit(
            str(rng.choice(proper)),
            late_s=rng.uniform(0, 1.5),
            short=frozenset(rng.choice(30, size=3, replace=False).tolist()),
        )
        for name in "abcd"[: rng.integers(1, 5)]
    }
    events: dict[int, Event] = {}
    for turn in rng.choice(np.arange(1, 14), size=3, replace=False):
        events[int(turn)] = _lost_or_back(str(rng.choice(list(units))))
    wrong = {int(turn): int(rng.integers(14)) for turn in rng.choice(12, size=2, replace=False)}
    line = Line(units, seed, events, wrong_turn=wrong)
    line.calibrate()
    line.events = {}
    for name, unit in units.items():  # those that are still lost come back, and miss nothing
        unit.there = True
        line.tray.back(name)
    line.turn_until_done()
    line.check(4)
    for unit in units.values():
        _require_all_targets(unit)


def _mountings() -> list[str]:
    return ["".join(m) for m in itertools.permutations(["+x", "-x", "+y", "-y", "+z", "-z"], 3)]


def _is_rotation(mounting: str) -> bool:
    try:
        return np.linalg.det(rotation(mounting)) > 0
    except ValueError:
        return False


def _lost_or_back(name: str) -> Event:
    def happens(line: Line) -> Instruction | None:
        unit = line.units[name]
        unit.there = not unit.there
        return line.tray.back(name) if unit.there else line.tray.left(name)

    return happens


# What the instruction follows, by single reports.


def _tray(**slots: str) -> Tray:
    return Tray(slots or SLOTS, OWN_NAMES, hold_s=HOLD_S, apart_deg=APART_DEG)


def _report(tray: Tray, slot: str, *, lacks: Sequence[str], at: str | None = None, held_s: float = 0.0) -> Any:
    """By slots that sit as the fixture does, so that labels are the fixture's."""
    return tray.poses(slot, Guide(14 - len(lacks), 14, held_s, 3.0, missing=tuple(lacks), at=at))


LABELS = [label for label, _ in PLAN]
ALIKE = dict.fromkeys("abcd", "+x+y+z")


def _begun(slots: str = "abcd") -> Tray:
    tray = _tray(**{s: ALIKE[s] for s in slots})
    for slot in slots:
        tray.targets(slot, PLAN)
    return tray


def _without(*labels: str) -> list[str]:
    return [label for label in LABELS if label not in labels]


def test_an_instruction_stays_until_all_have_its_pose() -> None:
    tray = _begun()
    told = [_report(tray, s, lacks=_without("+X"), at="+X", held_s=3.0) for s in "abcd"]
    assert [i.label for i in told] == ["+X up"] * 3 + [described(PLAN[1][1])]
    assert [i.slots for i in told] == [("b", "c", "d"), ("c", "d"), ("d",), ("a", "b", "c", "d")]


def test_who_takes_another_pose_is_followed_there_and_led_back() -> None:
    tray = _begun()
    other = LABELS[5]
    up = dict(PLAN)[other]
    for slot in "ab":
        told = _report(tray, slot, lacks=_without(other), at=other, held_s=3.0)
    assert told.vector == pytest.approx(up)
    assert told.slots == ("c", "d")
    for slot in "cd":
        told = _report(tray, slot, lacks=_without(other), at=other, held_s=3.0)
    assert told.label == "+X up"


def test_one_unit_of_four_with_a_wrong_mounting_is_outvoted() -> None:
    tray = _begun()
    told = _report(tray, "d", lacks=_without(LABELS[5]), at=LABELS[5], held_s=3.0)
    assert told.label == "+X up"


def test_the_pose_that_most_lack_is_next_and_of_these_the_first_of_the_plan() -> None:
    tray = _begun()
    _report(tray, "a", lacks=LABELS[2:8])
    _report(tray, "b", lacks=LABELS[4:6])
    _report(tray, "c", lacks=LABELS[4:9])
    told = _report(tray, "d", lacks=[LABELS[9]])
    up = dict(PLAN)[LABELS[4]]
    assert told.vector == pytest.approx(up)
    assert told.slots == ("a", "b", "c")


def test_what_is_lost_or_has_ended_has_no_say_at_once() -> None:
    tray = _begun("ab")
    assert _report(tray, "a", lacks=_without("+X"), at="+X", held_s=4.0).slots == ("b",)
    told = tray.left("b")
    assert told is not None
    assert (told.slots, told.face) == (("a",), dict(zip(LABELS, LABELS, strict=True)).get(told.label.split()[0]))
    assert tray.left("a") is None
    back = tray.back("b")
    assert back is not None
    assert (back.label, back.slots) == ("+X up", ("b",))


def test_a_repeat_goes_after_new_poses_that_as_many_lack() -> None:
    tray = _begun("ab")
    last = LABELS[-1]
    for slot in "ab":
        _report(tray, slot, lacks=LABELS[3:])
    _report(tray, "b", lacks=[last])
    told = tray.poses("a", Guide(14, 14, 0.0, 3.0, NextPose("+X", (1.0, 0.0, 0.0), once_more=True), repeat_due=True))
    assert told is not None
    assert told.vector == pytest.approx(dict(PLAN)[last])
    told = tray.poses("b", Guide(14, 14, 0.0, 3.0, NextPose("+X", (1.0, 0.0, 0.0), once_more=True), repeat_due=True))
    assert told is not None
    assert (told.label, told.slots) == ("+X up once more", ("a", "b"))
    assert _report(tray, "b", lacks=["+X"]).label == "+X up"  # new to one of them


def test_units_of_other_plans_share_the_poses_that_they_have_in_common() -> None:
    """One renews its biases alone, by corners of the cube."""
    tray = _tray(a="+x+y+z", b="+x+y+z")
    tray.targets("a", PLAN)
    four = bias_directions(4)
    tray.targets("b", four)
    told = _report(tray, "a", lacks=_without("+X"))
    assert told.slots == ("a", "b")
    assert any(np.allclose(told.vector, v) for _, v in four)


@pytest.mark.parametrize("seed", range(3))
def test_check_poses_are_apart_from_the_units_own_in_its_own_axes(seed: int) -> None:
    """By poses that no turn of the unit maps onto each other."""
    tray, rng = _tray(), np.random.default_rng(seed)
    fitted = rng.standard_normal((20, 3))
    fitted /= np.linalg.norm(fitted, axis=1, keepdims=True)
    for slot, mounting in SLOTS.items():
        targets = tray.check_targets(slot, 5, fitted @ rotation(mounting))
        ups = np.array([rotation(mounting) @ v for _, v in targets])
        assert np.max(ups @ fitted.T) < np.cos(np.radians(APART_DEG))
    expected = np.array([v for _, v in elsewhere(fitted, 5)])
    assert np.allclose(ups, expected)


def test_a_unit_that_has_to_make_do_with_the_fits_attitudes_lacks_no_more() -> None:
    tray = _begun("ab")
    tray.left("b")
    assert tray.poses("a", Guide(1, 3, 0.0, 3.0, missing=("+X", "+Y"), only_near=True)) is None


def test_nobody_who_lacks_a_pose_means_no_instruction() -> None:
    tray = _tray()
    assert tray.instruction() is None
    tray.targets("a", PLAN)
    assert tray.poses("a", Guide(14, 14, 3.0, 3.0)) is None


def test_on_demand_the_fixture_takes_the_best_pose_and_a_slot_that_is_done_leaves() -> None:
    """Slots need 12, 14 and 14 poses of the 26: the plan of the fixture is that of each unit."""
    plan = directions(26)
    line = Line({name: Unit(SLOTS[name]) for name in "abc"})
    for name, unit in line.units.items():
        targets = line.tray.targets(name, plan)
        wanted = 12 if name == "b" else 14
        unit.settings = {"wanted": wanted, "repeat": False, "targets": targets, "best_first": True}
    assert line.turn_until_done() == 14
    taken = [np.array(i.vector) for i in line.instructions]
    for k in range(9, 14):
        others = [v for _, v in plan if max(v @ t for t in taken[:k]) < 0.999]
        best = min(magnitude_error(np.array([*taken[:k], v])) for v in others)
        assert magnitude_error(np.array(taken[: k + 1])) == pytest.approx(best, rel=1e-5)
    assert [i.slots for i in line.instructions] == [("a", "b", "c")] * 12 + [("a", "c")] * 2
