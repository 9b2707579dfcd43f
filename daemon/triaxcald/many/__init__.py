"""Many recordings: which they are, who works at them, and where the results go.

Work is a function from one recording to a `Finding`. It runs in this process or on
the processes of a Dask cluster; each result is stored as it comes.
"""

from triaxcald.many.progress import Pace
from triaxcald.many.sources import Found, Source, Unusable, sources_of
from triaxcald.many.tables import TABLE_KINDS, Table, is_current, open_table
from triaxcald.many.work import (
    COMMON_AFTER,
    COMMON_BEFORE,
    Column,
    Done,
    Finding,
    Row,
    Settings,
    Work,
    attempt,
    unusable,
)

__all__ = [
    "COMMON_AFTER",
    "COMMON_BEFORE",
    "TABLE_KINDS",
    "Column",
    "Done",
    "Finding",
    "Found",
    "Pace",
    "Row",
    "Settings",
    "Source",
    "Table",
    "Unusable",
    "Work",
    "attempt",
    "is_current",
    "open_table",
    "sources_of",
    "unusable",
]
