"""Lines that name their numbers, and lines with the time stamp of a serial monitor,
as tables with a header.

    ax=0.02 ay=0.74 az=-0.69
    Acceleration X: 0.2, Y: 7.3, Z: 6.8 m/s^2
    12:00:00.033 -> a/g:  485  12431  -11483
    {"t": 0.02, "acc": {"x": 0.02, "y": 0.74, "z": -0.69}}

A line stays a line, so that a fault is named where it stands. Lines that are none of
the table's (another sensor's) are passed over and counted.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import triaxcal_drivers as td
from triaxcald.tables.layout import DAY_TIME, LINES_LOOKED_AT, MOMENT, NUMERIC_LEAST, UNIT_TEXT, Layout, layout_of
from triaxcald.tables.naming import AXES, Unclear, roles_of
from triaxcald.tables.native_csv import FIELDS_MOST

HEAD = 2**20
"""Characters in which such lines are looked for."""
LINE_MOST = 4096
"""Characters of a line with a name for each number: some ten sensors of nine axes."""
LINES_LEAST = 2
"""One line that looks so is no table."""
MOSTLY = 0.5
"""Of the first lines that are not blank as many are of the table, or of its other
kinds."""
KIND_LEAST = 0.1
"""A kind of line that comes with less than this share of the samples is a garbled
one of them."""
STAMP = "time stamp"
"""Name of the column with the times of a serial monitor."""
_LETTERS = [[letter] for axis in AXES for letter in (axis, axis.upper())]
_COMMAS_PART = re.compile(r"\d,[+-]?\d+,[+-]?\d")
"""A number between two commas without a blank: no decimal ones."""
BETWEEN_MOST = 1000
"""Texts between the numbers of lines that are remembered: blanks before a number may
be of any count."""
NO_SAMPLE = "?"
"""In the place of a line that is garbled: it has too few fields."""

Cells = Sequence[tuple[str, str, str]]
"""Name, text and unit of each number of a line."""


@dataclass(frozen=True)
class Labelled:
    """``text`` has the lines of the original, or a line for each record of a JSON
    document (``records``). ``passed_over`` counts lines of other kinds, by an
    example."""

    text: str
    layout: Layout | None
    passed_over: Mapping[str, int] = field(default_factory=dict)
    records: bool = False


def labelled(text: str) -> Labelled | None:
    """None for what is no such text. Raises Unclear where lines of several kinds
    may be meant."""
    return _json_document(text) or _json_lines(text) or _of_lines(text)


# JSON: a record a line, or a document of records or columns.


def _json_lines(text: str) -> Labelled | None:
    head = [line for line in _head(text) if line.strip()]
    there = sum(_json_line(line) is not None for line in head)
    if there < LINES_LEAST or there < MOSTLY * len(head):
        return None
    return _of_records([_json_line(line) if line.strip() else {} for line in text.split("\n")])


def _head(text: str) -> list[str]:
    return text[:HEAD].split("\n")[:LINES_LOOKED_AT]


def _json_line(line: str) -> dict[str, str] | None:
    """The numbers and texts of a line by their path; None for another line."""
    bare = line.strip().removeprefix("[").rstrip(",]").strip()
    if not (bare.startswith("{") and bare.endswith("}")):
        return {} if line.strip() in ("[", "]") else None
    return _flat(_loaded(bare))


def _loaded(text: str) -> Any:
    """None for what is no JSON. Numbers stay as they are written."""
    try:
        return json.loads(text, parse_float=str, parse_int=str)
    except (ValueError, RecursionError):
        return None


def _flat(value: Any) -> dict[str, str] | None:
    if not isinstance(value, dict):
        return None
    found: dict[str, str] = {}
    waiting: list[tuple[str, Any]] = [("", value)]
    while waiting:
        path, inner = waiting.pop()
        if isinstance(inner, dict):
            waiting += [(f"{path}.{key}" if path else str(key), v) for key, v in reversed(inner.items())]
        elif isinstance(inner, list):
            waiting += [(f"{path}[{i}]", v) for i, v in reversed(list(enumerate(inner)))]
        else:
            found[path] = "" if inner is None else str(inner)
        if len(found) + len(waiting) > FIELDS_MOST:
            return None
    return found


def _json_document(text: str) -> Labelled | None:
    if not re.match(r"\s*[\[{]", text) or not text[-HEAD:].rstrip().endswith(("]", "}")):
        return None
    records = _records(_loaded(text))
    if records is None or len(records) < LINES_LEAST:
        return None
    found = _of_records([_flat(record) for record in records])
    return None if found is None else Labelled(found.text, found.layout, records=True)


def _records(document: Any) -> list[Any] | None:
    """A list of objects, alone or the only one in an object; or columns, as lists
    of one length."""
    if isinstance(document, list):
        return document if document and all(isinstance(record, dict) for record in document) else None
    if not isinstance(document, dict):
        return None
    lists = {name: inner for name, inner in document.items() if isinstance(inner, list) and inner}
    inside = [records for inner in lists.values() if (records := _records(inner))]
    if len(inside) == 1:
        return inside[0]
    columns = {n: c for n, c in lists.items() if not any(isinstance(v, dict | list) for v in c)}
    if len(columns) < NUMERIC_LEAST or len({len(c) for c in columns.values()}) > 1:
        return None
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def _of_records(records: Sequence[Mapping[str, str] | None]) -> Labelled | None:
    """``{}`` for what is no record, None for one that cannot be read."""
    names: dict[str, None] = {}
    for record in records:
        names.update(dict.fromkeys(record or ()))
        if len(names) > FIELDS_MOST:
            raise Unclear(f"more than {FIELDS_MOST} different names in lines of JSON, expected the same in each")
    if len(names) < NUMERIC_LEAST:
        return None
    rows = [NO_SAMPLE if r is None else _row([r.get(name, "") for name in names]) if r else "" for r in records]
    first = next(i for i, record in enumerate(records) if record)
    return Labelled("\n".join(rows), Layout("\t", ".", tuple(names), None, first, len(names), ()))


def _row(cells: Sequence[str]) -> str:
    row = "\t".join(re.sub(r'[\s"]+', " ", cell).strip() for cell in cells)
    return row if row.strip() else NO_SAMPLE


# Lines with labels, and with the time stamps of a serial monitor.

_DATE = r"(?:\d{4}-\d\d-\d\d|\d{1,2}[./-]\d{1,2}[./-]\d{2,4}|\d{4}/\d\d/\d\d|[A-Z][a-z]{2} [ \d]\d(?: \d{4})?)"
_CLOCK = r"\d{1,2}:\d\d:\d\d(?:[.,:]\d{1,9}(?:,\d{3})?)?(?: ?[AaPp][Mm])?Z?"
_STAMPED = re.compile(
    rf"\[(?:(?P<date>{_DATE})[ T_]+)?(?P<clock>{_CLOCK})\][ \t]*(?:[:>,;|]|-(?![.\d]))*[ \t]*|"
    rf"(?:(?P<date2>{_DATE})[ T_]+)?(?P<clock2>{_CLOCK})[ \t]*[-=]?>+[ \t]*|"
    r"[EWIDV] \((?P<millis>\d+)\)[ \t]*"
)
"""In brackets, or with an arrow, as serial monitors have them; or the level and the
milliseconds of a firmware's log."""
_WORD = r"(?:[^\W\d]|[°µμ%])[\w./^²³°%*]*(?:[ \t]?[\[(][^\s\])},;]{1,8}[\])])?"
_MOMENT = rf"(?:{MOMENT.pattern}|{DAY_TIME.pattern})(?![\w:.])"


