"""What the service keeps: rows made from the outcomes in the folder, events, the trail,
and what a restart needs. All methods block; any thread may call."""

from __future__ import annotations

import base64
import binascii
import errno
import json
import os
import sqlite3
import threading
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from sqlalchemy import Connection, Engine, Select, Table, and_, delete, func, insert, inspect, or_, select, update
from sqlalchemy.exc import SQLAlchemyError

from triaxcald.errors import InputError, StationError
from triaxcald.outcome import SUFFIX
from triaxcald.schema.codes import Verdict
from triaxcald.schema.columns import COLUMNS, NAMES, Kind
from triaxcald.service import tables
from triaxcald.service.database import (
    DatabaseError,
    SqliteFile,
    answering,
    copy_sqlite,
    migrate,
    plain_engine,
    postgresql_engine,
)
from triaxcald.service.golden import LastCheck
from triaxcald.station.config import Station
from triaxcald.store import BESIDE, FILE_NAME, VERSION, Store
from triaxcald.utc import iso_time
from triaxcald.work import plain_serial

EVENTS_KEPT: Final = 10_000
BATCH: Final = 500
"""Outcomes in one transaction."""
TRAIL: Final = "trail.jsonl"
FIGURES: Final = ("rms_g", "cross_validated_rms_g", "verification_rms_g")
"""Measurements with a limit."""
COEFFICIENTS: Final = {"scale_factor": "output/g", "misalignment": "rad", "bias": "g"}
WAITING, DELIVERED, REFUSED = "waiting", "delivered", "refused"
RECEIVER: Final = "receiver "
"""Key of a setting, before the receiver's name."""
NAMED: Final = "receiver"
"""Action in the trail: a receiver was first named."""
TAIL: Final = 1 << 20
"""Bytes of the end of `trail.jsonl` that are compared with the trail at each start."""
AT_MOST_US: Final = 2**63 - 1
"""What a database can hold."""
LOOK_MOST: Final = 200
"""Runs whose files are looked for one by one."""
LOCK: Final = 74112
"""Of a PostgreSQL server, with the name of the station: who takes its runs."""
SERVICE_LOCK: Final = LOCK + 1
"""The same: which service works for it."""
KEEPALIVE: Final = {"tcp_keepalives_idle": 10, "tcp_keepalives_interval": 5, "tcp_keepalives_count": 3}
"""Settings by which a PostgreSQL server finds out within 25 s that a client is gone."""


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
    """The database of the service at a station. Use `open` or `of_folder`."""

    def __init__(self, station: str, folder: Path, receivers: tuple[str, ...], url: str | None) -> None:
        self.station, self.folder = station, folder
        self.lost: str | None = None
        """What people have to do where the file was damaged or removed."""
        self.losses = 0
        """How often that was."""
        self._file = SqliteFile(self.folder / FILE_NAME, self._prepare_file) if url is None else None
        self.engine: Engine = postgresql_engine(url) if url is not None else self._sqlite_file.engine
        self.home = tables.HERE if url is None else self.station
        self._receivers = receivers
        self._since_us: dict[str, int] = {}
        self._store = Store(folder)
        self._taking = threading.Lock()
        self._trailing = threading.Lock()

    @staticmethod
    def open(station: Station, url: str | None = None) -> Ledger:
        """Raises InputError, DatabaseError."""
        try:
            station.folder.mkdir(parents=True, exist_ok=True)
        except OSError as e:
            raise InputError(f"{station.folder}: no folder for recordings: {e.strerror}") from e
        ledger = Ledger(station.file.name, station.folder, _receivers(station), url)
        ledger._begin()
        return ledger

    @staticmethod
    def of_folder(folder: Path, station: str, url: str | None = None) -> Ledger:
        """Without the station's file, whose name is ``station``. Raises InputError,
        DatabaseError."""
        ledger = Ledger(station, folder, (), url)
        ledger._begin()
        setting = tables.setting
        query = select(setting.c.key).where(setting.c.home == ledger.home, setting.c.key.startswith(RECEIVER))
        with ledger.reading() as db:
            ledger._receivers = tuple(key.removeprefix(RECEIVER) for key in db.execute(query).scalars())
        return ledger

    def _begin(self) -> None:
        try:
            if not self._sqlite:
                migrate(self.engine)
                self._join_trail(self.engine)
            with self.reading():
                pass
        except BaseException:
            self.close()
            raise

    def receive(self, station: Station) -> None:
        """The station file was read again."""
        self._receivers = _receivers(station)

    def close(self) -> None:
        self.engine.dispose()
        self._store.close()

    @property
    def path(self) -> Path | None:
        """The file of an SQLite database."""
        return None if self._file is None else self._file.path

    @property
    def run(self) -> Table:
        """The table of runs."""
        return tables.local_run if self._sqlite else tables.shared_run

    @property
    def _sqlite(self) -> bool:
        return self._file is not None

    @property
    def _sqlite_file(self) -> SqliteFile:
        assert self._file is not None
        return self._file

    def _prepare_file(self, suspect: bool) -> None:
        """Make the tables of a file that is new, and check one that is ``suspect``. A
        new file gets the trail back from its other copy. Raises DatabaseError,
        InputError."""
        path = self._sqlite_file.path
        if os.path.lexists(path) and (path.is_symlink() or not path.is_file()):
            raise InputError(f"{path}: expected a file of its own")
        with Store(self.folder) as index:  # its tables come first
            if not index.make():
                raise _later_or_held(path)
        engine = plain_engine(path)
        with answering():
            known = inspect(engine).has_table("alembic_version")
        migrate(engine)
        with answering(), engine.begin() as db:  # gone where the index was made anew
            db.exec_driver_sql("CREATE INDEX IF NOT EXISTS run_at ON run (at_us, outcome)")
        before = self._join_trail(engine)
        if not known and (before or suspect):
            self.losses += 1
            self.lost = (
                f"{path}: the database was damaged or removed, and is made anew from the folder: "
                "people and tokens have to be entered anew"
            )
        self._since_us = {}

    @contextmanager
    def writing(self) -> Iterator[Connection]:
        """One transaction. Raises DatabaseError."""
        with answering(), self.engine.begin() as db:
            yield db

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """Raises DatabaseError."""
        with answering(), self.engine.connect().execution_options(reading=True) as db:
            yield db

    @contextmanager
    def _taking_alone(self) -> Iterator[Connection]:
        """One transaction, beside which no other process takes runs of this station."""
        with self.writing() as db:
            if not self._sqlite:
                db.execute(select(func.pg_advisory_xact_lock(LOCK, func.hashtext(self.home))))
            yield db

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Keep other services off the station of this name in a shared database: each
        would remove the runs of the other, whose folder it does not see. A file has its
        folder's lock. Raises StationError if there is one, DatabaseError."""
        if self._sqlite:
            yield
            return
        with answering():
            db = self.engine.connect().execution_options(isolation_level="AUTOCOMMIT")
        try:
            with answering():
                db.detach()  # closed at the end, and the lock with it
                for name, value in KEEPALIVE.items():  # of a computer that lost its power
                    db.exec_driver_sql(f"SET {name} = {value}")
                free = db.execute(select(func.pg_try_advisory_lock(SERVICE_LOCK, func.hashtext(self.home)))).scalar()
            if not free:
                raise StationError(
                    f"--database: another service works for a station named {self.station}; give one another name"
                )
            yield
        finally:
            with suppress(SQLAlchemyError):
                db.close()

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
            if self._sqlite and self._store.in_memory:
                self._store.close()  # the next look tries the file again
                raise _later_or_held(self.folder / FILE_NAME)
            self.begin_deliveries()
            home = tables.filed.c.home == self.home
            with self.reading() as db:
                found = db.execute(select(tables.filed.c.outcome, tables.filed.c.outcome_sha256).where(home))
                filed = {str(row.outcome): str(row.outcome_sha256) for row in found}
            gone = [outcome for outcome in filed if outcome not in there]
            due = [outcome for outcome, digest in there.items() if filed.get(outcome) != digest]
            for start in range(0, len(gone), BATCH):
                with self._taking_alone() as db:
                    self._forget(db, gone[start : start + BATCH])
            new: list[str] = []
            for start in range(0, len(due), BATCH):
                rows = self._store.rows(due[start : start + BATCH])
                with self._taking_alone() as db:
                    self._enter(db, sorted(rows, key=lambda row: (row["ended_us"], row["outcome"])))
                new += [str(row["run"]) for row in rows if row["outcome"] not in filed and row["run"] is not None]
            return new

    def _enter(self, db: Connection, rows: Sequence[Mapping[str, Any]]) -> None:
        """Make the rows of these outcomes anew, with what is to be delivered."""
        self._forget(db, [row["outcome"] for row in rows])
        if not self._sqlite:
            db.execute(insert(tables.shared_run), [{"home": self.home, **row} for row in rows])
        if rows:
            db.execute(insert(tables.filed), [self._filed(row) for row in rows])
        measured = [m for row in rows for m in measurements_of(row)]
        if measured:
            db.execute(insert(tables.measurement), [{"home": self.home, **m} for m in measured])
        self._count_units(db, {self._filed(row)["plain_serial"] for row in rows})
        self._send(db, rows)

    def _send(self, db: Connection, rows: Sequence[Mapping[str, Any]]) -> None:
        """Have the runs delivered that no receiver has got."""
        if set(self._since_us) != set(self._receivers):
            raise DatabaseError("the database was made anew meanwhile")  # the next look enters them
        out = tables.outbox
        here = and_(out.c.home == self.home, out.c.run.in_([row["run"] for row in rows]))
        sent = {(row.receiver, row.run) for row in db.execute(select(out.c.receiver, out.c.run).where(here))}
        added_us = time.time_ns() // 1000
        for row in rows:
            for receiver, since_us in self._since_us.items():
                if row["run"] is None or row["ended_us"] < since_us or (receiver, row["run"]) in sent:
                    continue
                sent.add((receiver, row["run"]))  # the folder may hold a copy of the outcome
                made = {"receiver": receiver, "run": row["run"], "outcome": row["outcome"], "added_us": added_us}
                db.execute(insert(out).values(home=self.home, state=WAITING, tries=0, **made))

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
        reported = row["serial"]
        serial = reported if row["work_serial"] is None else row["work_serial"]
        return {
            "home": self.home,
            **{key: row[key] for key in ("outcome", "outcome_sha256", "run", "at_us", "ended_us", "verdict", "code")},
            "serial": serial,
            "plain_serial": None if serial is None else plain_serial(serial),
            "plain_reported": None if reported is None else plain_serial(reported),
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

    def begin_deliveries(self) -> None:
        """Note from when on each receiver gets results: since it was first named. What
        ended in the same second counts, as a killed service may have left it. The trail
        has it too, and so it outlives the database. Raises DatabaseError."""
        if set(self._since_us) == set(self._receivers):
            return
        found: dict[str, int] = {}
        for receiver in self._receivers:
            key = RECEIVER + receiver
            since_us = self.setting(key)
            if since_us is None and (since_us := self._first_named(receiver)) is None:
                since_us = time.time_ns() // 1_000_000_000 * 1_000_000
                what = {"receiver": receiver, "since_us": since_us}
                self.trail(iso_time(time.time_ns()), None, None, NAMED, what, True, None)
            self.put_setting(key, since_us)
            found[receiver] = int(since_us)
        self._since_us = found

    def _first_named(self, receiver: str) -> int | None:
        """As the trail has it."""
        trail = tables.trail
        query = select(trail.c.what).where(trail.c.action == NAMED, trail.c.station == self.station)
        with self.reading() as db:
            told = [json.loads(what) for what in db.execute(query.order_by(trail.c.id)).scalars()]
        return next((w["since_us"] for w in told if w["receiver"] == receiver), None)

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
        return self._documents(rows[:limit]), following

    def every(self, wanted: RunFilter) -> list[dict[str, Any]]:
        """All these runs, in the order of time."""
        run = self.run
        query = self._wanted(select(run), wanted).order_by(run.c.at_us, run.c.outcome)
        with self.reading() as db:
            rows = db.execute(query).mappings().all()
        return self._documents(rows)

    def run_of(self, run_id: str) -> dict[str, Any] | None:
        """The run of that id."""
        with self.reading() as db:
            filed = tables.filed
            of_run = select(filed.c.outcome).where(filed.c.home == self.home, filed.c.run == run_id)
            query = self._here(select(self.run)).where(self.run.c.outcome.in_(of_run)).order_by(self.run.c.outcome)
            rows = db.execute(query.limit(1)).mappings().all()
        return next(iter(self._documents(rows)), None)

    def _documents(self, rows: Sequence[Mapping[Any, Any]]) -> list[dict[str, Any]]:
        """Runs with the columns of `results`; files that are not in the folder are not
        named."""
        if len(rows) > LOOK_MOST:
            with suppress(OSError):
                names = frozenset(os.listdir(self.folder))
                return [_document(row, names.__contains__) for row in rows]
        return [_document(row, lambda name: os.path.lexists(self.folder / name)) for row in rows]

    def unit(self, serial: str) -> list[dict[str, Any]]:
        """All runs of a unit, in the order of time."""
        return self.every(RunFilter(serial=serial))

    def golden(self, serial: str, slots: Sequence[str], until_us: int) -> dict[str, LastCheck]:
        """The last verification of the golden unit ``serial`` in each of these slots,
        as far as there is one. Runs without a verdict and calibrations are none, nor is
        one that passed after ``until_us``, by a clock that was wrong."""
        run, filed = self.run, tables.filed
        of_unit = select(filed.c.outcome).where(filed.c.home == self.home, filed.c.plain_serial == plain_serial(serial))
        query = self._here(select(run.c.ended_us, run.c.verdict)).where(
            run.c.outcome.in_(of_unit),
            run.c.verdict.in_([Verdict.PASS.value, Verdict.FAIL.value]),
            run.c.verification_rms_g.is_not(None),
            run.c.rms_g.is_(None),
            or_(run.c.ended_us <= until_us, run.c.verdict == Verdict.FAIL.value),
        )
        query = query.order_by(run.c.ended_us.desc(), run.c.outcome.desc()).limit(1)
        found = {}
        with self.reading() as db:
            for slot in slots:
                if (row := db.execute(query.where(run.c.slot == slot)).first()) is not None:
                    found[slot] = LastCheck(int(row.ended_us), row.verdict == Verdict.PASS)
        return found

    def measurements_of(self, run_id: str) -> list[dict[str, Any]]:
        """The figures of a run."""
        made = tables.measurement
        query = select(made).where(made.c.home == self.home, made.c.run == run_id).order_by(made.c.outcome.desc())
        keys = ("name", "value", "unit", "low", "high", "passed")
        with self.reading() as db:
            # The folder may hold a copy of the outcome.
            found = {row["name"]: {key: row[key] for key in keys} for row in db.execute(query).mappings()}
        return [found[name] for name in MEASUREMENTS if name in found]

    def _wanted(self, query: Select[Any], wanted: RunFilter) -> Select[Any]:
        run, filed = self.run, tables.filed
        query = self._here(query).where(*wanted.conditions(run))
        if wanted.serial is not None:
            plain = plain_serial(wanted.serial)
            of_unit = select(filed.c.outcome).where(
                filed.c.home == self.home, or_(filed.c.plain_serial == plain, filed.c.plain_reported == plain)
            )
            query = query.where(run.c.outcome.in_(of_unit))
        return query

    def _here(self, query: Select[Any]) -> Select[Any]:
        """Of this station alone."""
        return query if self._sqlite else query.where(tables.shared_run.c.home == self.home)

    def in_order(self, wanted: RunFilter, size: int) -> Iterator[list[dict[str, Any]]]:
        """All these runs in the order of time, ``size`` of them at a time, each batch
        read when it is asked for."""
        run = self.run
        query = self._wanted(select(run), wanted).order_by(run.c.at_us, run.c.outcome).limit(size)
        last: Mapping[Any, Any] | None = None
        while True:
            following = query
            if last is not None:
                later = and_(run.c.at_us == last["at_us"], run.c.outcome > last["outcome"])
                following = query.where(or_(run.c.at_us > last["at_us"], later))
            with self.reading() as db:
                rows = db.execute(following).mappings().all()
            if rows:
                yield self._documents(rows)
            if len(rows) < size:
                return
            last = rows[-1]

    def columns(self, wanted: RunFilter, names: Sequence[str]) -> list[dict[str, Any]]:
        """These columns of all these runs, in the order of time; `tables.local_run` has
        their names. Files may be named that are not in the folder."""
        run = self.run
        query = self._wanted(select(*(run.c[name] for name in names)), wanted).order_by(run.c.at_us, run.c.outcome)
        with self.reading() as db:
            return [dict(zip(names, row, strict=True)) for row in db.execute(query)]

    def first_judged(self) -> dict[tuple[str, str | None], int]:
        """Time of the first attempt at each unit that passed or failed [µs since 1970],
        by plain serial number and part number."""
        run, filed = self.run, tables.filed
        unit = (filed.c.plain_serial, run.c.part_number)
        query = self._here(select(*unit, func.min(filed.c.at_us))).where(
            filed.c.home == self.home, filed.c.outcome == run.c.outcome, filed.c.plain_serial.is_not(None),
            filed.c.tried, filed.c.verdict.in_((Verdict.PASS.value, Verdict.FAIL.value)),
        )  # fmt: skip
        with self.reading() as db:
            return {(serial, part): int(at_us) for serial, part, at_us in db.execute(query.group_by(*unit))}

    # Events.

    def append(self, events: list[dict[str, Any]]) -> None:
        """Keep these events, which come in the order of their numbers; the last
        `EVENTS_KEPT` stay. One that is kept already may come again. Raises
        DatabaseError."""
        rows = [
            {
                "home": self.home, "seq": event["seq"], "run": event.get("run"),
                "event": json.dumps(event, allow_nan=False),
            }
            for event in events
        ]  # fmt: skip
        if not rows:
            return
        event = tables.event
        there = select(event.c.seq, event.c.event).where(
            event.c.home == self.home, event.c.seq.between(rows[0]["seq"], rows[-1]["seq"])
        )
        with self.writing() as db:
            kept = {(row.seq, row.event) for row in db.execute(there)}
            if new := [row for row in rows if (row["seq"], row["event"]) not in kept]:
                db.execute(insert(event), new)
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
        text = json.dumps(value)
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
            "uid": uuid.uuid4().hex, "time": time, "station": self.station, "who": who, "role": role, "action": action,
            "what": json.dumps(what), "ok": ok, "code": code,
        }  # fmt: skip
        with self._trailing, self.writing() as db:
            db.execute(insert(tables.trail).values(row))
            self._append_line({**row, "what": what})

    def _append_line(self, line: Mapping[str, Any]) -> None:
        """Raises DatabaseError: the row is then taken back."""
        data = (json.dumps(line) + "\n").encode()
        try:
            descriptor = os.open(self.folder / TRAIL, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o640)
            try:
                size = os.fstat(descriptor).st_size
                if size and os.pread(descriptor, 1, size - 1) != b"\n":
                    data = b"\n" + data  # the last line was cut short
                if os.write(descriptor, data) < len(data):
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
        except OSError as e:
            raise DatabaseError(f"{self.folder / TRAIL}: {e.strerror}") from e

    def _join_trail(self, engine: Engine) -> bool:
        """Enter lines of `trail.jsonl` that have no row: all of them in a new file,
        else the last ones, as after a kill. Gives whether there are lines. Raises
        DatabaseError."""
        trail = tables.trail
        with answering(), engine.begin() as db:
            empty = db.execute(select(trail.c.id).where(trail.c.station == self.station).limit(1)).first() is None
            try:
                lines = _last_lines(self.folder / TRAIL, None if empty else TAIL)
            except FileNotFoundError:
                return False
            except OSError as e:
                raise DatabaseError(f"{self.folder / TRAIL}: {e.strerror}") from e
            held: dict[str, dict[str, Any]] = {}
            for line in lines:
                with suppress(ValueError, KeyError, TypeError):  # a line that was cut short
                    told = json.loads(line)
                    row = {c.name: told[c.name] for c in trail.c if c.name not in ("id", "what")}
                    held[told["uid"]] = {**row, "what": json.dumps(told["what"])}
            uids = list(held)
            for start in range(0, len(uids), BATCH):
                batch = uids[start : start + BATCH]
                there = set(db.execute(select(trail.c.uid).where(trail.c.uid.in_(batch))).scalars())
                if missing := [held[uid] for uid in batch if uid not in there]:
                    db.execute(insert(trail), missing)
        return bool(lines)

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

    def body_of(self, waiting: Waiting) -> str | None:
        """What was sent, or nearly, when the result was first tried."""
        query = select(tables.sending.c.body).where(tables.sending.c.id == waiting.id)
        with self.reading() as db:
            body: str | None = db.execute(query).scalar()
        return body

    def keep_body(self, waiting: Waiting, body: str) -> None:
        """Before the first try: each later one sends the same."""
        with self.writing() as db:
            db.execute(insert(tables.sending).values(id=waiting.id, body=body))

    def has_delivered(self, receiver: str) -> bool:
        """Whether a result ever reached the receiver."""
        out = tables.outbox
        here = and_(out.c.home == self.home, out.c.receiver == receiver, out.c.state == DELIVERED)
        with self.reading() as db:
            return db.execute(select(out.c.id).where(here).limit(1)).first() is not None

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
            if "state" in values:
                db.execute(delete(tables.sending).where(tables.sending.c.id == waiting.id))

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


