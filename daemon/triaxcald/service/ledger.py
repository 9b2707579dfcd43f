"""What the service keeps: rows made from the outcomes in the folder, events, the trail,
and what a restart needs. All methods block; any thread may call."""

from __future__ import annotations

import base64
import binascii
import json
import os
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from sqlalchemy import Connection, Engine, Select, Table, and_, delete, func, insert, or_, select, update

from triaxcald.errors import InputError
from triaxcald.outcome import SUFFIX
from triaxcald.schema.columns import COLUMNS, NAMES, Kind
from triaxcald.service import tables
from triaxcald.service.database import (
    DatabaseError,
    answering,
    copy_sqlite,
    migrate,
    postgresql_engine,
    sqlite_engine,
)
from triaxcald.station.config import Station
from triaxcald.store import BESIDE, FILE_NAME, OWN_COLUMNS, Store
from triaxcald.work import plain_serial

EVENTS_KEPT: Final = 10_000
BATCH: Final = 500
"""Outcomes in one transaction."""
TRAIL: Final = "trail.jsonl"
FIGURES: Final = ("rms_g", "cross_validated_rms_g", "verification_rms_g")
"""Measurements with a limit."""
COEFFICIENTS: Final = {"scale_factor": "output/g", "misalignment": "rad", "bias": "g"}
WAITING, DELIVERED, REFUSED = "waiting", "delivered", "refused"


@dataclass(frozen=True)
class RunFilter:
    """Which runs are asked for; what is None does not matter. Times are microseconds
    since 1970: from ``since_us`` on and before ``until_us``."""

    serial: str | None = None
    order: str | None = None
    verdict: str | None = None
    code: str | None = None
    part_number: str | None = None
    fixture: str | None = None
    slot: str | None = None
    operator: str | None = None
    since_us: int | None = None
    until_us: int | None = None

    def conditions(self, run: Table) -> list[Any]:
        """As conditions on the table of runs, apart from the serial number."""
        given = {key: getattr(self, key) for key in _EQUAL}
        found = [run.c[key] == value for key, value in given.items() if value is not None]
        if self.since_us is not None:
            found.append(run.c.at_us >= self.since_us)
        if self.until_us is not None:
            found.append(run.c.at_us < self.until_us)
        return found


_EQUAL: Final = ("order", "verdict", "code", "part_number", "fixture", "slot", "operator")


@dataclass(frozen=True)
class Waiting:
    """A result on its way to a receiver. ``outcome`` is the file's name."""

    id: int
    run: str
    outcome: str
    tries: int


@dataclass(frozen=True)
class Delivery:
    """The state of a receiver's results; ``oldest_s`` is the age of the oldest that
    waits, 0 without one; ``error`` is of the last try."""

    receiver: str
    waiting: int
    refused: int
    oldest_s: float
    error: str | None

    def document(self) -> dict[str, Any]:
        return dict(vars(self))


