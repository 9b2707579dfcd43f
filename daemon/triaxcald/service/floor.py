"""The station at work: takes what people scan and order, runs the trays, and keeps the
desk up to date."""

from __future__ import annotations

import asyncio
import shutil
import sys
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final, Protocol

import triaxcal as tc
from triaxcald.errors import DaemonError, InputError
from triaxcald.learned_odds import odds_for, odds_of_station
from triaxcald.memory import give_back
from triaxcald.run.attempts import Killed, settle_killed
from triaxcald.run.events import Events
from triaxcald.run.golden_unit import golden_calibration
from triaxcald.run.orders import RuleBroken, require_serial, with_serials, works
from triaxcald.run.unit_run import Outcome, TrayRun
from triaxcald.schema.codes import Code, Stage
from triaxcald.service import golden
from triaxcald.service.desk import Desk, Scanned
from triaxcald.service.errors import ApiError, Problem
from triaxcald.service.stream import Stream
from triaxcald.signing.station import signing_of
from triaxcald.station.config import Station, check_lines
from triaxcald.utc import iso_time
from triaxcald.work import wrong

if TYPE_CHECKING:
    from triaxcald.recording.schema import Phase
    from triaxcald.station.guidance import Guide
    from triaxcald.station.tray import Instruction

DISK_LEAST: Final = 64 << 20
"""Free bytes below which no tray starts: more than the recordings of a tray of four."""
LIVE_S: Final = 0.4
"""Shortest time between two pictures of the directions."""
DAY_S: Final = 86_400.0
DUE_LATE_S: Final = 0.1
"""A golden unit is shown as due so long after the moment, so that it surely is."""
RETRY_S: Final = 2.0
"""Time until a database that has failed is asked again."""
DESK: Final = "desk"
"""Key of what is kept of the desk."""


class Book(Protocol):
    """What the floor asks of the database. All methods block, and raise DaemonError."""

    def take(self) -> list[str]: ...

    def setting(self, key: str) -> Any | None: ...

    def put_setting(self, key: str, value: Any) -> None: ...

    def golden(self, serial: str, slots: Sequence[str], until_us: int) -> dict[str, golden.LastCheck]: ...


def _now_us() -> int:
    return time.time_ns() // 1000


def now() -> str:
    return iso_time(time.time_ns())


