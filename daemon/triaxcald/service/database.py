"""The database of the service: `triaxcal.sqlite` in the station's folder, or a
PostgreSQL server. What is special of either is here."""

from __future__ import annotations

import os
import sqlite3
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Final

from alembic import command
from alembic.config import Config
from alembic.script import ScriptDirectory
from alembic.util import CommandError
from sqlalchemy import Connection, Engine, create_engine, event, inspect, text
from sqlalchemy.engine import URL, make_url
from sqlalchemy.engine.interfaces import ExceptionContext
from sqlalchemy.exc import ArgumentError, InvalidatePoolError, NoSuchModuleError, SQLAlchemyError
from sqlalchemy.pool import NullPool, QueuePool

from triaxcald.errors import InputError, StationError
from triaxcald.files import new_beside

BUSY_S: Final = 5
"""Longest wait for another process."""
PATIENCE: Final = {
    "connect_timeout": BUSY_S, "keepalives_idle": 10, "keepalives_interval": 5, "keepalives_count": 3,
    "tcp_user_timeout": 20_000,
}  # fmt: skip
"""Of connections to PostgreSQL: a server that is gone is found out within 25 s."""
MIGRATIONS: Final = Path(__file__).parent / "migrations"


class DatabaseError(StationError):
    """The database does not answer, or is damaged."""


@contextmanager
def answering() -> Iterator[None]:
    """Raises DatabaseError for the errors of the database."""
    try:
        yield
    except SQLAlchemyError as e:
        first = str(getattr(e, "orig", None) or e).strip().splitlines()
        raise DatabaseError(f"the database does not answer: {first[0] if first else type(e).__name__}") from e


class SqliteFile:
    """A file of SQLite that another process may replace, or this one where it is
    damaged: connections of its `engine` are to the file that is there. ``prepare``
    makes tables in a file that is new; it is called with whether the file seems
    damaged, before a connection is opened."""

    def __init__(self, path: Path, prepare: Callable[[bool], None]) -> None:
        self.path, self._prepare = path, prepare
        self._lock = threading.Lock()
        self._known: int | None = None
        self._suspect = False
        self.engine = engine = create_engine("sqlite://", creator=self._connect, poolclass=QueuePool)
        _set_up(engine)
        event.listen(engine, "connect", self._note)
        event.listen(engine, "checkout", self._follow)
        event.listen(engine, "handle_error", self._doubt)

    def _connect(self) -> sqlite3.Connection:
        with self._lock:
            if self._suspect or self._known is None or self._known != self._inode():
                self._prepare(self._suspect)
                self._known, self._suspect = self._inode(), False
        return _connected(self.path)

    def _inode(self) -> int | None:
        try:
            return os.lstat(self.path).st_ino
        except OSError:
            return None

    def _note(self, _: Any, record: Any) -> None:
        record.info["inode"] = self._inode()

    def _follow(self, _: Any, record: Any, __: Any) -> None:
        if record.info.get("inode") != self._inode():
            raise InvalidatePoolError

    def _doubt(self, context: ExceptionContext) -> None:
        """Open the file anew where it seems damaged: it is checked first."""
        code = getattr(context.original_exception, "sqlite_errorcode", 0) & 0xFF
        if code in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB):
            self._suspect = context.is_disconnect = True


def plain_engine(path: Path) -> Engine:
    """Of a file as it is, for one connection at a time."""
    engine = create_engine("sqlite://", creator=lambda: _connected(path), poolclass=NullPool)
    _set_up(engine)
    return engine


def _connected(path: Path) -> sqlite3.Connection:
    return sqlite3.connect(path, timeout=BUSY_S, isolation_level=None, check_same_thread=False)


def _set_up(engine: Engine) -> None:
    """Transactions begin with the right to write, for which two cannot wait at once;
    those with the option ``reading`` do not."""

    @event.listens_for(engine, "connect")
    def prepare(connection: Any, _: Any) -> None:
        for pragma in ("journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON"):
            connection.execute(f"PRAGMA {pragma}")

    @event.listens_for(engine, "begin")
    def begin(connection: Connection) -> None:
        reading = connection.get_execution_options().get("reading", False)
        connection.exec_driver_sql("BEGIN" if reading else "BEGIN IMMEDIATE")


def postgresql_engine(url: str, named: str = "--database") -> Engine:
    """Raises InputError for a URL that is none of PostgreSQL; the message calls it as
    it is ``named``."""
    try:
        parsed = make_url(url)
    except (ArgumentError, ValueError) as e:  # the latter of a port, or of an address in brackets
        raise InputError(f"{named}: expected a URL as postgresql://USER@HOST/NAME") from e
    if parsed.get_backend_name() not in ("postgresql", "postgres"):
        raise InputError(f"{named}: expected postgresql://…, not {parsed.drivername}://…")
    parsed = URL.create(
        "postgresql+psycopg", parsed.username, parsed.password, parsed.host, parsed.port, parsed.database, parsed.query
    )
    try:
        return create_engine(parsed, pool_pre_ping=True, connect_args=PATIENCE)
    except (ImportError, NoSuchModuleError) as e:
        raise InputError(f"{named}: pip install 'triaxcal[postgres]' brings what speaks to PostgreSQL") from e


def shown_address(url: str) -> str:
    """Of an engine's URL: without its password, and without options, which may hold
    one."""
    return make_url(url).set(query={}).render_as_string(hide_password=True)


def migrate(engine: Engine) -> None:
    """Bring the tables to the present version. Raises InputError for those of a later
    one, DatabaseError."""
    config = Config()
    config.set_main_option("script_location", str(MIGRATIONS).replace("%", "%%"))
    config.set_main_option("path_separator", "os")
    known = {revision.revision for revision in ScriptDirectory.from_config(config).walk_revisions()}
    with answering(), engine.begin() as connection:
        if engine.dialect.name == "postgresql":  # two services may begin at once
            connection.execute(text("SELECT pg_advisory_xact_lock(74112)"))
        if inspect(connection).has_table("alembic_version"):
            there = set(connection.execute(text("SELECT version_num FROM alembic_version")).scalars())
            if later := there - known:
                raise InputError(f"the database is of a later version of triaxcal (revision {', '.join(later)})")
        config.attributes["connection"] = connection
        try:
            command.upgrade(config, "head")
        except CommandError as e:
            raise DatabaseError(f"the tables cannot be brought to this version: {e}") from e


def copy_sqlite(path: Path, to: Path) -> None:
    """A consistent copy, while others write; ``to`` appears when it is complete, and
    may replace an earlier copy alone. Raises InputError."""
    try:
        if to.exists() and (to.samefile(path) or not _is_sqlite(to)):
            raise InputError(f"--backup {to}: exists already, and is no earlier copy")
        with new_beside(to) as partial:
            with (
                closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True, timeout=BUSY_S)) as source,
                closing(sqlite3.connect(partial)) as target,
            ):
                source.backup(target, pages=1000)
            with partial.open("rb") as copied:
                os.fsync(copied.fileno())
    except (sqlite3.Error, OSError) as e:
        raise InputError(f"--backup {to}: {getattr(e, 'strerror', None) or e}") from e


def _is_sqlite(path: Path) -> bool:
    """Raises OSError."""
    with path.open("rb") as file:
        return file.read(16) == b"SQLite format 3\0"
