"""The table `run` of a folder, and what is asked of it."""

from __future__ import annotations

import json
import marshal
import os
import sqlite3
import stat
import threading
import time
import zlib
from collections.abc import Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import triaxcal_drivers as td
from triaxcald.inputs import DOCUMENT_MOST
from triaxcald.outcome import SUFFIX
from triaxcald.schema.codes import Verdict
from triaxcald.schema.columns import COLUMNS, NAMES, Kind
from triaxcald.store.database import BUSY_S, OWN, TIMES, Database, check, has_service, transaction
from triaxcald.store.rows import BESIDE, Cell, NoOutcome, cells_of

BATCH = 500
"""Outcomes in one transaction: what an interruption loses, and others wait for."""
SETTLED_NS = 2_000_000_000
"""A file that was changed so lately may change again within one tick of the file
system's clock, and look the same: it is read again."""

Cells = tuple[Cell, ...]


class _File(NamedTuple):
    """By which an outcome is known to be as it was."""

    size: int
    modified_ns: int


def _file(entry: os.DirEntry[str]) -> _File | None:
    """None of what is no file: a folder, a pipe, a link to nothing; and of a name that
    is no text, which no table can hold."""
    try:
        entry.name.encode()
        status = entry.stat()
    except (OSError, UnicodeEncodeError):
        return None
    return _File(status.st_size, status.st_mtime_ns) if stat.S_ISREG(status.st_mode) else None


@dataclass(frozen=True)
class Runs:
    """``rows`` have the cells of `NAMES`. ``skipped`` are names of files that are no
    outcome, or cannot be read."""

    rows: list[Cells]
    skipped: list[str]

    def documents(self) -> Iterator[dict[str, Any]]:
        """One object a row, lists as lists."""
        for row in self.rows:
            yield {
                c.name: json.loads(str(cell)) if c.kind is Kind.TEXTS and cell is not None else cell
                for c, cell in zip(COLUMNS, row, strict=True)
            }


