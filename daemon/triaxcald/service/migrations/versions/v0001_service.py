"""The first tables of the service."""

from __future__ import annotations

from typing import Any

from alembic import op

from triaxcald.service import tables

revision = "0001"
down_revision = None

TABLES = ("filed", "unit", "measurement", "person", "token", "session", "trail", "outbox", "event", "setting")


def upgrade() -> None:
    connection = op.get_bind()
    postgresql = connection.dialect.name == "postgresql"
    if postgresql:
        tables.shared_run.create(connection)
    for name in TABLES:
        tables.metadata.tables[name].create(connection)
    for statement in POSTGRESQL if postgresql else SQLITE:
        op.execute(statement)


def downgrade(**_: Any) -> None:
    raise NotImplementedError("restore a backup instead")


SQLITE = tuple(
    f"CREATE TRIGGER trail_{verb.lower()} BEFORE {verb} ON trail "
    "BEGIN SELECT RAISE(ABORT, 'the trail is append-only'); END"
    for verb in ("UPDATE", "DELETE")
)
POSTGRESQL = (
    "CREATE FUNCTION trail_is_append_only() RETURNS trigger LANGUAGE plpgsql AS "
    "$$ BEGIN RAISE EXCEPTION 'the trail is append-only'; END $$",
    "CREATE TRIGGER trail_kept BEFORE UPDATE OR DELETE ON trail FOR EACH ROW EXECUTE FUNCTION trail_is_append_only()",
    "CREATE TRIGGER trail_whole BEFORE TRUNCATE ON trail FOR EACH STATEMENT EXECUTE FUNCTION trail_is_append_only()",
)
