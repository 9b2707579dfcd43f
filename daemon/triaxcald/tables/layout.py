"""How a text table is laid out: encoding, separator, decimal mark, header, row
of units, and where its numbers begin.

Tables come as programs write them: with a byte order mark or in Windows-1252,
with `sep=;`, remarks before the header, a header behind #, a row of units, a
decimal comma, a separator at the end of each line. The numbers themselves say
which separator is meant: with the right one, most lines have one and the same
number of numeric fields.
"""

from __future__ import annotations

import codecs
import csv
import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

LINES_LOOKED_AT = 500
"""Loggers write up to a hundred lines about themselves before the first sample."""
NUMERIC_LEAST = 3
"""Numbers in a line of samples: the three outputs."""
SEPARATORS = ("\t", ";", ",", "|", " ")
"""Blanks, in runs and with tabs among them, only where no other parts the
lines."""
MISSING = frozenset(("", "nan", "na", "n/a", "null", "none", "inf", "+inf", "-inf", "infinity", "-infinity", "-nan"))
"""Texts in lower case that stand for no number; so do all that begin with #
(#N/A, #NV, #DIV/0!)."""
NUMBER = re.compile(r"[+-]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][+-]?\d+)?", re.ASCII)
THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(?:,\d{3})+", re.ASCII)
"""What may be a number with its thousands parted by commas."""
TABLE_LEAST = 10
"""Lines of numbers above the header that are no remarks any more."""
DAY_TIME = re.compile(r"\d{1,2}:\d\d:\d\d(?:[.,]\d{1,9}|:\d{3})?", re.ASCII)
DATED = re.compile(r"(\S+(?: \S+)?)[ T]+(\d{1,2}:\d\d:\d\d(?:[.,]\d{1,9}|:\d{3})?)( ?[AaPp][Mm])?", re.ASCII)
"""A date as nobody else writes it, and the time of day."""
MOMENT = re.compile(
    r"\d{4}-\d\d-\d\d(?:[T ]\d\d:\d\d(?::\d\d(?:[.,]\d{1,9})?)?)?(?: ?(?:Z|UTC|[+-]\d\d(?::?\d\d)?))?", re.ASCII
)
UNIT_TEXT = re.compile(
    r"[\[(<{][^\])>}]*[\])>}]|m/s(?:\^2|\*\*2|2|²)|m/s/s|m\*s\^-2|m/\(s\^2\)|[kmµμu]?g|mG|G|[mµμun]?s|sec|seconds|ms|°C|degC|C|K|[mµu]?V|volts?|Hz|"
    r"(?:deg|rad|°)/s|dps|[mµμu]?T|uT|gauss|counts?|lsb|-|1|",
    re.IGNORECASE,
)
_RULE = re.compile(r"[^\w\n]*|[_\W]*_{3}[_\W]*")
"""A line without letters and digits: dashes under a header, the border of a
printed table."""
_SEPARATOR_LINE = re.compile(r'"?sep=(.)"?', re.IGNORECASE)
_MARKS = ((codecs.BOM_UTF8, "utf-8"), (codecs.BOM_UTF16_LE, "utf-16-le"), (codecs.BOM_UTF16_BE, "utf-16-be"))
_REMARK = ("#", "%", "//")


@dataclass(frozen=True)
class Layout:
    """``header`` has a name for each of the ``fields``, and is None where there
    is none; ``units`` likewise.

    ``first`` is the line, 0-based, of the first sample; ``remarks`` are the
    lines before the header. ``unlike`` is the line, 0-based, of what looks like
    a header and has another number of fields, and that number.
    """

    separator: str
    decimal: str
    header: tuple[str, ...] | None
    units: tuple[str, ...] | None
    first: int
    fields: int
    remarks: tuple[str, ...]
    unlike: tuple[int, int] | None = None
    fault: str = ""
    """Why the numbers may be read in two ways."""


def decoded(data: bytes) -> str:
    """By the byte order mark, as UTF-16 by its zeros, as UTF-8, else as
    Windows-1252; with line ends ``\\n``.

    Raises ValueError for bytes that are no text.
    """
    text = _decoded(data)
    if "\0" in text:
        raise ValueError("binary data")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _decoded(data: bytes) -> str:
    for mark, encoding in _MARKS:
        if data.startswith(mark):
            return data[len(mark) :].decode(encoding)
    head = data[:4096]
    even, odd = head[::2].count(0), head[1::2].count(0)
    if even + odd > len(head) / 4 and min(even, odd) == 0:
        return data.decode("utf-16-be" if even else "utf-16-le")
    try:
        return data.decode()
    except UnicodeDecodeError:
        return data.decode("cp1252")


