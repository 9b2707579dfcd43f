"""The runs of a folder, of a file `triaxcal.sqlite`, or of a PostgreSQL server, and
what the certificates beside the outcomes say of effects and uncertainties."""

from __future__ import annotations

import json
import re
import sqlite3
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import triaxcal_drivers as td
from triaxcald.errors import InputError
from triaxcald.inputs import DOCUMENT_MOST
from triaxcald.schema.columns import NAMES
from triaxcald.store import TIMES, Store, timed_in
from triaxcald.work import plain_serial

Row = dict[str, Any]
WORK: Final = ("part_number", "batch", "station", "fixture", "slot", "operator", "order", "serial")
"""Columns that a selection names."""


@dataclass(frozen=True)
class Selection:
    """Which runs: times in µs since 1970, from ``since_us`` on and before ``until_us``,
    and ``equal`` texts by column of `WORK`."""

    since_us: int | None = None
    until_us: int | None = None
    equal: Mapping[str, str] = field(default_factory=dict)

    def takes(self, row: Row) -> bool:
        return all(
            plain_serial(wanted) in _plain(row) if name == "serial" else row[name] == wanted
            for name, wanted in self.equal.items()
        )


def _plain(row: Row) -> list[str]:
    """Serial numbers of the unit, without leading zeros."""
    return [plain_serial(text) for text in (row["serial"], row["work_serial"]) if text is not None]


@dataclass(frozen=True)
class SeenEffect:
    """An effect in a certificate: the ``probability`` that it acts, None where it is a
    finding without a calibrated one; ``coefficients`` by name, each with value,
    standard error and unit, empty where the calibration does not correct it."""

    probability: float | None
    coefficients: Mapping[str, tuple[float, float | None, str]]


@dataclass(frozen=True)
class Certified:
    """``uncertainty`` by the keys of `expanded_uncertainty_g`."""

    effects: Mapping[str, SeenEffect]
    uncertainty: Mapping[str, float]


@dataclass(frozen=True)
class Runs:
    """``rows`` are attempts and others, in the order of time, with the columns of
    `results` and `TIMES`. ``certified`` is by the name of the outcome; ``skipped`` are
    names of files that are no outcome or certificate."""

    source: str
    rows: list[Row]
    certified: dict[str, Certified]
    skipped: list[str]
    folder: Path | None = None
    """Of the certificates; None of a server's runs."""


def read_runs(source: str, selection: Selection, tell: Callable[[int, int], None] = lambda done, of: None) -> Runs:
    """``source`` is a folder, a file, or a URL of PostgreSQL or SQLite. ``tell`` is
    called with the number of certificates read so far, and of all. Raises InputError,
    DatabaseError."""
    given = {"since_us": selection.since_us, "until_us": selection.until_us}
    folder: Path | None = None
    skipped: list[str] = []
    if "://" in source and not source.startswith("sqlite:"):
        cells = _of_server(source, given)
    else:
        path = Path(re.sub(r"^sqlite:(///?)?", "", source))
        folder = path if path.is_dir() else path.parent
        cells, skipped = _of_folder(path, given) if path.is_dir() else (_of_file(path, given), [])
    rows = [dict(zip((*NAMES, *TIMES), row, strict=True)) for row in cells]
    rows = [row for row in rows if selection.takes(row)]
    certified, unread = _certificates(folder, rows, tell) if folder is not None else ({}, [])
    return Runs(source, rows, certified, skipped + unread, folder)


def _of_server(url: str, given: Mapping[str, int | None]) -> Sequence[tuple[Any, ...]]:
    if hint := td.hints.absent(("sqlalchemy", "alembic")):
        raise InputError(f"a database of several stations: {hint}")
    from triaxcald.service.every_station import runs_of_every_station

    return runs_of_every_station(url, named="the database", since_us=given["since_us"], until_us=given["until_us"])


def _of_folder(path: Path, given: Mapping[str, int | None]) -> tuple[Sequence[tuple[Any, ...]], list[str]]:
    try:
        with Store(path) as store:
            found = store.timed(since_us=given["since_us"], until_us=given["until_us"])
    except OSError as e:
        raise InputError(f"{path}: cannot be read: {e.strerror}") from e
    return found.rows, found.skipped


