"""An operator who turns units and switches their supplies as the events of a run say.
Pure; time is an argument."""

from __future__ import annotations

import json
import math
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import triaxcal as tc

EVENT = "triaxcal.event/1"


class NoEvent(Exception):
    """A line is no event of a run."""


# What a followed unit goes through.


class FollowedPath:
    """The turning of a unit that an operator turns, in the fixture's axes: it stands in
    its ``first`` direction of up (3,), and each turn takes ``move_s``.

    Times are the unit's. A turn is added before it begins.
    """

    def __init__(self, first: tc.Floats, move_s: float) -> None:
        self.move_s = move_s
        self._starts_s: list[float] = []
        self._directions = [np.asarray(first, dtype=float)]

    def turn(self, direction: tc.Floats, t_s: float, *, now_s: float) -> float:
        """Turn to ``direction`` (3,) at ``t_s``, or once the present turn has ended; in
        place of turns that have not begun ``now_s``. The time of arrival."""
        self.stay(now_s)
        begin_s = max(t_s, self._starts_s[-1] + self.move_s) if self._starts_s else t_s
        self._starts_s.append(begin_s)
        self._directions.append(direction)
        return begin_s + self.move_s

    def stay(self, now_s: float) -> None:
        """Drop the turns that have not begun."""
        begun = bisect_right(self._starts_s, now_s)
        del self._starts_s[begun:], self._directions[begun + 1 :]

    @property
    def turns(self) -> int:
        return len(self._starts_s)

    def directions(self, first: int = 0) -> list[tc.Floats]:
        """From the one that the turn ``first`` begins in, to the last."""
        return self._directions[first:]

    def specific_force(self, t_s: tc.Floats) -> tc.Floats:
        """a (n,3) in g at times (n,)."""
        t_s = np.asarray(t_s, dtype=float)
        starts_s, directions = self._lately(t_s)
        turn = np.searchsorted(starts_s, t_s, side="right") - 1
        here, there = directions[np.maximum(turn, 0)], directions[turn + 1]
        x = np.where(turn < 0, 0.0, (t_s - np.append(starts_s, 0.0)[turn]) / self.move_s)
        return tc.synthetic.turn(here, there, x, self.move_s)

    def before(self, t_s: tc.Floats) -> tc.Floats:
        """As `triaxcal.synthetic.Path` has it."""
        t_s = np.asarray(t_s, dtype=float)
        starts_s, directions = self._lately(t_s)
        arrived = np.searchsorted(starts_s + self.move_s, t_s, side="right")
        return np.asarray(directions[np.maximum(arrived - 1, 0)])

    def _lately(self, t_s: tc.Floats) -> tuple[tc.Floats, tc.Floats]:
        """The turns (k,) from two before the times on, and the directions (k+1,3)
        around them: a path of months takes no longer to look up."""
        first = max(bisect_right(self._starts_s, np.min(t_s, initial=np.inf)) - 2, 0)
        return np.array(self._starts_s[first:]), np.array(self._directions[first:])

    def restarted(self, t_s: float) -> None:
        """It stands where it stood."""


# The events, as far as they tell an operator what to do.


@dataclass(frozen=True)
class _Event:
    kind: str
    tray: str
    unit: str | None
    held: Mapping[str, Any]


def _event(line: bytes) -> _Event:
    """Raises NoEvent."""
    try:
        held = json.loads(line)
    except (ValueError, RecursionError) as e:
        raise NoEvent from e
    if not isinstance(held, dict) or held.get("format") != EVENT:
        raise NoEvent
    kind, tray, unit = (held.get(key) for key in ("event", "tray", "unit"))
    if not isinstance(kind, str) or not isinstance(tray, str) or not isinstance(unit, str | None):
        raise NoEvent
    return _Event(kind, tray, unit, held)


def _direction(vector: object) -> tc.Floats:
    """A unit vector (3,). Raises NoEvent."""
    if not isinstance(vector, list) or len(vector) != 3:
        raise NoEvent
    if not all(isinstance(v, int | float) and not isinstance(v, bool) for v in vector):
        raise NoEvent
    try:
        v = np.array([float(x) for x in vector])
    except OverflowError as e:
        raise NoEvent from e
    length = math.hypot(*v)
    if not 0 < length < math.inf:
        raise NoEvent
    return np.asarray(v / length)


def _count(number: object) -> int:
    if not isinstance(number, int) or isinstance(number, bool):
        raise NoEvent
    return number


# The operator.

SAME_DEG = 1.0
"""An instruction within this angle is the same one: vectors are rounded in events."""
ELSEWHERE_DEG = 30.0
"""A wrong turn ends at least so far from the asked direction: on any other of the 26,
which are 35° apart and more. A pose not taken yet is so far from all taken ones, if
there is room: three times what a station asks for."""
CANDIDATES = 64
"""Directions from which a pose not taken yet is chosen."""
PATIENCE_S = 30.0
"""In a pose that brings no new event, until the operator notices that it was wrong, or
was taken before: ten times as long as a station asks to hold a pose."""


