"""Attitude files: which way was up in each pose, as CSV, matched to the still
poses of a recording."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald.errors import InputError

VECTOR, TIMES, LABEL = ("x", "y", "z"), ("start_s", "end_s"), "label"
TOLD_MOST = 30
TABLE_MOST, ROWS_MOST = 2**20, 10_000  # bytes; a turntable that takes ten thousand poses is at it for days


@dataclass(frozen=True)
class Row:
    """``up`` (3,) in the table's frame; ``start_s``, ``end_s`` where the file
    has them. ``name`` for messages."""

    line: int
    name: str
    up: tc.Floats
    start_s: float | None = None
    end_s: float | None = None


def read_attitudes(path: str) -> list[Row]:
    """A CSV with the columns ``x,y,z`` or ``label`` (a label of a plan), or
    both, and ``start_s,end_s`` or neither.

    `#` lines are comments. Raises InputError: file, line, field, what was
    expected.
    """
    try:
        text = td.files.read_whole(Path(path), TABLE_MOST, pipe=True).decode("utf-8-sig")
    except OSError as e:
        raise InputError(f"{path}: cannot be read: {e.strerror}") from e
    except UnicodeDecodeError as e:
        raise InputError(f"{path}: not UTF-8 text (byte {e.start})") from e
    try:
        lines = [(n, [cell.strip() for cell in cells]) for n, cells in _lines(text)]
    except csv.Error as e:
        raise InputError(f"{path}: not CSV text: {e}") from e
    if not lines:
        raise InputError(f"{path}: empty, expected the header x,y,z or label, and start_s,end_s or neither")
    (header_line, header), body = lines[0], lines[1:]
    _check_header(path, header_line, header)
    if len(body) > ROWS_MOST:
        raise InputError(f"{path}: {len(body)} attitudes, expected at most {ROWS_MOST}")
    rows = [_row(path, line, header, cells) for line, cells in body]
    if not rows:
        raise InputError(f"{path}: line {header_line}: no attitudes after the header, expected some")
    return rows


def _lines(text: str) -> Iterator[tuple[int, list[str]]]:
    for number, line in enumerate(text.splitlines(), start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            yield number, next(csv.reader([line], strict=True))


def _check_header(path: str, line: int, header: Sequence[str]) -> None:
    expected = "expected x,y,z or label, and start_s,end_s or neither"
    for name in header:
        if name not in (*VECTOR, *TIMES, LABEL):
            raise InputError(f"{path}: line {line}: no column '{name[:40]}' is known, {expected}")
        if header.count(name) > 1:
            raise InputError(f"{path}: line {line}: the column {name} is there twice, {expected}")
    for group in (VECTOR, TIMES):
        missing = [name for name in group if name not in header]
        if 0 < len(missing) < len(group):
            raise InputError(f"{path}: line {line}: the column {missing[0]} is missing, {expected}")
    if VECTOR[0] not in header and LABEL not in header:
        raise InputError(f"{path}: line {line}: the columns x,y,z are missing, {expected}")


def _row(path: str, line: int, header: Sequence[str], cells: Sequence[str]) -> Row:
    where = f"{path}: line {line}"
    if len(cells) != len(header):
        raise InputError(f"{where}: {len(cells)} fields, expected {len(header)} ({','.join(header)})")
    held = dict(zip(header, cells, strict=True))
    if VECTOR[0] in held:
        up = np.array([_number(where, name, held[name]) for name in VECTOR])
        if not 1e-150 < float(np.max(np.abs(up))) < 1e150:
            raise InputError(f"{where}: x,y,z: a vector of no length, expected the direction of up")
    else:
        up = _labelled(where, held[LABEL])
    name = f"line {line} ({held[LABEL]})" if held.get(LABEL) else f"line {line}"
    if TIMES[0] not in held:
        return Row(line, name, up)
    start, end = (_number(where, name, held[name]) for name in TIMES)
    if not start < end:
        raise InputError(f"{where}: end_s: {end:g} is not after start_s {start:g}")
    return Row(line, name, up, start, end)


def _number(where: str, field: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"{where}: {field}: '{text[:40]}', expected a finite number")
    return value


def _labelled(where: str, label: str) -> tc.Floats:
    known: Mapping[str, tc.Floats] = dict(tc.planning.cube_directions())
    try:
        return known[label.upper().replace("−", "-")]
    except KeyError:
        raise InputError(
            f"{where}: label: '{label[:40]}', expected one of a plan as +X, -Y+Z or +X-Y-Z (of 26)"
        ) from None


def match(
    rows: Sequence[Row], poses: Sequence[tc.Pose], *, path: str, recording: str
) -> tuple[list[tc.Pose], list[Row]]:
    """The poses that have a row, and their rows: by time where the file has
    times, else in order.

    Raises InputError where the two do not go together.
    """
    if rows[0].start_s is None:
        if len(rows) != len(poses):
            raise InputError(
                f"{path}: {len(rows)} attitudes, but {len(poses)} still poses in {recording}{_found(poses)}; expected "
                "one row for each pose, or columns start_s,end_s to match them by"
            )
        return list(poses), list(rows)
    owner: dict[int, Row] = {}
    for row in rows:
        shared = [_shared(row, p) for p in poses]
        best = int(np.argmax(shared)) if shared else -1
        if best < 0 or shared[best] <= 0:
            raise InputError(
                f"{path}: line {row.line}: no still pose of {recording} between {row.start_s:g} and {row.end_s:g} s"
                f"{_found(poses)}"
            )
        if best in owner:
            p = poses[best]
            raise InputError(
                f"{path}: line {row.line}: the still pose at {p.start_s:.1f} to {p.end_s:.1f} s is that of line "
                f"{owner[best].line} already"
            )
        owner[best] = row
    kept = sorted(owner)
    return [poses[i] for i in kept], [owner[i] for i in kept]


def _shared(row: Row, pose: tc.Pose) -> float:
    assert row.start_s is not None
    assert row.end_s is not None
    return min(row.end_s, pose.end_s) - max(row.start_s, pose.start_s)


def _found(poses: Sequence[tc.Pose]) -> str:
    if not poses:
        return ""
    spans = ", ".join(f"{p.start_s:.1f}–{p.end_s:.1f}" for p in poses[:TOLD_MOST])
    return f" (at {spans}{' …' if len(poses) > TOLD_MOST else ''} s)"
