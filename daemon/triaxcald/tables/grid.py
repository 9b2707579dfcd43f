"""A table as columns of cells: what stands where, before anything is known of
what it means."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from triaxcal_drivers.nearest import clipped
from triaxcald.tables import arrow
from triaxcald.tables.arrow import Column
from triaxcald.tables.layout import Layout, decoded, is_sample, layout_of
from triaxcald.tables.naming import Unclear
from triaxcald.tables.own_text import FIELDS_MOST

HEAD = 2**20
"""Characters in which the layout is looked for."""
_LEFT = r"^[ \t]*(?:(?:#|%|//)[^\n]*)?(?:\n|\Z)"


@dataclass(frozen=True)
class Grid:
    """Columns of n rows with their names. ``line_of`` says where a row stands,
    as in "line 17". ``head`` are the lines above, and ``ragged`` those that have
    another number of fields: where, and how many."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    named: bool
    columns: tuple[Column, ...]
    line_of: Callable[[int], str]
    head: tuple[str, ...] = ()
    ragged: tuple[tuple[str, int], ...] = ()

    def called(self, column: int) -> str:
        return f"column {clipped(self.names[column])}" if self.named else f"column {column + 1}"


def grid_of_parquet(path: Path) -> Grid:
    """Raises InputError."""
    names, columns = arrow.read_parquet(path)
    return Grid(tuple(names), ("",) * len(names), True, tuple(columns), lambda row: f"row {row + 1}")


def grid_of_text(first: bytes, rest: Iterator[bytes]) -> Grid:
    """Of the bytes of a file, the ``first`` block and the ``rest``. Raises
    Unclear."""
    whole = b"".join(chain((first,), rest))
    if whole.startswith((b"\x1f\x8b", b"\x89MCAP", b"PAR1", b"PK\x03\x04")):
        raise Unclear(f"binary data ({_kind_of_file(whole)}), expected a text table")
    try:
        text = decoded(whole)
    except ValueError:
        raise Unclear("binary data, expected a text table") from None
    if not text.strip():
        raise Unclear("empty file, expected a text table")
    layout = _layout(text)
    at = _offset(text, layout.first)
    left = re.compile(_LEFT.replace("//", "//" if layout.separator == ";" else "//|;"), re.MULTILINE)
    body = left.sub("", text[at:])
    if layout.separator == " ":
        body = re.sub(r"^ +| +$", "", re.sub(r"[ \t]+", " ", body), flags=re.MULTILINE)
    columns, ragged = _read(body, layout)
    _require_no_lines_in_cells(columns, layout)
    columns, names, units = _without_empty(columns, layout)
    left_out = {r.row for r in ragged}
    line_of = _lines(text, layout.first, left, left_out)
    every = _lines(text, layout.first, left, set())
    return Grid(
        names, units, layout.header is not None, tuple(columns), line_of, layout.remarks,
        tuple((every(r.row), r.fields) for r in ragged),
    )  # fmt: skip


def _layout(text: str) -> Layout:
    """Raises Unclear where there is none, or more than one."""
    head = text[:HEAD].split("\n")
    if len(text) > HEAD and len(head) > 1:
        head.pop()
    layout = layout_of(head)
    if layout is None:
        raise Unclear("no line with three numbers, expected a table of samples")
    if layout.unlike is not None:
        line, count = layout.unlike
        raise Unclear(f"line {line + 1}: {count} names, and {layout.fields} fields in the lines of numbers below")
    if layout.fault:
        raise Unclear(layout.fault)
    if layout.fields > FIELDS_MOST:
        raise Unclear(f"{layout.fields} fields, expected at most {FIELDS_MOST}")
    return layout


def _require_no_lines_in_cells(columns: Sequence[Column], layout: Layout) -> None:
    """A stray quote takes the lines up to the next one for a text."""
    for column in columns:
        for cell in column.over_several_lines():
            swallowed = [line for line in cell.split("\n")[1:] if is_sample(line, layout.separator)]
            if swallowed:
                quoted = clipped(swallowed[0].strip())
                raise Unclear(f"a stray quotation mark: samples stand between it and the next one ({quoted}…)")


def _kind_of_file(data: bytes) -> str:
    return {b"\x1f\x8b": "gzip; name it .gz", b"\x89M": "MCAP; name it .mcap", b"PA": "Parquet; name it .parquet"}.get(
        data[:2], "a ZIP archive or a spreadsheet; save it as CSV"
    )


def _offset(text: str, line: int) -> int:
    at = 0
    for _ in range(line):
        at = text.index("\n", at) + 1
    return at


def _read(body: str, layout: Layout) -> tuple[list[Column], list[arrow.Ragged]]:
    try:
        columns, ragged = arrow.read_text(body, layout.separator, layout.decimal, layout.fields)
        if any(r.fields > layout.fields for r in ragged):  # some programs end the first line, or some, with separators
            s = re.escape(layout.separator)
            ended = re.compile(rf"^((?:[^{s}\n]*{s}){{{layout.fields - 1}}}[^{s}\n]*){s}+$", re.MULTILINE)
            columns, ragged = arrow.read_text(ended.sub(r"\1", body), layout.separator, layout.decimal, layout.fields)
    except ValueError as e:
        raise Unclear(f"not readable as a table: {e}") from e
    return columns, ragged


def _without_empty(columns: list[Column], layout: Layout) -> tuple[list[Column], tuple[str, ...], tuple[str, ...]]:
    """Without the columns that trailing separators make."""
    names = list(layout.header or (str(i + 1) for i in range(layout.fields)))
    units = list(layout.units or ("",) * layout.fields)
    while columns and columns[-1].gaps.all() and (layout.header is None or not names[-1].strip()):
        columns, names, units = columns[:-1], names[:-1], units[:-1]
    return columns, tuple(names), tuple(units)


def _lines(text: str, first: int, left: re.Pattern[str], left_out: set[int]) -> Callable[[int], str]:
    def line_of(row: int) -> str:
        at = -1
        read = -1
        for number, line in enumerate(text.split("\n")[first:], start=first + 1):
            if not left.fullmatch(line):
                at += 1
                read += at not in left_out
                if read == row:
                    return f"line {number}"
        return "the last line"

    return line_of