class Floor:
    """``load`` reads the station file again, ``loaded`` receives the new station.
    ``log`` takes a line for people, ``recorded`` is called after runs have entered the
    database. All methods are called in the event loop; those that take something from
    people raise ApiError."""

    def __init__(
        self,
        station: Station,
        book: Book,
        stream: Callable[[Callable[[int], dict[str, Any]]], Stream],
        *,
        load: Callable[[], Station],
        log: Callable[[str], None],
        recorded: Callable[[], None] = lambda: None,
        loaded: Callable[[Station], None] = lambda _: None,
    ) -> None:
        self.station, self._book, self._load, self._log, self._recorded = station, book, load, log, recorded
        self._loaded = loaded
        self.desk = _desk_of(station)
        self.stream = stream(self.state)
        self._tray: TrayRun | None = None
        self._task: asyncio.Task[None] | None = None
        self._starting = asyncio.Lock()
        self._entering = asyncio.Lock()
        self._saving = asyncio.Lock()
        self._retry: asyncio.TimerHandle | None = None
        self._told: set[str] = set()
        self._again = False
        self._stopping = False
        self._saved: dict[str, Any] | None = None
        self._checks: dict[str, golden.LastCheck] = {}
        self._due_timer: asyncio.TimerHandle | None = None
        self.counts: dict[str, int] = {}
        """Runs by verdict since the service began."""

    async def begin(self) -> None:
        """Settle what a killed service has left, and show the tray as it was. Raises
        DaemonError."""
        kept = await asyncio.to_thread(self._book.setting, DESK)
        if isinstance(kept, Mapping):
            self.desk.restore(kept, now())
        for killed in await asyncio.to_thread(settle_killed, self.station):
            self._settled(killed)
        await self._enter()
        self.stream.changed()
        await self._save()

    # What people order.

    def state(self, seq: int) -> dict[str, Any]:
        """The `triaxcal.station_state/1` after the event ``seq``."""
        slots = self._golden_blocked()
        self.desk.blocked = self._blocked(slots)
        self.desk.blocked_slots = slots if self.desk.blocked in list(slots.values()) else {}
        return self.desk.document(seq)

    @property
    def blocked(self) -> str | None:
        """Code of what keeps the next tray from starting."""
        return self._blocked(self._golden_blocked())

    def _blocked(self, slots: Mapping[str, Problem]) -> str | None:
        return self._trouble or golden.worst(slots)

    def _golden_blocked(self) -> dict[str, Problem]:
        """Slots of the next start that wait for their golden unit."""
        return golden.blocked_slots(self.station.file.rules, self.desk.waiting, self._checks, _now_us())

    @property
    def _trouble(self) -> str | None:
        """Code of a fault of this computer that keeps any tray from starting."""
        if self.stream.trouble is not None:
            return Problem.DATABASE.value
        with suppress(OSError):
            if shutil.disk_usage(self.station.folder).free < DISK_LEAST:
                return Problem.DISK.value
        return None

    async def scan(self, text: str, person: str | None = None) -> dict[str, Any]:
        """Take a scanned text, by a ``person`` as in `start`; gives what it was."""
        scanned = self.desk.scan(text, now())
        answer = scanned.document()
        if scanned.kind == "command":
            return {**answer, **await self._command(scanned, person)}
        if scanned.kind == "serial":
            self._require_serial(scanned)
        await self._changed()
        return answer

    async def _command(self, scanned: Scanned, person: str | None) -> dict[str, Any]:
        if scanned.value == "START":
            return await self.start(None, person)
        if scanned.value == "STOP":
            return await self.stop("stopped by the operator")
        await self.clear()
        return {}

    def _require_serial(self, scanned: Scanned) -> None:
        """Refuse a serial number against the rule at once, not only at the start."""
        assert scanned.slot is not None
        try:
            require_serial(self.station.file.rules, scanned.value, scanned.slot)
        except RuleBroken as e:
            self.desk.slots[scanned.slot].empty(now())
            raise ApiError(Problem.INVALID, str(e)) from e

    async def put(self, serials: Mapping[str, str | None], work: Mapping[str, str | None]) -> None:
        """Take serial numbers of slots, and work."""
        self.desk.put(serials, work, now())
        await self._changed()

    async def clear(self) -> None:
        self.desk.clear(now())
        await self._changed()

    async def start(self, request: str | None, person: str | None = None) -> dict[str, Any]:
        """Start the scanned slots. The same ``request`` starts once, and gets the same
        answer each time. Who has signed in, ``person``, is the operator unless a badge
        was scanned or the station file names one."""
        async with self._starting:
            if request is not None and request in self.desk.starts:
                return self.desk.starts[request]
            if self.desk.running or self._task is not None:
                raise ApiError(Problem.RUNNING, "a tray is running")
            due = self.desk.due()
            if (trouble := self._trouble) is not None:
                raise ApiError(Problem(trouble), _BLOCKED[Problem(trouble)])
            with self.desk.starting():
                await self._require_golden(due)
                tray = await self._made(due, person)
            if self._stopping:
                raise ApiError(Problem.RUNNING, "the service is about to end")
            runs = {slot: unit.run for slot, unit in tray.units.items()}
            answer, before = {"tray": tray.id, "runs": runs}, self.desk.kept()
            self.desk.started(tray.id, runs, due, now())
            if request is not None:
                self.desk.remember_start(request, answer)
            # On the disk before any device is touched: a repetition after a restart of
            # the service must not start again.
            self._tray = tray  # which can be stopped from now on
            if not await self._save():
                self._tray = None
                self.desk.restore(before, now())
                raise ApiError(Problem.DATABASE, _BLOCKED[Problem.DATABASE])
            self.stream.changed()
            self._task = asyncio.ensure_future(self._run(tray))
            # Cycles hold its samples and files, and a service looks for garbage seldom.
            self._task.add_done_callback(lambda _: give_back())
            return answer

    async def _require_golden(self, due: Mapping[str, str | None]) -> None:
        """Refuse slots whose golden unit is due or has failed, by the outcomes in the
        folder."""
        rules = self.station.file.rules
        if rules.golden is None:
            return
        try:
            await self._take()
        except DaemonError as e:
            raise ApiError(Problem.DATABASE, str(e)) from e
        blocked = golden.blocked_slots(rules, due, self._checks, _now_us())
        if (problem := golden.worst(blocked)) is not None:
            raise ApiError(problem, golden.told(rules, blocked))

    async def stop(self, reason: str) -> dict[str, Any]:
        """Stop all units at work; gives their slots."""
        return {"stopped": [slot for slot in self.desk.slots if self._stop(slot, reason)]}

    async def stop_slot(self, slot: str, reason: str) -> dict[str, Any]:
        if slot not in self.desk.slots:
            raise ApiError(Problem.UNKNOWN, f"no slot '{slot}'; the slots are {', '.join(self.desk.slots)}")
        return {"stopped": [slot] if self._stop(slot, reason) else []}

    def _stop(self, slot: str, reason: str) -> bool:
        if why := wrong(reason):
            raise ApiError(Problem.INVALID, f"reason: {why}")
        unit = None if self._tray is None else self._tray.units.get(slot)
        if unit is None or unit.ended:
            return False
        unit.stop(reason)
        return True

    async def reload(self) -> None:
        """Read the station file again, now or after the tray."""
        self._again = True
        if self._task is None:
            await self._reloaded()

    async def end(self) -> None:
        """Stop what is at work, and wait until each device is in order. Each
        cancellation meanwhile is passed on to the units."""
        self._stopping = True
        for timer in (self._due_timer, self._retry):
            if timer is not None:
                timer.cancel()
        # A start that is under way ends first.
        starting = asyncio.ensure_future(self._starting.acquire())
        while not starting.done():
            with suppress(asyncio.CancelledError):
                await asyncio.wait([starting])
        self._starting.release()
        if (task := self._task) is not None:
            for slot in self.desk.slots:
                self._stop(slot, "the service was stopped")
            while not task.done():
                try:
                    await asyncio.wait([task])
                except asyncio.CancelledError:
                    task.cancel()
        await self._save()

    # A tray.

    async def _made(self, due: Mapping[str, str | None], person: str | None) -> TrayRun:
        """The units of these slots, ready to run."""
        station = self.station
        station = replace(station, places=tuple(p for p in station.places if p.unit.name in due))
        given = {key: value for key, value in self.desk.work.items() if value is not None}
        if person is not None:
            given.setdefault("operator", person)
        scanned = [(slot, serial) for slot, serial in due.items() if serial is not None]
        try:
            await asyncio.to_thread(signing_of, station)
            station = with_serials(station, scanned)
            work = await asyncio.to_thread(works, station, given)
            check_lines(station.places, where=str(station.path))
            odds = await asyncio.to_thread(odds_for, station, work)
        except RuleBroken as e:
            problem = _OF_RULE.get(e.rule, Problem.INVALID)
            raise ApiError(problem, _told(e)) from e
        except (InputError, tc.InvalidData) as e:
            raise ApiError(Problem.INVALID, str(e)) from e
        receiver = _Receiver(self._took, self.stream)
        tray = TrayRun(
            station, receiver, work=work, odds=odds, ended=receiver.ended, killed=self._settled, begun=receiver.begun
        )  # fmt: skip
        receiver.of(tray)
        return tray

    async def _run(self, tray: TrayRun) -> None:
        try:
            await tray
        except asyncio.CancelledError:
            raise
        except DaemonError as e:
            self._log(f"triaxcal: {e}")
            self.desk.failed(str(e), now())
        except Exception as e:  # noqa: BLE001 - supervises the tray: the service goes on
            traceback.print_exc(file=sys.stderr)
            self.desk.failed(f"internal error: {type(e).__name__}: {e}", now())
        finally:
            self._tray, self._task = None, None
            for slot in self.desk.slots.values():
                if slot.at_work:  # its outcome could not be made
                    self.desk.failed("the run ended without an outcome", now())
        await self._changed()
        if self._again and not self._stopping:
            await self._reloaded()

    def _took(self, event: dict[str, Any]) -> None:
        """Take an event of the tray."""
        self.desk.apply(event)
        self.stream.emit(event)
        if event["event"] == "ended":
            verdict = event["outcome"]["verdict"]
            self.counts[verdict] = self.counts.get(verdict, 0) + 1
            _keep_alive(asyncio.ensure_future(self._enter()))
        if event["event"] in ("ended", "tray"):
            _keep_alive(asyncio.ensure_future(self._save()))

    def _settled(self, killed: Killed) -> None:
        """A killed run has its outcome now."""
        self._log(killed.line)
        document = killed.document
        events = Events(self.stream.emit, self.desk.tray or "", {document["unit"]: document["run"]},
                        number=self.stream.number)  # fmt: skip
        events.settled(document)
        for slot in self.desk.slots.values():
            if slot.run == document["run"]:
                self.desk.ended(slot.slot, document, now())

    async def _enter(self) -> None:
        """Bring the database up to date with the folder, later if it fails."""
        try:
            await self._take()
        except DaemonError as e:
            self._later(e)

    def _later(self, error: DaemonError) -> None:
        """Enter and save in a while what the database has not taken."""
        if str(error) not in self._told:  # once, not with each attempt
            self._log(f"triaxcal: {error}")
        self._told.add(str(error))
        if self._retry is None and not self._stopping:
            self._retry = asyncio.get_running_loop().call_later(RETRY_S, self._again_now)

    def _again_now(self) -> None:
        async def again() -> None:
            await self._enter()
            await self._save()

        self._retry = None
        _keep_alive(asyncio.ensure_future(again()))

    async def _take(self) -> None:
        """Bring the database up to date with the folder. Raises DaemonError."""
        async with self._entering:
            await asyncio.to_thread(self._book.take)
            rule, before = self.station.file.rules.golden, self._checks
            slots, until_us = list(self.desk.slots), _now_us() + golden.CLOCK_STEP_US
            self._checks = (
                {} if rule is None else await asyncio.to_thread(self._book.golden, rule.serial, slots, until_us)
            )
        self._told.clear()
        self._recorded()
        self._await_due()
        if self._checks != before:
            self.stream.changed()

    def _await_due(self) -> None:
        """Show it when the golden unit of a slot becomes due."""
        if self._due_timer is not None:
            self._due_timer.cancel()
        now_us = _now_us()
        due_us = golden.next_due_us(self.station.file.rules, self._checks, now_us)
        if due_us is None or self._stopping:
            self._due_timer = None
            return
        # A day at most: the host's clock may be set.
        wait_s = min((due_us - now_us) / 1e6 + DUE_LATE_S, DAY_S)
        self._due_timer = asyncio.get_running_loop().call_later(wait_s, self._due)

    def _due(self) -> None:
        self._await_due()
        self.stream.changed()

    async def _changed(self) -> None:
        self.stream.changed()
        await self._save()

    async def _save(self) -> bool:
        """Keep the desk for a restart, later if the database fails. Gives whether it is
        kept now."""
        async with self._saving:  # an earlier state never replaces a later one
            kept = self.desk.kept()
            if kept == self._saved:
                return True
            try:
                await asyncio.to_thread(self._book.put_setting, DESK, kept)
                self._saved = kept
            except DaemonError as e:
                self._later(e)
                return False
        return True

    async def _reloaded(self) -> None:
        async with self._starting:
            if self._task is not None:  # a tray came first: after it
                return
            self._again = False
            try:
                station = await asyncio.to_thread(self._load)
                self._require_same_place(station)
                await asyncio.to_thread(golden_calibration, station)
                await asyncio.to_thread(odds_of_station, station)
            except Exception as e:  # noqa: BLE001 - the old station file stays in use
                self._log(f"triaxcal: not loaded again, the old station file stays in use: {e}")
                return
            kept = self.desk.kept()
            self.station, self.desk = station, _desk_of(station)
            self.desk.restore(kept, now())
            self._loaded(station)
        self._log(f"{station.path}: loaded again")
        await self._enter()  # its golden unit may be another
        await self._changed()

    def _require_same_place(self, station: Station) -> None:
        """Raises InputError where the runs of a station that was read again would not
        come where the database looks for them, and where it has no units."""
        station.require_units()
        if station.folder != self.station.folder:
            raise InputError(f"{station.path}: folder changes with a restart of the service")
        if station.file.name != self.station.file.name:
            raise InputError(f"{station.path}: name changes with a restart of the service")


