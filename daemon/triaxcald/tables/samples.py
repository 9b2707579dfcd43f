"""Samples from a table of anybody's making: what is clear is read and said,
what is not is asked for by its option."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from triaxcal.figures import plain
from triaxcal_drivers.nearest import clipped
from triaxcald.errors import InputError
from triaxcald.tables import arrow, clock
from triaxcald.tables.arrow import Column
from triaxcald.tables.layout import Layout, decoded, is_sample, layout_of
from triaxcald.tables.naming import INDEX, ISO, OUTPUTS, TIME, Name, Roles, Unclear, roles_of, seconds_and_rest
from triaxcald.tables.own_text import FIELDS_MOST, CsvSamples, is_own, samples_of_blocks
from triaxcald.tables.source import blocks, label_of

HEAD = 2**20
"""Characters in which the layout is looked for."""
ROWS_LOOKED_AT = 10_000
"""For the words in a column: those that come in turn come early."""
VALUE_LIMIT = 1e100
"""Squares of values, and sums of them, have to be numbers too."""
SENSORS = frozenset(("sensor", "sensors", "type", "id", "device", "source", "node", "side", "imu", "name"))
"""Words by which a column of numbers names the sensor that a row is of."""
VALUES_MOST, IN_TURN = 50, 0.2
"""Sensors are few, and their rows come in turn; a label of what was done
changes rarely."""
SECONDS_MOST = 2**63 // 10**9
FAR = 1e4
"""Times what nine in ten samples reach: more is no reading, as a knock reaches
the end of the range."""
RESTARTS = 10
"""A clock rises so many times as often as it starts again, at least."""
COMPUTED_LEAST = 0.999
"""Correlation with the magnitude of the outputs above which a column is
computed from them; a temperature that is measured has not a thousandth of
it."""
CELSIUS = (-60.0, 150.0)
"""A thermometer of degrees Celsius beside a sensor shows no other; counts of a
converter are beyond."""
_SENSORS = re.compile(r"acc|gyr|mag|baro|grav|rotat|orient|linear", re.IGNORECASE)
_LEFT = r"^[ \t]*(?:(?:#|%|//)[^\n]*)?(?:\n|\Z)"


@dataclass(frozen=True)
class Reading:
    """How a table is to be read, where the user says so. ``columns`` are names
    or numbers (from 1) of the table's by role (t, ux, uy, uz, or a channel's
    name); ``time_unit`` one of `naming.TIME_UNITS`; ``rate`` in Hz; ``where``
    are values that the rows to be read have in a column; with ``pose_means``
    each row is the mean of a pose, and needs no time. Columns called as one of
    ``wanted`` are channels under that name, whatever else they may be."""

    columns: Mapping[str, str] = field(default_factory=dict)
    time_unit: str | None = None
    rate: float | None = None
    skip_bad: bool = False
    where: Mapping[str, str] = field(default_factory=dict)
    pose_means: bool = False
    wanted: frozenset[str] = frozenset()


@dataclass(frozen=True)
class Table:
    """``remarks`` say what was guessed and what was left out, a line each;
    ``output_unit`` is what the header says. ``beside`` are the cells (n,) of
    the columns that are neither outputs nor channels, by name, and of the
    time."""

    samples: CsvSamples
    remarks: tuple[str, ...] = ()
    output_unit: str = ""
    beside: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class _Grid:
    """Columns of n rows with their names. ``line_of`` says where a row stands,
    as in "line 17"."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    named: bool
    columns: tuple[Column, ...]
    line_of: Callable[[int], str]
    head: tuple[str, ...] = ()
    ragged: tuple[tuple[str, int], ...] = ()

    def called(self, column: int) -> str:
        return f"column {clipped(self.names[column])}" if self.named else f"column {column + 1}"


