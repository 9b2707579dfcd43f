"""Which rows of a table are samples: those of one sensor, with a number in each
cell that is needed, at times that rise."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from triaxcal_drivers.nearest import clipped
from triaxcald.tables.arrow import MOSTLY, Column
from triaxcald.tables.grid import Grid
from triaxcald.tables.layout import NUMBER
from triaxcald.tables.naming import OUTPUTS, Name, Unclear

ROWS_LOOKED_AT = 10_000
"""For the words in a column: those that come in turn come early."""
SENSORS = frozenset(("sensor", "sensors", "type", "id", "device", "source", "node", "side", "imu", "name"))
"""Words by which a column of numbers names the sensor that a row is of."""
VALUES_MOST, IN_TURN = 50, 0.2
"""Sensors are few, and their rows come in turn; a label of what was done
changes rarely."""
FAR = 1e4
"""Times what nine in ten samples reach: more is no reading, as a knock reaches
the end of the range."""
_SENSORS = re.compile(r"acc|gyr|mag|baro|grav|rotat|orient|linear", re.IGNORECASE)


def rows_where(grid: Grid, where: Mapping[str, str]) -> NDArray[np.bool_]:
    """(n,) those that have these values in these columns. Raises Unclear."""
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


def require_one_sensor(grid: Grid, chosen: NDArray[np.bool_]) -> None:
    """Rows of several sensors below each other, as some phones write them,
    would be read as one that jumps. Raises Unclear."""
    for i, column in enumerate(grid.columns):
        by_number = bool(set(Name.of(grid.names[i]).words) & SENSORS) and grid.named
        if column.strange[chosen].mean() > MOSTLY and _of_quantities(column, by_number):
            continue
        values = _in_turn(column, chosen, by_number)
        if values:
            raise Unclear(
                f"rows of several sensors in turn ({grid.called(i)}: {clipped(', '.join(values))}); choose those of "
                f"one: --where {Name.of(grid.names[i]).text}={values[0]}"
            )
        if column.texts is None or column.moments_ns is not None or not column.strange[chosen].mean() > MOSTLY:
            continue
        texts = {column.text(int(row)) for row in np.flatnonzero(chosen)[:ROWS_LOOKED_AT]}
        if 1 < len(texts) <= 50 and sum(bool(_SENSORS.search(t)) for t in texts) > 1:
            wanted = next((t for t in sorted(texts) if re.search("acc", t, re.IGNORECASE)), min(texts))
            raise Unclear(
                f"rows of several sensors ({grid.called(i)}: {clipped(', '.join(sorted(texts)))}); choose "
                f"those of one: --where {Name.of(grid.names[i]).text}={wanted}"
            )


def _of_quantities(column: Column, by_number: bool) -> bool:
    """Whether a column of texts holds numbers with the other decimal mark than
    the table's. They name no sensor, unless the column's name says that its
    numbers do, and they have no fraction."""
    texts = [column.text(int(row)) for row in np.flatnonzero(column.strange)[:ROWS_LOOKED_AT]]
    if not texts or not all(map(NUMBER.fullmatch, texts)):
        return False
    return not by_number or any(float(t.replace(",", ".")) % 1 for t in texts)


def _in_turn(column: Column, chosen: NDArray[np.bool_], by_number: bool) -> list[str]:
    """The few values that a column of texts, or of numbers that name something,
    has in turn from row to row."""
    rows = np.flatnonzero(chosen)[:ROWS_LOOKED_AT]
    numbered = by_number and column.whole is not None and column.usable[rows].mean() > MOSTLY
    if column.moments_ns is not None or len(rows) < 4 or not (numbered or column.strange[rows].mean() > MOSTLY):
        return []
    names = column.whole if numbered else None
    held = [column.text(int(r)) if names is None else str(names[r]) for r in rows]
    values = sorted(set(held), key=lambda v: ("acc" not in v.lower(), v))
    turns = sum(a != b for a, b in pairwise(held)) / len(held)
    few = 1 < len(values) <= min(VALUES_MOST, len(held) // 4)
    return values if few and turns > IN_TURN else []


def require_numbers(grid: Grid, i: int, chosen: NDArray[np.bool_]) -> None:
    """Of a column that is an output: most of its cells are numbers, if not
    all."""
    column = grid.columns[i]
    if column.moments_ns is not None or (chosen & column.usable).sum() * 2 <= (chosen & column.strange).sum():
        rows = np.flatnonzero(chosen & (column.strange | (column.moments_ns is not None)))
        if not len(rows):
            raise Unclear(f"{grid.called(i)} holds no number" if len(column.numbers) else "no samples, expected some")
        row = int(rows[0])
        raise Unclear(f"{grid.line_of(row)}: {grid.called(i)}: '{column.text(row)[:40]}', expected a finite number")


def rows_with_numbers(
    grid: Grid, needed: Sequence[int], chosen: NDArray[np.bool_], skip_bad: bool
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
    if not skip_bad:
        raise Unclear(f"{faults[0]}; {count} such lines: --skip-bad leaves them out")
    return usable, [f"{count} of {int(chosen.sum()) + len(grid.ragged)} lines left out (--skip-bad); {faults[0]}"]


def _far(grid: Grid, outputs: Sequence[int], usable: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(3,n) cells that hold something else than outputs: a line garbled on its
    way, a moment in the place of a header."""
    sizes = np.abs(np.nan_to_num([grid.columns[i].numbers for i in outputs]))
    if not usable.any():
        return np.zeros(sizes.shape, bool)
    return np.asarray(sizes > FAR * np.quantile(sizes.max(axis=0)[usable], 0.9))


def rows_in_time(
    grid: Grid,
    time: int | None,
    rows: NDArray[np.intp],
    time_ns: NDArray[np.int64],
    readings: NDArray[np.float64],
    channels: Mapping[str, NDArray[np.float64]],
) -> NDArray[np.bool_]:
    """Which rows are no exact repetition of the one before; ``time`` is the
    column of the times. Raises Unclear where these do not rise."""
    step = np.diff(time_ns)
    values = np.column_stack([readings, *channels.values()])
    repeated = (step == 0) & (values[1:] == values[:-1]).all(axis=1)
    wrong = np.flatnonzero((step <= 0) & ~repeated)
    if len(wrong):
        at = int(wrong[0]) + 1
        what = "is that of the line before" if step[at - 1] == 0 else "is before that of the line before"
        column = "the time" if time is None else f"{grid.called(time)}: the time"
        raise Unclear(
            f"{grid.line_of(int(rows[at]))}: {column} {what} ({len(wrong)} such lines), expected times that rise; "
            "where samples are evenly spaced, --rate HZ counts them instead"
        )
    return np.concatenate(([True], ~repeated))
