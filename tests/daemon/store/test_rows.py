"""An outcome as a row: each cell from its place, and nothing from a document that is not ours."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from tests.daemon.store.conftest import document
from triaxcald.documents import to_text
from triaxcald.recording.reader import Recording
from triaxcald.schema.columns import COLUMNS, NAMES, Kind
from triaxcald.schema.outcome import Outcome
from triaxcald.store.rows import NoOutcome, cells_of, microseconds

RECORDINGS = Path(__file__).parents[3] / "recordings"
VALUES: dict[Kind, Any] = {Kind.TEXT: "a text", Kind.TEXTS: ["one", "two"], Kind.WHOLE: 7, Kind.NUMBER: 0.25}


def cells(of: dict[str, Any], name: str = "a.outcome.json") -> dict[str, Any]:
    return cells_of(to_text(of).encode(), name)


def put(of: dict[str, Any], key: tuple[str | int, ...], value: Any) -> None:
    """At the place; lists have three items."""
    at: Any = of
    for step, following in pairwise(key):
        if isinstance(step, str) and not isinstance(at.get(step), (dict, list)):
            at[step] = [None] * 3 if isinstance(following, int) else {}
        at = at[step]
    at[key[-1]] = value


@pytest.mark.parametrize("column", [c for c in COLUMNS if c.key], ids=lambda c: c.name)
def test_each_cell_comes_from_its_place(column: Any) -> None:
    assert column.key
    value = {"verdict": "fail", "started": "2026-01-31T11:00:00+00:00", "ended": "2026-01-31T11:00:00+00:00"}.get(
        column.name, VALUES[column.kind]
    )
    of = document()
    put(of, column.key, value)
    found = cells(of)[column.name]
    assert (json.loads(found) if column.kind is Kind.TEXTS else found) == value


WRONG: list[Any] = [{}, True, float("inf"), float("nan"), "x" * 5000, [1], ["a", None], 10**400]


@pytest.mark.parametrize("column", [c for c in COLUMNS if c.key], ids=lambda c: c.name)
@pytest.mark.parametrize("value", WRONG, ids=range(len(WRONG)))
def test_a_value_of_another_type_makes_no_row(column: Any, value: Any) -> None:
    of = document()
    put(of, column.key, value)
    with pytest.raises(NoOutcome):
        cells_of(json.dumps(of).encode(), "a.outcome.json")


@pytest.mark.parametrize(
    "changed",
    [
        {"format": "triaxcal.run/1"}, {"format": None}, {"verdict": "perhaps"}, {"ended": "yesterday"},
        {"ended": "2026-13-01T00:00:00+00:00"}, {"started": ""}, {"measured": 5}, {"measured": []}, {"work": "me"},
        {"measured": {"calibration": {"bias": [0.1, 0.2]}}}, {"work": {"attempt": 0}}, {"unit": None},
        {"reason": None}, {"limits": [1]},
    ],
    ids=str,
)  # fmt: skip
def test_a_document_that_is_not_ours_makes_no_row(changed: dict[str, Any]) -> None:
    with pytest.raises(NoOutcome):
        cells(document(**changed))


@pytest.mark.parametrize(
    "data",
    [
        b"", b"null", b"[]", b"{", b"\xff\xfe", b"[" * 100_000, b'{"a":' * 100_000, b'{"format":"triaxcal.outcome/1"}',
        b'{"format":1,"format":2}', b'{"exit_code":' + b"9" * 5000 + b"}", b"[]," * 500_000, b'{"unit":"\\ud800"}',
    ],
    ids=range(12),
)  # fmt: skip
def test_bytes_that_are_no_outcome_make_no_row(data: bytes) -> None:
    with pytest.raises(NoOutcome):
        cells_of(data, "a.outcome.json")


def test_a_stored_outcome_of_an_earlier_version_has_empty_cells_for_later_keys() -> None:
    with Recording.open(RECORDINGS / "made-by/0.2.0.dev0/can-second-order.mcap") as recording:
        data = recording.attachments["outcome.json"]
    held = Outcome.read(json.loads(data))
    assert held is not None
    assert held.measured is not None
    found = cells_of(data, "can-second-order-1001-x.outcome.json")
    assert (found["serial"], found["verdict"], found["rms_g"]) == ("1001", "pass", held.measured.after.rms_g)
    assert (found["rms_limit_g"], found["verification_rms_limit_g"]) == (6e-05, 6e-05)
    later = {"run", "started", "duration_s", "slot", "work_serial", "operator", "attempt", "scale_factor_x"}
    assert {name for name in later if found[name] is not None} == set()
    assert found["tried"] == 1  # its recording is listed


def test_the_duration_is_from_start_to_end_whatever_the_offset() -> None:
    found = cells(document(started="2026-01-31T12:59:00.500+01:00"))
    assert found["duration_s"] == 59.5
    assert found["at_us"] == found["ended_us"] - 59_500_000


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1970-01-01T00:00:00+00:00", 0), ("1970-01-01T00:00:00", 0), ("1970-01-01T01:00:00.000001+01:00", 1),
        ("1969-12-31T23:59:59.999999+00:00", -1), ("2026-01-31T12:00:00Z", 1769860800_000000),
    ],
)  # fmt: skip
def test_times_are_counted_in_utc(text: str, expected: int) -> None:
    assert microseconds(text) == expected


def test_names_are_unique_and_none_is_lost() -> None:
    assert len(set(NAMES)) == len(NAMES)
    assert set(NAMES) < set(cells(document()))