class Store:
    """The index of one folder. Any thread may call; one call waits for another. Each
    answer is of the folder as it is at the call."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._lock = threading.RLock()
        self._database = Database(folder)
        self._names: frozenset[str] = frozenset()
        self._unread: list[str] = []

    def __enter__(self) -> Store:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        with self._lock:
            self._database.close()

    # Questions.

    def latest(self, serial: str | None) -> str | None:
        """The SHA-256 of a unit's outcome that ended last; None where there is none."""
        found = self._ask(f"SELECT outcome_sha256 FROM run WHERE plain(serial) = plain(:serial) {_LAST}", serial)
        return str(found[0]) if found else None

    def attempts(self, serial: str | None) -> int:
        """The number of attempts at a unit so far, by the expected serial number, else
        by the reported one. It does not fall where early outcomes were moved away."""
        found = self._ask(
            f"SELECT count(DISTINCT coalesce(run, outcome)), coalesce(max(attempt), 0) FROM run WHERE {_TRIED}",
            serial,
        )
        return max(int(cell or 0) for cell in found) if found else 0

    def has_passed(self, serial: str | None) -> bool:
        """Whether an attempt at a unit has passed."""
        found = self._ask(f"SELECT count(*) FROM run WHERE {_TRIED} AND verdict = '{Verdict.PASS}'", serial)
        return bool(found and found[0])

    def runs(
        self,
        *,
        since_us: int | None = None,
        until_us: int | None = None,
        serial: str | None = None,
        code: str | None = None,
    ) -> Runs:
        """Runs that began (ended, where there is no start) from ``since_us`` on and
        before ``until_us`` [µs since 1970], of this reported or expected serial number,
        with this code; in the order of time. Raises OSError where the folder cannot be
        read."""
        given = {
            "at_us >= ?": since_us, "at_us < ?": until_us,
            "plain(?) IN (plain(serial), plain(work_serial))": serial, "code = ?": code,
        }  # fmt: skip
        wanted = {condition: value for condition, value in given.items() if value is not None}
        where = f" WHERE {' AND '.join(wanted)}" if wanted else ""
        query = f"SELECT * FROM run{where} ORDER BY at_us, outcome"

        def work(db: sqlite3.Connection) -> Runs:
            self._refresh(db)
            # All at once: a reader that waits for a pager would keep writers out.
            rows = db.execute(query, tuple(wanted.values())).fetchall()
            for i, row in enumerate(rows):
                rows[i] = self._present(row)
            left_out = db.execute("SELECT name FROM file WHERE name NOT IN (SELECT outcome FROM run)")
            return Runs(rows, sorted([*(str(name) for (name,) in left_out), *self._unread]))

        with self._lock:
            if not self._database.exists and not self._listing():
                return Runs([], [])  # no index in a folder without an outcome
            return self._database.on(work)

    def timed(self, *, since_us: int | None = None, until_us: int | None = None) -> Runs:
        """As `runs`; the rows have the cells of `TIMES` too, and files are named
        whether they are in the folder or not."""

        def work(db: sqlite3.Connection) -> Runs:
            self._refresh(db)
            left_out = db.execute("SELECT name FROM file WHERE name NOT IN (SELECT outcome FROM run)")
            return Runs(_timed(db, since_us, until_us), sorted([*(str(name) for (name,) in left_out), *self._unread]))

        with self._lock:
            if not self._database.exists and not self._listing():
                return Runs([], [])
            return self._database.on(work)

    def digests(self) -> dict[str, str]:
        """SHA-256 of each outcome in the folder, by its name, in the order of their
        ends. Raises OSError where the folder cannot be read."""

        def work(db: sqlite3.Connection) -> dict[str, str]:
            self._refresh(db)
            return dict(db.execute("SELECT outcome, outcome_sha256 FROM run ORDER BY ended_us, outcome"))

        with self._lock:
            return self._database.on(work)

    def rows(self, outcomes: Sequence[str]) -> list[dict[str, Cell]]:
        """The rows of these outcomes as they were last read, with the times of the
        index. Files are named whether they are in the folder or not."""

        def work(db: sqlite3.Connection) -> list[dict[str, Cell]]:
            marks = ", ".join("?" * len(outcomes))
            found = db.execute(f"SELECT * FROM run WHERE outcome IN ({marks})", tuple(outcomes)).fetchall()
            return [dict(zip((*NAMES, *TIMES), _checked(row), strict=True)) for row in found]

        with self._lock:
            return self._database.on(work)

    def make(self) -> bool:
        """Make the file of the index, also in a folder without an outcome, and check
        the whole of it. False where there can be none, and the index is in memory."""
        with self._lock:
            self._database.on(check)
            return not self._database.in_memory

    def has_service(self) -> bool:
        """Whether the file also has the tables of a service."""
        with self._lock:
            return self._database.exists and self._database.on(has_service)

    @property
    def in_memory(self) -> bool:
        """Whether there could be no file. The next call after `close` tries again."""
        return self._database.in_memory

    def forget(self) -> None:
        """Forget all outcomes: the next look at the folder reads them anew."""

        def work(db: sqlite3.Connection) -> None:
            with transaction(db):
                db.execute("DELETE FROM file")
                db.execute("DELETE FROM run")

        with self._lock:
            if self._database.exists:
                self._database.on(work)

    def _present(self, row: Cells) -> Cells:
        """The cells of `NAMES`, without names of files that are not in the folder.
        Raises sqlite3.DatabaseError where a cell is not as it was written."""
        held = _checked(row)
        for i in _BESIDE:
            if held[i] not in self._names:
                held[i] = None
        return tuple(held[: len(NAMES)])

    def _ask(self, query: str, serial: str | None) -> Cells | None:
        """The first row of the answer about a serial number, by what is known where the
        folder may not be listed."""

        def work(db: sqlite3.Connection) -> Cells | None:
            with suppress(OSError):
                self._refresh(db)
            found: Cells | None = db.execute(query, {"serial": serial}).fetchone()
            return found

        with self._lock, suppress(OSError):
            if serial is not None and (self._database.exists or self._listing()):
                return self._database.on(work)
        return None

    # Keeping up with the folder.

    def _refresh(self, db: sqlite3.Connection) -> None:
        """Bring the table up to date: only files that are new or changed are read.
        Raises OSError where the folder cannot be listed."""
        # The index is read before the folder, so that an outcome that another process
        # adds meanwhile does not pass for one that is gone.
        known = {
            str(name): (_File(size, modified_ns), settled)
            for name, size, modified_ns, settled in db.execute("SELECT name, size, modified_ns, settled FROM file")
        }
        found = self._listing()
        if gone := [(name, *file) for name, (file, _) in known.items() if name not in found]:
            with transaction(db):
                for name, *file in gone:
                    if db.execute(f"{_FORGET} AND size = ? AND modified_ns = ?", (name, *file)).rowcount:
                        db.execute("DELETE FROM run WHERE outcome = ?", (name,))
        due = [name for name, file in found.items() if known.get(name) != (file, 1)]
        for start in range(0, len(due), BATCH):
            self._take(db, {name: found[name] for name in due[start : start + BATCH]})

    def _take(self, db: sqlite3.Connection, files: dict[str, _File]) -> None:
        """Read these outcomes and put their rows in place of the old ones."""
        rows: dict[str, Cells | None] = {}
        read_ns = time.time_ns()
        for name in files:
            try:
                rows[name] = self._row(name)
            except OSError:
                if os.path.lexists(self.folder / name):  # else it is gone meanwhile
                    self._unread.append(name)
        stamps = [(name, *files[name], int(abs(read_ns - files[name].modified_ns) > SETTLED_NS)) for name in rows]
        with transaction(db):
            for name in files:
                if db.execute(_FORGET, (name,)).rowcount:
                    db.execute("DELETE FROM run WHERE outcome = ?", (name,))
            db.executemany("INSERT INTO file VALUES (?, ?, ?, ?)", stamps)
            db.executemany(_INSERT, [row for row in rows.values() if row is not None])

    def _listing(self) -> dict[str, _File]:
        """The outcomes in the folder, by name; none where there is no folder. Raises
        OSError."""
        found: dict[str, _File] = {}
        beside, unread = [], []
        ends = tuple(BESIDE.values())
        try:
            with os.scandir(self.folder) as entries:
                for entry in entries:
                    if entry.name.endswith(ends):
                        beside.append(entry.name)
                    elif entry.name.endswith(SUFFIX):
                        if (file := _file(entry)) is None:
                            unread.append(entry.name)
                        else:
                            found[entry.name] = file
        except FileNotFoundError:
            return {}
        self._names, self._unread = frozenset(beside), unread
        return found

    def _row(self, name: str) -> Cells | None:
        """None of what is no outcome. Raises OSError."""
        try:
            cells = cells_of(td.files.read_whole(self.folder / name, DOCUMENT_MOST), name)
        except (NoOutcome, td.files.TooLarge):
            return None
        row = [cells[column] for column in (*NAMES, *TIMES)]
        return (*row, _check(row))


