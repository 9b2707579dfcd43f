"""The file `triaxcal.sqlite`: its tables, their versions, and what happens where it is
damaged or cannot be written."""

from __future__ import annotations

import os
import sqlite3
import stat
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Final, TypeVar

from triaxcald.files import unused
from triaxcald.schema.columns import COLUMNS, Kind
from triaxcald.work import plain_serial

FILE_NAME: Final = "triaxcal.sqlite"
DAMAGED: Final = ".damaged"
"""Behind the name of a file that is damaged, or of another program."""
TABLES: Final = ("file", "run")
"""What the index has in the file. A service has further tables in it."""
BUSY_S = 5.0
"""Longest wait for another process. It holds the file for one batch at a time."""
TIMES: Final = ("at_us", "ended_us", "tried")
"""Columns that only the index has: start (else end) and end in µs since 1970, and
whether it was an attempt at the unit."""
OWN: Final = (*TIMES, "crc")
"""With a check sum of all cells before it."""

T = TypeVar("T")
_SQL = {Kind.TEXT: "TEXT", Kind.TEXTS: "TEXT", Kind.WHOLE: "INTEGER", Kind.NUMBER: "REAL"}


def _outcome_tables() -> tuple[str, ...]:
    """What is made from the outcomes. A migration that changes it drops both tables:
    the next look at the folder fills them."""
    columns = ", ".join(f'"{c.name}" {_SQL[c.kind]}{" NOT NULL" if c.required else ""}' for c in COLUMNS)
    own = ", ".join(f"{name} INTEGER NOT NULL" for name in OWN)
    return (
        # Every file of that name; one without a row in `run` is no outcome.
        "CREATE TABLE file (name TEXT PRIMARY KEY, size INTEGER NOT NULL, modified_ns INTEGER NOT NULL, "
        "settled INTEGER NOT NULL)",
        f"CREATE TABLE run ({columns}, {own}, PRIMARY KEY (outcome))",
        "CREATE INDEX run_serial ON run (serial)",
        "CREATE INDEX run_work_serial ON run (work_serial)",
    )


MIGRATIONS: Sequence[tuple[str, ...]] = (_outcome_tables(),)
"""Statements that bring the file from each version to the next. The version of a
file is `PRAGMA user_version`, the number of those that it has had."""
VERSION: Final = len(MIGRATIONS)
_UNAVAILABLE = frozenset(
    (
        sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED, sqlite3.SQLITE_READONLY, sqlite3.SQLITE_IOERR,
        sqlite3.SQLITE_FULL, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_PERM, sqlite3.SQLITE_PROTOCOL,
        sqlite3.SQLITE_NOLFS,
    )
)  # fmt: skip
"""Errors of the disk or of access. Any other is one of the contents: damage."""


class _NotOurs(Exception):
    """There is no file that may be used."""