def read_table(name: str, reading: Reading | None = None, *, beside: bool = False) -> Table:
    """Of a path, or of text on standard input (``-``); with ``beside`` the
    cells of all its columns are kept. Raises InputError: file, line, field,
    what was expected."""
    reading = reading or Reading()
    label = label_of(name)
    try:
        if name.endswith((".parquet", ".pq")):
            names, columns = arrow.read_parquet(Path(name))
            grid = _Grid(tuple(names), ("",) * len(names), True, tuple(columns), lambda row: f"row {row + 1}")
            return _assembled(grid, reading, beside)
        data = blocks(name, label)
        first = next(data, b"")
        if (replace(reading, wanted=frozenset()) == Reading() and is_own(first)) or not first:
            samples = samples_of_blocks(chain((first,), data) if first else (), label)
            clock.require_seconds(samples.time_ns, "t_s")
            return Table(samples)
        return _assembled(_grid(first, data), reading, beside)
    except Unclear as e:
        raise InputError(f"{label}: {e}") from None


def _grid(first: bytes, rest: Iterator[bytes]) -> _Grid:
    whole = b"".join(chain((first,), rest))
    if whole.startswith((b"\x1f\x8b", b"\x89MCAP", b"PAR1", b"PK\x03\x04")):
        raise Unclear(f"binary data ({_kind(whole)}), expected a text table")
    try:
        text = decoded(whole)
    except ValueError:
        raise Unclear("binary data, expected a text table") from None
    if not text.strip():
        raise Unclear("empty file, expected a text table")
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
    return _Grid(
        names, units, layout.header is not None, tuple(columns), line_of, layout.remarks,
        tuple((every(r.row), r.fields) for r in ragged),
    )  # fmt: skip


def _require_no_lines_in_cells(columns: Sequence[Column], layout: Layout) -> None:
    """A stray quote takes the lines up to the next one for a text."""
    for column in columns:
        for cell in column.over_several_lines():
            swallowed = [line for line in cell.split("\n")[1:] if is_sample(line, layout.separator)]
            if swallowed:
                quoted = clipped(swallowed[0].strip())
                raise Unclear(f"a stray quotation mark: samples stand between it and the next one ({quoted}…)")


def _kind(data: bytes) -> str:
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


def _assembled(grid: _Grid, reading: Reading, beside: bool) -> Table:
    chosen = _rows_where(grid, reading.where)
    if grid.named and TIME not in reading.columns:
        grid = _with_joined_times(grid)
    roles = roles_of(grid.names, grid.units, reading.columns, named=grid.named)
    _require_one_sensor(grid, chosen)
    for i in roles.outputs:
        _require_numbers(grid, i, chosen)
    parsed = [Name.of(n, u) for n, u in zip(grid.names, grid.units, strict=True)]
    if TIME not in roles.said:
        times = tuple(i for i in roles.time if not _is_no_time(grid.columns[i], parsed[i], chosen))
        roles = replace(roles, time=times)
    timing = _timing(grid, roles, parsed, reading, chosen)
    needed = [*roles.outputs, *roles.channels.values(), *([] if timing.column is None else [timing.column])]
    keep, skipped = _kept(grid, needed, chosen, reading)
    rows = np.flatnonzero(keep)
    if not len(rows):
        raise Unclear("no samples, expected some")
    readings = np.stack([grid.columns[i].numbers[rows] for i in roles.outputs], axis=1)
    for axis, i in zip(range(3), roles.outputs, strict=True):
        if (np.abs(readings[:, axis]) >= VALUE_LIMIT).any():
            row = int(rows[int(np.argmax(np.abs(readings[:, axis])))])
            raise Unclear(f"{grid.line_of(row)}: {grid.called(i)}: a value of {VALUE_LIMIT:g} or more")
    if timing.time_ns is not None:
        time_ns = timing.time_ns[rows]
    else:
        time_ns, by_index = _counted(grid, timing, rows, chosen)
        timing = timing if by_index else replace(timing, index=None)
    channels, renamed, left_out = _channels(grid, roles, parsed, timing, rows, readings, reading.wanted)
    once = _rising(grid, timing, rows, time_ns, readings, channels)
    samples = CsvSamples(
        time_ns[once], readings[once], {n: v[once] for n, v in channels.items()}, int(len(once) - once.sum())
    )
    remarks = [_read_as(grid, roles, timing, renamed, reading)]
    remarks += [f"left out: {'; '.join(left_out)}"] if left_out else []
    if len({*(units := [parsed[i].unit for i in roles.outputs])}) > 1:
        raise Unclear(f"outputs in {', '.join(unit or 'no unit' for unit in units)}; expected one unit for all three")
    kept = _beside(grid, roles, samples.channels, rows[once]) if beside else {}
    return Table(samples, (*remarks, *skipped), _unit_of(roles, parsed), kept)