def _number(decimal: str) -> str:
    return rf"(?<![\w.])[+-]?(?:\d+(?:[{decimal}]\d+)?\.?|[{decimal}]\d+)(?:[eE][+-]?\d+)?(?!\d|:\d)"


def _tokens_of(decimal: str) -> re.Pattern[str]:
    return re.compile(
        rf"(?P<moment>(?<![\w.]){_MOMENT})|(?P<number>{_number(decimal)})|(?P<word>{_WORD})|"
        r"(?P<mark>[:=]+>?)|(?P<separator>[,;|\t{}&/$@!])|(?P<blank>(?:[ \[\]()<>\"'*#~]|-(?![.\d]))+)|(?P<other>.)"
    )


_TOKENS = {decimal: _tokens_of(decimal) for decimal in ".,"}


def _of_lines(text: str) -> Labelled | None:
    head = _head(text)
    stamps, rests = _without_stamps(head)
    found = _kinds(rests)
    if found is None and not stamps:
        return None
    lines = text.split("\n")
    stamps, rests = _without_stamps(lines)
    return _beside(stamps, rests) if found is None else _table(lines, stamps, rests, found)


def _without_stamps(lines: Sequence[str]) -> tuple[dict[int, tuple[str, str]], Sequence[str]]:
    """The stamps of lines, by their index, with the name of their column; and the
    lines without them. None where most have none."""
    head = [line for line in lines[:LINES_LOOKED_AT] if line.strip()]
    if sum(bool(_STAMPED.match(line.lstrip())) for line in head) <= MOSTLY * len(head):
        return {}, lines
    stamps: dict[int, tuple[str, str]] = {}
    rests = list(lines)
    for i, line in enumerate(lines):
        bare = line.lstrip()
        if m := _STAMPED.match(bare):
            if m["millis"]:
                stamps[i] = "millis", m["millis"]
            else:
                date, clock = m["date"] or m["date2"], m["clock"] or m["clock2"]
                # A comma behind a point parts thousands, as in 00:00:01.234,567.
                clock = clock.replace(",", "") if "." in clock else clock.replace(",", ".")
                stamps[i] = STAMP, f"{date} {clock}" if date else clock
            rests[i] = bare[m.end() :]
    return stamps, rests