def is_remark(line: str, separator: str) -> bool:
    """Whether a line without blanks about it is none of the table's."""
    return line.startswith(_REMARK) or (separator != ";" and line.startswith(";"))


def is_rule(line: str) -> bool:
    """Whether a line is drawn, and holds neither names nor numbers; a blank one
    is none."""
    return bool(line.strip()) and bool(_RULE.fullmatch(line))


def layout_of(
    lines: Sequence[str], used: Callable[[tuple[str, ...] | None, int], Collection[int] | None] = lambda *_: None
) -> Layout | None:
    """Of the first lines of a table; None where no line has three numbers.
    ``used`` says by the header and the number of fields which columns will be
    read, None where that is not known: where the columns of a table have not
    one decimal mark, it is theirs."""
    lines = lines[:LINES_LOOKED_AT]
    stated = next((m for line in lines[:3] if (m := _SEPARATOR_LINE.fullmatch(line.strip()))), None)
    found = [run for s in ((stated[1],) if stated else SEPARATORS) if (run := _run(lines, s))]
    if not found:
        return None
    printed = [run for run in found if run.separator != " "]
    if printed and 2 * max(run.lines for run in printed) > max(run.lines for run in found):
        found = printed
    best = max(found, key=lambda run: (run.lines, run.numeric))
    rows = [split(line, best.separator) for line in lines[best.first :] if is_sample(line, best.separator)]
    found_layout = _above(lines, best, ".", _labelled(rows))
    numbers = [f for row in rows for f in row if _may_be_number(f)]
    fault = _marks(numbers)
    if fault and (columns := used(found_layout.header, best.fields)) is not None:
        numbers = [row[i] for row in rows for i in columns if i < len(row) and _may_be_number(row[i])]
        fault = _marks(numbers)
    decimal = "," if any("," in f for f in numbers) else "."
    fault = fault or _above_the_header(lines, best, found_layout)
    return replace(found_layout, decimal=decimal, fault=fault)


def _may_be_number(field: str) -> bool:
    return bool(NUMBER.fullmatch(field) or THOUSANDS.fullmatch(field))


def _marks(numbers: Sequence[str]) -> str:
    """What is wrong with the decimal marks, if anything: a comma may part
    thousands."""
    commas = [f for f in numbers if "," in f]
    pointed = next((f for f in numbers if "." in f), None)
    if commas and pointed is not None:
        return (
            f"numbers with a comma and with a point ({commas[0]}, {pointed}); write them without thousands separators"
        )
    if commas and all(THOUSANDS.fullmatch(f) for f in commas):
        return f"{commas[0]} may have a decimal comma or part thousands; write numbers without thousands separators"
    return ""


def _above_the_header(lines: Sequence[str], run: _Run, layout: Layout) -> str:
    """Whether another table stands above."""
    above = [i for i in range(len(layout.remarks)) if is_sample(lines[i], run.separator)]
    if len(above) < TABLE_LEAST:
        return ""
    fields = len(split(lines[above[0]], run.separator))
    return f"line {above[0] + 1}: another table, of {fields} fields, above that of {run.fields}; part them in two files"


def split(line: str, separator: str) -> list[str]:
    """The fields of a line (RFC 4180), without blanks about them."""
    line = " ".join(line.split()) if separator == " " else line.strip(" ")
    try:
        fields = next(csv.reader([line], delimiter=separator, skipinitialspace=separator != "\t"), [])
    except csv.Error:  # a field of more than 128 KiB
        return []
    return [field.strip() for field in fields]


def is_number(field: str, separator: str) -> bool:
    return bool(NUMBER.fullmatch(field)) and not (separator == "," and "," in field and len(field.split(",")) > 2)


@dataclass(frozen=True)
class _Run:
    """``lines`` with as many ``fields``, of which at most ``numeric`` are
    numbers or moments, from line ``first`` on.

    ``trailing``: all of them end with a separator.
    """

    separator: str
    first: int
    lines: int
    fields: int
    numeric: int
    trailing: bool


def is_sample(line: str, separator: str) -> bool:
    return (
        bool(line.strip())
        and not is_remark(line.strip(), separator)
        and _numeric(split(line, separator), separator) > 0
    )


def _numeric(row: Sequence[str], separator: str) -> int:
    """How many fields are numbers or moments; 0 where that are fewer than
    three."""
    count = sum(
        is_number(f, separator) or bool(MOMENT.fullmatch(f) or DATED.fullmatch(f) or DAY_TIME.fullmatch(f)) for f in row
    )
    return count if count >= NUMERIC_LEAST else 0