def _beside(grid: _Grid, roles: Roles, channels: Mapping[str, object], rows: NDArray[np.intp]) -> dict[str, Any]:
    """What was not read, or under another name than its own, unless that is one
    of ours."""
    read = {"t_s", *OUTPUTS, *channels}
    found: dict[str, Any] = {}
    for i, column in enumerate(grid.columns):
        name = Name.of(grid.names[i]).text if grid.named else f"column {i + 1}"
        if i in roles.outputs or not name or column.cells is None:
            continue
        if name in read and name not in OUTPUTS:  # the first of that name is the channel
            read.remove(name)
            continue
        found[f"{name} ({i + 1})" if name in {*found, *channels, *OUTPUTS} else name] = arrow.chosen(column.cells, rows)
    return found


def _with_joined_times(grid: _Grid) -> _Grid:
    """Seconds and nanoseconds in two columns, as ROS has them, as one of
    nanoseconds."""
    for i, j in seconds_and_rest(grid.names):
        seconds, rest = grid.columns[i], grid.columns[j]
        if seconds.whole is None or rest.whole is None:
            continue
        if np.abs(seconds.whole).max(initial=0) >= SECONDS_MOST:
            continue
        whole = seconds.whole * 10**9 + rest.whole
        joined = Column(whole.astype(float), seconds.gaps | rest.gaps, seconds.strange | rest.strange, whole=whole)
        name = f"{grid.names[i]} + {grid.names[j]} (ns)"
        return replace(
            grid,
            names=(*(name if k == i else n for k, n in enumerate(grid.names) if k != j),),
            units=(*(u for k, u in enumerate(grid.units) if k != j),),
            columns=(*(joined if k == i else c for k, c in enumerate(grid.columns) if k != j),),
        )
    return grid


def _rows_where(grid: _Grid, where: Mapping[str, str]) -> NDArray[np.bool_]:
    n = len(grid.columns[0].numbers) if grid.columns else 0
    chosen = np.ones(n, bool)
    for name, value in where.items():
        found = [i for i, held in enumerate(grid.names) if name in (held, Name.of(held).text)]
        if len(found) != 1:
            has = ", ".join(Name.of(held).text for held in grid.names) if grid.named else "no header"
            raise Unclear(f"--where {name}={value}: {len(found)} columns of that name; the table has {clipped(has)}")
        column = grid.columns[found[0]]
        chosen &= column.equals(value)
        if not chosen.any():
            raise Unclear(f"--where {name}={value}: no row has that; it has {clipped(', '.join(_distinct(column)))}")
    return chosen


def _distinct(column: Column, most: int = 20) -> list[str]:
    return sorted({column.text(row) for row in range(min(len(column.numbers), ROWS_LOOKED_AT))})[:most]


def _require_one_sensor(grid: _Grid, chosen: NDArray[np.bool_]) -> None:
    """Rows of several sensors below each other, as some phones write them,
    would be read as one that jumps."""
    for i, column in enumerate(grid.columns):
        values = _in_turn(column, chosen, by_number=bool(set(Name.of(grid.names[i]).words) & SENSORS) and grid.named)
        if values:
            raise Unclear(
                f"rows of several sensors in turn ({grid.called(i)}: {clipped(', '.join(values))}); choose those of "
                f"one: --where {Name.of(grid.names[i]).text}={values[0]}"
            )
        if column.texts is None or column.moments_ns is not None or not column.strange[chosen].mean() > 0.5:
            continue
        texts = {column.text(int(row)) for row in np.flatnonzero(chosen)[:ROWS_LOOKED_AT]}
        if 1 < len(texts) <= 50 and sum(bool(_SENSORS.search(t)) for t in texts) > 1:
            wanted = next((t for t in sorted(texts) if re.search("acc", t, re.IGNORECASE)), min(texts))
            raise Unclear(
                f"rows of several sensors ({grid.called(i)}: {clipped(', '.join(sorted(texts)))}); choose "
                f"those of one: --where {Name.of(grid.names[i]).text}={wanted}"
            )


