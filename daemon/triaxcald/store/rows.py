"""From an outcome to its row in the index. Fields are taken by hand and checked: the
models would take ten times as long for 20,000 outcomes."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping
from datetime import UTC, datetime, timedelta
from typing import Any, Final, NamedTuple

from triaxcald.errors import InputError
from triaxcald.inputs import parse_document
from triaxcald.outcome import FORMAT, SUFFIX, digest_of
from triaxcald.schema.codes import Verdict
from triaxcald.schema.columns import COLUMNS, Key, Kind

Cell = str | int | float | None
BESIDE: Final = {"recording": ".mcap", "certificate": ".certificate.json", "report": ".report.html"}
"""Files of a run, by column, with the ends of their names."""
TEXT_MOST = 4000
"""Characters of one cell; the longest sentence of ours is shorter."""
WHOLE_MOST = 2**63 - 1
FINITE_MOST = sys.float_info.max


class NoOutcome(Exception):
    """A document that is no outcome, or has a field of another type than ours."""


def cells_of(data: bytes, name: str) -> dict[str, Cell]:
    """The row of the outcome with these bytes in the file ``name``: the cells of
    `NAMES`, and those that only the index has. A `provision` or `restore` was no
    attempt at the unit; before version 0.2 an attempt is known by the contents of its
    recording. Raises NoOutcome."""
    try:
        document = parse_document(data, where=name)
    except InputError as e:
        raise NoOutcome(str(e)) from e
    if document.get("format") != FORMAT:
        raise NoOutcome(f"{name}: not {FORMAT}")
    cells: dict[str, Cell] = {}
    for place, keys, taken in _PLACES:
        values = _values(_at(document, place), keys)
        for value, (column, read, required) in zip(values, taken, strict=True):
            cells[column] = None if value is None else read(value)
            if required and value is None:
                raise NoOutcome(f"{name}: {column} is missing")
    if cells["verdict"] not in _VERDICTS:
        raise NoOutcome(f"{name}: no verdict of ours")
    if cells["attempt"] is not None and int(cells["attempt"]) < 1:
        raise NoOutcome(f"{name}: attempts count from 1")
    started, ended = _moment(cells["started"]), _moment(cells["ended"])
    assert ended is not None
    stem = name.removesuffix(SUFFIX)
    cells |= {column: stem + end for column, end in BESIDE.items() if cells.get(column) is None}
    return cells | {
        "duration_s": None if started is None else (ended - started) / 1e6,
        "outcome": name,
        "outcome_sha256": digest_of(data),
        "at_us": ended if started is None else started,
        "ended_us": ended,
        "tried": int(cells["attempt"] is not None or document.get("contents") is not None),
    }


_VERDICTS = frozenset(map(str, Verdict))


def microseconds(text: str) -> int:
    """Of a time in ISO 8601 since 1970, UTC where it has no offset. Raises
    ValueError."""
    moment = datetime.fromisoformat(text)
    aware = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
    return (aware - _EPOCH) // timedelta(microseconds=1)


_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def _moment(text: Cell) -> int | None:
    if text is None:
        return None
    try:
        return microseconds(str(text))
    except ValueError as e:
        raise NoOutcome(f"no time: {e}") from e


def _at(document: Any, place: Key) -> Any:
    """None where a key is absent or null on the way."""
    for key in place:
        (document,) = _values(document, (key,))
        if document is None:
            return None
    return document


def _values(held: Any, keys: Key) -> list[Any]:
    """None for what is absent from an object; all of them where there is none."""
    if held is None:
        return [None] * len(keys)
    if isinstance(held, dict):
        return [*map(held.get, keys)]
    if isinstance(held, list) and all(isinstance(key, int) and key < len(held) for key in keys):
        return [held[int(key)] for key in keys]
    raise NoOutcome(f"no {keys[0]} in a {type(held).__name__}")


def _text(value: Any) -> str:
    if type(value) is str and len(value) <= TEXT_MOST:
        return value
    raise NoOutcome("no text")


def _texts(value: Any) -> str:
    if isinstance(value, list) and all(type(text) is str for text in value):
        return _text(json.dumps(value, ensure_ascii=False))
    raise NoOutcome("no list of texts")


def _whole(value: Any) -> int:
    if type(value) is int and abs(value) <= WHOLE_MOST:
        return value
    raise NoOutcome("no whole number")


def _number(value: Any) -> float:
    if type(value) in (int, float) and abs(value) <= FINITE_MOST:  # which NaN is not
        return float(value) + 0.0  # SQLite has no negative zero
    raise NoOutcome("no finite number")


_READERS: Mapping[Kind, Callable[[Any], Cell]] = {
    Kind.TEXT: _text, Kind.TEXTS: _texts, Kind.WHOLE: _whole, Kind.NUMBER: _number,
}  # fmt: skip


class _Taken(NamedTuple):
    column: str
    read: Callable[[Any], Cell]
    required: bool


def _places() -> list[tuple[Key, Key, list[_Taken]]]:
    """The columns by the object or list that holds them, which is looked up once: its
    place, the keys in it, and what is made of their values."""
    found: dict[Key, dict[str | int, _Taken]] = {}
    for c in COLUMNS:
        if c.key:
            found.setdefault(c.key[:-1], {})[c.key[-1]] = _Taken(c.name, _READERS[c.kind], c.required)
    return [(place, tuple(taken), list(taken.values())) for place, taken in found.items()]


_PLACES = _places()
