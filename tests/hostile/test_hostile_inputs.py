"""A hostile input is one line with the right exit code, soon and in little memory; nothing half-written is left."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from tests.conftest import PROGRESS

if TYPE_CHECKING:
    from tests.hostile.rows import Row

TIMES_MOST = 1.0  # what importing the whole program takes on the same machine in the same minute, about 2 s
BYTES_MOST = 140 * 10**6  # beyond what the program takes
BATCHES = 4


def run(rows: list[Row], folder: Path) -> list[dict[str, Any]]:
    """What came of each row, its time in that of the imports."""
    given, before = [], []
    for i, row in enumerate(rows):
        own = folder / str(i)
        own.mkdir()
        words = row.make(own)
        given.append((str(own), words))
        before.append(sorted(own.rglob("*")))
    done = subprocess.run(
        [sys.executable, Path(__file__).with_name("measured.py")],
        input=json.dumps(given),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    measured = json.loads(done.stdout)
    found: list[dict[str, Any]] = measured["commands"]
    for i, (outcome, names) in enumerate(zip(found, before, strict=True)):
        left = {p for p in (folder / str(i)).rglob("*") if p.name not in (".out", ".err")}
        outcome["left"] = sorted(str(p) for p in left - set(names))
        outcome["times"] = outcome["seconds"] / measured["imports"]
    return found


def faults(row: Row, outcome: dict[str, Any], secret: str) -> list[str]:
    """What is not as it should be."""
    told, found = PROGRESS.sub("", outcome["told"]), []  # which a busy machine sees after three seconds
    lines = told.splitlines()
    if outcome["code"] != row.code or "Traceback" in told:
        found.append(f"ended with {outcome['code']}, expected {row.code}: {told[-1500:]}")
    elif row.code and (len(lines) != 1 or not lines[0].startswith("triaxcal") or row.words not in lines[0]):
        found.append(f"said {told[-1500:]!r}, expected one line with {row.words!r}")
    if secret[:8] in told:
        found.append("showed what is in a foreign file")
    if outcome["times"] > TIMES_MOST:
        found.append(f"took {outcome['times']:.1f} times the processor time of all imports")
    if outcome["bytes"] > BYTES_MOST:
        found.append(f"took {outcome['bytes'] / 1e6:.0f} MB")
    if outcome["left"]:
        found.append(f"left {outcome['left']}")
    return [f"{row.what}: {fault}" for fault in found]


@pytest.mark.slow
@pytest.mark.parametrize("batch", range(BATCHES))
def test_a_hostile_input_is_one_line_soon_and_in_little_memory(tmp_path: Path, batch: int) -> None:
    from tests.hostile.rows import ROWS, SECRET  # many megabytes, made where they are wanted and not on collection

    rows = ROWS[batch::BATCHES]
    outcomes = run(rows, tmp_path)
    assert [fault for row, outcome in zip(rows, outcomes, strict=True) for fault in faults(row, outcome, SECRET)] == []
