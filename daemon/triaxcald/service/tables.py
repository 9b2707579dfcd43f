"""The tables of the service. `run` and `file` of a folder's `triaxcal.sqlite` belong to
`triaxcald.store`; a PostgreSQL server, which several stations share, has a table `run`
of the same columns.

``home`` is the station in whose folder a run is: its name, in a file `HERE`. Times end
in ``_us`` (microseconds since 1970) or are texts in ISO 8601, UTC.
"""

from __future__ import annotations

from typing import Any, Final

from sqlalchemy import (
    BigInteger,
    Boolean,
    Column,
    Double,
    ForeignKey,
    Identity,
    Index,
    Integer,
    MetaData,
    PrimaryKeyConstraint,
    Table,
    TypeDecorator,
    UniqueConstraint,
)  # fmt: skip
from sqlalchemy import Text as SqlText

from triaxcald.schema.columns import COLUMNS, Kind
from triaxcald.store import TIMES

metadata: Final = MetaData()
HERE: Final = "."
"""In place of the station's name in a file, which belongs to one folder."""


class Text(TypeDecorator[str]):
    """Text with a replacement for what not every database can hold: zero bytes, and
    halves of a surrogate pair."""

    impl = SqlText
    cache_ok = True

    def process_bind_param(self, value: str | None, dialect: Any) -> str | None:
        return None if value is None else value.replace("\0", "\ufffd").encode("utf-8", "replace").decode()


_TYPES: Final[dict[Kind, Any]] = {Kind.TEXT: Text, Kind.TEXTS: Text, Kind.WHOLE: BigInteger, Kind.NUMBER: Double}


def _of_run() -> list[Column[Any]]:
    cells = [Column(c.name, _TYPES[c.kind], nullable=not c.required) for c in COLUMNS]
    return [*cells, *(Column(name, BigInteger, nullable=False) for name in TIMES)]


local_run: Final = Table("run", MetaData(), *_of_run(), PrimaryKeyConstraint("outcome"))
"""As `triaxcald.store` makes it, in SQLite."""

shared_run: Final = Table(
    "run", MetaData(), Column("home", Text, nullable=False), *_of_run(), PrimaryKeyConstraint("home", "outcome")
)
"""In PostgreSQL."""
Index("run_serial", shared_run.c.serial)
Index("run_at", shared_run.c.at_us, shared_run.c.outcome)

filed: Final = Table(
    "filed", metadata,
    Column("home", Text, nullable=False),
    Column("outcome", Text, nullable=False),
    Column("outcome_sha256", Text, nullable=False),
    Column("run", Text),
    Column("serial", Text),
    Column("plain_serial", Text),
    Column("plain_reported", Text),
    Column("at_us", BigInteger, nullable=False),
    Column("ended_us", BigInteger, nullable=False),
    Column("tried", Boolean, nullable=False),
    Column("verdict", Text, nullable=False),
    Column("code", Text),
    PrimaryKeyConstraint("home", "outcome"),
)  # fmt: skip
"""Outcomes from which rows of the other tables are made. ``serial`` is the expected
serial number, else the reported one, which ``plain_reported`` is of."""

# All of a file's rows have one home: an index that begins with it has to be better than
# any other.
Index("filed_serial", filed.c.home, filed.c.plain_serial, filed.c.ended_us, filed.c.outcome)
Index("filed_reported", filed.c.home, filed.c.plain_reported, filed.c.outcome)
Index("filed_run", filed.c.home, filed.c.run, filed.c.outcome)

unit: Final = Table(
    "unit", metadata,
    Column("home", Text, nullable=False),
    Column("plain_serial", Text, nullable=False),
    Column("serial", Text, nullable=False),
    Column("first_us", BigInteger, nullable=False),
    Column("last_us", BigInteger, nullable=False),
    Column("attempts", Integer, nullable=False),
    Column("passed", Boolean, nullable=False),
    Column("verdict", Text, nullable=False),
    Column("code", Text),
    Column("run", Text),
    PrimaryKeyConstraint("home", "plain_serial"),
)  # fmt: skip
"""One row for each serial number; verdict, code and run are those of the last run."""

