"""A file of another kind, or of more cells than memory holds, is refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.daemon.tables.exports import EXPORTS
from tests.daemon.tables.written import read
from triaxcald.errors import InputError
from triaxcald.tables import arrow
from triaxcald.tables.samples import read_table


def test_what_is_no_parquet_file_is_said(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a\.parquet: not readable as Parquet: "):
        read(tmp_path, b"PAR1 and no more", name="a.parquet")
    with pytest.raises(InputError, match=r"b\.parquet: cannot be read: No such file or directory"):
        read_table(str(tmp_path / "b.parquet"))
    (tmp_path / "c.parquet").mkdir()
    with pytest.raises(InputError, match=r"c\.parquet: cannot be read: "):
        read_table(str(tmp_path / "c.parquet"))


def test_a_parquet_file_of_more_cells_than_memory_holds_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(arrow, "CELLS_MOST", 100)
    (tmp_path / "a.parquet").write_bytes(next(e.data for e in EXPORTS if e.suffix == ".parquet"))
    with pytest.raises(InputError, match=r"a\.parquet: more than 100 cells"):
        read_table(str(tmp_path / "a.parquet"))
