"""Samples from a table of anybody's making: what is clear is read and said,
what is not is asked for by its option."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from triaxcal_drivers.file_kind import document_kind
from triaxcal_drivers.nearest import clipped
from triaxcald.errors import InputError
from triaxcald.tables import arrow, clock
from triaxcald.tables.arrow import MOSTLY
from triaxcald.tables.channels import VALUE_LIMIT, channels_of
from triaxcald.tables.grid import Grid, grid_of_own, grid_of_parquet, grid_of_text, holds_text
from triaxcald.tables.naming import OUTPUTS, TIME, Name, Roles, Unclear, column_of, roles_of
from triaxcald.tables.own_text import REQUIRED, CsvSamples, header_of, is_applied, is_own, samples_of_blocks
from triaxcald.tables.rows import require_numbers, require_one_sensor, rows_in_time, rows_where, rows_with_numbers
from triaxcald.tables.source import blocks, label_of, whole_lines
from triaxcald.tables.timing import Timing, is_no_time, times_of, timing_of, with_joined_times


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


def read_table(name: str, reading: Reading | None = None, *, beside: bool = False) -> Table:
    """Of a path, or of text on standard input (``-``); with ``beside`` the
    cells of all its columns are kept. Raises InputError: file, line, field,
    what was expected."""
    reading = reading or Reading()
    label = label_of(name)
    try:
        if name.endswith((".parquet", ".pq")):
            return _table_of(grid_of_parquet(Path(name)), reading, beside)
        data = blocks(name, label)
        first = next(data, b"")
        if known := document_kind(first):
            raise Unclear(f"{known}, expected a recording (.mcap) or a table of samples")
        own = replace(reading, wanted=frozenset()) == Reading() and is_own(first)
        if own and holds_text(whole_lines(first)):
            grid = grid_of_own(b"".join(chain((first,), data)), label)
            return _table_of(grid, reading, beside, lacking=() if is_applied(grid.names) else _lacking(grid))
        if own or not first:
            try:
                samples = samples_of_blocks(chain((first,), data) if first else (), label)
            except InputError:
                if (again := _applied_again(name, label, first)) is None:
                    raise
                return _table_of(again, reading, beside)
            clock.require_seconds(samples.time_ns, "t_s")
            return Table(samples)
        whole = b"".join(chain((first,), data))
        return _table_of(grid_of_text(whole, lambda *header: _used(reading, *header)), reading, beside)
    except Unclear as e:
        raise InputError(f"{label}: {e}") from None


def _applied_again(name: str, label: str, first: bytes) -> Grid | None:
    """What `triaxcal apply` wrote, of a file, though its ``first`` block holds
    numbers alone: a column may have its first gap far behind."""
    try:
        if not Path(name).is_file() or not is_applied(header_of(whole_lines(first), label)[1]):
            return None
        whole = b"".join(blocks(name, label))
        return grid_of_own(whole, label) if holds_text(whole) else None
    except InputError:
        return None


def _used(reading: Reading, header: tuple[str, ...] | None, fields: int) -> Collection[int] | None:
    """The columns that are read, where the user names all of them, or where
    they are those of our own layout. Raises Unclear."""
    columns = reading.columns
    by_name = header is not None or all(column.isdecimal() for column in columns.values())
    if by_name and {*OUTPUTS} <= set(columns) and (TIME in columns or reading.rate is not None):
        names = header or [str(i + 1) for i in range(fields)]
        return [column_of(names, column, named=header is not None) for column in columns.values()]
    return range(len(REQUIRED)) if header is not None and header[: len(REQUIRED)] == REQUIRED else None


def _lacking(grid: Grid) -> Sequence[int]:
    """Further columns that lack some numbers, and have most of them."""
    return [i for i, column in enumerate(grid.columns) if i >= len(REQUIRED) and MOSTLY <= column.share < 1]


def _as_own(reading: Reading) -> Reading:
    """In our own layout its columns are named, and times are seconds, unless
    the user says anything else of these."""
    said = {TIME, *OUTPUTS} & set(reading.columns) or reading.time_unit or reading.rate or reading.pose_means
    if said:
        return reading
    return replace(reading, time_unit="s", columns={o: o for o in OUTPUTS} | dict(reading.columns))


def _table_of(grid: Grid, reading: Reading, beside: bool, lacking: Sequence[int] = ()) -> Table:
    """``lacking`` are columns that have to have a number in each row too."""
    given, reading = reading, _as_own(reading) if grid.is_own else reading
    own = reading is not given
    chosen = rows_where(grid, reading.where)
    if grid.named and TIME not in reading.columns and not own:
        grid = with_joined_times(grid)
    roles = roles_of(grid.names, grid.units, reading.columns, named=grid.named)
    require_one_sensor(grid, chosen)
    for i in roles.outputs:
        require_numbers(grid, i, chosen)
    names = [Name.of(n, u) for n, u in zip(grid.names, grid.units, strict=True)]
    if TIME not in roles.said:
        times = tuple(i for i in roles.time if not is_no_time(grid.columns[i], names[i], chosen))
        roles = replace(roles, time=times)
    timed = replace(roles, time=(0,), said=roles.said | {TIME}) if own else roles
    timing = timing_of(
        grid, timed, names, chosen,
        rate=reading.rate, time_unit=reading.time_unit, pose_means=reading.pose_means,
    )  # fmt: skip
    needed = [*roles.outputs, *roles.channels.values(), *([] if timing.column is None else [timing.column])]
    keep, skipped = rows_with_numbers(grid, [*needed, *lacking], chosen, reading.skip_bad)
    rows = np.flatnonzero(keep)
    if not len(rows):
        raise Unclear("no samples, expected some")
    readings = _readings(grid, roles, rows)
    time_ns, timing = times_of(grid, timing, rows, chosen)
    if own:
        clock.require_seconds(time_ns, "t_s")
    channels, renamed, left_out = channels_of(grid, roles, names, timing, rows, readings, reading.wanted)
    once = rows_in_time(grid, timing.column, rows, time_ns, readings, channels)
    held = {name: values[once] for name, values in channels.items()}
    samples = CsvSamples(time_ns[once], readings[once], held, int(len(once) - once.sum()))
    remarks = [_read_as(grid, roles, timing, renamed, given)]
    remarks += [f"left out: {'; '.join(left_out)}"] if left_out else []
    output_unit = _output_unit([names[i].unit for i in roles.outputs])
    kept = _beside(grid, roles, samples.channels, rows[once]) if beside else {}
    return Table(samples, (*remarks, *skipped), output_unit, kept)


def _readings(grid: Grid, roles: Roles, rows: NDArray[np.intp]) -> NDArray[np.float64]:
    """(n,3) of these rows."""
    readings = np.stack([grid.columns[i].numbers[rows] for i in roles.outputs], axis=1)
    for i, size in zip(roles.outputs, np.abs(readings).T, strict=True):
        if (size >= VALUE_LIMIT).any():
            line = grid.line_of(int(rows[int(np.argmax(size))]))
            raise Unclear(f"{line}: {grid.called(i)}: a value of {VALUE_LIMIT:g} or more")
    return readings


def _output_unit(units: Sequence[str]) -> str:
    if len(set(units)) > 1:
        raise Unclear(f"outputs in {', '.join(unit or 'no unit' for unit in units)}; expected one unit for all three")
    return units[0]


def _beside(grid: Grid, roles: Roles, channels: Mapping[str, object], rows: NDArray[np.intp]) -> dict[str, Any]:
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


def _read_as(grid: Grid, roles: Roles, timing: Timing, renamed: Mapping[str, int], reading: Reading) -> str:
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


def _shown(grid: Grid, column: int) -> str:
    name = Name.of(grid.names[column]).text if grid.named else ""
    return clipped(name) if name else f"column {column + 1}"