measurement: Final = Table(
    "measurement", metadata,
    Column("home", Text, nullable=False),
    Column("outcome", Text, nullable=False),
    Column("run", Text),
    Column("name", Text, nullable=False),
    Column("value", Double, nullable=False),
    Column("unit", Text, nullable=False),
    Column("low", Double),
    Column("high", Double),
    Column("passed", Boolean),
    PrimaryKeyConstraint("home", "outcome", "name"),
)  # fmt: skip

Index("measurement_run", measurement.c.home, measurement.c.run, measurement.c.outcome)

person: Final = Table(
    "person", metadata,
    Column("name", Text, primary_key=True),
    Column("role", Text, nullable=False),
    Column("pin", Text, nullable=False),
    Column("disabled", Boolean, nullable=False),
    Column("created", Text, nullable=False),
)  # fmt: skip
"""``pin`` is the hash by argon2."""

token: Final = Table(
    "token", metadata,
    Column("hash", Text, primary_key=True),
    Column("name", Text, nullable=False),
    Column("role", Text, nullable=False),
    Column("created", Text, nullable=False),
    Column("revoked", Text),
)  # fmt: skip
"""``hash`` is the SHA-256 of the token."""

session: Final = Table(
    "session", metadata,
    Column("hash", Text, primary_key=True),
    Column("person", Text, ForeignKey("person.name"), nullable=False, index=True),
    Column("used_s", Double, nullable=False),
)  # fmt: skip

trail: Final = Table(
    "trail", metadata,
    Column("id", BigInteger().with_variant(Integer, "sqlite"), Identity(), primary_key=True),
    Column("uid", Text, nullable=False, unique=True),
    Column("time", Text, nullable=False),
    Column("station", Text, nullable=False),
    Column("who", Text),
    Column("role", Text),
    Column("action", Text, nullable=False),
    Column("what", Text, nullable=False),
    Column("ok", Boolean, nullable=False),
    Column("code", Text),
)  # fmt: skip
"""Append-only, by triggers. ``uid`` is also in the line of `trail.jsonl`, ``station``
is the station's name at the time, ``what`` is a JSON object."""

outbox: Final = Table(
    "outbox", metadata,
    Column("id", BigInteger().with_variant(Integer, "sqlite"), Identity(), primary_key=True),
    Column("home", Text, nullable=False),
    Column("receiver", Text, nullable=False),
    Column("run", Text, nullable=False),
    Column("outcome", Text, nullable=False),
    Column("state", Text, nullable=False),
    Column("tries", Integer, nullable=False),
    Column("added_us", BigInteger, nullable=False),
    Column("ended_us", BigInteger),
    Column("error", Text),
    UniqueConstraint("home", "receiver", "run"),
)  # fmt: skip
"""``state`` is `waiting`, `delivered` or `refused`; ``added_us`` and ``ended_us`` are
the times of entry and end, ``error`` is of the last try."""
Index("outbox_run", outbox.c.home, outbox.c.run, outbox.c.receiver)
_failed: Final = outbox.c.error.is_not(None)
Index(
    "outbox_error", outbox.c.home, outbox.c.receiver, outbox.c.id, sqlite_where=_failed, postgresql_where=_failed
)  # fmt: skip
Index("outbox_waiting", outbox.c.home, outbox.c.receiver, outbox.c.state, outbox.c.id)

sending: Final = Table(
    "sending", metadata,
    Column("id", BigInteger, primary_key=True, autoincrement=False),
    Column("body", Text, nullable=False),
)  # fmt: skip
"""The ``body`` with which a row of `outbox` that waits was first tried."""

event: Final = Table(
    "event", metadata,
    Column("home", Text, nullable=False),
    Column("seq", BigInteger, nullable=False),
    Column("run", Text),
    Column("event", Text, nullable=False),
    PrimaryKeyConstraint("home", "seq"),
)  # fmt: skip
"""``event`` is a `triaxcal.event/1`."""
Index("event_run", event.c.home, event.c.run, event.c.seq)

setting: Final = Table(
    "setting", metadata,
    Column("home", Text, nullable=False),
    Column("key", Text, nullable=False),
    Column("value", Text, nullable=False),
    PrimaryKeyConstraint("home", "key"),
)  # fmt: skip
"""``value`` is JSON."""