def _in_turn(column: Column, chosen: NDArray[np.bool_], by_number: bool) -> list[str]:
    """The few values that a column of texts, or of numbers that name something,
    has in turn from row to row."""
    rows = np.flatnonzero(chosen)[:ROWS_LOOKED_AT]
    numbered = by_number and column.whole is not None and column.usable[rows].mean() > 0.5
    if column.moments_ns is not None or len(rows) < 4 or not (numbered or column.strange[rows].mean() > 0.5):
        return []
    names = column.whole if numbered else None
    held = [column.text(int(r)) if names is None else str(names[r]) for r in rows]
    values = sorted(set(held), key=lambda v: ("acc" not in v.lower(), v))
    turns = sum(a != b for a, b in pairwise(held)) / len(held)
    few = 1 < len(values) <= min(VALUES_MOST, len(held) // 4)
    return values if few and turns > IN_TURN else []


def _require_numbers(grid: _Grid, i: int, chosen: NDArray[np.bool_]) -> None:
    column = grid.columns[i]
    if column.moments_ns is not None or (chosen & column.usable).sum() * 2 <= (chosen & column.strange).sum():
        rows = np.flatnonzero(chosen & (column.strange | (column.moments_ns is not None)))
        if not len(rows):
            raise Unclear(f"{grid.called(i)} holds no number" if len(column.numbers) else "no samples, expected some")
        row = int(rows[0])
        raise Unclear(f"{grid.line_of(row)}: {grid.called(i)}: '{column.text(row)[:40]}', expected a finite number")


@dataclass(frozen=True)
class _Timing:
    """``time_ns`` (n,), None where the samples are counted, by ``index`` where
    that is a column; ``column`` is the one that the times are of. ``said`` is
    what is to be said of it."""

    time_ns: NDArray[np.int64] | None
    column: int | None
    said: str
    rate: float = 0.0
    index: int | None = None


def _timing(grid: _Grid, roles: Roles, names: Sequence[Name], reading: Reading, chosen: NDArray[np.bool_]) -> _Timing:
    rate, where = reading.rate, "--rate"
    if reading.time_unit not in (None, INDEX) and rate is not None:
        raise Unclear(f"--rate, --time-unit {reading.time_unit}: give one or the other")
    by_index = reading.time_unit == INDEX
    candidates = [i for i in roles.time if _rises_at_all(grid.columns[i], chosen)]
    if not roles.time and grid.named:
        moments = [i for i, c in enumerate(grid.columns) if c.moments_ns is not None and _rises_at_all(c, chosen)]
        candidates = moments if len(moments) == 1 else []
    if TIME in roles.said:
        candidates = list(roles.time)
    if reading.pose_means and rate is None and not candidates:
        return _Timing(None, None, "one pose a second", 1.0)
    if rate is None and (by_index or not candidates):
        stated = clock.stated_rate(grid.head)
        if stated is None:
            raise Unclear(_no_time(grid, roles, by_index))
        rate, where = stated[0], f"'{clipped(stated[1])}'"
    if rate is not None:
        counted = [*(roles.time[:1] if by_index or TIME in roles.said else ()), *roles.indices]
        index = next(iter(counted), None)
        return _Timing(None, None, f"{plain(rate, 6)} Hz by {where}", rate, index)
    return _timed(grid, candidates, names, reading.time_unit, chosen)


def _no_time(grid: _Grid, roles: Roles, by_index: bool) -> str:
    if by_index:
        return "--time-unit index: say how many samples a second it counts: --rate HZ"
    if roles.indices:
        return f"{grid.called(roles.indices[0])} is an index, and nothing states a rate: --rate HZ"
    for i in roles.time:
        if grid.columns[i].strange.any():
            row = int(np.flatnonzero(grid.columns[i].strange)[0])
            held = grid.columns[i].text(row)[:40]
            return f"{grid.called(i)}: '{held}' is no time (dates as 2026-01-31 12:00:00.25); convert it, or --rate HZ"
        falls = np.flatnonzero(np.diff(grid.columns[i].numbers) < 0)
        if len(falls):
            where = f"{grid.line_of(int(falls[0]) + 1)}: {grid.called(i)}"
            return f"{where}: the time falls back, as a counter does that starts again; --rate HZ counts the samples"
    which = "t=NAME" if grid.named else "t=NUMBER"
    return (
        f"no column of time; name it (--columns {which},…), or say how many samples a second there are: --rate HZ; "
        "if each row is the mean of a pose: --pose-means"
    )


def _rises_at_all(column: Column, chosen: NDArray[np.bool_]) -> bool:
    rows = chosen & column.usable
    if rows.sum() * 2 < chosen.sum():
        return False
    values = column.moments_ns if column.moments_ns is not None else column.numbers
    held = values[rows]
    return len(held) < 2 or held[-1] > held[0]


def _is_no_time(column: Column, name: Name, chosen: NDArray[np.bool_]) -> bool:
    """Of a column that may be either: a temperature falls as it rises, a clock
    at most where it starts again."""
    steps = np.diff(column.numbers[chosen & column.usable])
    return name.is_either and column.moments_ns is None and bool((steps < 0).sum() * RESTARTS > (steps > 0).sum())


def _timed(
    grid: _Grid, candidates: Sequence[int], names: Sequence[Name], unit: str | None, chosen: NDArray[np.bool_]
) -> _Timing:
    """Of the candidates whose unit is clear the first whose times all rise;
    they have to agree about how long the recording took."""
    unstated = [i for i in candidates if names[i].time_unit is None and grid.columns[i].moments_ns is None]
    of_unit = (unstated or list(candidates))[0] if unit is not None else None
    found: list[tuple[bool, int, NDArray[np.int64], str]] = []
    unclear: Unclear | None = None
    for i in [of_unit] if of_unit is not None else candidates:
        column = grid.columns[i]
        try:
            time_ns, known = clock.nanoseconds(_of_rows(column, chosen), names[i], unit)
        except Unclear as e:
            unclear = unclear or e
            continue
        whole = np.zeros(len(chosen), np.int64)
        whole[chosen] = time_ns
        steps = np.diff(whole[chosen & column.usable])
        found.append((bool((steps > 0).all()), i, whole, known))
    if not found:
        assert unclear is not None
        raise unclear
    rising = [f for f in found if f[0]] or found
    lasted = {i: _lasted_s(t, chosen & grid.columns[i].usable) for _, i, t, _ in rising}
    longest, shortest = max(lasted.values()), min(lasted.values())
    if longest - shortest > 2 + 0.01 * abs(longest):
        both = ", ".join(f"{grid.called(i)} {plain(s)} s" for i, s in lasted.items())
        raise Unclear(f"columns of time that do not agree how long it took ({both}); choose one: --columns t=NAME")
    _, i, time_ns, known = rising[0]
    return _Timing(time_ns, i, "dates" if known == ISO else known)


def _of_rows(column: Column, chosen: NDArray[np.bool_]) -> Column:
    return Column(
        column.numbers[chosen],
        column.gaps[chosen],
        column.strange[chosen],
        None if column.moments_ns is None else column.moments_ns[chosen],
        None if column.whole is None else column.whole[chosen],
    )


def _lasted_s(time_ns: NDArray[np.int64], rows: NDArray[np.bool_]) -> float:
    held = time_ns[rows]
    return float(held[-1] - held[0]) * 1e-9 if len(held) else 0.0


def _counted(
    grid: _Grid, timing: _Timing, rows: NDArray[np.intp], chosen: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], bool]:
    """(n,), and whether it is the index that counted them."""
    index = None if timing.index is None else grid.columns[timing.index]
    every = np.zeros(len(grid.columns[0].numbers), bool)
    every[rows] = True
    if index is not None:
        time_ns, counted = clock.of_index(_of_rows(index, every), len(rows), timing.rate)
        if counted:
            return time_ns, True
    among = np.cumsum(chosen)[rows]  # rows of other sensors do not count
    place = among - among[0] if not grid.ragged else np.arange(len(rows))
    return clock.of_index(None, int(place[-1]) + 1, timing.rate)[0][place], False


