"""All units of a tray are turned together on one fixture: which pose it takes next."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

import triaxcal as tc
from triaxcald.mounting import rotation
from triaxcald.station.faces import described, face_up, turned
from triaxcald.station.guidance import Guide

WAIT_HOLDS, WAIT_S = 3.0, 5.0
"""A pose that others have is held for a slot that lacks it until they have been still
for so many times `hold_s` and so many seconds more. A sound slot finds the pose within
one hold time and one evaluation, which takes some seconds on a busy computer; a second
hold time is for a jolt."""


@dataclass(frozen=True)
class Instruction:
    """The next pose of a fixture: ``label`` in the names of its faces, ``face`` if one
    points up, ``vector`` (3,) of up in the fixture's axes, ``slots`` that lack it."""

    label: str
    face: str | None
    vector: tuple[float, float, float]
    slots: tuple[str, ...]


@dataclass
class _Slot:
    """``into_unit`` (3,3) leads from the fixture's axes to the unit's, ``numbers`` from
    the labels of the slot's targets to directions of the fixture. ``wants`` are the
    directions that the slot lacks, ``again`` the one of these that it has taken before,
    ``ranks`` those of the directions that it would rather have than others, the best
    one 0; ``at`` is the direction of the present pose, which has lasted for
    ``held_s``."""

    into_unit: tc.Floats
    numbers: dict[str, int]
    wants: frozenset[int] = frozenset()
    again: int | None = None
    ranks: dict[int, int] = field(default_factory=dict)
    at: int | None = None
    held_s: float = 0.0
    here: bool = False


class Tray:
    """Chooses the pose that most slots lack, for all slots that are there.

    ``mountings`` are those of the slots, in the order in which slots are named,
    ``names`` those of the fixture's faces by axis. ``hold_s`` and ``apart_deg`` are of
    the plan. Values in, instruction out: no clock, no bus.

    Directions are numbered in the fixture's axes, those of the plan first. A slot that
    is lost or has ended has no say until it comes back.
    """

    def __init__(
        self, mountings: Mapping[str, str], names: Mapping[str, str], *, hold_s: float, apart_deg: float
    ) -> None:
        self._slots = {slot: _Slot(rotation(mounting).T, {}) for slot, mounting in mountings.items()}
        self._names, self._apart_deg = dict(names), apart_deg
        self._wait_s = WAIT_HOLDS * hold_s + WAIT_S
        self._directions: list[tc.planning.Direction] = []
        self._numbers: dict[tuple[float, ...], int] = {}
        self._check: list[int] = []
        self._present: int | None = None

    def targets(self, slot: str, plan: Sequence[tc.planning.Direction]) -> list[tc.planning.Direction]:
        """The directions of ``plan``, in the fixture's axes, as the slot's unit has
        them. The slot now lacks them all."""
        return self._aimed(slot, [self._number(direction) for direction in plan])

    def check_targets(self, slot: str, wanted: int, taken: tc.Floats) -> list[tc.planning.Direction]:
        """``wanted`` directions apart from those ``taken`` (n,3), in the unit's axes:
        those that other slots check in, and others only where these are too near."""
        fixture = taken @ self._slots[slot].into_unit
        near = np.cos(np.radians(self._apart_deg))
        apart = [i for i in self._check if np.max(fixture @ self._directions[i][1], initial=-1.0) < near]
        if len(apart) < wanted:
            known = np.array([*fixture, *(self._directions[i][1] for i in self._check)]).reshape(-1, 3)
            more = [self._number(d) for d in tc.planning.elsewhere(known, wanted - len(apart))]
            self._check += more
            apart += more
        return self._aimed(slot, apart[:wanted])

    def poses(self, slot: str, guide: Guide) -> Instruction | None:
        """Take note of the slot's poses so far."""
        state = self._slots[slot]
        state.here, state.held_s = True, guide.held_s
        state.at = None if guide.at is None else state.numbers[guide.at]
        due = guide.next if guide.repeat_due else None
        state.again = None if due is None else state.numbers.get(due.label)
        missing = () if guide.complete else guide.missing
        state.ranks = {state.numbers[label]: rank for rank, label in enumerate(missing)} if guide.ranked else {}
        state.wants = frozenset(
            [*(state.numbers[label] for label in missing), *([] if state.again is None else [state.again])]
        )
        return self.instruction()

    def left(self, slot: str) -> Instruction | None:
        """The slot is lost or has ended."""
        self._slots[slot].here = False
        return self.instruction()

    def back(self, slot: str) -> Instruction | None:
        """The slot is there again, with the poses that it had."""
        state = self._slots[slot]
        state.here, state.at, state.held_s = True, None, 0.0
        return self.instruction()

    def instruction(self) -> Instruction | None:
        """The present instruction; None if no slot lacks a pose."""
        present = self._present = self._chosen()
        if present is None:
            return None
        _, up = self._directions[present]
        lacking = [(name, state) for name, state in self._slots.items() if state.here and present in state.wants]
        again = " once more" if all(state.again == present for _, state in lacking) else ""
        x, y, z = map(float, up)
        return Instruction(
            described(up, self._names) + again, face_up(up, self._names), (x, y, z), tuple(n for n, _ in lacking)
        )

    def _number(self, direction: tc.planning.Direction) -> int:
        """Number of the direction, a new one if it is new."""
        key = tuple(float(c) for c in np.round(direction[1], 9) + 0.0)  # no minus zero
        if key not in self._numbers:
            self._numbers[key] = len(self._directions)
            self._directions.append(direction)
        return self._numbers[key]

    def _aimed(self, slot: str, numbers: Sequence[int]) -> list[tc.planning.Direction]:
        state = self._slots[slot]
        targets = [turned(self._directions[i], state.into_unit) for i in numbers]
        state.numbers = {label: i for (label, _), i in zip(targets, numbers, strict=True)}
        state.wants, state.again, state.at, state.held_s, state.here = frozenset(numbers), None, None, 0.0, True
        state.ranks = {}
        self._present = self._chosen()
        return targets

    def _chosen(self) -> int | None:
        here = [state for state in self._slots.values() if state.here and state.wants]
        lack = Counter(i for state in here for i in state.wants)
        if not lack:
            return None
        standing = [(s.at, s.held_s) for s in here if s.at is not None and s.at not in s.wants]
        waited_for = {i for i, held_s in standing if held_s >= self._wait_s}
        # The fixture stays in its pose for slots that still need it. It is where at
        # least half of the slots have a pose: one with a wrong mounting is outvoted.
        votes = Counter(i for i, _ in standing)
        held = {i for i in votes if i in lack and i not in waited_for and 2 * votes[i] >= len(here)}
        if held and self._present not in held:
            return min(held)
        # An instruction stays until all have the pose.
        if self._present in lack and self._present not in waited_for:
            return self._present
        # The pose that most lack; new ones before repeats, the best for those that lack
        # it, in the order of the plan.
        left = lack.keys() - waited_for or lack.keys()
        return min(
            left,
            key=lambda i: (
                -lack[i],
                all(s.again == i for s in here if i in s.wants),
                sum(s.ranks.get(i, 0) for s in here if i in s.wants),
                i,
            ),
        )
