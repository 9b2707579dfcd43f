"""The runs of all stations that share a PostgreSQL server, for a look at all units."""

from __future__ import annotations

from typing import Any

from sqlalchemy import inspect, select

from triaxcald.errors import InputError
from triaxcald.schema.columns import NAMES
from triaxcald.service import tables
from triaxcald.service.database import answering, postgresql_engine
from triaxcald.store import TIMES


def runs_of_every_station(
    url: str, *, named: str = "--database", since_us: int | None, until_us: int | None
) -> list[tuple[Any, ...]]:
    """Rows with the cells of `NAMES` and `TIMES`, in the order of time; ``since_us``
    and ``until_us`` as in `RunFilter`. Messages call the URL as it is ``named``.
    Nothing is written. Raises InputError for a URL
    that is none, and for a database without our tables; DatabaseError."""
    run = tables.shared_run
    query = select(*(run.c[name] for name in (*NAMES, *TIMES))).order_by(run.c.at_us, run.c.outcome)
    if since_us is not None:
        query = query.where(run.c.at_us >= since_us)
    if until_us is not None:
        query = query.where(run.c.at_us < until_us)
    engine = postgresql_engine(url, named)
    try:
        with answering(), engine.connect() as connection:
            if not inspect(connection).has_table("run"):
                raise InputError("the database has no table of runs: expected that of `triaxcal serve --database`")
            return [tuple(row) for row in connection.execute(query)]
    finally:
        engine.dispose()