def _beside(stamps: Mapping[int, tuple[str, str]], rests: Sequence[str]) -> Labelled | None:
    """Lines of a plain table behind their stamps: these become the last column, as
    the device's own time counts first."""
    layout = layout_of(rests[:LINES_LOOKED_AT])
    if layout is None:
        return None
    header = len(layout.remarks) if layout.header is not None else -1
    rows = []
    for i, rest in enumerate(rests):
        name, stamp = stamps.get(i, ("", ""))
        if i == header:
            stamp = name or next(iter(stamps.values()))[0]
        rows.append(f'{rest.rstrip()}{layout.separator}"{stamp}"' if stamp and rest.strip() else rest)
    return Labelled("\n".join(rows), None)


@dataclass(frozen=True)
class _Kinds:
    """``names`` and ``units`` of the lines that are samples, and the names of the
    others."""

    decimal: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    others: frozenset[tuple[str, ...]]


def _kinds(rests: Sequence[str]) -> _Kinds | None:
    head = [line for line in rests[:LINES_LOOKED_AT] if len(line) <= LINE_MOST and line.strip()]
    decimal = _decimal(head)
    read = [cells for line in head if (cells := _cells(line, decimal)) is not None]
    counted = Counter(tuple(name for name, _, _ in cells) for cells in read)
    units = {tuple(name for name, _, _ in cells): tuple(unit for _, _, unit in cells) for cells in reversed(read)}
    samples = {kind: n for kind, n in counted.items() if len(kind) >= NUMERIC_LEAST and n >= LINES_LEAST}
    if not samples:
        return None
    most = max(samples.values())
    usual = {kind: n for kind, n in samples.items() if n >= KIND_LEAST * most}
    clear = [kind for kind in usual if _has_outputs(kind, units[kind])]
    clear = [kind for kind in clear if not any(set(kind) < set(other) for other in clear)]
    if len(clear) > 1:
        examples = "; ".join(td.hints.clipped(", ".join(kind)) for kind in clear[:NUMERIC_LEAST])
        raise Unclear(f"lines of several kinds in turn ({examples}); keep those of one sensor in the file")
    best = clear[0] if clear else max(usual, key=lambda kind: usual[kind])
    others = frozenset(k for k, n in counted.items() if n >= KIND_LEAST * usual[best] and not set(k) <= set(best))
    if sum(n for k, n in counted.items() if k in others or set(k) <= set(best)) < MOSTLY * len(head):
        return None
    return _Kinds(decimal, best, units[best], others)


def _has_outputs(names: tuple[str, ...], units: tuple[str, ...]) -> bool:
    try:
        roles_of(names, units, {}, named=True)
    except Unclear:
        return False
    return True


