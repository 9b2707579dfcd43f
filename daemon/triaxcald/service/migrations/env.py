"""Alembic runs the migrations on the connection that `triaxcald.service.database`
hands over. Imported by itself it does nothing."""

from __future__ import annotations

from alembic import context

from triaxcald.service.tables import metadata

config = getattr(context, "config", None)
if config is not None:
    context.configure(connection=config.attributes["connection"], target_metadata=metadata)
    with context.begin_transaction():
        context.run_migrations()
