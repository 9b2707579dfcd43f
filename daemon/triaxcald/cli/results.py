"""results."""

from __future__ import annotations

import argparse
import csv
import gzip
import io
import json
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from datetime import date
from pathlib import Path
from typing import Any

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald.cli.console import erased, micro, say, show, table
from triaxcald.cli.syntax import writable
from triaxcald.errors import InputError
from triaxcald.files import new_beside
from triaxcald.printable import printable_json
from triaxcald.schema.codes import Code, Verdict
from triaxcald.schema.columns import COLUMNS, NAMES, Kind
from triaxcald.store import Runs, Store, microseconds

KINDS = (".csv", ".csv.gz", ".parquet")
SHOWN_MOST = 1000
"""Rows on the console. Nobody reads more; laying out 20,000 takes half a minute."""
NAMED_MOST = 3
"""Files that are left out, by name; the others are counted."""
WORDS = {
    Verdict.PASS: "PASS",
    Verdict.FAIL: "FAIL",
    Verdict.ABORTED: "STOPPED",
    Verdict.NOT_JUDGED: "NO LIMIT",
}
SAID = (Code.WITHIN_LIMITS, Code.NO_LIMIT)
"""Codes that say no more than the word."""


def results_command(a: argparse.Namespace) -> int:
    require_kind(a.output)
    since_us, until_us = period_us(a.since, a.until)
    if a.database is not None and not a.rebuild:
        raise InputError("--database: give --rebuild with it")
    if a.rebuild:
        _rebuild(a.folder, a.database)
    runs = _runs(a.folder, since_us=since_us, until_us=until_us, serial=a.serial, code=a.code)
    if a.output is not None:
        write_table(a.output, {c.name: _TYPES[c.kind] for c in COLUMNS}, _joined(runs))
    if a.json:
        _emit(str(a.folder), runs)
    elif a.output is None and runs.rows:
        _show(runs.rows)
    if not a.json:
        show(_summary(runs.rows))
    if runs.skipped:
        more = f" and {len(runs.skipped) - NAMED_MOST} more" if len(runs.skipped) > NAMED_MOST else ""
        say(f"{a.folder}: left out, not readable as an outcome: {', '.join(runs.skipped[:NAMED_MOST])}{more}")
    return 0


def period_us(since: str | None, until: str | None) -> tuple[int | None, int | None]:
    """The first moment of ``since``, and the one after ``until``. Raises InputError."""
    since_us = None if since is None else _moment("--since", since)
    until_us = None if until is None else _moment("--until", until, days=1)
    if since_us is not None and until_us is not None and since_us >= until_us:
        raise InputError(f"--since: expected a time before --until {until}, not '{since}'")
    return since_us, until_us


def _moment(option: str, text: str, days: int = 0) -> int:
    """Microseconds since 1970: of a date its first moment, or that of so many days
    later. Raises InputError."""
    with suppress(ValueError):
        day = date.fromisoformat(text)
        return ((day - date(1970, 1, 1)).days + days) * 86_400_000_000
    try:
        return microseconds(text)
    except ValueError:
        expected = "expected a date or a time as 2026-01-31 or 2026-01-31T12:00+01:00"
        raise InputError(f"{option}: {expected}, not '{text}'") from None


def _rebuild(folder: Path, database: str | None) -> None:
    """Make the index anew, and the rows of a service where there is one. Raises
    InputError, StationError."""
    _require_folder(folder)
    try:
        with Store(folder) as store:
            store.forget()
            rows = store.runs().rows
            served = store.has_service()
    except OSError as e:
        raise InputError(f"{folder}: cannot be read: {e.strerror}") from e
    if not rows and database is not None:
        raise InputError(f"{folder}: no outcome says which station's rows these are")
    if not served and database is None:
        return
    if hint := td.hints.absent(("sqlalchemy", "alembic")):
        if database is not None:
            raise InputError(f"--database: {hint}")
        say(f"{folder}: the rows of units and measurements stay as they are: {hint}")
        return
    from triaxcald.service.ledger import Ledger

    station = str(rows[-1][NAMES.index("station")]) if rows else ""
    with closing(Ledger.of_folder(folder, station, database)) as ledger:
        ledger.rebuild()


def _require_folder(folder: Path) -> None:
    """Raises InputError."""
    if not folder.is_dir():
        raise InputError(f"{folder}: {'not a folder' if folder.exists() else 'there is no such folder'}")


def _runs(folder: Path, **wanted: Any) -> Runs:
    """Raises InputError where the folder cannot be read."""
    _require_folder(folder)
    try:
        with Store(folder) as store:
            return store.runs(**wanted)
    except OSError as e:
        raise InputError(f"{folder}: cannot be read: {e.strerror}") from e