def _table(
    lines: Sequence[str], stamps: Mapping[int, tuple[str, str]], rests: Sequence[str], kinds: _Kinds
) -> Labelled:
    stamp = next(iter(stamps.values()))[0] if stamps else ""
    rows: list[str] = []
    first = None
    passed_over: Counter[str] = Counter()
    examples: dict[tuple[str, ...], str] = {}
    read = _Reader(kinds.decimal)
    for i, rest in enumerate(rests):
        cells = read.cells(rest) if rest.strip() else None
        names = tuple(name for name, _, _ in cells or ())
        if not rest.strip():
            rows.append("")
        elif names == kinds.names or (names and len(set(names)) == len(names) and set(names) <= set(kinds.names)):
            by_name = {name: text for name, text, _ in cells or ()}
            texts = (
                [text for _, text, _ in cells or ()]
                if names == kinds.names
                else [by_name.get(n, "") for n in kinds.names]
            )
            rows.append(_row([*texts, *([stamps.get(i, ("", ""))[1]] if stamp else [])]))
            first = i if first is None else first
        elif names in kinds.others:
            passed_over[examples.setdefault(names, rest.strip())] += 1
            rows.append("")
        else:
            rows.append(NO_SAMPLE)
    names = (*kinds.names, stamp) if stamp else kinds.names
    units = (*kinds.units, "") if stamp else kinds.units
    first = first or 0
    layout = Layout("\t", ".", names, units if any(units) else None, first, len(names), tuple(lines[:first]))
    return Labelled("\n".join(rows), layout, passed_over)


def _decimal(head: Sequence[str]) -> str:
    """The comma where it makes one number of each two that the point leaves, in a
    label (ax=0,12 ay=1) or in whole lines (acc: 0,12; 0,34; 0,98)."""
    lines = [runs for line in head if (runs := _runs(line, ".")) and any(run.words for run in runs)]
    if any("." in text for runs in lines for run in runs for text in run.texts):
        return "."
    several = [run for runs in lines for run in runs if len(run.texts) > 1]
    if several and all(len(run.texts) == 2 for run in several):
        return ","
    if any(_COMMAS_PART.search(line) for line in head):
        return "."
    counts = [[len(re.findall(_number(mark), line)) for mark in ".,"] for line in head]
    halved = [by_comma for by_point, by_comma in counts if by_point and by_point == 2 * by_comma]
    return "," if lines and len(halved) >= MOSTLY * len(head) and min(halved) >= NUMERIC_LEAST else "."


@dataclass
class _Run:
    """A label and the numbers behind it."""

    words: list[str]
    marked: bool
    prefix: str = ""
    texts: list[str] = field(default_factory=list)
    unit: str = ""


def _runs(line: str, decimal: str) -> list[_Run] | None:
    """None for a line that is not of labels and numbers."""
    runs: list[_Run] = []
    words: list[str] = []  # since the last number or separator
    prefix = ""
    waiting: _Run | None = None  # has its mark, and no number yet
    for token in _TOKENS[decimal].finditer(line):
        kind, text = token.lastgroup, token[0]
        if kind == "word":
            words.append(text)
        elif kind == "mark":
            if not words and not runs:
                return None
            if not words:  # 1234: ax=…
                continue
            if waiting is not None and len(words) == 1:
                prefix = " ".join(waiting.words)  # Acc: X=…
            elif waiting is not None:
                waiting.texts.append(words.pop(0))  # state=OK ax=…
                runs.append(waiting)
            elif runs:
                words = _without_unit(runs[-1], words)
            waiting, words = _Run(words, True, prefix), []
        elif kind in ("number", "moment"):
            if waiting is not None and words:
                # Accelerometer: X 0.1 Y 0.2
                prefix, waiting = " ".join(waiting.words), None
            if waiting is not None:
                runs.append(waiting)
                waiting = None
            elif words:
                words = _without_unit(runs[-1], words) if runs else words
                runs.append(_Run(words, False, prefix))
            elif not runs:
                runs.append(_Run([], False))
            runs[-1].texts.append(text)
            words = []
        elif kind == "separator" and words:
            if waiting is not None:
                waiting.texts.append(" ".join(words))
                runs.append(waiting)
                waiting = None
            else:
                _end(runs, words)
            words = []
        elif kind == "other":
            return None
    if waiting is not None and words:
        waiting.texts.append(" ".join(words))
        runs.append(waiting)
    elif words:
        _end(runs, words)
    return runs


def _end(runs: list[_Run], words: list[str]) -> None:
    """Words that are no label are a unit, or a text of their own: it may name the
    sensor."""
    rest = _without_unit(runs[-1], [*words, ""]) if runs else [*words, ""]
    if rest[:-1]:
        runs.append(_Run([], False, texts=[" ".join(rest[:-1])]))


def _without_unit(before: _Run, words: list[str]) -> list[str]:
    """The words of a label behind the unit of the number before."""
    if len(words) > 1 and UNIT_TEXT.fullmatch(words[0]):
        before.unit = before.unit or words[0]
        words = words[1:]
    return words


