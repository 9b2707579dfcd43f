"""Where results go as they come: a row each, in an SQLite file or, until a CSV or
Parquet file is written at the end, in a journal beside it."""

from __future__ import annotations

import csv
import gzip
import io
import json
import os
import sqlite3
import zlib
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from math import isfinite
from pathlib import Path
from typing import Any, BinaryIO, Final

from triaxcald.errors import DEVICE, DISK, DeviceInUse, DiskError, InputError
from triaxcald.files import new_beside, require_writable, synchronise
from triaxcald.many.sources import Source
from triaxcald.many.work import COMMON_AFTER, COMMON_BEFORE, Column, Row, Settings
from triaxcald.schema.columns import Kind

TABLE_KINDS: Final = (".parquet", ".csv", ".csv.gz", ".sqlite")
FORMAT: Final = "triaxcal.many/1"
JOURNAL: Final = ".journal"
LOCK: Final = ".lock"
_AGAIN: Final = frozenset((DEVICE, DISK))
"""Exit codes of what may come out otherwise another time: a worker that died, memory,
a store or disk that failed."""
_TYPES: Final[Mapping[Kind, type]] = {Kind.TEXT: str, Kind.TEXTS: str, Kind.WHOLE: int, Kind.NUMBER: float}
_SQL: Final = {Kind.TEXT: "TEXT", Kind.TEXTS: "TEXT", Kind.WHOLE: "INTEGER", Kind.NUMBER: "REAL"}


def open_table(path: Path | None, command: str, columns: Sequence[Column[Any]], *, resume: bool) -> Table:
    """A table of the ``command``, or one that keeps nothing where there is no ``path``.
    Raises InputError: another kind of file, an unfinished table without ``resume``;
    DeviceInUse where another process writes it."""
    if path is None:
        if resume:
            raise InputError("--resume: give the table that is to be finished: -o TABLE")
        return _Nowhere(columns)
    if not path.name.endswith(TABLE_KINDS):
        raise InputError(f"{path}: expected a name that ends in {', '.join(TABLE_KINDS)}")
    if not path.parent.is_dir():
        raise InputError(f"{path}: there is no folder {path.parent}")
    require_writable(path)
    if path.is_dir():
        raise InputError(f"{path}: Is a directory, expected the name of a table")
    kind = SqliteTable if path.name.endswith(".sqlite") else FileTable
    return kind(path, command, columns, resume=resume)


def is_current(row: Row, of: Source, settings: Settings) -> bool:
    """Whether the row is of a recording that has not changed since, by the same
    software and settings, and would not come out otherwise another time."""
    if row["exit_code"] in _AGAIN or not (of.stamp or of.size):
        return False
    if row["error"] and not row["sha256"]:  # never read: for lack of a right, a mount or a package
        return False
    now = (of.size, of.stamp, settings.software, settings.digest)
    return now == (row["size"], row["stamp"] or "", row["software"], row["settings"])


class Table(ABC):
    """A context manager. Rows are durable when `store` returns."""

    def __init__(self, columns: Sequence[Column[Any]]) -> None:
        self.columns = columns

    @abstractmethod
    def stored(self, name: str) -> Row | None:
        """The latest row of a recording."""

    @abstractmethod
    def store(self, row: Row) -> None:
        """Raises DiskError."""

    @abstractmethod
    def finish(self, order: Iterable[str], asked: Sequence[str] = ()) -> None:
        """All is done; rows are to be in this order where the table has one. Rows of
        what was ``asked`` for, or lies below it, go if they name no recording and are
        not in the ``order``: the argument has been mended. Raises DiskError."""

    @abstractmethod
    def close(self) -> None: ...

    def __enter__(self) -> Table:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _cells(self, row: Mapping[str, Any]) -> list[Any]:
        return [_plain(row.get(column.name)) for column in self.columns]