class Ledger:
    """The database of the service at a station. Use `open`."""

    def __init__(self, station: Station, engine: Engine) -> None:
        self.engine = engine
        self.home = station.file.name
        self.folder = station.folder
        self._receivers = tuple(receiver.name for receiver in station.file.deliver)
        self._store = Store(station.folder)
        self._taking = threading.Lock()
        self._trailing = threading.Lock()
        self._inode: int | None = None

    @staticmethod
    def open(station: Station, url: str | None = None) -> Ledger:
        """Raises InputError, DatabaseError."""
        try:
            station.folder.mkdir(parents=True, exist_ok=True)
        except OSError as e:
            raise InputError(f"{station.folder}: no folder for recordings: {e.strerror}") from e
        engine = sqlite_engine(station.folder / FILE_NAME) if url is None else postgresql_engine(url)
        ledger = Ledger(station, engine)
        try:
            ledger._prepare()
        except BaseException:
            ledger.close()
            raise
        return ledger

    def receive(self, station: Station) -> None:
        """The station file was read again."""
        self._receivers = tuple(receiver.name for receiver in station.file.deliver)

    def close(self) -> None:
        self.engine.dispose()
        self._store.close()

    @property
    def path(self) -> Path | None:
        """The file of an SQLite database."""
        return self.folder / FILE_NAME if self._sqlite else None

    @property
    def run(self) -> Table:
        """The table of runs."""
        return tables.local_run if self._sqlite else tables.shared_run

    @property
    def _sqlite(self) -> bool:
        return self.engine.dialect.name == "sqlite"

    def _prepare(self) -> None:
        """Make the tables. A new file gets the trail back from its other copy."""
        if self._sqlite:
            self._store.make()  # the tables of the index come first
        migrate(self.engine)
        self._inode = self._present_inode()
        if self._sqlite:
            self._bring_trail_back()

    def _present_inode(self) -> int | None:
        if not self._sqlite:
            return None
        try:
            return (self.folder / FILE_NAME).stat().st_ino
        except OSError:
            return None

    @contextmanager
    def writing(self) -> Iterator[Connection]:
        """One transaction. Raises DatabaseError."""
        self._follow_file()
        with answering(), self.engine.begin() as db:
            yield db

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """Raises DatabaseError."""
        self._follow_file()
        with answering(), self.engine.connect().execution_options(reading=True) as db:
            yield db

    def _follow_file(self) -> None:
        """Leave a file that was set aside as damaged, or deleted."""
        if self._sqlite and self._present_inode() != self._inode:
            self.engine.dispose()
            self._prepare()

    # Runs.

    def take(self) -> list[str]:
        """Bring the tables up to date with the outcomes in the folder, each batch in a
        transaction with what is to be delivered. Gives the ids of new ones.
        Raises DatabaseError, InputError if the folder cannot be read."""
        with self._taking:
            try:
                there = self._store.digests()
            except OSError as e:
                raise InputError(f"{self.folder}: {e.strerror}") from e
            home = tables.filed.c.home == self.home
            with self.reading() as db:
                found = db.execute(select(tables.filed.c.outcome, tables.filed.c.outcome_sha256).where(home))
                filed = {str(row.outcome): str(row.outcome_sha256) for row in found}
            gone = [outcome for outcome in filed if outcome not in there]
            due = [outcome for outcome, digest in there.items() if filed.get(outcome) != digest]
            for start in range(0, len(gone), BATCH):
                with self.writing() as db:
                    self._forget(db, gone[start : start + BATCH])
            new: list[str] = []
            for start in range(0, len(due), BATCH):
                rows = self._store.rows(due[start : start + BATCH])
                with self.writing() as db:
                    self._file(db, sorted(rows, key=lambda row: (row["ended_us"], row["outcome"])))
                new += [str(row["run"]) for row in rows if row["outcome"] not in filed and row["run"] is not None]
            return new

    def _file(self, db: Connection, rows: Sequence[Mapping[str, Any]]) -> None:
        """Make the rows of these outcomes anew."""
        self._forget(db, [row["outcome"] for row in rows])
        if not self._sqlite:
            kept = (*NAMES, *OWN_COLUMNS)
            db.execute(insert(tables.shared_run), [{"home": self.home, **{k: row[k] for k in kept}} for row in rows])
        if rows:
            db.execute(insert(tables.filed), [self._filed(row) for row in rows])
        measured = [m for row in rows for m in measurements_of(row)]
        if measured:
            db.execute(insert(tables.measurement), [{"home": self.home, **m} for m in measured])
        self._count_units(db, {self._filed(row)["plain_serial"] for row in rows})
        since = {receiver: self._since(db, receiver) for receiver in self._receivers}
        sent = {
            (receiver, run)
            for receiver, run in db.execute(
                select(tables.outbox.c.receiver, tables.outbox.c.run).where(
                    tables.outbox.c.home == self.home, tables.outbox.c.run.in_([row["run"] for row in rows])
                )
            )
        }
        added_us = time.time_ns() // 1000
        out = [
            {
                "home": self.home, "receiver": receiver, "run": row["run"], "outcome": row["outcome"],
                "state": WAITING, "tries": 0, "added_us": added_us,
            }
            for row in rows
            for receiver in self._receivers
            if row["run"] is not None and row["ended_us"] >= since[receiver] and (receiver, row["run"]) not in sent
        ]  # fmt: skip
        if out:
            db.execute(insert(tables.outbox), out)

    def _forget(self, db: Connection, outcomes: Sequence[str]) -> None:
        """Remove what was made from these outcomes."""
        if not outcomes:
            return
        filed = tables.filed
        here = and_(filed.c.home == self.home, filed.c.outcome.in_(outcomes))
        serials = set(db.execute(select(filed.c.plain_serial).where(here)).scalars())
        db.execute(delete(filed).where(here))
        made = tables.measurement
        db.execute(delete(made).where(made.c.home == self.home, made.c.outcome.in_(outcomes)))
        if not self._sqlite:
            run = tables.shared_run
            db.execute(delete(run).where(run.c.home == self.home, run.c.outcome.in_(outcomes)))
        self._count_units(db, serials)

    def _filed(self, row: Mapping[str, Any]) -> dict[str, Any]:
        serial = row["serial"] if row["serial"] is not None else row["work_serial"]
        return {
            "home": self.home,
            **{key: row[key] for key in ("outcome", "outcome_sha256", "run", "at_us", "ended_us", "verdict", "code")},
            "serial": serial,
            "plain_serial": None if serial is None else plain_serial(serial),
            "tried": bool(row["tried"]),
        }

    def _count_units(self, db: Connection, serials: set[str | None]) -> None:
        """Make the rows of these units anew."""
        unit, filed = tables.unit, tables.filed
        wanted = sorted(serial for serial in serials if serial is not None)
        if not wanted:
            return
        db.execute(delete(unit).where(unit.c.home == self.home, unit.c.plain_serial.in_(wanted)))
        runs: dict[str, list[Any]] = {}
        query = select(filed).where(filed.c.home == self.home, filed.c.plain_serial.in_(wanted))
        for row in db.execute(query.order_by(filed.c.ended_us, filed.c.outcome)):
            runs.setdefault(row.plain_serial, []).append(row)
        if runs:
            db.execute(insert(unit), [self._unit(serial, rows) for serial, rows in runs.items()])

    def _unit(self, serial: str, rows: Sequence[Any]) -> dict[str, Any]:
        last = rows[-1]
        return {
            "home": self.home,
            "plain_serial": serial,
            "serial": last.serial,
            "first_us": min(row.at_us for row in rows),
            "last_us": last.ended_us,
            "attempts": sum(row.tried for row in rows),
            "passed": any(row.verdict == "pass" for row in rows),
            "verdict": last.verdict,
            "code": last.code,
            "run": last.run,
        }

    def _since(self, db: Connection, receiver: str) -> int:
        """From when on runs are delivered: since the receiver was first named. What
        ended in the same second counts, as a killed service may have left it."""
        key = f"receiver {receiver}"
        value = self._setting(db, key)
        if value is None:
            value = int(time.time()) * 1_000_000
            self._put_setting(db, key, value)
        return int(value)

    def begin_deliveries(self) -> None:
        """Note from when on each receiver gets results."""
        with self.writing() as db:
            for receiver in self._receivers:
                self._since(db, receiver)

    # Questions about runs.

    def runs(self, wanted: RunFilter, limit: int, after: str | None = None) -> tuple[list[dict[str, Any]], str | None]:
        """The latest runs first, ``limit`` of them, and the cursor for those ``after``
        them. Raises InputError for a cursor that is none."""
        run = self.run
        query = self._wanted(select(run), wanted)
        if after is not None:
            at_us, outcome = _place(after)
            query = query.where(or_(run.c.at_us < at_us, and_(run.c.at_us == at_us, run.c.outcome < outcome)))
        query = query.order_by(run.c.at_us.desc(), run.c.outcome.desc()).limit(limit + 1)
        with self.reading() as db:
            rows = db.execute(query).mappings().all()
        following = _cursor(rows[limit - 1]) if len(rows) > limit else None
        return [self._document(row) for row in rows[:limit]], following

    def every(self, wanted: RunFilter) -> list[dict[str, Any]]:
        """All these runs, in the order of time."""
        run = self.run
        query = self._wanted(select(run), wanted).order_by(run.c.at_us, run.c.outcome)
        with self.reading() as db:
            return [self._document(row) for row in db.execute(query).mappings()]

    def run_of(self, run_id: str) -> dict[str, Any] | None:
        """The run of that id."""
        with self.reading() as db:
            row = db.execute(self._here(select(self.run)).where(self.run.c.run == run_id)).mappings().first()
        return None if row is None else self._document(row)

    def unit(self, serial: str) -> list[dict[str, Any]]:
        """All runs of a unit, in the order of time."""
        return self.every(RunFilter(serial=serial))

    def measurements_of(self, run_id: str) -> list[dict[str, Any]]:
        """The figures of a run."""
        made = tables.measurement
        query = select(made).where(made.c.home == self.home, made.c.run == run_id)
        keys = ("name", "value", "unit", "low", "high", "passed")
        with self.reading() as db:
            found = [{key: row[key] for key in keys} for row in db.execute(query).mappings()]
        return sorted(found, key=lambda m: MEASUREMENTS.index(m["name"]))

    def _document(self, row: Mapping[Any, Any]) -> dict[str, Any]:
        """A run with the columns of `results`; files that are gone have no name."""
        found = {name: row[name] for name in NAMES}
        for name in _TEXTS:
            found[name] = None if row[name] is None else json.loads(row[name])
        for name in BESIDE:
            if row[name] is not None and not os.path.lexists(self.folder / row[name]):
                found[name] = None
        return found

    def _wanted(self, query: Select[Any], wanted: RunFilter) -> Select[Any]:
        run, filed = self.run, tables.filed
        query = self._here(query).where(*wanted.conditions(run))
        if wanted.serial is not None:
            of_unit = select(filed.c.outcome).where(
                filed.c.home == self.home, filed.c.plain_serial == plain_serial(wanted.serial)
            )
            query = query.where(run.c.outcome.in_(of_unit))
        return query

    def _here(self, query: Select[Any]) -> Select[Any]:
        """Of this station alone."""
        return query if self._sqlite else query.where(tables.shared_run.c.home == self.home)

    # Events.

    def append(self, events: list[dict[str, Any]]) -> None:
        """Keep these events; the last `EVENTS_KEPT` stay. Raises DatabaseError."""
        rows = [
            {
                "home": self.home, "seq": event["seq"], "run": event.get("run"),
                "event": json.dumps(event, ensure_ascii=False, allow_nan=False),
            }
            for event in events
        ]  # fmt: skip
        if not rows:
            return
        event = tables.event
        with self.writing() as db:
            db.execute(insert(event), rows)
            db.execute(delete(event).where(event.c.home == self.home, event.c.seq <= rows[-1]["seq"] - EVENTS_KEPT))

    def events_after(self, seq: int, limit: int) -> list[dict[str, Any]]:
        event = tables.event
        query = select(event.c.event).where(event.c.home == self.home, event.c.seq > seq)
        with self.reading() as db:
            return [json.loads(e) for e in db.execute(query.order_by(event.c.seq).limit(limit)).scalars()]

    def events_of(self, run_id: str) -> list[dict[str, Any]]:
        """The events of a run, as far as they are kept."""
        event = tables.event
        query = select(event.c.event).where(event.c.home == self.home, event.c.run == run_id)
        with self.reading() as db:
            return [json.loads(e) for e in db.execute(query.order_by(event.c.seq)).scalars()]

    def last_seq(self) -> int:
        event = tables.event
        with self.reading() as db:
            return int(db.execute(select(func.max(event.c.seq)).where(event.c.home == self.home)).scalar() or 0)

    # Settings.

    def setting(self, key: str) -> Any | None:
        with self.reading() as db:
            return self._setting(db, key)

    def put_setting(self, key: str, value: Any) -> None:
        with self.writing() as db:
            self._put_setting(db, key, value)

    def _setting(self, db: Connection, key: str) -> Any | None:
        setting = tables.setting
        query = select(setting.c.value).where(setting.c.home == self.home, setting.c.key == key)
        value = db.execute(query).scalar()
        return None if value is None else json.loads(value)

    def _put_setting(self, db: Connection, key: str, value: Any) -> None:
        setting = tables.setting
        text = json.dumps(value, ensure_ascii=False)
        here = update(setting).where(setting.c.home == self.home, setting.c.key == key)
        if not db.execute(here.values(value=text)).rowcount:
            db.execute(insert(setting).values(home=self.home, key=key, value=text))

    # The trail.

    def trail(
        self, time: str, who: str | None, role: str | None, action: str, what: Mapping[str, Any], ok: bool,
        code: str | None,
    ) -> None:  # fmt: skip
        """A row of the trail, and a line in `trail.jsonl`. Raises DatabaseError."""
        row = {
            "time": time, "home": self.home, "who": who, "role": role, "action": action,
            "what": json.dumps(what, ensure_ascii=False), "ok": ok, "code": code,
        }  # fmt: skip
        with self._trailing, self.writing() as db:
            db.execute(insert(tables.trail).values(row))
            self._append_line({**row, "what": what})

    def _append_line(self, line: Mapping[str, Any]) -> None:
        """Raises DatabaseError: the row is then taken back, so that both agree."""
        data = (json.dumps(line, ensure_ascii=False) + "\n").encode("utf-8", "backslashreplace")
        try:
            descriptor = os.open(self.folder / TRAIL, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o640)
            try:
                os.write(descriptor, data)
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
        except OSError as e:
            raise DatabaseError(f"{self.folder / TRAIL}: {e.strerror}") from e

    def _bring_trail_back(self) -> None:
        """Fill an empty trail from `trail.jsonl`."""
        with suppress(OSError), answering(), self.engine.begin() as db:
            if db.execute(select(func.count()).select_from(tables.trail)).scalar():
                return
            rows = []
            for line in (self.folder / TRAIL).read_text("utf-8").splitlines():
                with suppress(ValueError, KeyError, TypeError):  # a line that was cut short
                    held = json.loads(line)
                    keys = ("time", "home", "who", "role", "action", "ok", "code")
                    rows.append({**{key: held[key] for key in keys}, "what": json.dumps(held["what"])})
            if rows:
                db.execute(insert(tables.trail), rows)

    # Deliveries.

    def next_delivery(self, receiver: str) -> Waiting | None:
        """The oldest result that waits for the receiver."""
        out = tables.outbox
        query = select(out.c.id, out.c.run, out.c.outcome, out.c.tries).where(
            out.c.home == self.home, out.c.receiver == receiver, out.c.state == WAITING
        )
        with self.reading() as db:
            row = db.execute(query.order_by(out.c.id).limit(1)).first()
        return None if row is None else Waiting(*row)

    def end_delivery(self, waiting: Waiting, error: str | None) -> None:
        """The result is delivered, or refused for good with this ``error``."""
        values: dict[str, Any] = {"ended_us": time.time_ns() // 1000, "error": error}
        values["state"] = DELIVERED if error is None else REFUSED
        self._set_delivery(waiting, values)

    def note_try(self, waiting: Waiting, error: str) -> None:
        self._set_delivery(waiting, {"error": error})

    def _set_delivery(self, waiting: Waiting, values: Mapping[str, Any]) -> None:
        out = tables.outbox
        with self.writing() as db:
            db.execute(update(out).where(out.c.id == waiting.id).values(tries=out.c.tries + 1, **values))

    def deliveries(self) -> list[Delivery]:
        """The state of each receiver of the station file."""
        out = tables.outbox
        now_us = time.time_ns() // 1000
        found = []
        with self.reading() as db:
            for receiver in self._receivers:
                here = and_(out.c.home == self.home, out.c.receiver == receiver)
                waiting = db.execute(
                    select(func.count(), func.min(out.c.added_us)).where(here, out.c.state == WAITING)
                ).one()
                refused = db.execute(select(func.count()).where(here, out.c.state == REFUSED)).scalar()
                error = db.execute(
                    select(out.c.error).where(here, out.c.error.is_not(None)).order_by(out.c.id.desc()).limit(1)
                ).scalar()
                oldest_s = 0.0 if waiting[1] is None else max(0.0, (now_us - waiting[1]) / 1e6)
                found.append(Delivery(receiver, int(waiting[0]), int(refused or 0), oldest_s, error))
        return found

    # Copies.

    def backup(self, to: Path) -> None:
        """A consistent copy, also while the service runs. Raises InputError."""
        if self.path is None:
            raise InputError("--backup: a PostgreSQL database has tools of its own: pg_dump")
        copy_sqlite(self.path, to)

    def rebuild(self) -> None:
        """Make all rows of runs, units and measurements anew from the outcomes. Raises
        DatabaseError, InputError."""
        with self._taking:
            self._store.forget()
            home = self.home
            made: list[Table] = [tables.filed, tables.unit, tables.measurement]
            if not self._sqlite:
                made.append(tables.shared_run)
            with self.writing() as db:
                for table in made:
                    db.execute(delete(table).where(table.c.home == home))
        self.take()


def measurements_of(row: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """The figures of a run as rows of `measurement`: those with a limit, then the
    coefficients."""
    of = {"outcome": row["outcome"], "run": row["run"]}
    for name in FIGURES:
        if (value := row[name]) is not None:
            high = row[f"{name.removesuffix('_g')}_limit_g"]
            passed = None if high is None else bool(value <= high)
            yield {**of, "name": name, "value": value, "unit": "g", "low": None, "high": high, "passed": passed}
    for kind, measure in COEFFICIENTS.items():
        for axis in "xyz":
            if (value := row[f"{kind}_{axis}"]) is not None:
                name = f"{kind}_{axis}"
                yield {**of, "name": name, "value": value, "unit": measure, "low": None, "high": None, "passed": None}


MEASUREMENTS: Final = (*FIGURES, *(f"{kind}_{axis}" for kind in COEFFICIENTS for axis in "xyz"))
"""Names of the measurements, in order."""
_TEXTS: Final = frozenset(c.name for c in COLUMNS if c.kind is Kind.TEXTS)


def _cursor(row: Mapping[Any, Any]) -> str:
    return base64.urlsafe_b64encode(f"{row['at_us']}:{row['outcome']}".encode()).decode()


def _place(cursor: str) -> tuple[int, str]:
    try:
        at_us, _, outcome = base64.urlsafe_b64decode(cursor.encode()).decode().partition(":")
        if not outcome.endswith(SUFFIX):
            raise ValueError
        return int(at_us), outcome
    except (ValueError, binascii.Error) as e:
        raise InputError("after: no cursor of this list") from e
