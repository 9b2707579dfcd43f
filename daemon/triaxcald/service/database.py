"""The database of the service: `triaxcal.sqlite` in the station's folder, or a
PostgreSQL server. What is special of either is here."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Final

from alembic import command
from alembic.config import Config
from alembic.script import ScriptDirectory
from alembic.util import CommandError
from sqlalchemy import Connection, Engine, create_engine, event, inspect, text
from sqlalchemy.engine import URL, make_url
from sqlalchemy.exc import ArgumentError, NoSuchModuleError, SQLAlchemyError

from triaxcald.errors import InputError, StationError

BUSY_S: Final = 5
"""Longest wait for another process."""
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


def sqlite_engine(path: Path) -> Engine:
    """Transactions begin with the right to write, for which two cannot wait at once."""
    engine = create_engine(f"sqlite:///{path}", connect_args={"timeout": BUSY_S, "check_same_thread": False})

    @event.listens_for(engine, "connect")
    def prepare(connection: Any, _: Any) -> None:
        connection.isolation_level = None
        for pragma in ("journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON"):
            connection.execute(f"PRAGMA {pragma}")

    @event.listens_for(engine, "begin")
    def begin(connection: Connection) -> None:
        reading = connection.get_execution_options().get("reading", False)
        connection.exec_driver_sql("BEGIN" if reading else "BEGIN IMMEDIATE")

    return engine


def postgresql_engine(url: str) -> Engine:
    """Raises InputError for a URL that is none of PostgreSQL."""
    try:
        parsed = make_url(url)
    except ArgumentError as e:
        raise InputError("--database: expected a URL as postgresql://USER@HOST/NAME") from e
    if parsed.get_backend_name() not in ("postgresql", "postgres"):
        raise InputError(f"--database: expected postgresql://…, not {parsed.drivername}://…")
    parsed = URL.create(
        "postgresql+psycopg", parsed.username, parsed.password, parsed.host, parsed.port, parsed.database, parsed.query
    )
    try:
        return create_engine(parsed, pool_pre_ping=True, connect_args={"connect_timeout": BUSY_S})
    except (ImportError, NoSuchModuleError) as e:
        raise InputError("--database: pip install 'triaxcal[postgres]' brings what speaks to PostgreSQL") from e


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
    """A consistent copy, while others write; ``to`` appears when it is complete. Raises
    InputError."""
    partial = to.with_name(f"{to.name}.partial")
    try:
        with (
            closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True, timeout=BUSY_S)) as source,
            closing(sqlite3.connect(partial)) as target,
        ):
            source.backup(target, pages=1000)
        with partial.open("rb") as copied:
            os.fsync(copied.fileno())
        os.replace(partial, to)
    except (sqlite3.Error, OSError) as e:
        partial.unlink(missing_ok=True)
        raise InputError(f"--backup {to}: {e}") from e
