"""What is on its way to a receiver stays as it was sent first."""

from __future__ import annotations

from typing import Any

from alembic import op

from triaxcald.service import tables

revision = "0002"
down_revision = "0001"


def upgrade() -> None:
    tables.sending.create(op.get_bind())


def downgrade(**_: Any) -> None:
    raise NotImplementedError("restore a backup instead")