def _document(row: Mapping[Any, Any], exists: Callable[[str], bool]) -> dict[str, Any]:
    """A run with the columns of `results`."""
    found = {name: json.loads(row[name]) if name in _TEXTS and row[name] is not None else row[name] for name in NAMES}
    for name in BESIDE:
        if found[name] is not None and not exists(found[name]):
            found[name] = None
    return found


def _receivers(station: Station) -> tuple[str, ...]:
    return tuple(receiver.name for receiver in station.file.deliver)


def _last_lines(path: Path, size: int | None) -> list[bytes]:
    """The whole lines within the last ``size`` bytes of a file. Raises OSError."""
    with path.open("rb") as file:
        start = 0 if size is None else max(0, file.seek(0, os.SEEK_END) - size)
        file.seek(start)
        lines = file.read().splitlines()
    return lines[1:] if start else lines


def _later_or_held(path: Path) -> InputError | DatabaseError:
    """Why there is no file of the index."""
    with suppress(sqlite3.Error), closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as db:
        if db.execute("PRAGMA user_version").fetchone()[0] > VERSION:
            return InputError(f"{path}: of a later version of triaxcal")
    return DatabaseError(f"{path}: the file cannot be written, or another process holds it")


def _cursor(row: Mapping[Any, Any]) -> str:
    return base64.urlsafe_b64encode(f"{row['at_us']}:{row['outcome']}".encode()).decode()


def _place(cursor: str) -> tuple[int, str]:
    try:
        at_us, _, outcome = base64.urlsafe_b64decode(cursor.encode()).decode().partition(":")
        if not outcome.endswith(SUFFIX) or not -AT_MOST_US <= int(at_us) <= AT_MOST_US:
            raise ValueError
        return int(at_us), outcome
    except (ValueError, binascii.Error) as e:
        raise InputError("after: no cursor of this list") from e
