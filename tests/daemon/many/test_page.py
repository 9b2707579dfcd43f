"""The page of the tables is made from the columns."""

from __future__ import annotations

import runpy
from pathlib import Path

SCRIPT = Path(__file__).parents[3] / "docs/reference/many.py"


def test_the_page_of_the_tables_is_what_the_columns_say_of_themselves() -> None:
    names = runpy.run_path(str(SCRIPT))
    assert names["PAGE"].read_text("utf-8") == names["page"](), "run make docs"
    for table in (names["AUDIT"], *names["BATCH"].values()):
        listed = [column.name for column in table]
        assert len(listed) == len(set(listed))
