"""A table as columns of cells: what stands where, before anything is known of
what it means."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

import triaxcal_drivers as td
from triaxcald.errors import InputError
from triaxcald.tables import arrow
from triaxcald.tables.arrow import MOSTLY, Column
from triaxcald.tables.labelled import labelled
from triaxcald.tables.layout import Layout, decoded, is_sample, layout_of
from triaxcald.tables.naming import Unclear
from triaxcald.tables.native_csv import FIELDS_MOST, REQUIRED, TIME_LIMIT_S, header_of, is_applied

HEAD = 2**20
"""Characters in which the layout is looked for."""
_LEFT = r"^[ \t]*(?:(?:#|%|//)[^\n]*|[-=+_*]{3,}[ \t]*)?(?:\n|\Z)"
"""Blank lines, remarks and the borders of a printed table."""
_NO_NUMBERS = re.compile(r"[^\d.,eE+\-\s]|,[ \t\r]*(?:[,\n]|\Z)")
"""Of a text of our own layout, below its header."""
_HTML = re.compile(r"\s*(?:<\?xml[^>]*>\s*)?<(?:!doctype\s+html|html|head|body|table)\b", re.IGNORECASE)


@dataclass(frozen=True)
class Grid:
    """Columns of n rows with their names. ``line_of`` says where a row stands,
    as in "line 17". ``head`` are the lines above, and ``ragged`` those that have
    another number of fields: where, and how many. ``ours``: cells are parted
    and numbers written as in our own layout. ``passed_over`` counts lines of
    another kind, by an example. ``labelled``: the names stand in each line."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    named: bool
    columns: tuple[Column, ...]
    line_of: Callable[[int], str]
    head: tuple[str, ...] = ()
    ragged: tuple[tuple[str, int], ...] = ()
    ours: bool = True
    passed_over: Mapping[str, int] = field(default_factory=dict)
    labelled: bool = False

    def called(self, column: int) -> str:
        return f"column {td.hints.clipped(self.names[column])}" if self.named else f"column {column + 1}"

    @property
    def is_native(self) -> bool:
        """Whether it is of our own layout, as Parquet or as text: its columns
        come first, each name once, and the times may be seconds."""
        if not (self.ours and self.named and self.names[: len(REQUIRED)] == REQUIRED):
            return False
        time = self.columns[0]
        in_seconds = time.moments_ns is None and np.abs(time.numbers[time.usable]).max(initial=0.0) < TIME_LIMIT_S
        return bool(in_seconds) and all(self.names.count(name) == 1 for name in REQUIRED)


def grid_of_parquet(path: td.files.AnyPath) -> Grid:
    """Raises InputError."""
    names, columns = arrow.read_parquet(path)
    return Grid(tuple(names), ("",) * len(names), True, tuple(columns), lambda row: f"row {row + 1}")


def holds_text(lines: bytes) -> bool:
    """Whether the first ``lines`` of a text of our own layout have further
    columns that hold something else than numbers.

    In what `triaxcal apply` wrote these may be any that were no channels of its
    input. Anywhere else it is a column of which not even half the cells are
    numbers: a cell without one among many that have one is a fault.
    """
    try:
        text, names, at = header_of(lines, "")
        body = re.sub(_LEFT, "", text[_offset(text, at) :], flags=re.MULTILINE)
        if not _NO_NUMBERS.search(body):
            return False
        columns, _ = arrow.read_text(body, ",", ".", len(names))
    except (InputError, ValueError):
        return False  # it has a fault, which is told where all of it is read
    least = 1.0 if is_applied(names) else MOSTLY
    return any(len(c.numbers) and c.share < least for c in columns[len(REQUIRED) :])


def grid_of_own(whole: bytes, label: str) -> Grid:
    """Of text of our own layout. Raises Unclear, InputError."""
    text, names, first = header_of(whole, label)
    return _grid(text, Layout(",", ".", names, None, first, len(names), ()))


def grid_of_text(
    whole: bytes, used: Callable[[tuple[str, ...] | None, int], Collection[int] | None] = lambda *_: None
) -> Grid:
    """Of the bytes of a file; ``used`` as `layout_of` takes it. Raises
    Unclear."""
    if whole.startswith((b"\x1f\x8b", b"\x89MCAP", b"PAR1", b"PK\x03\x04")):
        raise Unclear(f"binary data ({_kind_of_file(whole)}), expected a text table")
    try:
        text = decoded(whole)
    except ValueError:
        raise Unclear("binary data, expected a text table") from None
    if not text.strip():
        raise Unclear("empty file, expected a text table")
    if _HTML.match(text):
        raise Unclear("HTML, expected a text table")
    found = labelled(text)
    if found is None:
        return _grid(text, _layout(text, used))
    grid = _grid(found.text, found.layout or _layout(found.text, used))
    line_of = grid.line_of
    return replace(
        grid,
        passed_over=found.passed_over,
        line_of=(lambda row: line_of(row).replace("line", "record")) if found.records else line_of,
        ours=False,
        labelled=found.layout is not None,
    )


def _grid(text: str, layout: Layout) -> Grid:
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
        tuple((every(r.row), r.fields) for r in ragged), (layout.separator, layout.decimal) == (",", "."),
    )  # fmt: skip


def _layout(text: str, used: Callable[[tuple[str, ...] | None, int], Collection[int] | None]) -> Layout:
    """Raises Unclear where there is none, or more than one."""
    head = text[:HEAD].split("\n")
    if len(text) > HEAD and len(head) > 1:
        head.pop()
    layout = layout_of(head, used)
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
                quoted = td.hints.clipped(swallowed[0].strip())
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
    """Without the columns that trailing separators make, and where a header names
    the others, leading ones."""
    names = list(layout.header or (str(i + 1) for i in range(layout.fields)))
    units = list(layout.units or ("",) * layout.fields)
    while columns and columns[0].gaps.all() and layout.header is not None and not names[0].strip():
        columns, names, units = columns[1:], names[1:], units[1:]
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