def _told(broken: RuleBroken) -> str:
    """What to do at a page instead of a command line."""
    if broken.rule == "operator":
        return "no operator; scan the badge"
    if broken.rule == "retest_reason" and broken.work is not None:
        unit = f"unit {broken.work.serial} in slot {broken.work.slot}"
        return f"{unit} has passed before; give the reason of the re-test"
    return str(broken)


def _desk_of(station: Station) -> Desk:
    slots = [(place.unit.name, place.unit.serial) for place in station.places]
    return Desk(station.file.name, slots, station.file.work.model_dump(), station.file.fixture.names, now())


_OF_RULE: Final = {"attempts": Problem.ATTEMPTS_USED, "retest_reason": Problem.REASON_MISSING}
_BLOCKED: Final = {
    Problem.DISK: "the disk is full; free some space in the station's folder",
    Problem.DATABASE: "the database takes nothing; see the log of the service",
}
_tasks: set[asyncio.Future[Any]] = set()


def _keep_alive(task: asyncio.Future[Any]) -> None:
    """The loop has only weak references to its tasks."""
    _tasks.add(task)
    task.add_done_callback(_tasks.discard)


class _Receiver:
    """The progress of a tray: as events, and as pictures of the directions."""

    def __init__(self, took: Callable[[dict[str, Any]], None], stream: Stream) -> None:
        self._took, self._stream = took, stream
        self._events: Events | None = None
        self._shown: dict[str, dict[str, Any]] = {}
        self._shown_s = 0.0

    def of(self, tray: TrayRun) -> None:
        runs = {slot: unit.run for slot, unit in tray.units.items()}
        self._events = Events(self._took, tray.id, runs, number=self._stream.number)
        self._left = set(runs)

    @property
    def events(self) -> Events:
        assert self._events is not None
        return self._events

    def begun(self) -> None:
        self.events.started()

    def ended(self, outcome: Outcome) -> None:
        self._shown.pop(outcome.unit, None)
        self.events.ended(outcome)
        self._left.discard(outcome.unit)
        if not self._left:
            self.events.all_ended()

    def stage(self, unit: str, stage: Stage) -> None:
        self._shown.pop(unit, None)
        self.events.stage(unit, stage)

    def note(self, unit: str, text: str) -> None:
        pass

    def lost(self, unit: str, code: Code, reason: str) -> None:
        self._shown.pop(unit, None)
        self.events.lost(unit, code, reason)

    def back(self, unit: str) -> None:
        self.events.back(unit)

    def poses(self, unit: str, phase: Phase, guide: Guide) -> None:
        self.events.poses(unit, phase, guide)
        self._shown[unit] = {
            "up": _rounded(guide.up),
            "held_s": round(guide.held_s, 1),
            "hold_s": guide.hold_s,
            "too_short": guide.too_short,
            "taken": [_rounded(v) for v in guide.taken],
            "missing": [_rounded(v) for v in guide.lacking],
            "found": guide.found,
            "wanted": guide.wanted,
            "phase": phase,
        }
        at_s = asyncio.get_running_loop().time()
        if at_s - self._shown_s >= LIVE_S:
            self._shown_s = at_s
            self._stream.live({"slots": dict(self._shown)})

    def instruction(self, instruction: Instruction | None) -> None:
        self.events.instruction(instruction)


def _rounded(v: Sequence[float] | None) -> list[float] | None:
    return None if v is None else [round(c, 3) for c in v]
