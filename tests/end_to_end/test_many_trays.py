"""Trays from one seed in one folder, and processes that are killed: each attempt leaves one true outcome.

``TRAYS`` is the number of trays; fewer than 27 do not hold each fault. ``TRAYS_SEED`` draws other trays and other
moments, ``TRAYS_KILLS`` more of the latter.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import json
import os
import resource
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import triaxcal_drivers as td
from tests import virtual_line as line
from tests.end_to_end.conftest import PROGRAM, until
from triaxcald.provision.state import DeviceState
from triaxcald.recording import disk
from triaxcald.recording.reader import Recording
from triaxcald.run import provision_by_hand, unit_run
from triaxcald.run.orders import works
from triaxcald.run.unit_run import TrayRun, UnitHandle
from triaxcald.schema.codes import Code, Stage
from triaxcald.simulation.unit import (
    CRC,
    TABLE,
    Faults,
    Physics,
    ReferenceUnit,
    Stored,
    checksum,
    factory_calibration,
)
from triaxcald.station.config import Place, load_station
from triaxcald.station.lock import locked

pytestmark = pytest.mark.slow

SEED = int(os.environ.get("TRAYS_SEED", "20260131"))
TRAYS = int(os.environ.get("TRAYS", "30"))
KILLS = int(os.environ.get("TRAYS_KILLS", "6"))
HOUR_NS = 3_600_000_000_000

CONTRACT: Mapping[str, tuple[str, int | None]] = {
    "within_limits": ("pass", 0),
    **dict.fromkeys(("no_limit", "not_checked"), ("not_judged", 0)),
    **dict.fromkeys(
        ("fit_outside", "cross_validated_outside", "verification_outside", "verification_worse"), ("fail", 1)
    ),
    **dict.fromkeys(("no_poses", "refused", "implausible"), ("aborted", 3)),
    **dict.fromkeys(
        ("wrong_unit", "serial_twice", "two_answer", "absent", "lost", "in_use", "not_settled"), ("aborted", 4)
    ),
    **dict.fromkeys(("disk", "memory"), ("aborted", 5)),
    "stopped": ("aborted", 130),
    **dict.fromkeys(("killed", "internal"), ("aborted", None)),
}
"""Verdict and exit code of each code, as stations script against them."""

Run = Callable[..., Any]
Document = dict[str, Any]


# What is true of a folder, whatever happened in it.


@dataclass(frozen=True)
class Ended:
    """An outcome in a folder."""

    name: str
    data: bytes
    document: Document


def outcomes_in(folder: Path) -> list[Ended]:
    """In the order of their ends."""
    found = [Ended(p.name, data := p.read_bytes(), json.loads(data)) for p in folder.glob("*.outcome.json")]
    return sorted(found, key=lambda o: (datetime.fromisoformat(o.document["ended"]), o.name))


def check_folder(folder: Path, triaxcal: Run) -> list[Ended]:
    outcomes = outcomes_in(folder)
    documents = [o.document for o in outcomes]
    assert len({d["run"] for d in documents}) == len(documents)
    for d in documents:
        assert (d["verdict"], d["exit_code"]) == CONTRACT[d["code"]], (d["code"], d["reason"])
    _results_are_of(outcomes, triaxcal("results", folder, "--json").json["runs"])
    _history_is_told(outcomes)
    audited = triaxcal("audit", folder)
    assert audited.code == 0, audited.out + audited.err
    return outcomes


def _results_are_of(outcomes: Sequence[Ended], rows: Sequence[Document]) -> None:
    of_work = ("operator", "order", "batch", "part_number", "fixture", "slot", "attempt")
    expected = {
        o.name: {
            **{key: o.document[key] for key in ("run", "verdict", "code", "serial", "exit_code", "device_state")},
            **{key: o.document["work"][key] for key in of_work},
            "work_serial": o.document["work"]["serial"],
            "work_reason": o.document["work"]["reason"],
            "settles": o.document["settles"],
            "outcome_sha256": hashlib.sha256(o.data).hexdigest(),
        }
        for o in outcomes
    }
    assert len(rows) == len(outcomes)
    assert {row["outcome"]: {key: row[key] for key in expected[row["outcome"]]} for row in rows} == expected


def _history_is_told(outcomes: Sequence[Ended]) -> None:
    """Each outcome names the one before it of its unit, and the attempts at a unit count up."""
    latest: dict[str, str] = {}
    attempts: Counter[str] = Counter()
    for o in outcomes:
        serial, work = o.document["serial"], o.document["work"]
        assert o.document["supersedes"] == latest.get(serial), o.name
        if serial is not None:
            latest[serial] = hashlib.sha256(o.data).hexdigest()
        if work["attempt"] is not None:
            tried = work["serial"] or serial
            attempts[tried] += 1
            assert work["attempt"] == attempts[tried], o.name


def lines_of(text: str) -> list[Document]:
    """The events of a run; what a killed process left of a line is none."""
    whole, _, _ = text.rpartition("\n")
    return [json.loads(line) for line in whole.splitlines()]


def ended_in(events: Sequence[Document]) -> list[Document]:
    return [event["outcome"] for event in events if event["event"] == "ended"]


# Trays of units on a virtual clock, with their faults.

POSES = 9
FIXTURE = {"poses": POSES, "hold_s": 1.4, "move_s": 0.6}
PLAN = {"poses": POSES, "hold_s": 0.6, "check_poses": 2, "comes_back_s": 0.3, "patience_s": 45.0}
LIMITS: Mapping[str, Mapping[str, float]] = {
    "within_limits": {"rms_g": 5e-4, "verification_rms_g": 5e-4},
    "no_limit": {},
    "fit_outside": {"rms_g": 1e-9},
    "cross_validated_outside": {"cross_validated_rms_g": 1e-9},
    "verification_outside": {"verification_rms_g": 1e-9},
}
"""The stations, by the code of a sound unit."""
WRITING = ("within_limits", "no_limit", "verification_outside")
FAULTS: Mapping[str, tuple[str, Sequence[str]]] = {
    "another unit": ("wrong_unit", tuple(LIMITS)),
    "one serial twice": ("serial_twice", tuple(LIMITS)),
    "nobody": ("absent", tuple(LIMITS)),
    "falls silent": ("lost", tuple(LIMITS)),
    "in use": ("in_use", tuple(LIMITS)),
    "never still": ("no_poses", tuple(LIMITS)),
    "dead axis": ("refused", tuple(LIMITS)),
    "nonsense": ("implausible", WRITING),
    "forgets a store": ("not_settled", WRITING),
    "refuses a register": ("not_settled", WRITING),
    "dies on a write": ("not_settled", WRITING),
    "knocked": ("verification_worse", ("no_limit",)),
    "stopped": ("stopped", tuple(LIMITS)),
    "no memory": ("memory", tuple(LIMITS)),
    "defect": ("internal", tuple(LIMITS)),
    "full disk": ("disk", tuple(LIMITS)),
}
"""Their codes, and the stations that come to them."""
KNOCK_V = 0.25
SERIALS = range(1001, 1013)


class Spoiled:
    """A sensor whose output (n, 3) [V] is changed by ``spoil``, which gets the number of restarts too."""

    def __init__(self, sound: Physics, spoil: Callable[[NDArray[np.float64], int], NDArray[np.float64]]) -> None:
        self._sound, self._spoil, self._restarts = sound, spoil, 0

    def sample(self, unit_time_s: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        volts, temperature_c = self._sound.sample(unit_time_s)
        return self._spoil(volts, self._restarts), temperature_c

    def restarted(self, unit_time_s: float) -> None:
        self._restarts += 1
        self._sound.restarted(unit_time_s)


def nonsense() -> bytes:
    """A stored calibration with a right checksum, whose bias is none."""
    copy = factory_calibration()
    copy["bias_x"] = TABLE["bias_x"].encode(2.0)
    return Stored({**copy, CRC: checksum(copy)}).image()


@dataclass
class Slot:
    """``expects`` is the serial number in the station file, ``holds`` that of the unit."""

    fault: str
    code: str
    expects: str | None
    holds: int


@dataclass
class Watcher:
    """Stops the slots of ``stopping`` at their first pose."""

    stopping: frozenset[str]
    units: Mapping[str, UnitHandle] = field(default_factory=dict)

    def stage(self, unit: str, stage: Stage) -> None: ...
    def note(self, unit: str, text: str) -> None: ...
    def back(self, unit: str) -> None: ...
    def lost(self, unit: str, code: object, trouble: str) -> None: ...

    def poses(self, unit: str, phase: Any, guide: Any) -> None:
        if unit in self.stopping:
            self.units[unit].stop(f"no longer wanted in {unit}")


class Factory:
    """The trays of one folder. ``ended`` are the outcomes that the runs have returned."""

    def __init__(self, workshop: Any, triaxcal: Run, patch: pytest.MonkeyPatch, rng: np.random.Generator) -> None:
        self.workshop, self.triaxcal, self._patch, self._rng = workshop, triaxcal, patch, rng
        self.folder: Path = workshop.folder / "line"
        self.ended: list[Document] = []
        self.open_serials: list[int] = []
        """Units that died while they were written, and whose journal is there."""
        self._stock: dict[int, bytes] = {}
        """EEPROMs by serial number."""
        self._impatient = {kind: workshop.impatient_profile(f"triax-ref-{kind}") for kind in ("can", "modbus")}
        self._units: dict[str, ReferenceUnit] = {}
        self._devices: dict[str, line.VirtualDevice] = {}
        self._failing: dict[str, Exception] = {}
        self._without_room: set[str] = set()
        self._begins_ns = time.time_ns() - 2 * TRAYS * HOUR_NS

    # What is in the trays.

    def drawn(self) -> Iterator[tuple[str, list[Slot]]]:
        """Stations, with what is in their slots: each sound ending and each fault at least once."""
        deck = [(code, "sound") for code in LIMITS for _ in range(2)]
        deck += [(str(self._rng.choice(stations)), fault) for fault, (_, stations) in FAULTS.items()]
        deck += [("within_limits", "dies on a write")]
        self._rng.shuffle(deck)
        for number in self._rng.permutation(TRAYS):
            station, *first = deck[number] if number < len(deck) else (str(self._rng.choice(list(LIMITS))),)
            possible = [f for f, (_, stations) in FAULTS.items() if station in stations and f not in _PAIRED]
            others = self._rng.choice([*possible, "sound", "sound"], self._rng.integers(not first, 3))
            yield station, self._slots(station, [*first, *map(str, others)])

    def _slots(self, station: str, faults: Sequence[str]) -> list[Slot]:
        serials = [int(s) for s in self._rng.choice(SERIALS, 2 * len(faults), replace=False)]
        slots: list[Slot] = []
        for fault in faults:
            code = station if fault == "sound" else FAULTS[fault][0]
            serial = serials.pop()
            if fault == "sound" and station == "within_limits" and len(self.open_serials) > 1:
                serial = self.open_serials.pop(0)  # it is written to its end now
            match fault:
                case "another unit":
                    slots.append(Slot(fault, code, str(serial), serials.pop()))
                case "one serial twice":
                    slots += [Slot("sound", station, None, serial), Slot(fault, code, None, serial)]
                case "dies on a write":
                    serial = 9001 + len(self._stock)
                    slots.append(Slot(fault, code, str(serial), serial))
                    self.open_serials.append(serial)
                case _:
                    slots.append(Slot(fault, code, str(serial), serial))
        return slots

    def _unit(self, slot: Slot, station: str) -> ReferenceUnit:
        fixture = {
            "never still": {**FIXTURE, "hold_s": 0.3},
            "dead axis": {**FIXTURE, "poses": 2 * POSES},  # the other axes cannot tell some poses apart
        }.get(slot.fault, FIXTURE)
        device = self.workshop.device(serial=slot.holds, seed=int(self._rng.integers(2**31)), fixture=fixture)
        sound = line.described(device)
        physics = sound.physics
        if slot.fault == "dead axis":
            physics = Spoiled(physics, lambda volts, _: volts * [1.0, 1.0, 0.0])
        elif slot.fault == "knocked":
            physics = Spoiled(physics, lambda volts, restarts: volts + KNOCK_V * (restarts > 0))
        faults = {
            "nobody": Faults(die_at_s=0.0),
            "falls silent": Faults(die_at_s=float(self._rng.uniform(4.0, 14.0))),
            "forgets a store": Faults(forget_store=True),
            "refuses a register": Faults(refuse_registers=frozenset({"misalignment_y"})),
            "dies on a write": Faults(die_on_write="bias_y"),
        }.get(slot.fault)
        stored = nonsense() if slot.fault == "nonsense" else self._stock.get(slot.holds)
        if station == "no_limit" and slot.holds not in self.open_serials:
            stored = nonsense() if slot.fault == "nonsense" else None  # a calibration like the old one may be worse
        return ReferenceUnit(physics, serial_number=slot.holds, stored=stored, faults=faults)

    # The line.

    @contextlib.contextmanager
    def on_virtual_clock(self) -> Iterator[None]:
        """The device of a slot is that which lies in it; the program fails where a slot says so."""
        certify, require_room = unit_run.certify, disk.require_room

        def failing(*arguments: Any, unit_name: str, **more: Any) -> Any:
            if unit_name in self._failing:
                raise self._failing[unit_name]
            return certify(*arguments, unit_name=unit_name, **more)

        def full(path: Path) -> None:
            if path.name.partition("-")[0] in self._without_room:
                raise disk.no_room(path, 0)
            require_room(path)

        with line.virtual_line(), self._patch.context() as patch:
            patch.setattr(Place, "device", lambda place: self._device(place))
            patch.setattr(provision_by_hand, "RegisterLink", line._linked)
            patch.setattr(unit_run, "certify", failing)
            patch.setattr(disk, "require_room", full)
            yield

    def put_in(self, slots: Mapping[str, Slot], limits: str) -> Path:
        """The units lie in their slots, an hour after those before them; the station file."""
        self._begins_ns += HOUR_NS
        self._patch.setattr(line, "START_NS", self._begins_ns)
        entries = []
        for i, (name, slot) in enumerate(slots.items()):
            kind = ("modbus", "can")[i % 2]
            bus = (
                {"interface": "virtual", "channel": "trays", "node_id": 1 + i}
                if kind == "can"
                else {"host": "127.0.0.1", "port": 502 + i}
            )
            profile = self._impatient[kind] if slot.fault == "falls silent" else f"triax-ref-{kind}"
            expected = {} if slot.expects is None else {"serial": slot.expects}
            entries.append({"name": name, "profile": profile, "bus": bus, **expected})
        station: Path = self.workshop.station(*entries, plan=PLAN, folder="line", limits=LIMITS[limits])
        self._units = {name: self._unit(slot, limits) for name, slot in slots.items()}
        self._devices = {}
        return station

    def _device(self, place: Place) -> line.VirtualDevice:
        name = place.unit.name
        if name not in self._devices:
            kind = {"can": line.OnCan, "modbus": line.OnModbus}[place.bundle.profile.driver]
            self._devices[name] = kind(self._units[name], place.bundle, place.bus)
        return self._devices[name]

    def run(self, number: int, limits: str, drawn: Sequence[Slot]) -> None:
        slots = {f"s{i}": slot for i, slot in enumerate(drawn, 1)}
        station = load_station(self.put_in(slots, limits))
        fails = {"no memory": MemoryError(), "defect": ValueError("a defect")}
        self._failing = {name: fails[slot.fault] for name, slot in slots.items() if slot.fault in fails}
        self._without_room = {name for name, slot in slots.items() if slot.fault == "full disk"}
        watcher = Watcher(frozenset(name for name, slot in slots.items() if slot.fault == "stopped"))
        given = {"operator": f"operator {number % 3}", "order": f"WO {number}", "reason": "again"}

        async def all_units() -> None:
            async with contextlib.AsyncExitStack() as stack:
                for place in station.places:
                    if slots[place.unit.name].fault == "in use":
                        await stack.enter_async_context(locked(td.claim_of(place.bus)))
                tray = TrayRun(
                    station, watcher, work=works(station, given), ended=lambda o: self.ended.append(dict(o.document))
                )
                watcher.units = tray.units
                await tray

        asyncio.run(all_units())
        found = {d["unit"]: d["code"] for d in self.ended[-len(slots) :]}
        wanted = {name: slot.code for name, slot in slots.items()}
        if any(slot.fault == "one serial twice" for slot in slots.values()):  # whoever answers first keeps the number
            assert sorted(found.values()) == sorted(wanted.values()), (number, limits, self.ended[-len(slots) :])
        else:
            assert found == wanted, (number, limits, self.ended[-len(slots) :])
        for name, slot in slots.items():
            if slot.fault not in ("nonsense", "another unit"):
                self._stock[slot.holds] = self._units[name].eeprom

    # By hand.

    def provision(self, *arguments: Any, serial: int) -> None:
        """On a unit of the stock, of which an outcome with `not_checked` comes."""
        station = self.put_in({"s1": Slot("sound", "not_checked", str(serial), serial)}, "within_limits")
        done = self.triaxcal("provision", *arguments, station, "--json")
        assert done.code == 0, done.err
        outcome = done.json["outcome"]
        assert (outcome["code"], outcome["device_state"]) == ("not_checked", "new_verified")
        self.ended.append(outcome)


_PAIRED = ("one serial twice", "dies on a write")
"""Not in a slot beside others that are drawn."""


# Trays of processes: their clock is the host's.

LIVE = {"speed": 30.0, "fixture": {"poses": 26, "hold_s": 1.4, "move_s": 0.6}}
ENDLESS = {"poses": 40, "hold_s": 0.6, "patience_s": 1e6}
"""More poses than the fixture takes: such a run goes on for ever."""
FILE_MOST = 60_000
"""Bytes of a file on the disk that fails, which a recording soon has."""


def live_station(workshop: Any, *served: Any) -> Path:
    units = [{"name": f"s{i}", "bus": one.bus, "serial": str(one.unit.serial_number)} for i, one in enumerate(served)]
    station: Path = workshop.station(*units, plan=ENDLESS, folder="line")
    return station


def has_poses(process: Any, slots: int) -> bool:
    found = {e["unit"] for e in lines_of(process.out) if e["event"] == "poses" and e["found"] >= 2}
    return len(found) == slots or not process.running


def two_answer(factory: Factory) -> None:
    bus = {"interface": "virtual", "channel": "two-answer", "node_id": 5}
    with contextlib.ExitStack() as stack:
        for serial in (3001, 3002):
            device = factory.workshop.device(f"{serial}.toml", profile="triax-ref-can", bus=bus, serial=serial)
            stack.enter_context(factory.workshop.serve(device))
        station = factory.workshop.station({"profile": "triax-ref-can", "bus": bus}, plan=PLAN, folder="line")
        done = factory.triaxcal("run", station, "--events")
    (outcome,) = ended_in(lines_of(done.out))
    assert (done.code, outcome["code"]) == (4, "two_answer")
    factory.ended.append(outcome)


def signalled(factory: Factory, start: Callable[..., Any], number: signal.Signals) -> list[Document]:
    """The events of a tray of two whose process got a signal when both had poses."""
    with contextlib.ExitStack() as stack:
        served = [
            stack.enter_context(factory.workshop.serve(factory.workshop.device(f"{s}.toml", serial=s, seed=s, **LIVE)))
            for s in (1001, 1002)
        ]
        process = start("run", live_station(factory.workshop, *served), "--events")
        until(lambda: has_poses(process, 2))
        process.send(number)
        assert process.wait() == (130 if number is signal.SIGTERM else -number), process.err
    return lines_of(process.out)


@pytest.mark.timeout(1800)
def test_every_attempt_of_many_trays_leaves_one_outcome_with_its_code(
    workshop: Any, triaxcal: Run, start: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    print(f"TRAYS={TRAYS} TRAYS_SEED={SEED}")
    monkeypatch.setattr("triaxcald.provision.access.RECONNECT_S", 0.5)
    factory = Factory(workshop, triaxcal, monkeypatch, np.random.default_rng(SEED))
    with factory.on_virtual_clock():
        for number, (limits, slots) in enumerate(factory.drawn()):
            factory.run(number, limits, slots)
        passed = next(d for d in factory.ended if d["code"] == "within_limits")
        fitted = triaxcal("fit", factory.folder / passed["recording"], "-o", workshop.folder / "cal.json")
        assert fitted.code == 0, fitted.err
        factory.provision(workshop.folder / "cal.json", serial=int(passed["serial"]))
        for serial in factory.open_serials:
            factory.provision("--resume", serial=serial)
            interrupted = next(d for d in factory.ended if d["serial"] == str(serial))
            assert factory.ended[-1]["settles"] == interrupted["run"]
    two_answer(factory)
    killed = signalled(factory, start, signal.SIGKILL)
    assert ended_in(killed) == []
    stopped = ended_in(signalled(factory, start, signal.SIGTERM))
    assert [d["code"] for d in stopped] == ["stopped", "stopped"]
    factory.ended += stopped

    outcomes = [o.document for o in check_folder(factory.folder, triaxcal)]
    assert {d["code"] for d in outcomes} == set(CONTRACT) == set(map(str, Code))
    runs_killed = {d["run"] for d in outcomes if d["code"] == "killed"}
    assert runs_killed == {e["run"] for e in killed if e["run"] is not None}
    assert {d["run"] for d in outcomes} == runs_killed | {d["run"] for d in factory.ended}
    by_run = {d["run"]: d for d in outcomes}
    assert all(by_run[d["run"]] == d for d in factory.ended)
    print(Counter(d["code"] for d in outcomes))


def test_a_disk_that_fails_in_a_recording_leaves_a_folder_that_can_be_audited(
    workshop: Any, triaxcal: Run, start: Callable[..., Any]
) -> None:
    folder: Path = workshop.folder / "line"
    with workshop.serve(workshop.device(serial=1003, **LIVE)) as served:
        station = live_station(workshop, served)
        done = subprocess.run(
            [PROGRAM, "run", station, "--events"], capture_output=True, text=True, timeout=180, check=False,
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (FILE_MOST, FILE_MOST)),
        )  # fmt: skip
        (outcome,) = ended_in(lines_of(done.stdout))
        assert (done.returncode, outcome["code"]) == (5, "disk"), done.stderr
        process = start("run", station, "--events")  # which puts the folder in order
        until(lambda: has_poses(process, 1))
        process.send(signal.SIGTERM)
        assert process.wait() == 130, process.err
    assert [o.document["code"] for o in check_folder(folder, triaxcal)] == ["disk", "stopped"]


# Processes that are killed at random moments.

KILLED = {"speed": 15.0, "fixture": {"poses": POSES, "hold_s": 1.4, "move_s": 0.6}}
STAGES = {"identity": 0.3, "poses": 2.0, "fitting": 1.0, "writing": 1.2, "check_poses": 0.6, "report": 1.0}
"""Stages, with the longest delay of a kill after their event [s]: about as long as they last."""
EEPROM_S = 0.5
"""The simulated unit stores what it holds within this time of a change."""


@dataclass(frozen=True)
class Attempt:
    """An attempt from outside: the EEPROM before and after it, the journals after it, and its events."""

    before: Stored
    after: Stored
    journals: frozenset[str]
    events: Sequence[Document]

    @property
    def run(self) -> str | None:
        return next((e["run"] for e in self.events if e["run"] is not None), None)


class Target:
    """A simulated unit in a process of its own, and its station."""

    def __init__(self, workshop: Any, start: Callable[..., Any], port: int) -> None:
        bus = {"host": "127.0.0.1", "port": port}
        self._start = start
        self._eeprom = workshop.folder / "eeprom.bin"
        self.folder: Path = workshop.folder / "line"
        start("sim", workshop.device(bus=bus, eeprom=self._eeprom.name, **KILLED)).says("serving ")
        plan = {**PLAN, "comes_back_s": 5.0, "patience_s": 120.0}
        self.station = workshop.station({"name": "rec", "bus": bus}, plan=plan, folder="line")

    def run(self, stage: str | None, delay_s: float) -> Attempt:
        """A run that is killed so long after the event of a stage; to its end without one."""
        before = self._held()
        process = self._start("run", self.station, "--events")
        if stage is not None:
            until(lambda: not process.running or any(e.get("stage") == stage for e in lines_of(process.out)))
            _wait(delay_s)
            if process.running:
                process.send(signal.SIGKILL)
        code = process.wait()
        assert code in (-signal.SIGKILL, 0), process.err
        _wait(EEPROM_S)
        journals = frozenset(map(str, (self.folder / "journal").glob("*.json")))
        return Attempt(before, self._held(), journals, lines_of(process.out))

    def _held(self) -> Stored:
        stored = (
            Stored.from_image(self._eeprom.read_bytes()) if self._eeprom.exists() else Stored(factory_calibration())
        )
        assert stored.valid
        return stored


def _wait(seconds: float) -> None:
    ends_s = time.monotonic() + seconds
    until(lambda: time.monotonic() >= ends_s)


def _is_true(document: Document, attempt: Attempt, folder: Path) -> None:
    """The device holds what the outcome says."""
    before, after = attempt.before.calibration, attempt.after.calibration
    told = document["code"], document["device_state"], document["evidence"]
    match DeviceState(document["device_state"]):
        case DeviceState.UNTOUCHED:
            assert attempt.after == attempt.before, told
            assert document["journal"] is None, told
        case DeviceState.OLD:
            assert after == before, told
        case DeviceState.NEW_VERIFIED:
            assert after != before, told
            assert attempt.after.write_counter > attempt.before.write_counter, told
            with Recording.open(folder / document["recording"]) as recording:
                written = recording.attachments.get("registers-after.json")
            if written is not None:
                assert {name: bytes.fromhex(raw) for name, raw in json.loads(written).items()} == dict(after), told
        case DeviceState.UNKNOWN:
            assert document["journal"] in attempt.journals, told
        case state:
            pytest.fail(f"a killed run cannot know of {state}")


def test_a_process_that_is_killed_leaves_one_outcome_that_is_true_of_the_device(
    workshop: Any, triaxcal: Run, start: Callable[..., Any], free_port: int
) -> None:
    print(f"TRAYS_SEED={SEED} TRAYS_KILLS={KILLS}")
    rng = np.random.default_rng([SEED, 1])
    target = Target(workshop, start, free_port)
    order = [str(stage) for _ in range(0, KILLS, len(STAGES)) for stage in rng.permutation(list(STAGES))]
    attempts = [target.run(stage, float(rng.uniform(0.0, STAGES[stage]))) for stage in order[:KILLS]]
    attempts.append(target.run(None, 0.0))

    outcomes = [o.document for o in check_folder(target.folder, triaxcal)]
    assert len(outcomes) == len(attempts) == sum(_started(a) for a in attempts)
    by_run = {d["run"]: d for d in outcomes}
    assert set(by_run) == {a.run for a in attempts}
    for attempt in attempts:
        document = by_run[attempt.run]
        assert ended_in(attempt.events) in ([], [document])
        _is_true(document, attempt, target.folder)
        reached = [e["stage"] for e in attempt.events if e["event"] == "stage"]
        print(document["code"], document["device_state"], document["evidence"], "after", *reached)
    assert not (target.folder / "running").exists()


def _started(attempt: Attempt) -> int:
    return sum(e["event"] == "tray" and e["state"] == "started" for e in attempt.events)
