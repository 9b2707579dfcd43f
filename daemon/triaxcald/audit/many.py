"""Audits of many recordings, of which none hides another: a row each."""

from __future__ import annotations

from typing import Final

import triaxcal_drivers as td
from triaxcald.audit import text
from triaxcald.audit.conduct import Audit, audit
from triaxcald.errors import DONE, OUTSIDE
from triaxcald.many import COMMON_AFTER, COMMON_BEFORE, Column, Finding
from triaxcald.many.sources import LIST
from triaxcald.schema.columns import Kind

ENDINGS: Final = (".mcap",)
"""Ends of names of recordings in a folder."""
MANIFESTS: Final = (*LIST, ".txt")
"""Ends of names of manifests: no text is a recording that could be audited."""

COLUMNS: Final[tuple[Column[Audit], ...]] = (
    *COMMON_BEFORE,
    Column("result", Kind.TEXT, "`same_bytes`, `same_figures`, `within` or `differs`", lambda a: a.result.value),
    Column("verdict", Kind.TEXT, "[verdict](outcome.md#verdict-and-code) of the run", lambda a: a.verdict),
    Column("serial", Kind.TEXT, "serial number of the unit", lambda a: a.serial),
    Column("run", Kind.TEXT, "id of the run", lambda a: a.run),
    Column("made_by", Kind.TEXT, "version that made the recording, if it is another one", lambda a: a.made_by),
    Column("differences", Kind.WHOLE, "number of differences", lambda a: len(a.differences)),
    Column(
        "first_difference", Kind.TEXT, "the first of them",
        lambda a: text.difference(a.differences[0]) if a.differences else None,
    ),
    Column(
        "of_uncertainty", Kind.NUMBER, "of `same_figures`: the largest difference of a figure in its uncertainty",
        lambda a: a.agreement.of_uncertainty if a.agreement.figures else None,
    ),
    *COMMON_AFTER,
)  # fmt: skip


def audited(path: td.files.AnyPath, *, within: float | None = None) -> Finding:
    """Raises what `audit` does; ``within`` as there."""
    found = audit(path, within=within)
    return Finding(
        {column.name: column.value(found) for column in COLUMNS if column not in (*COMMON_BEFORE, *COMMON_AFTER)},
        OUTSIDE if found.differences else DONE,
        tuple(text.lines(found)),
        text.document(str(path), found),
    )
