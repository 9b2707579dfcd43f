"""Tables written to a file and read, for the tests of what is made of them."""

from __future__ import annotations

from pathlib import Path

import pytest

from triaxcald.errors import InputError
from triaxcald.tables.samples import Reading, Table, read_table

GOOD = "time,ax,ay,az\n0.00,1,2,3\n0.01,1,2,3.5\n0.02,1,2,4\n"
EVERY = [f"{i / 100:.2f},{0.1 + i % 3:.3f},0.2,0.9" for i in range(40)]


def read(folder: Path, content: str | bytes, reading: Reading | None = None, name: str = "a.csv") -> Table:
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_table(str(path), reading)


def asked(folder: Path, content: str | bytes, reading: Reading | None = None) -> str:
    with pytest.raises(InputError) as caught:
        read(folder, content, reading)
    return str(caught.value).removeprefix(f"{folder / 'a.csv'}: ")


def lines(rows: list[str], header: str = "time,ax,ay,az") -> str:
    return "\n".join([header, *rows]) + "\n"