class Database:
    """The database of a folder. A damaged file is set aside and made anew; of one that
    is sound and has the tables of a service, the tables of the index alone are made
    anew. Where there can be no file (a disk that is full or read-only, a file of a
    later version, another process that holds it) it is in memory until `close`."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / FILE_NAME
        self._db: sqlite3.Connection | None = None
        self._inode: int | None = None
        self._in_memory = False

    @property
    def in_memory(self) -> bool:
        return self._in_memory

    @property
    def exists(self) -> bool:
        return self._db is not None or os.path.lexists(self.path)

    def close(self) -> None:
        if self._db is not None:
            self._db.close()
        self._db, self._in_memory = None, False

    def on(self, work: Callable[[sqlite3.Connection], T]) -> T:
        """What ``work`` gives. It is called again from its beginning where the database
        had to be made anew."""
        replaced = emptied = False
        while True:
            try:
                self._leave_what_was_removed()
                if self._db is None:
                    self._open()
                assert self._db is not None
                return work(self._db)
            except (sqlite3.Error, UnicodeDecodeError, _NotOurs) as e:
                if self._in_memory:
                    raise
                before, self._db = self._db, None
                if isinstance(e, _NotOurs) or _code(e) in _UNAVAILABLE:
                    self._use_memory(before)
                    continue
                if before is not None:
                    before.close()
                if not emptied and self._empty():
                    emptied = True
                    continue
                if emptied or replaced or not self._set_aside():
                    self._use_memory(None)
                replaced = True

    def _open(self) -> None:
        """Raises sqlite3.Error, _NotOurs."""
        try:
            status = os.lstat(self.path)
        except FileNotFoundError:
            status = None
        except OSError as e:
            raise _NotOurs from e
        if status is not None and not stat.S_ISREG(status.st_mode):
            raise _NotOurs  # a link would have someone else choose the file
        self._inode = None if status is None else status.st_ino
        db = _connected(self.path)
        try:
            _prepare(db)
        except BaseException:
            db.close()
            raise
        self._db, self._inode = db, self._present_inode()

    def _present_inode(self) -> int | None:
        try:
            return os.lstat(self.path).st_ino
        except OSError:
            return None

    def _leave_what_was_removed(self) -> None:
        """Close a file that was deleted or set aside while it was open."""
        if self._db is not None and not self._in_memory and self._present_inode() != self._inode:
            self._db.close()
            self._db = None

    def _set_aside(self) -> bool:
        """Rename the damaged file, unless another process has done so; its journal
        first, which SQLite would apply to the next file of that name. False where that
        cannot be done."""
        if self._inode is None or self._present_inode() != self._inode:
            return True
        aside = unused(self.path.with_name(FILE_NAME + DAMAGED))
        try:
            for end in ("-journal", "-wal", "-shm", ""):
                with suppress(FileNotFoundError):
                    os.replace(f"{self.path}{end}", f"{aside}{end}")
        except OSError:
            return False
        return True

    def _empty(self) -> bool:
        """Make the tables of the outcomes anew in a sound file that also holds those of
        a service. False where that cannot be done."""
        try:
            with closing(_connected(self.path)) as db:
                if self._present_inode() is None or not has_service(db):
                    return False
                if db.execute("PRAGMA integrity_check(1)").fetchone()[0] != "ok":
                    return False
                with transaction(db):
                    for table in TABLES:
                        db.execute(f"DROP TABLE IF EXISTS {table}")
                    for statement in _outcome_tables():
                        db.execute(statement)
                    db.execute(f"PRAGMA user_version = {len(MIGRATIONS)}")
                return True
        except (sqlite3.Error, UnicodeDecodeError):
            return False

    def _use_memory(self, before: sqlite3.Connection | None) -> None:
        """In memory, with what is in the tables ``before`` as far as it can be read."""
        db = _connected(":memory:")
        _prepare(db)
        if before is not None:
            with suppress(sqlite3.Error, UnicodeDecodeError), transaction(db):
                for table in TABLES:
                    rows = before.execute(f"SELECT * FROM {table}")
                    db.executemany(f"INSERT INTO {table} VALUES ({', '.join('?' * len(rows.description))})", rows)
            before.close()
        self._db, self._in_memory = db, True


@contextmanager
def transaction(db: sqlite3.Connection) -> Iterator[None]:
    """Begins with the right to write, for which two processes cannot wait at once."""
    db.execute("BEGIN IMMEDIATE")
    try:
        yield
        db.execute("COMMIT")
    except BaseException:
        if db.in_transaction:
            with suppress(sqlite3.Error):
                db.execute("ROLLBACK")
        raise


def has_service(db: sqlite3.Connection) -> bool:
    """Whether a service has tables in the file."""
    query = "SELECT count(*) FROM sqlite_master WHERE name = 'alembic_version'"
    return bool(db.execute(query).fetchone()[0])


def _connected(path: Path | str) -> sqlite3.Connection:
    db = sqlite3.connect(path, timeout=BUSY_S, isolation_level=None, check_same_thread=False)
    db.create_function("plain", 1, lambda serial: None if serial is None else plain_serial(str(serial)))
    return db


def _prepare(db: sqlite3.Connection) -> None:
    """Bring the tables to the present version. Raises sqlite3.Error, _NotOurs for the
    file of a later version."""
    version = _version(db)
    if version > len(MIGRATIONS):
        raise _NotOurs
    if version and (told := db.execute("PRAGMA integrity_check(1)").fetchone()[0]) != "ok":
        raise sqlite3.DatabaseError(told)
    if version == len(MIGRATIONS):
        return
    with transaction(db):
        version = _version(db)  # another process may have been faster
        if version == 0 and db.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]:
            raise sqlite3.DatabaseError("tables of another program")
        for statements in MIGRATIONS[version:]:
            for statement in statements:
                db.execute(statement)
        db.execute(f"PRAGMA user_version = {len(MIGRATIONS)}")


def _version(db: sqlite3.Connection) -> int:
    return int(db.execute("PRAGMA user_version").fetchone()[0])


def _code(e: Exception) -> int:
    """The primary code of SQLite; -1 of an error that Python found, as in a text that
    is no UTF-8."""
    code: int = getattr(e, "sqlite_errorcode", -1)
    return code if code < 0 else code & 0xFF