def _kept(
    grid: _Grid, needed: Sequence[int], chosen: NDArray[np.bool_], reading: Reading
) -> tuple[NDArray[np.bool_], list[str]]:
    """The rows with a number in each of the columns that are needed. Raises
    Unclear where there are others, unless they are to be skipped; what to say
    of them."""
    usable = chosen.copy()
    for i in needed:
        usable &= grid.columns[i].usable
    far = usable & _far(grid, needed[: len(OUTPUTS)], usable)
    usable &= ~far.any(axis=0)
    bad = chosen & ~usable
    faults = []
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        too_far = [i for i, of_column in zip(needed, far, strict=False) if of_column[row]]
        i = next((i for i in needed if not grid.columns[i].usable[row]), *too_far[:1])
        held = grid.columns[i].text(row)
        what = f"'{held[:40]}'" if held else "empty"
        expected = f"a number within {FAR:g} times most others" if i in too_far else "a finite number"
        faults.append(f"{grid.line_of(row)}: {grid.called(i)}: {what}, expected {expected}")
    for line, fields in grid.ragged[:1]:
        faults.append(f"{line}: {fields} fields, expected {len(grid.columns)}")
    count = int(bad.sum()) + len(grid.ragged)
    if not count:
        return usable, []
    if not reading.skip_bad:
        raise Unclear(f"{faults[0]}; {count} such lines: --skip-bad leaves them out")
    return usable, [f"{count} of {int(chosen.sum()) + len(grid.ragged)} lines left out (--skip-bad); {faults[0]}"]