def _of_file(path: Path, given: Mapping[str, int | None]) -> Sequence[tuple[Any, ...]]:
    if not path.is_file():
        raise InputError(f"{path}: there is no such folder or file")
    try:
        return timed_in(path, since_us=given["since_us"], until_us=given["until_us"])
    except (sqlite3.Error, UnicodeDecodeError) as e:
        expected = "expected a folder, triaxcal.sqlite, or postgresql://…"
        raise InputError(f"{path}: no table of runs can be read from it ({e}); {expected}") from e


# Certificates. One has 100 kB, of which 5 are wanted: these are cut out by their
# indentation, which a writer of ours gives, and the whole is parsed where it differs.


def _certificates(
    folder: Path, rows: Sequence[Row], tell: Callable[[int, int], None]
) -> tuple[dict[str, Certified], list[str]]:
    found, unread = {}, []
    for i, row in enumerate(rows):
        name = row["certificate"]
        if name is None or row["rms_g"] is None:  # without a fit there is none
            continue
        try:
            data = td.files.read_whole(folder / Path(name).name, DOCUMENT_MOST)
            found[row["outcome"]] = certified_in(data.decode())
        except FileNotFoundError:
            continue
        except (OSError, ValueError, td.files.TooLarge):
            unread.append(name)
        tell(i + 1, len(rows))
    return found, unread


def certified_in(text: str) -> Certified:
    """Of the text of a `triaxcal.certificate/1`. Raises ValueError for another."""
    try:
        return _certified(_cut_out(text))
    except (KeyError, TypeError, AttributeError, RecursionError):
        pass
    try:
        result = json.loads(text)["result"]
        calibration = result["calibration"]
        parts = {key: result.get(key) for key in _OF_RESULT}
        return _certified(parts | {key: calibration.get(key) for key in _OF_CALIBRATION})
    except (KeyError, TypeError, AttributeError, RecursionError) as e:
        raise ValueError("no certificate") from e


_OF_RESULT: Final = ("findings", "probabilities")
_OF_CALIBRATION: Final = ("effects", "expanded_uncertainty_g")
_DECODER: Final = json.JSONDecoder()


def _cut_out(text: str) -> dict[str, Any]:
    """Raises KeyError where a part is not at its place."""
    start = _after(text, '\n  "result": ', 0)
    parts = {key: _DECODER.raw_decode(text, _after(text, f'\n    "{key}": ', start))[0] for key in _OF_RESULT}
    inside = _after(text, '\n    "calibration": ', start)
    for key in _OF_CALIBRATION:
        parts[key] = _DECODER.raw_decode(text, _after(text, f'\n      "{key}": ', inside))[0]
    return parts


def _after(text: str, key: str, start: int) -> int:
    """Texts in JSON hold no line ends: what follows one, with so many spaces, is a key
    at that depth."""
    at = text.find(key, start)
    if at < 0:
        raise KeyError(key)
    return at + len(key)


def _certified(parts: Mapping[str, Any]) -> Certified:
    coefficients = {
        effect: {
            name: (float(of["value"]), _number(of.get("standard_error")), str(of.get("unit") or ""))
            for name, of in by_name.items()
            if isinstance(of, dict) and _number(of.get("value")) is not None
        }
        for effect, by_name in (parts["effects"] or {}).items()
    }
    findings = {finding["effect"] for finding in parts["findings"] or []}
    chances = {name: _number(p) for name, p in (parts["probabilities"] or {}).items()}
    names = {**dict.fromkeys(coefficients), **dict.fromkeys(findings), **dict.fromkeys(chances)}
    effects = {
        name: SeenEffect(chances.get(name), coefficients.get(name, {}))
        for name in names
        if chances.get(name) is not None or name in findings or name in coefficients
    }
    known = {key: _number(value) for key, value in (parts["expanded_uncertainty_g"] or {}).items()}
    return Certified(effects, {key: value for key, value in known.items() if value is not None})


def _number(value: Any) -> float | None:
    return float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else None
