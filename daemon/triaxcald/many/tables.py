"""Where results go as they come: a row each, in an SQLite file or, until a CSV or
Parquet file is written at the end, in a journal beside it."""

from __future__ import annotations

import csv
import gzip
import io
import json
import os
import sqlite3
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from math import isfinite
from pathlib import Path
from typing import Any, BinaryIO, Final

from triaxcald.errors import DEVICE, DISK, DeviceInUse, DiskError, InputError
from triaxcald.files import new_beside, require_writable
from triaxcald.many.sources import Source
from triaxcald.many.work import Column, Row, Settings
from triaxcald.schema.columns import Kind

TABLE_KINDS: Final = (".parquet", ".csv", ".csv.gz", ".sqlite")
FORMAT: Final = "triaxcal.many/1"
JOURNAL: Final = ".journal"
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
    def finish(self, order: Iterable[str]) -> None:
        """All is done; rows are to be in this order where the table has one. Raises
        DiskError."""

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


class _Nowhere(Table):
    def stored(self, name: str) -> Row | None:
        return None

    def store(self, row: Row) -> None:
        pass

    def finish(self, order: Iterable[str]) -> None:
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
        require_writable(self._journal_path)
        if self._journal_path.exists() and not resume:
            raise InputError(
                f"{self._journal_path}: an interrupted run has left it; --resume goes on with it, or delete it"
            )
        try:
            self._journal: BinaryIO = open(self._journal_path, "a+b")  # noqa: SIM115 - until `close`
            _lock(self._journal, path)
            self._offsets = self._read_journal(resume)
        except OSError as e:
            raise InputError(f"{self._journal_path}: cannot be written: {e.strerror}") from e

    def _read_journal(self, resume: bool) -> dict[str, int]:
        """Where each recording's latest row begins. Raises InputError, OSError."""
        file, offsets = self._journal, dict[str, int]()
        file.seek(0)
        head = file.readline()
        if not head.endswith(b"\n"):  # a new one, or nothing came of it
            file.truncate(0)
            self._append(self._head)
            if resume and self._path.exists():
                for row in self._rows_of_table():
                    offsets[str(row["recording"])] = self._append(row, durable=False)
            return offsets
        said = _object(head)
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

    def _rows_of_table(self) -> Iterator[Row]:
        """Of a finished table. Raises InputError where it has other columns."""
        names = [column.name for column in self.columns]
        if self._path.name.endswith(".parquet"):
            from triaxcald.tables.arrow import read_rows

            held, rows = read_rows(self._path)
        else:
            held, rows = _read_csv(self._path, {c.name: _TYPES[c.kind] for c in self.columns})
        if missing := set(names) - set(held):
            raise InputError(f"{self._path}: no table of `triaxcal {self._head['command']}`: no column {min(missing)}")
        for row in rows:
            yield {name: row.get(name) for name in names}

    def _append(self, value: Mapping[str, Any], *, durable: bool = True) -> int:
        at = self._journal.seek(0, os.SEEK_END)
        self._journal.write(json.dumps(value, ensure_ascii=False, allow_nan=False).encode() + b"\n")
        if durable:
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
        except OSError as e:
            raise DiskError(f"{self._journal_path}: cannot be written: {e.strerror}; --resume goes on") from e

    def finish(self, order: Iterable[str]) -> None:
        asked = (_plain(name) for name in order)
        names = dict.fromkeys([*(n for n in asked if n in self._offsets), *self._offsets])
        rows = (self._cells(row) for name in names if (row := self.stored(name)) is not None)
        try:
            with new_beside(self._path) as beside:
                self._write(beside, rows)
            self._journal_path.unlink()
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
                lines.writerows(rows)

    def close(self) -> None:
        with suppress(OSError):
            self._journal.close()


def _packed(path: Path) -> bool:
    return path.name.endswith(".gz")