def _cells(line: str, decimal: str) -> Cells | None:
    """None for a line that is not of labels and numbers."""
    runs = _runs(line, decimal)
    if runs is None or not any(run.words for run in runs):
        return None
    if any(run.words and not run.marked and len(run.texts) > 1 for run in runs):
        return None  # a table whose rows begin with a name
    labels, source = _labels(runs)
    found = [
        (name, text.replace(decimal, "."), run.unit)
        for run, label in zip(runs, labels, strict=True)
        for name, text in zip(_names(label, run.texts), run.texts, strict=True)
    ]
    return [*_with_unit_of_triple(found), *([("source", source, "")] if source else [])]


def _labels(runs: Sequence[_Run]) -> tuple[list[str], str]:
    """And the words before all of them, which name the source of the line."""
    found: list[list[str]] = []
    stem: list[str] = []  # Acceleration X: 0.1, Y: 0.2, Z: 0.3; IMU ax=0.1 ay=0.2 az=0.3
    last = ""
    for run in runs:
        label = run.words
        if len(label) > 1:
            stem, last = label[:-1], label[-1]
        elif stem and label and _of_another_axis(last, label[0]):
            label = [*stem, *label]
        else:
            stem = []
        found.append([*run.prefix.split(), *label])
    # Letters of axes alone need the words before them.
    source: list[str] = []
    while len(named := [label for label in found if label]) > 1:
        shared = len({label[0] for label in named}) == 1 and all(len(label) > 1 for label in named)
        if not shared or all(label[1:] in _LETTERS for label in named):
            break
        source.append(named[0][0])
        found = [label[1:] for label in found]
    return [" ".join(label) for label in found], " ".join(source)


def _of_another_axis(one: str, other: str) -> bool:
    """Whether two words differ by x, y, z alone."""
    if len(one) != len(other):
        return False
    apart = [(a, b) for a, b in zip(one.lower(), other.lower(), strict=True) if a != b]
    return len(apart) == 1 and all(letter in AXES for letter in apart[0])


class _Reader:
    """`_cells` of line after line: lines that differ in their numbers alone have
    the same names."""

    def __init__(self, decimal: str) -> None:
        self._decimal = decimal
        self._number = re.compile(_number(decimal))
        self._known: dict[str, Sequence[tuple[str, str | None, str]]] = {}

    def cells(self, line: str) -> Cells | None:
        between = self._number.sub("0", line)
        numbers = [text.replace(self._decimal, ".") for text in self._number.findall(line)]
        if (known := self._known.get(between)) is not None:
            left = iter(numbers)
            return [(name, next(left) if text is None else text, unit) for name, text, unit in known]
        cells = _cells(line, self._decimal)
        if cells is not None and len(self._known) < BETWEEN_MOST:
            left = iter([*numbers, ""])
            upcoming = next(left)
            pattern: list[tuple[str, str | None, str]] = []
            for name, text, unit in cells:
                if text == upcoming:
                    upcoming = next(left)
                    pattern.append((name, None, unit))
                else:
                    pattern.append((name, text, unit))
            if sum(text is None for _, text, _ in pattern) == len(numbers):
                self._known[between] = pattern
        return cells


def _names(label: str, texts: Sequence[str]) -> Iterator[str]:
    """Three numbers behind a label are its x, y and z; six behind a/g those of
    both."""
    parts = [part.strip() for part in re.split(r"[/+&]", label)]
    if not label:
        yield from (_unnamed(text, i) for i, text in enumerate(texts, 1))
    elif len(texts) == 1:
        yield label
    elif len(texts) == len(AXES) * len(parts) and all(parts):
        yield from (f"{part} {axis}" for part in parts for axis in AXES)
    else:
        yield from (f"{label} {i}" for i in range(1, len(texts) + 1))


def _unnamed(text: str, place: int) -> str:
    if text[:1].isalpha():
        return "words"
    return STAMP if ":" in text else f"number {place}"


def _with_unit_of_triple(cells: list[tuple[str, str, str]]) -> Cells:
    """A unit behind z is that of x and y, if these have none."""
    for i in range(len(cells) - 2):
        three = cells[i : i + 3]
        ends = [name[-1:].lower() for name, _, _ in three]
        same = len({name[:-1] for name, _, _ in three}) == 1
        if "".join(ends) == AXES and same and [unit for _, _, unit in three[:2]] == ["", ""] and three[2][2]:
            cells[i : i + 3] = [(name, text, three[2][2]) for name, text, _ in three]
    return cells