# Output.


def _summary(rows: Sequence[Sequence[Any]]) -> str:
    """ "12 runs: 10 pass, 2 fail (10 within_limits, 2 fit_outside)"."""
    if not rows:
        return "no runs"
    verdicts, codes = _counts(rows, "verdict"), _counts(rows, "code")
    told = ", ".join(f"{count} {word}" for word, count in verdicts.items())
    by_code = ", ".join(f"{count} {word}" for word, count in codes.items())
    return f"{tc.number_format.number_of(len(rows), 'run')}: {told}{f' ({by_code})' if codes else ''}"


def _counts(rows: Iterable[Sequence[Any]], column: str) -> dict[str, int]:
    """In the order of our words, then of others that a later version may have."""
    counted = Counter(str(row[NAMES.index(column)]) for row in rows if row[NAMES.index(column)] is not None)
    order = [str(word) for word in (*Verdict, *Code)]
    return {word: counted[word] for word in sorted(counted, key=lambda w: (order.index(w) if w in order else 99, w))}


def _show(rows: Sequence[Sequence[Any]]) -> None:
    """A row a run. The table fits a terminal of 80 characters."""
    shown = [dict(zip(NAMES, row, strict=True)) for row in rows[-SHOWN_MOST:]]
    columns = ["started (UTC)", "slot", "serial", "try", "result", "fit", "check"]
    title = "rms error of the fit and of the check poses in µg"
    if len(rows) > SHOWN_MOST:
        title = f"the last {SHOWN_MOST} of {len(rows)} runs (-o writes all), {title}"
    table(title, columns, map(_line, shown))


def _line(row: dict[str, Any]) -> list[str | None]:
    attempt = row["attempt"]
    return [
        str(row["started"] or row["ended"])[:16].replace("T", " "),
        row["slot"] or row["unit"],
        row["serial"] or row["work_serial"],
        None if attempt is None else str(attempt),
        WORDS[Verdict(row["verdict"])] + ("" if row["code"] in (None, *SAID) else f" {row['code']}"),
        *(None if row[name] is None else micro(row[name]) for name in ("rms_g", "verification_rms_g")),
    ]


def _emit(folder: str, runs: Runs) -> None:
    """`triaxcal.results/1`, a run a line: of many runs no more than one is in memory
    as text."""
    from triaxcald.schema.results import Results, Row

    head = Results(
        format="triaxcal.results/1",
        folder=folder,
        verdicts=_counts(runs.rows, "verdict"),
        codes=_counts(runs.rows, "code"),
        skipped=runs.skipped,
        runs=[],
    ).document()
    erased()
    _put("{")
    for key in [key for key in head if key != "runs"]:
        _put(f"\n  {json.dumps(key)}: {_json(head[key])},")
    _put('\n  "runs": [')
    for i, row in enumerate(runs.documents()):
        _put(f"{',' if i else ''}\n    {_json(Row.model_validate(row).document())}")
    _put("\n  ]\n}\n" if runs.rows else "]\n}\n")


def _json(value: Any) -> str:
    return printable_json(json.dumps(value, ensure_ascii=False, allow_nan=False))


def _put(text: str) -> None:
    sys.stdout.write(text)


def require_kind(path: Path | None) -> None:
    """Raises InputError where no table has such a name, or none can be written
    there."""
    if path is not None and not path.name.endswith(KINDS):
        raise InputError(f"{path}: expected a name that ends in {', '.join(KINDS)}")
    writable(path)


def write_table(path: Path, types: Mapping[str, type], rows: Iterable[Sequence[Any]]) -> None:
    """Cells of these types by column, None for a gap. Raises InputError."""
    try:
        with new_beside(path) as beside:
            if path.name.endswith(".parquet"):
                from triaxcald.tables.arrow import write_rows

                write_rows(beside, types, rows)
                return
            with beside.open("wb") as file:
                packed = path.name.endswith(".gz")
                bytes_ = gzip.GzipFile(filename="", fileobj=file, mode="wb", mtime=0) if packed else file
                with io.TextIOWrapper(bytes_, "utf-8", newline="") as out:
                    lines = csv.writer(out, lineterminator="\n")
                    lines.writerow(types)
                    lines.writerows(rows)
    except OSError as e:
        raise InputError(f"{path}: cannot be written: {e.strerror}") from e


def _joined(runs: Runs) -> Iterator[list[Any]]:
    """The cells of each run, lists as one text."""
    for row in runs.documents():
        yield ["; ".join(cell) if isinstance(cell, list) else cell for cell in row.values()]


_TYPES: dict[Kind, type] = {Kind.TEXT: str, Kind.TEXTS: str, Kind.WHOLE: int, Kind.NUMBER: float}
