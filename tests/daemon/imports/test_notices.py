"""What is said of an import, where there is one of a kind."""

from __future__ import annotations

from typing import Any

from triaxcald.imports.importing import left_out, remarks, summary

TIMES = {"back": 1, "furthest_back_s": 2.0, "equal": 1, "pauses": 1, "longest_pause_s": 3.0}
COUNTS = dict.fromkeys(("missing", "duplicates", "incomplete", "errors", "malformed", "invalid", "not_finite"), 0)


def detail(**more: Any) -> dict[str, Any]:
    return {
        "kind": "BLF", "file": "a.blf", "samples": {"samples": 1, **COUNTS}, "other_frames": 1, "elsewhere": 0,
        "other_records": {}, "remarks": [], "seconds_by_log": 0.0, "times": TIMES, "damaged": 2, "damage": "byte 7",
        **more,
    }  # fmt: skip


def test_one_of_a_kind_is_told_in_the_singular() -> None:
    assert summary("rec.mcap", detail(), 0.0) == "rec.mcap: 1 sample in 0.00 s from a.blf (BLF)"
    assert left_out(detail()) == "left out: 1 frame of other identifiers"
    assert left_out(detail(kind="MCAP")) == "left out: 1 message of other topics"
    assert remarks(detail(), 0.0) == [
        "1 record came with a time before that of an earlier one, by up to 2 s; these times are kept",
        "1 sample came with the time of the one before; the commands that read the recording leave such out",
        "1 pause, the longest of 3 s",
        "damaged: byte 7, and 1 more place; what is whole was taken",
    ]
