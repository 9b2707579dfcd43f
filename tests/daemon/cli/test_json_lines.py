"""Progress as JSON, a line each."""

from __future__ import annotations

import io
import json

from triaxcald.cli.record import JsonLines
from triaxcald.schema.codes import Code

NOW_NS = 1_772_366_400_250_000_000


def test_each_line_is_an_object_with_time_level_and_event() -> None:
    out = io.StringIO()
    lines = JsonLines(out, lambda: NOW_NS)
    lines.note("unit0", "recording")
    lines.lost("unit0", Code.ABSENT, "nothing answers\nat node 5")
    lines.say("error", "ended", unit="unit0", lost=3)
    assert [json.loads(line) for line in out.getvalue().splitlines()] == [
        {"time": "2026-03-01T12:00:00.250+00:00", "level": "info", "event": "stage", "unit": "unit0",
         "message": "recording"},
        {"time": "2026-03-01T12:00:00.250+00:00", "level": "warning", "event": "lost", "unit": "unit0",
         "message": "nothing answers\nat node 5"},
        {"time": "2026-03-01T12:00:00.250+00:00", "level": "error", "event": "ended", "unit": "unit0", "lost": 3},
    ]  # fmt: skip


def test_nobody_who_reads_is_no_failure() -> None:
    out = io.StringIO()
    out.close()
    JsonLines(out).note("unit0", "recording")