def _plain(cell: Any) -> Any:
    """As every kind of table can hold it: names of files may be no text, and figures no
    numbers."""
    if isinstance(cell, str):
        return cell.encode("utf-8", "backslashreplace").decode()
    return None if isinstance(cell, float) and not isfinite(cell) else cell


def _names_none(row: Mapping[str, Any], asked: Sequence[str]) -> bool:
    """Whether the row is an error of an argument, or of a part of one."""
    if not row["error"] or row["sha256"] or row["size"] is not None or row["stamp"]:
        return False
    name = str(row["recording"])
    return any(name == given or name.startswith(f"{given.rstrip('/')}/") for given in asked)


class _Nowhere(Table):
    def stored(self, name: str) -> Row | None:
        return None

    def store(self, row: Row) -> None:
        pass

    def finish(self, order: Iterable[str], asked: Sequence[str] = ()) -> None:
        pass

    def close(self) -> None:
        pass


class FileTable(Table):
    """CSV or Parquet. The journal beside it has a JSON object a line; what a kill
    leaves of a last line is cut off. The table itself is written once, at the end."""

    def __init__(self, path: Path, command: str, columns: Sequence[Column[Any]], *, resume: bool) -> None:
        super().__init__(columns)
        self._path = path
        self._journal_path = path.with_name(path.name + JOURNAL)
        self._head = {"format": FORMAT, "command": command}
        self._is_new = self._has_more = False
        require_writable(self._journal_path)
        self._lock = _Lock(path)
        try:
            self._journal, self._offsets = self._opened(resume)
        except BaseException as e:
            self._lock.release()
            if isinstance(e, OSError):
                raise InputError(f"{self._journal_path}: cannot be written: {e.strerror}") from e
            raise

    def _opened(self, resume: bool) -> tuple[BinaryIO, dict[str, int]]:
        """The journal, and where each recording's latest row begins. Raises InputError,
        OSError."""
        if not self._journal_path.exists():
            return self._begun(resume)
        if not resume:
            raise InputError(
                f"{self._journal_path}: an interrupted run has left it; --resume goes on with it, or delete it"
            )
        file = open(self._journal_path, "r+b")  # noqa: SIM115 - until `close`
        try:
            head = file.readline()
            if not head.endswith(b"\n") and _line(self._head).startswith(head):  # nothing came of it
                file.close()
                return self._begun(resume)
            return file, self._read_journal(file, head)
        except BaseException:
            file.close()
            raise

    def _begun(self, resume: bool) -> tuple[BinaryIO, dict[str, int]]:
        """A new journal, with the rows of the finished table on ``resume``. It is on
        the disk as a whole or not at all."""
        kept = self._rows_of_table(resume)
        offsets = dict[str, int]()
        with new_beside(self._journal_path) as beside, beside.open("wb") as file:
            file.write(_line(self._head))
            for row in kept:
                offsets[str(row["recording"])] = file.tell()
                file.write(_line(row))
        self._is_new = True
        return open(self._journal_path, "r+b"), offsets

    def _read_journal(self, file: BinaryIO, head: bytes) -> dict[str, int]:
        said, offsets = _object(head), dict[str, int]()
        if said != self._head:
            ours, theirs = (f"`triaxcal {h.get('command')}`" for h in (self._head, said or {}))
            raise InputError(f"{self._journal_path}: the journal of {theirs}, expected that of {ours}")
        at = file.tell()
        while line := file.readline():
            if not line.endswith(b"\n"):
                file.truncate(at)
                break
            if (found := _object(line)) is not None and isinstance(found.get("recording"), str):
                offsets[found["recording"]] = at
            at = file.tell()
        return offsets

    def _rows_of_table(self, resume: bool) -> Iterator[Row]:
        """Of a finished table, none without ``resume``. Raises InputError where the
        file is no table of results, or on ``resume`` one without all the columns."""
        if not self._path.exists() or not self._path.stat().st_size:
            return iter(())
        if self._path.name.endswith(".parquet"):
            from triaxcald.tables.arrow import read_rows

            held, rows = read_rows(self._path)
        else:
            held, rows = _read_csv(self._path, {c.name: _TYPES[c.kind] for c in self.columns})
        needed = [column.name for column in (self.columns if resume else (*COMMON_BEFORE, *COMMON_AFTER))]
        if missing := set(needed) - set(held):
            of = (
                f"table of `triaxcal {self._head['command']}`"
                if resume
                else "table of results, which alone is replaced"
            )
            raise InputError(f"{self._path}: no {of}: no column {min(missing)}")
        if not resume:
            return iter(())
        return ({name: row.get(name) for name in needed} for row in rows)

    def _append(self, value: Mapping[str, Any]) -> int:
        at = self._journal.seek(0, os.SEEK_END)
        self._journal.write(_line(value))
        self._journal.flush()
        os.fsync(self._journal.fileno())
        return at

    def stored(self, name: str) -> Row | None:
        at = self._offsets.get(_plain(name))
        if at is None:
            return None
        self._journal.seek(at)
        row = _object(self._journal.readline())
        return None if row is None else {column.name: row.get(column.name) for column in self.columns}

    def store(self, row: Row) -> None:
        try:
            cells = dict(zip((column.name for column in self.columns), self._cells(row), strict=True))
            self._offsets[cells["recording"]] = self._append(cells)
            self._has_more = True
        except OSError as e:
            raise DiskError(f"{self._journal_path}: cannot be written: {e.strerror}; --resume goes on") from e

    def finish(self, order: Iterable[str], asked: Sequence[str] = ()) -> None:
        given = dict.fromkeys(_plain(name) for name in order)
        names = dict.fromkeys([*(n for n in given if n in self._offsets), *self._offsets])
        found = (row for name in names if (row := self.stored(name)) is not None)
        rows = (self._cells(row) for row in found if row["recording"] in given or not _names_none(row, asked))
        try:
            with new_beside(self._path) as beside:
                self._write(beside, rows)
            self._journal_path.unlink()
            synchronise(self._path.parent)
        except OSError as e:
            raise DiskError(f"{self._path}: cannot be written: {e.strerror}; --resume goes on") from e

    def _write(self, path: Path, rows: Iterable[Sequence[Any]]) -> None:
        types = {column.name: _TYPES[column.kind] for column in self.columns}
        if self._path.name.endswith(".parquet"):
            from triaxcald.tables.arrow import write_rows  # 50 MB that nothing else needs

            write_rows(path, types, rows)
            return
        with path.open("wb") as file:
            packed = gzip.GzipFile(filename="", fileobj=file, mode="wb", mtime=0) if _packed(self._path) else file
            with io.TextIOWrapper(packed, "utf-8", newline="") as out:
                lines = csv.writer(out, lineterminator="\n")
                lines.writerow(types)
                quoted = csv.writer(out, lineterminator="\n", quoting=csv.QUOTE_ALL)
                for row in rows:  # the module quotes no carriage return, at which it ends a line
                    (quoted if any(isinstance(cell, str) and "\r" in cell for cell in row) else lines).writerow(row)

    def close(self) -> None:
        with suppress(OSError):
            self._journal.close()
            if self._is_new and not self._has_more:  # nothing came of it, and the table has all that it holds
                self._journal_path.unlink(missing_ok=True)
        self._lock.release()