def _read_csv(path: Path, types: Mapping[str, type]) -> tuple[list[str], Iterator[Row]]:
    """Raises InputError."""
    try:
        raw: Any = gzip.open(path, "rb") if _packed(path) else path.open("rb")  # noqa: SIM115 - until all rows are read
        text = io.TextIOWrapper(raw, "utf-8", newline="")
        lines = csv.reader(text)
        names = next(lines, [])
    except (OSError, ValueError, csv.Error) as e:
        raise InputError(f"{path}: cannot be read as a table of results: {e}") from e

    def rows() -> Iterator[Row]:
        with text:
            try:
                for line in lines:
                    row = dict(zip(names, line, strict=True))
                    yield {name: types[name](cell) if cell else None for name, cell in row.items() if name in types}
            except (OSError, ValueError, csv.Error) as e:
                raise InputError(f"{path}: cannot be read as a table of results: {e}") from e

    return names, rows()


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
        self._held: BinaryIO | None = None
        try:
            self._db = sqlite3.connect(path, isolation_level=None)
            self._held = open(path, "rb")  # noqa: SIM115 - closed after the connection: closing drops its locks
            _lock(self._held, path)
            self._db.execute("PRAGMA journal_mode = TRUNCATE")  # a row takes half the time
            self._begin(resume)
        except (sqlite3.Error, OSError) as e:
            raise InputError(f"{path}: cannot be used as a table of results: {_reason(e)}") from e

    def _begin(self, resume: bool) -> None:
        """Raises InputError, sqlite3.Error."""
        tables = {name for (name,) in self._db.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if tables and not {"made", "recordings"} <= tables:
            raise InputError(f"{self._path}: a database with other tables ({min(tables)}); write to another file")
        made = dict(self._db.execute("SELECT key, value FROM made")) if tables else {}
        if tables and made.get("format") != FORMAT:
            raise InputError(f"{self._path}: a database of another kind; write to another file")
        if tables and not resume and made.get("state") != "done":
            raise InputError(f"{self._path}: an interrupted run has left it; --resume goes on with it, or delete it")
        if tables and resume and made.get("command") != self._command:
            ours, theirs = f"`triaxcal {self._command}`", f"`triaxcal {made.get('command')}`"
            raise InputError(f"{self._path}: the table of {theirs}, expected that of {ours}")
        there = [name for _, name, *_ in self._db.execute("PRAGMA table_info(recordings)")]
        names = [column.name for column in self.columns]
        self._db.execute("BEGIN IMMEDIATE")
        if not resume or there != names:  # columns of another version: every row is made again
            self._db.execute("DROP TABLE IF EXISTS recordings")
            listed = ", ".join(f'"{c.name}" {_SQL[c.kind]}' for c in self.columns)
            self._db.execute(f"CREATE TABLE recordings ({listed}, PRIMARY KEY (recording))")
        self._db.execute("CREATE TABLE IF NOT EXISTS made (key TEXT PRIMARY KEY, value TEXT NOT NULL)")
        said = {"format": FORMAT, "command": self._command, "state": "running"}
        self._db.executemany("INSERT OR REPLACE INTO made VALUES (?, ?)", said.items())
        self._db.execute("COMMIT")
        self._put = f"INSERT OR REPLACE INTO recordings VALUES ({', '.join('?' * len(names))})"

    def stored(self, name: str) -> Row | None:
        cells = self._db.execute("SELECT * FROM recordings WHERE recording = ?", (_plain(name),)).fetchone()
        return None if cells is None else dict(zip((c.name for c in self.columns), cells, strict=True))

    def store(self, row: Row) -> None:
        self._execute(self._put, self._cells(row))

    def finish(self, order: Iterable[str]) -> None:
        self._execute("UPDATE made SET value = 'done' WHERE key = 'state'", ())

    def _execute(self, statement: str, values: Sequence[Any]) -> None:
        try:
            self._db.execute(statement, values)
        except sqlite3.Error as e:
            raise DiskError(f"{self._path}: cannot be written: {_reason(e)}; --resume goes on") from e

    def close(self) -> None:
        with suppress(sqlite3.Error):
            self._db.execute("PRAGMA journal_mode = DELETE")
            self._db.close()
        if self._held is not None:
            self._held.close()


def _reason(e: Exception) -> str:
    return (e.strerror if isinstance(e, OSError) else None) or str(e)


def _lock(file: BinaryIO, path: Path) -> None:
    """Against another process that writes the same table; until the file is closed.
    Raises DeviceInUse, OSError."""
    try:
        import fcntl  # which Windows has not
    except ImportError:
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise DeviceInUse(f"{path}: another process writes this table") from None
