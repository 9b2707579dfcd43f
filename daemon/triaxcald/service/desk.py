"""The tray of a station between and during its runs, as a value: what was scanned,
and what the events say. No clock, no file, no bus."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from typing import Any, Final

import numpy as np

from triaxcald.provision.identity import same_serial
from triaxcald.schema.codes import Verdict
from triaxcald.schema.station_state import SlotIs
from triaxcald.service.errors import ApiError, Problem
from triaxcald.station.faces import described, face_up
from triaxcald.work import wrong

WORK: Final = ("operator", "order", "batch", "part_number", "fixture", "reason")
"""What a tray is measured for, apart from serial numbers."""
COMMANDS: Final = ("START", "STOP", "CLEAR")
STARTS_KEPT: Final = 100
"""Requests to start that are known: a repetition comes soon after the first."""
ENDED: Final = {
    Verdict.PASS: SlotIs.PASSED,
    Verdict.FAIL: SlotIs.FAILED,
    Verdict.ABORTED: SlotIs.ABORTED,
    Verdict.NOT_JUDGED: SlotIs.NOT_JUDGED,
}
AT_WORK: Final = (SlotIs.RUNNING, SlotIs.LOST)


@dataclass(frozen=True)
class Scanned:
    """What a scanned text was taken for: ``kind`` is `operator`, `order`, `slot`,
    `command` or `serial`. ``slot`` is that of a serial number."""

    kind: str
    value: str
    slot: str | None = None

    def document(self) -> dict[str, Any]:
        told = {"taken_for": self.kind, self.kind: self.value}
        return told if self.slot is None else {**told, "slot": self.slot}


@dataclass
class Slot:
    """A slot. ``expected`` is the serial number of the station file, which holds where
    none is scanned."""

    slot: str
    since: str
    expected: str | None = None
    serial: str | None = None
    run: str | None = None
    state: SlotIs = SlotIs.EMPTY
    stage: str | None = None
    found: int = 0
    wanted: int = 0
    code: str | None = None
    reason: str | None = None
    next: dict[str, Any] | None = None

    @property
    def at_work(self) -> bool:
        return self.state in AT_WORK

    def empty(self, at: str) -> None:
        self.__dict__.update(vars(Slot(self.slot, at, self.expected)))

    def document(self) -> dict[str, Any]:
        """A slot of `triaxcal.station_state/1`."""
        return {key: value for key, value in asdict(self).items() if key != "expected"}


class Desk:
    """The tray of the ``station``; ``slots`` are pairs of a slot's name and the serial
    number of the station file. ``at`` is the time of a change (UTC, ISO 8601).

    ``work`` is what the next tray is measured for: as scanned, else as ``defaults``
    of the station file. ``faces`` are the names of the fixture's faces by axis. Methods
    that take something from people raise ApiError.
    """

    def __init__(
        self,
        station: str,
        slots: Sequence[tuple[str, str | None]],
        defaults: Mapping[str, str | None],
        faces: Mapping[str, str],
        at: str,
    ) -> None:
        self.station, self.faces = station, dict(faces)
        self.slots = {name: Slot(name, at, expected) for name, expected in slots}
        self.defaults = {key: defaults.get(key) for key in WORK}
        self.work = dict(self.defaults)
        self.tray: str | None = None
        self.instruction: dict[str, Any] | None = None
        self.blocked: str | None = None
        self.blocked_slots: Mapping[str, str] = {}
        """Codes by slot."""
        self.chosen: str | None = None
        self.starts: dict[str, dict[str, Any]] = {}
        """Answers to requests to start, by their id."""
        self._starting = False

    @property
    def running(self) -> bool:
        return any(slot.at_work for slot in self.slots.values())

    @contextmanager
    def starting(self) -> Iterator[None]:
        """While a start is looked into, the tray that is `due` stays as it is."""
        self._starting = True
        try:
            yield
        finally:
            self._starting = False

    def document(self, seq: int) -> dict[str, Any]:
        """The `triaxcal.station_state/1`, after the event ``seq``."""
        return {
            "format": "triaxcal.station_state/1",
            "seq": seq,
            "station": self.station,
            "tray": self.tray,
            "operator": self.work["operator"],
            "work": dict(self.work),
            "instruction": self.instruction or self._of_the_only_unit(),
            "blocked": self.blocked,
            "blocked_slots": list(self.blocked_slots),
            "chosen": self.chosen,
            "slots": [
                {**slot.document(), "blocked": self.blocked_slots.get(slot.slot)} for slot in self.slots.values()
            ],
        }

    def _of_the_only_unit(self) -> dict[str, Any] | None:
        """Where no fixture turns all units: the next pose of the only one at work."""
        at_work = [slot for slot in self.slots.values() if slot.at_work]
        if len(at_work) != 1 or (following := at_work[0].next) is None:
            return None
        up = np.array(following["vector"])
        label = described(up, self.faces) + (" once more" if following["once_more"] else "")
        face = face_up(up, self.faces)
        return {"label": label, "face": face, "vector": following["vector"], "slots": [at_work[0].slot]}

    # From people.

    def scan(self, text: str, at: str) -> Scanned:
        """Take a scanned text, which is no command: a badge, an order, a slot, or the
        serial number of the next empty slot."""
        text = text.strip()
        if why := wrong(text):
            raise ApiError(Problem.INVALID, f"the scanned text: {why}")
        prefix, colon, rest = text.partition(":")
        kind = {"OP": "operator", "WO": "order", "SLOT": "slot", "CMD": "command"}.get(prefix.upper() if colon else "")
        if kind is not None and not rest:
            raise ApiError(Problem.INVALID, f"the scanned text '{text}' has nothing behind the colon")
        if kind == "command":
            if (command := rest.upper()) not in COMMANDS:
                each = ", ".join(f"CMD:{name}" for name in COMMANDS)
                raise ApiError(Problem.INVALID, f"unknown command '{text}'; there are {each}")
            return Scanned(kind, command)
        self._require_idle()
        if kind in ("operator", "order"):
            self.work[kind] = rest
            return Scanned(kind, rest)
        if kind == "slot":
            self._slot(rest)
            self._leave_ended(at)
            self.chosen = rest
            return Scanned(kind, rest)
        self._require_once(text)
        self._leave_ended(at)
        slot = self._next_slot()
        self._fill(slot, text, at)
        self.chosen = None
        return Scanned("serial", text, slot.slot)

    def put(self, serials: Mapping[str, str | None], work: Mapping[str, str | None], at: str) -> None:
        """Take the serial numbers of slots, and work; nothing if anything is wrong. A
        serial number that is None empties the slot."""
        self._require_idle()
        for name, serial in serials.items():
            self._slot(name)
            if serial is not None and (why := wrong(serial)):
                raise ApiError(Problem.INVALID, f"slot {name}: serial number: {why}")
        for key, value in work.items():
            if value is not None and (why := wrong(value)):
                raise ApiError(Problem.INVALID, f"{key}: {why}")
        held = {s.slot: s.serial for s in self.slots.values() if s.state is SlotIs.SCANNED} | dict(serials)
        given = [(name, serial) for name, serial in held.items() if serial is not None]
        for i, (name, serial) in enumerate(given):
            for other, theirs in given[:i]:
                if same_serial(serial, theirs):
                    raise ApiError(
                        Problem.SERIAL_TWICE, f"serial number {serial}: slots {other} and {name} cannot have one unit"
                    )
        if serials:
            self._leave_ended(at)
        for name, serial in serials.items():
            if serial is None:
                self.slots[name].empty(at)
            else:
                self._fill(self.slots[name], serial, at)
        self.work.update(work)

    def clear(self, at: str) -> None:
        """Empty all slots; operator, order and the like stay, the reason of a re-test
        does not."""
        self._require_idle()
        for slot in self.slots.values():
            slot.empty(at)
        self.work["reason"], self.chosen, self.instruction = self.defaults["reason"], None, None

    def due(self) -> dict[str, str | None]:
        """Expected serial numbers of the slots that a start would run: those that were
        scanned, or without any those that the station file names. After a
        tray, a unit is scanned again or the tray cleared."""
        if not (due := self._next_start()):
            raise ApiError(Problem.INVALID, "no unit is scanned; scan the serial number of the unit in each slot")
        return due

    @property
    def waiting(self) -> dict[str, str | None]:
        """As `due`; nothing while a tray runs."""
        return {} if self.running else self._next_start()

    def _next_start(self) -> dict[str, str | None]:
        scanned = {s.slot: s.serial for s in self.slots.values() if s.state is SlotIs.SCANNED}
        if any(s.state in ENDED.values() for s in self.slots.values()):
            return scanned  # a unit that has its verdict is not run again unasked
        named: dict[str, str | None] = {s.slot: s.expected for s in self.slots.values() if s.expected is not None}
        return scanned or named

    # From the runs.

    def started(self, tray: str, runs: Mapping[str, str], serials: Mapping[str, str | None], at: str) -> None:
        """A tray begins: ``runs`` maps its slots to ids, ``serials`` to the expected
        serial numbers."""
        self.tray, self.instruction, self.chosen = tray, None, None
        for name, slot in self.slots.items():
            slot.empty(at)
            if name in runs:
                slot.serial, slot.run, slot.state = serials.get(name), runs[name], SlotIs.RUNNING

    def remember_start(self, request: str, answer: dict[str, Any]) -> None:
        self.starts[request] = answer
        while len(self.starts) > STARTS_KEPT:
            del self.starts[next(iter(self.starts))]

    def apply(self, event: Mapping[str, Any]) -> None:
        """Take an event of the tray (`triaxcal.event/1`)."""
        kind, at = event["event"], str(event["time"])
        if kind == "instruction":
            self.instruction = {key: event[key] for key in ("label", "face", "vector", "slots")}
        elif kind == "tray" and event["state"] == "ended":
            self.instruction = None
            self.work["reason"] = self.defaults["reason"]
        elif (slot := self.slots.get(str(event["unit"]))) is not None:
            self._apply_to(slot, kind, event, at)

    def _apply_to(self, slot: Slot, kind: str, event: Mapping[str, Any], at: str) -> None:
        if kind == "stage":
            slot.stage, slot.found, slot.wanted, slot.next = event["stage"], 0, 0, None
        elif kind == "poses":
            slot.found, slot.wanted, slot.next = event["found"], event["wanted"], event["next"]
        elif kind == "lost":
            slot.state, slot.code, slot.reason, slot.since = SlotIs.LOST, event["code"], event["reason"], at
        elif kind == "back":
            slot.state, slot.code, slot.reason, slot.since = SlotIs.RUNNING, None, None, at
        elif kind == "ended":
            self.ended(slot.slot, event["outcome"], at)

    def ended(self, name: str, outcome: Mapping[str, Any], at: str) -> None:
        """The run in a slot has ended, or a killed one was settled."""
        slot = self.slots[name]
        slot.state, slot.since = ENDED[Verdict(outcome["verdict"])], at
        slot.serial, slot.run = outcome["serial"] or slot.serial, outcome["run"]
        slot.code, slot.reason = outcome["code"], outcome["reason"]
        slot.stage, slot.next = None, None

    def failed(self, reason: str, at: str) -> None:
        """The tray ended without outcomes: nothing could be begun."""
        self.instruction = None
        for slot in self.slots.values():
            if slot.at_work:
                slot.state, slot.since, slot.reason, slot.stage, slot.next = SlotIs.ABORTED, at, reason, None, None

    # Across restarts of the service.

    def kept(self) -> dict[str, Any]:
        """What a restart of the service needs."""
        return {
            "slots": [slot.document() for slot in self.slots.values()],
            "work": dict(self.work),
            "tray": self.tray,
            "chosen": self.chosen,
            "starts": dict(self.starts),
        }

    def restore(self, kept: Mapping[str, Any], at: str) -> None:
        """Take what was `kept`, as far as the slots are still there. A slot at work is
        aborted: its process is gone, and `ended` has its outcome later."""
        known = {f.name for f in fields(Slot)}
        for held in kept.get("slots", ()):
            slot = self.slots.get(held.get("slot", ""))
            if slot is None:
                continue
            slot.__dict__.update({key: value for key, value in held.items() if key in known})
            slot.state = SlotIs(slot.state)
            if slot.at_work:
                slot.state, slot.since, slot.stage, slot.next = SlotIs.ABORTED, at, None, None
                slot.reason = "the service ended during the run"
        self.work.update({key: value for key, value in kept.get("work", {}).items() if key in WORK})
        self.tray, self.starts = kept.get("tray"), dict(kept.get("starts", {}))
        self.chosen = chosen if (chosen := kept.get("chosen")) in self.slots else None

    # Checks.

    def _require_idle(self) -> None:
        if self.running or self._starting:
            raise ApiError(Problem.RUNNING, "a tray is running; wait for its end, or stop it first")

    def _slot(self, name: str) -> Slot:
        if name not in self.slots:
            raise ApiError(Problem.UNKNOWN, f"no slot '{name}'; the slots are {', '.join(self.slots)}")
        return self.slots[name]

    def _require_once(self, serial: str) -> None:
        for slot in self.slots.values():
            scanned = slot.state is SlotIs.SCANNED and slot.slot != self.chosen
            if scanned and slot.serial is not None and same_serial(slot.serial, serial):
                raise ApiError(Problem.SERIAL_TWICE, f"serial number {serial} is in slot {slot.slot} already")

    def _next_slot(self) -> Slot:
        if self.chosen is not None:
            return self.slots[self.chosen]
        for slot in self.slots.values():
            if slot.state is SlotIs.EMPTY:
                return slot
        raise ApiError(Problem.INVALID, "every slot has a unit; START the tray, or CLEAR it to scan anew")

    def _leave_ended(self, at: str) -> None:
        """The results stay until the next tray is scanned."""
        for slot in self.slots.values():
            if slot.state in ENDED.values():
                slot.empty(at)

    def _fill(self, slot: Slot, serial: str, at: str) -> None:
        slot.empty(at)
        slot.serial, slot.state = serial, SlotIs.SCANNED
