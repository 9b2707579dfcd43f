"""Writes docs/reference/many.md from the columns of the tables: `python docs/reference/many.py`."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from triaxcald.audit.many import COLUMNS as AUDIT
from triaxcald.cli.batch import COLUMNS as BATCH
from triaxcald.many import COMMON_AFTER, COMMON_BEFORE, Column
from triaxcald.schema.columns import Kind

PAGE = Path(__file__).with_suffix(".md")
HEAD = """# Tables of many recordings

`triaxcal audit … -o TABLE` and [`triaxcal batch`](cli.md#triaxcal-batch-poses) write a row for each recording. The name of TABLE decides: `.parquet`, `.csv`, `.csv.gz` or `.sqlite` (table `recordings`). [How to](../how-to/audit-many-recordings.md). An empty cell is `NULL` in SQLite and Parquet. Made from the columns in the code by `docs/reference/many.py`.

Rows are stored as they come: in SQLite by one transaction each, otherwise in `TABLE.journal`, a JSON object a line. At the end CSV and Parquet are written whole, in the order in which the recordings were given, and the journal goes; rows of SQLite are in the order in which they came. `--resume` takes a row over if size, stamp and SHA-256 of command and options are the same and the same version of triaxcal made it. Rows with exit code 4 or 5 (a worker died, memory ran out, a store or a disk failed) are made again, and those with an error and without `sha256`: the recording could not be read. Rows of other recordings stay.

## Columns of every table

"""  # noqa: E501
TYPES = {Kind.TEXT: "text", Kind.TEXTS: "text", Kind.WHOLE: "integer", Kind.NUMBER: "number"}


def page() -> str:
    parts = [HEAD + _table((*COMMON_BEFORE, *COMMON_AFTER))]
    common = {column.name for column in (*COMMON_BEFORE, *COMMON_AFTER)}
    tables: dict[str, Iterable[Column[Any]]] = {"audit": [c for c in AUDIT if c.name not in common]}
    tables |= {f"batch {command}": columns for command, columns in BATCH.items()}
    parts += [f"## {name}\n\n{_table(columns)}" for name, columns in tables.items()]
    return "\n".join(parts)


def _table(columns: Iterable[Column[Any]]) -> str:
    rows = "".join(f"| `{c.name}` | {TYPES[c.kind]} | {c.meaning} |\n" for c in columns)
    return f"| column | type | meaning |\n|---|---|---|\n{rows}"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