def timed_in(path: Path, *, since_us: int | None = None, until_us: int | None = None) -> list[Cells]:
    """The rows of a file `triaxcal.sqlite` as it is, without a look at its folder, with
    the cells of `NAMES` and `TIMES`. Raises sqlite3.Error for a file that is none, of
    another version, or damaged."""
    with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True, timeout=BUSY_S)) as db:
        return _timed(db, since_us, until_us)


def _timed(db: sqlite3.Connection, since_us: int | None, until_us: int | None) -> list[Cells]:
    given = {"at_us >= ?": since_us, "at_us < ?": until_us}
    wanted = {condition: value for condition, value in given.items() if value is not None}
    where = f" WHERE {' AND '.join(wanted)}" if wanted else ""
    columns = ", ".join(f'"{name}"' for name in (*NAMES, *OWN))
    rows = db.execute(f"SELECT {columns} FROM run{where} ORDER BY at_us, outcome", tuple(wanted.values())).fetchall()
    return [tuple(_checked(row)) for row in rows]


def _checked(row: Cells) -> list[Cell]:
    """The cells without their check sum. Raises sqlite3.DatabaseError where one is not
    as it was written."""
    *held, check = row
    if check != _check(held):
        raise sqlite3.DatabaseError("a row was changed")
    return held


def _check(cells: Sequence[Cell]) -> int:
    """SQLite itself does not see that a byte within a cell has changed."""
    return zlib.crc32(marshal.dumps(tuple(cells), 2))  # a version without references: the same bytes each time


_BESIDE = tuple(NAMES.index(column) for column in BESIDE)
_FORGET = "DELETE FROM file WHERE name = ?"
_INSERT = f"INSERT INTO run VALUES ({', '.join('?' * (len(NAMES) + len(OWN)))})"
_TRIED = "tried AND plain(coalesce(work_serial, serial)) = plain(:serial)"
_LAST = "ORDER BY ended_us DESC, outcome DESC LIMIT 1"


@dataclass(frozen=True)
class History:
    """Earlier attempts at a unit in a folder: the digest of the ``latest`` outcome,
    None without one, the number of attempts, and whether one has passed."""

    latest: str | None = None
    attempts: int = 0
    passed: bool = False

    @staticmethod
    def of(folder: Path, serial: str | None) -> History:
        """``serial`` is the number of the unit, or the expected one of a unit that has
        not answered. The index is brought up to date first, which may take seconds."""
        if serial is None:
            return History()
        with Store(folder) as store:
            return History(store.latest(serial), store.attempts(serial), store.has_passed(serial))