def _packed(path: Path) -> bool:
    return path.name.endswith(".gz")


def _read_csv(path: Path, types: Mapping[str, type]) -> tuple[list[str], Iterator[Row]]:
    """Raises InputError."""

    def opened() -> io.TextIOWrapper:
        raw: Any = gzip.open(path, "rb") if _packed(path) else path.open("rb")  # noqa: SIM115 - closed with the text
        return io.TextIOWrapper(raw, "utf-8", newline="")

    def rows() -> Iterator[Row]:
        try:
            with opened() as text:
                lines = csv.reader(text)
                next(lines, None)
                for line in lines:
                    row = dict(zip(names, line, strict=True))
                    yield {name: types[name](cell) if cell else None for name, cell in row.items() if name in types}
        except _UNREADABLE as e:
            raise InputError(f"{path}: cannot be read as a table of results: {e}") from e

    try:
        with opened() as text:
            names = next(csv.reader(text), [])
    except _UNREADABLE as e:
        raise InputError(f"{path}: cannot be read as a table of results: {e}") from e
    return names, rows()


_UNREADABLE: Final = (OSError, ValueError, EOFError, zlib.error, csv.Error)


def _line(value: Mapping[str, Any]) -> bytes:
    return json.dumps(value, ensure_ascii=False, allow_nan=False).encode() + b"\n"


