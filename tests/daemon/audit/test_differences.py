"""Where two documents differ, and what of it counts where another version made the first."""

from __future__ import annotations

import json
from typing import Any

import pytest

from triaxcald.audit.differences import NOTHING, Difference, Kind, compare

STORED: dict[str, Any] = {"bias": [0.5, 0.25], "warnings": ["a word"], "poses": [{"used": True, "reason": "so"}]}


def found(again: dict[str, Any], *, by_another: bool) -> list[Difference]:
    return compare("x.json", json.dumps(STORED).encode(), json.dumps(again).encode(), by_another=by_another)


@pytest.mark.parametrize(
    "again",
    [
        STORED | {"warnings": ["another word", "and one more"]},
        STORED | {"added": 1},
        STORED | {"poses": [{"used": True, "reason": "otherwise", "excluded": None}]},
    ],
)
def test_of_another_version_words_and_further_keys_do_not_count(again: dict[str, Any]) -> None:
    assert found(again, by_another=True) == []
    assert found(again, by_another=False) != []


@pytest.mark.parametrize(
    ("again", "place", "stored", "now"),
    [
        (STORED | {"bias": [0.5, 0.26]}, "bias[1]", 0.25, 0.26),
        (STORED | {"poses": [{"used": False, "reason": "so"}]}, "poses[0].used", True, False),
        ({k: v for k, v in STORED.items() if k != "bias"}, "bias", [0.5, 0.25], NOTHING),
    ],
)
def test_numbers_count_whoever_made_them(again: dict[str, Any], place: str, stored: Any, now: Any) -> None:
    for by_another in (True, False):
        assert found(again, by_another=by_another) == [Difference("x.json", Kind.VALUE, place, stored, now)]


def test_bytes_count_only_where_the_version_is_the_same() -> None:
    stored, again = b'{"a": 1}', b'{"a":1}'
    assert compare("x.json", stored, again, by_another=True) == []
    assert compare("x.json", stored, again) == [Difference("x.json", Kind.BYTES)]