def _run(lines: Sequence[str], separator: str) -> _Run | None:
    """The samples: lines with the most common number of fields among those that
    hold numbers."""
    counted: dict[int, list[tuple[int, list[str]]]] = {}
    for i, line in enumerate(lines):
        if is_sample(line, separator):
            row = split(line, separator)
            counted.setdefault(len(row), []).append((i, row))
    if not counted:
        return None
    fields, rows = max(counted.items(), key=lambda item: len(item[1]))
    numeric = max(_numeric(row, separator) for _, row in rows)
    return _Run(separator, rows[0][0], len(rows), fields, numeric, all(row[-1] == "" for _, row in rows))


def _above(lines: Sequence[str], run: _Run, decimal: str, labelled: bool) -> Layout:
    """The layout, with header and row of units looked for from the first sample
    upwards."""
    header = units = None
    at = run.first
    counting = [str(i) for i in range(run.fields)]
    row = split(lines[at], run.separator)
    if at == 0 and run.lines > 1 and row in (counting, ["", *counting[:-1]]):  # pandas names columns of an array so
        return Layout(run.separator, decimal, tuple(row), None, 1, run.fields, ())
    behind_mark: int | None = None
    for i in range(run.first - 1, -1, -1):
        names = _names(lines[i], run, labelled)
        if names is None:
            continue
        if is_remark(lines[i].strip(), run.separator):
            behind_mark = i if behind_mark is None else behind_mark
            continue
        if units is None and header is None and any(names) and all(map(UNIT_TEXT.fullmatch, names)):
            units = tuple(names)
            continue
        header, at = tuple(names), i
        break
    if header is None and behind_mark is not None:
        header, at = tuple(_names(lines[behind_mark], run, labelled) or ()), behind_mark
    if header is None and units is not None:
        header, units = units, None
    first = _first_after(lines, run, at, header is not None)
    unlike = _unlike(lines[:first], run) if header is None else None
    return Layout(run.separator, decimal, header, units, first, run.fields, tuple(lines[:at]), unlike)


def _unlike(lines: Sequence[str], run: _Run) -> tuple[int, int] | None:
    """The line right above the samples, where it has several fields and no
    number."""
    at = len(lines) - 1
    while at >= 0 and is_rule(lines[at]):
        at -= 1
    if at < 0 or not lines[at].strip():
        return None
    row = split(lines[at], run.separator)
    few = len(row) < NUMERIC_LEAST or any(NUMBER.fullmatch(f) for f in row)
    return None if few else (at, len(row))


def _first_after(lines: Sequence[str], run: _Run, at: int, header: bool) -> int:
    """The first line behind the header that is neither a remark nor a row of
    units: also one that lacks numbers."""
    if not header:
        return next((i for i in range(run.first) if is_sample(lines[i], run.separator)), run.first)
    for i in range(at + 1, run.first):
        row = split(lines[i], run.separator)
        if is_sample(lines[i], run.separator):
            return i
        if (
            lines[i].strip()
            and not is_rule(lines[i])
            and not is_remark(lines[i].strip(), run.separator)
            and not all(map(UNIT_TEXT.fullmatch, row))
        ):
            return i if len(row) == run.fields else run.first
    return run.first


def _labelled(rows: Sequence[Sequence[str]]) -> bool:
    """Whether the rows begin with a name of their own, or with their number."""
    first = [row[0] for row in rows[:20]]
    counted = [f for f in first if f.isdecimal()]
    if len(counted) < len(first):
        return not any(NUMBER.fullmatch(f) for f in first)
    return [int(f) for f in counted] == list(range(int(counted[0]), int(counted[0]) + len(counted)))


def _names(line: str, run: _Run, labelled: bool) -> list[str] | None:
    """Names for all fields of a line that could be the header; None where it is
    not. ``labelled``: see `_labelled`."""
    bare = line.strip(" ").lstrip("#%/;").strip(" ") if is_remark(line.strip(), run.separator) else line
    if not bare.strip() or is_rule(bare):
        return None
    row = split(bare, run.separator)
    if len(row) == run.fields + 1 and row[-1].lower() in (
        "",
        "comment",
    ):  # LabVIEW's stands behind the first line alone
        row = row[:-1]
    if len(row) == run.fields - 1 and not is_remark(line.strip(), run.separator):
        if not (run.trailing or labelled):
            return None
        row = [*row, ""] if run.trailing else ["", *row]  # R names its rows, and not their column
    if len(row) != run.fields or not any(row) or any(NUMBER.fullmatch(f) or f.lower() == "nan" for f in row):
        return None
    return row