def _object(line: bytes) -> dict[str, Any] | None:
    try:
        found = json.loads(line)
    except ValueError:
        return None
    return found if isinstance(found, dict) else None


class SqliteTable(Table):
    """Table ``recordings`` of a file of its own, one transaction a row. Table ``made``
    says by which command, and whether all is done."""

    def __init__(self, path: Path, command: str, columns: Sequence[Column[Any]], *, resume: bool) -> None:
        super().__init__(columns)
        self._path, self._command = path, command
        self._was_there = path.exists()
        self._begun = False
        listed = ", ".join("?" * len(columns))
        self._put = f"INSERT OR REPLACE INTO recordings VALUES ({listed})"
        self._lock = _Lock(path)
        self._db: sqlite3.Connection | None = None
        try:
            self._db = sqlite3.connect(path, isolation_level=None)
            self._goes_on = self._require_ours(resume)
        except BaseException as e:
            self.close()
            if isinstance(e, sqlite3.Error | OSError):
                raise InputError(f"{path}: cannot be used as a table of results: {_reason(e)}") from e
            raise

    def _require_ours(self, resume: bool) -> bool:
        """Whether there are rows to go on with. Raises InputError, sqlite3.Error;
        changes nothing."""
        assert self._db is not None
        tables = {name for (name,) in self._db.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if not tables:
            return False
        if not {"made", "recordings"} <= tables:
            raise InputError(f"{self._path}: a database with other tables ({min(tables)}); write to another file")
        made = dict(self._db.execute("SELECT key, value FROM made"))
        if made.get("format") != FORMAT:
            raise InputError(f"{self._path}: a database of another kind; write to another file")
        if not resume and made.get("state") != "done":
            raise InputError(f"{self._path}: an interrupted run has left it; --resume goes on with it, or delete it")
        if not resume:
            return False
        if made.get("command") != self._command:
            ours, theirs = f"`triaxcal {self._command}`", f"`triaxcal {made.get('command')}`"
            raise InputError(f"{self._path}: the table of {theirs}, expected that of {ours}")
        there = [name for _, name, *_ in self._db.execute("PRAGMA table_info(recordings)")]
        if there != [column.name for column in self.columns]:
            raise InputError(f"{self._path}: no table of `triaxcal {self._command}` of this version: other columns")
        return True

    def _begin(self) -> None:
        """With the first row: a start that fails leaves the finished table. Raises
        sqlite3.Error."""
        assert self._db is not None
        self._begun = True
        self._db.execute("PRAGMA journal_mode = TRUNCATE")  # a row takes half the time
        self._db.execute("BEGIN IMMEDIATE")
        if not self._goes_on:
            self._db.execute("DROP TABLE IF EXISTS recordings")
            listed = ", ".join(f'"{c.name}" {_SQL[c.kind]}' for c in self.columns)
            self._db.execute(f"CREATE TABLE recordings ({listed}, PRIMARY KEY (recording))")
        self._db.execute("CREATE TABLE IF NOT EXISTS made (key TEXT PRIMARY KEY, value TEXT NOT NULL)")
        said = {"format": FORMAT, "command": self._command, "state": "running"}
        self._db.executemany("INSERT OR REPLACE INTO made VALUES (?, ?)", said.items())

    def stored(self, name: str) -> Row | None:
        if self._db is None or not (self._goes_on or self._begun):
            return None
        cells = self._db.execute("SELECT * FROM recordings WHERE recording = ?", (_plain(name),)).fetchone()
        return None if cells is None else dict(zip((c.name for c in self.columns), cells, strict=True))

    def store(self, row: Row) -> None:
        self._execute((self._put, self._cells(row)))

    def finish(self, order: Iterable[str], asked: Sequence[str] = ()) -> None:
        self._execute(*((_DELETE, (name,)) for name in self._mended(order, asked)), (_FINISH, ()))

    def _mended(self, order: Iterable[str], asked: Sequence[str]) -> list[str]:
        if self._db is None or not (self._goes_on or self._begun):
            return []
        try:
            cursor = self._db.execute("SELECT * FROM recordings WHERE error IS NOT NULL AND sha256 IS NULL")
            names = [column.name for column in self.columns]
            rows = [dict(zip(names, cells, strict=True)) for cells in cursor]
        except sqlite3.Error as e:
            raise DiskError(f"{self._path}: cannot be read: {_reason(e)}; --resume goes on") from e
        given = {_plain(name) for name in order} if rows else set()
        return [row["recording"] for row in rows if row["recording"] not in given and _names_none(row, asked)]

    def _execute(self, *statements: tuple[str, Sequence[Any]]) -> None:
        """As one transaction. Raises DiskError."""
        assert self._db is not None
        try:
            if self._begun:
                self._db.execute("BEGIN IMMEDIATE")
            else:
                self._begin()
            for statement, values in statements:
                self._db.execute(statement, values)
            self._db.execute("COMMIT")
        except sqlite3.Error as e:
            with suppress(sqlite3.Error):
                self._db.execute("ROLLBACK")
            raise DiskError(f"{self._path}: cannot be written: {_reason(e)}; --resume goes on") from e

    def close(self) -> None:
        if self._db is not None:
            with suppress(sqlite3.Error):
                if self._begun:
                    self._db.execute("PRAGMA journal_mode = DELETE")
                self._db.close()
            if not self._begun and not self._was_there:
                self._path.unlink(missing_ok=True)
        self._lock.release()


_DELETE: Final = "DELETE FROM recordings WHERE recording = ?"
_FINISH: Final = "UPDATE made SET value = 'done' WHERE key = 'state'"


def _reason(e: Exception) -> str:
    return (e.strerror if isinstance(e, OSError) else None) or str(e)


class _Lock:
    """Against another process that writes the same table: a lock of a file beside it,
    which other machines respect, too, where the file system is shared. Raises
    DeviceInUse; InputError where the folder takes no file."""

    def __init__(self, table: Path) -> None:
        self._path = table.with_name(table.name + LOCK)
        self._file: BinaryIO | None = None
        require_writable(self._path)
        try:
            import fcntl  # which Windows has not
        except ImportError:
            return
        try:
            while True:
                file = open(self._path, "ab")  # noqa: SIM115 - until `release`; NFS wants it writable
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    if os.path.samestat(os.fstat(file.fileno()), os.stat(self._path)):
                        self._file = file
                        return
                except FileNotFoundError:
                    pass  # whoever had it has just ended and removed it
                except BaseException:
                    file.close()
                    raise
                file.close()
        except BlockingIOError:
            raise DeviceInUse(f"{table}: another process writes this table") from None
        except OSError as e:
            raise InputError(f"{self._path}: cannot be written: {e.strerror}") from e

    def release(self) -> None:
        if self._file is not None:
            with suppress(OSError):
                self._path.unlink()
            self._file.close()
            self._file = None