@dataclass(frozen=True)
class Habits:
    """``reaction_s`` from an event to the turn or the switch; ``wrong_turns`` is the
    share of turns to another direction than the asked one; each attitude is off by
    ``attitude_error_deg``, the standard deviation about each axis."""

    reaction_s: float = 1.0
    wrong_turns: float = 0.02
    attitude_error_deg: float = 0.0
    move_s: float = 1.5


@dataclass(frozen=True)
class Switch:
    """The supply of a slot's unit goes off or comes ``on``."""

    slot: str
    on: bool


@dataclass
class _Task:
    """What a unit, or the fixture with all its units, was last told. ``asked`` (3,) is
    None where nothing is asked, or any pose will do; ``counted`` are the poses found as
    any pose was asked for. ``again_s`` is the time to turn again, unless an event
    comes first."""

    asked: tc.Floats | None = None
    wrong: bool = False
    counted: int | None = None
    arrives_s: float = -math.inf
    again_s: float = math.inf

    def same(self, direction: tc.Floats) -> bool:
        return self.asked is not None and _angle_deg(self.asked, direction) < SAME_DEG


@dataclass
class Operator:
    """Turns the units of a fixture, and switches them. ``mounted`` are the rotations
    (3,3) from the fixture's axes to the unit's, by slot.

    All units turn as one by an ``instruction``, and a unit alone by its ``poses``
    where its tray has no instructions. An instruction that repeats turns nothing, but
    for a wrong turn, which it corrects.
    """

    mounted: Mapping[str, tc.Floats]
    habits: Habits = Habits()
    seed: int | Sequence[int] = 0
    first: tc.Floats = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    ignored: int = field(default=0, init=False)
    """Lines that were no events."""
    strangers: list[str] = field(default_factory=list, init=False)
    """Slots that events named and that no unit here has."""

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng(self.seed)
        self.paths = {slot: FollowedPath(self.first, self.habits.move_s) for slot in self.mounted}
        self._tasks = {slot: _Task() for slot in self.mounted}
        self._fixture = _Task()
        self._together: str | None = None
        """The tray that has instructions."""
        self._lacking: dict[str, tuple[bool, int]] = {}
        """Of that tray, the slots that lack poses: whether a certain one, and the poses
        found."""
        self._since = dict.fromkeys(self.mounted, 0)
        """Turns of a unit before the run."""
        self._switches: list[tuple[float, Switch]] = []
        self._off: set[str] = set()

    def read(self, line: bytes, t_s: float) -> bool:
        """Take a line that comes at ``t_s``; whether it is an event."""
        try:
            self._take(_event(line), t_s)
        except NoEvent:
            self.ignored += 1
            return False
        return True

    def due(self, t_s: float) -> list[Switch]:
        """The switches up to ``t_s``, in their order. Turns again where a turn was
        wrong, or has brought nothing."""
        for slots, task in [(list(self.mounted), self._fixture), *(([s], t) for s, t in self._tasks.items())]:
            if t_s >= task.again_s:
                self._again(slots, task, t_s)
        due = [s for at_s, s in self._switches if at_s <= t_s]
        self._switches = self._switches[len(due) :]
        return due

    def ended(self, t_s: float) -> None:
        """No more events come: all stays as it is, with the supplies on."""
        self._rest(t_s)

    def _take(self, event: _Event, t_s: float) -> None:
        slot = event.unit if event.unit in self.mounted else None
        if event.unit is not None and event.unit not in (slot, *self.strangers):
            self.strangers.append(event.unit)
        match event.kind:
            case "instruction":
                self._instructed(event, _direction(event.held.get("vector")), t_s)
            case "poses":
                self._posed(event, slot, t_s)
            case "stage":
                self._staged(event, slot, t_s)
            case "ended" if slot is not None:
                self._tasks[slot] = _Task()
                self._lacking.pop(slot, None)
                self._supply(slot, True, t_s)
            case "tray":  # a new one too: the run before it may have been killed
                self._rest(t_s)

    def _instructed(self, event: _Event, direction: tc.Floats, t_s: float) -> None:
        if self._together != event.tray:
            self._together, self._lacking = event.tray, {}
            for slot in self._tasks:
                self._tasks[slot] = _Task()
        self._ask(list(self.mounted), self._fixture, direction, t_s)

    def _posed(self, event: _Event, slot: str | None, t_s: float) -> None:
        found, wanted = (_count(event.held.get(key)) for key in ("found", "wanted"))
        following = event.held.get("next")
        if following is None:
            asked = None
        elif isinstance(following, dict):
            asked = _direction(following.get("vector"))
        else:
            raise NoEvent
        if slot is None:
            return
        lacks = asked is not None or found < wanted
        if event.tray == self._together:
            self._posed_together(slot, (asked is not None, found) if lacks else None, t_s)
        elif asked is not None:
            self._ask([slot], self._tasks[slot], self.mounted[slot].T @ asked, t_s)
        elif lacks:
            self._ask_for_any([slot], self._tasks[slot], found, t_s)

    def _posed_together(self, slot: str, lacking: tuple[bool, int] | None, t_s: float) -> None:
        """News of a unit whose tray has instructions. There is none where any pose will
        do for all units that lack some."""
        self._lacking.pop(slot, None)
        if lacking is not None:
            self._lacking[slot] = lacking
        task, slots = self._fixture, list(self.mounted)
        if task.wrong and t_s >= task.arrives_s:
            self._again(slots, task, t_s)
        elif self._lacking and not any(certain for certain, _ in self._lacking.values()):
            self._ask_for_any(slots, task, sum(found for _, found in self._lacking.values()), t_s)

    def _staged(self, event: _Event, slot: str | None, t_s: float) -> None:
        stage = event.held.get("stage")
        if not isinstance(stage, str) or event.unit is None:
            raise NoEvent
        if slot is None:
            return
        if stage in ("power_off", "power_on"):
            self._supply(slot, stage == "power_on", t_s)
            return
        self._lacking.pop(slot, None)
        self._tasks[slot].counted = None
        if stage == "poses":
            self._since[slot] = self.paths[slot].turns

    # What is done.

    def _ask(self, slots: Sequence[str], task: _Task, direction: tc.Floats, t_s: float) -> None:
        if task.same(direction):
            if task.wrong and t_s >= task.arrives_s:
                self._again(slots, task, t_s)
            return
        corrects = task.wrong
        task.asked, task.counted = direction, None
        task.wrong = not corrects and bool(self._rng.random() < self.habits.wrong_turns)
        self._turn(slots, task, self._other_than(direction, slots) if task.wrong else direction, t_s)

    def _ask_for_any(self, slots: Sequence[str], task: _Task, found: int, t_s: float) -> None:
        if task.counted != found:
            task.asked, task.wrong, task.counted = None, False, found
            self._turn(slots, task, self._not_taken(slots[0]), t_s)

    def _again(self, slots: Sequence[str], task: _Task, t_s: float) -> None:
        """Correct a wrong turn; choose another pose where the last one has brought
        nothing."""
        task.wrong = False
        self._turn(slots, task, self._not_taken(slots[0]) if task.asked is None else task.asked, t_s)

    def _turn(self, slots: Sequence[str], task: _Task, direction: tc.Floats, t_s: float) -> None:
        """All ``slots`` by the same attitude, with its error."""
        off = direction + self._rng.standard_normal(3) * np.radians(self.habits.attitude_error_deg)
        off /= np.linalg.norm(off)
        begin_s = t_s + self.habits.reaction_s
        task.arrives_s = max(self.paths[slot].turn(off, begin_s, now_s=t_s) for slot in slots)
        unsure = task.wrong or task.asked is None
        task.again_s = task.arrives_s + PATIENCE_S if unsure else math.inf

    def _supply(self, slot: str, on: bool, t_s: float) -> None:
        if on == (slot not in self._off):
            return
        (self._off.discard if on else self._off.add)(slot)
        self._switches.append((t_s + self.habits.reaction_s, Switch(slot, on)))

    def _rest(self, t_s: float) -> None:
        self._fixture, self._together, self._lacking = _Task(), None, {}
        for slot in self._tasks:
            self._tasks[slot] = _Task()
            self._supply(slot, True, t_s)

    # Directions.

    def _other_than(self, direction: tc.Floats, slots: Sequence[str]) -> tc.Floats:
        """A direction of the plan that is neither the asked one nor the present one."""
        here = self.paths[slots[0]].directions()[-1]
        plan = [v for _, v in tc.planning.cube_directions()]
        others = [v for v in plan if min(_angle_deg(v, direction), _angle_deg(v, here)) > ELSEWHERE_DEG]
        return np.asarray(others[self._rng.integers(len(others))])

    def _not_taken(self, slot: str) -> tc.Floats:
        """The first of some random directions that is apart from all poses of the run;
        else the one farthest from them."""
        path = self.paths[slot]
        taken = np.array(path.directions(min(self._since[slot], path.turns)))
        drawn = self._rng.standard_normal((CANDIDATES, 3))
        drawn /= np.linalg.norm(drawn, axis=1, keepdims=True)
        nearest = np.max(drawn @ taken.T, axis=1)
        apart = np.flatnonzero(nearest < np.cos(np.radians(ELSEWHERE_DEG)))
        return np.asarray(drawn[apart[0] if len(apart) else np.argmin(nearest)])


def _angle_deg(a: tc.Floats, b: tc.Floats) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b, -1.0, 1.0))))