def _far(grid: _Grid, outputs: Sequence[int], usable: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(3,n) cells that hold something else than outputs: a line garbled on its
    way, a moment in the place of a header."""
    sizes = np.abs(np.nan_to_num([grid.columns[i].numbers for i in outputs]))
    if not usable.any():
        return np.zeros(sizes.shape, bool)
    return np.asarray(sizes > FAR * np.quantile(sizes.max(axis=0)[usable], 0.9))


def _channels(
    grid: _Grid,
    roles: Roles,
    names: Sequence[Name],
    timing: _Timing,
    rows: NDArray[np.intp],
    readings: NDArray[np.float64],
    wanted: frozenset[str],
) -> tuple[dict[str, NDArray[np.float64]], dict[str, int], list[str]]:
    """All other columns of numbers without gaps, which of them have another
    name than their column, and why the others are not among them."""
    channels = {role: grid.columns[i].numbers[rows] for role, i in roles.channels.items()}
    renamed: dict[str, int] = {}
    left_out: list[str] = []
    used = {*roles.outputs, *roles.channels.values(), timing.column, timing.index}
    celsius = [i for i, n in enumerate(names) if n.is_celsius and i not in used]
    celsius = [i for i in celsius if names[i].unit or not names[i].is_either] or celsius
    magnitude = np.linalg.norm(readings, axis=1)
    for i, column in enumerate(grid.columns):
        if i in used:
            continue
        name = re.sub(r'[,\s"]+', " ", names[i].text if grid.named else f"column {i + 1}").strip()
        values = column.numbers[rows]
        reason = _unfit(column, rows, magnitude)
        if name in wanted and name not in channels and not (column.strange | column.gaps)[rows].any():
            channels[name] = values
            continue
        clock_of_its_own = names[i].is_either and len(values) > 1 and bool((np.diff(values) > 0).all())
        if i in roles.time or clock_of_its_own or column.moments_ns is not None:
            reason = "another time"
        elif i in roles.indices or _counts(column, rows):
            reason = "an index"
        elif i in roles.rivals:
            reason = "other outputs"
        elif grid.named and names[i].is_without_gravity:
            reason = "without gravity"
        elif grid.named and names[i].is_computed:
            reason = "computed from the outputs"
        elif reason is None and (not name or name in (*OUTPUTS, "t_s") or name in channels):
            reason = "its name is taken" if name else "it has no name"
        if reason is None and [i] == celsius and "temp_c" not in channels and _as_celsius(values):
            name = "temp_c"
            renamed[name] = i
        if reason is None:
            channels[name] = values
        else:
            left_out.append(f"{name or f'column {i + 1}'} ({reason})")
    return channels, renamed, left_out


def _unfit(column: Column, rows: NDArray[np.intp], magnitude: NDArray[np.float64]) -> str | None:
    if column.strange[rows].any():
        return "no numbers"
    if column.gaps[rows].any():
        return f"{int(column.gaps[rows].sum())} of {len(rows)} cells empty"
    values = column.numbers[rows]
    if (np.abs(values) >= VALUE_LIMIT).any():
        return "values too large"
    if len(rows) > 2 and np.ptp(values) > 0 and np.ptp(magnitude) > 0:
        with np.errstate(all="ignore"):
            correlation = np.corrcoef(values, magnitude)[0, 1]
        if abs(correlation) > COMPUTED_LEAST:
            return "computed from the outputs"
    return None


def _counts(column: Column, rows: NDArray[np.intp]) -> bool:
    """Whether it numbers the rows, whatever its name: as a channel it would be
    the time again."""
    return column.whole is not None and len(rows) > 2 and bool((np.diff(column.whole[rows]) == np.diff(rows)).all())


def _as_celsius(values: NDArray[np.float64]) -> bool:
    return bool(CELSIUS[0] <= values.min() and values.max() <= CELSIUS[1])


def _rising(
    grid: _Grid,
    timing: _Timing,
    rows: NDArray[np.intp],
    time_ns: NDArray[np.int64],
    readings: NDArray[np.float64],
    channels: Mapping[str, NDArray[np.float64]],
) -> NDArray[np.bool_]:
    """Which rows are no exact repetition of the one before. Raises Unclear
    where times do not rise."""
    step = np.diff(time_ns)
    values = np.column_stack([readings, *channels.values()])
    repeated = (step == 0) & (values[1:] == values[:-1]).all(axis=1)
    wrong = np.flatnonzero((step <= 0) & ~repeated)
    if len(wrong):
        at = int(wrong[0]) + 1
        what = "is that of the line before" if step[at - 1] == 0 else "is before that of the line before"
        column = "the time" if timing.column is None else f"{grid.called(timing.column)}: the time"
        raise Unclear(
            f"{grid.line_of(int(rows[at]))}: {column} {what} ({len(wrong)} such lines), expected times that rise; "
            "where samples are evenly spaced, --rate HZ counts them instead"
        )
    return np.concatenate(([True], ~repeated))


def _read_as(grid: _Grid, roles: Roles, timing: _Timing, renamed: Mapping[str, int], reading: Reading) -> str:
    parts = []
    if timing.column is not None:
        parts.append(f"t = {_shown(grid, timing.column)} [{timing.said}]")
    elif timing.index is not None:
        parts.append(f"t = {_shown(grid, timing.index)}, {timing.said}")
    else:
        parts.append(f"t = rows, {timing.said}")
    parts += [f"{axis} = {_shown(grid, i)}" for axis, i in zip(OUTPUTS, roles.outputs, strict=True)]
    parts += [f"{channel} = {_shown(grid, i)}" for channel, i in renamed.items() if channel != _shown(grid, i)]
    return f"read as {', '.join(parts)}" + ("" if set(reading.columns) >= {*OUTPUTS} else " (else: --columns)")


def _shown(grid: _Grid, column: int) -> str:
    name = Name.of(grid.names[column]).text if grid.named else ""
    return clipped(name) if name else f"column {column + 1}"


def _unit_of(roles: Roles, names: Sequence[Name]) -> str:
    units = {names[i].unit for i in roles.outputs}
    return units.pop() if len(units) == 1 else ""
