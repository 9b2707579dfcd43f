"""Samples from a table of anybody's making: what is clear is read and said,
what is not is asked for by its option."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald.decoded import SampleRate
from triaxcald.errors import InputError
from triaxcald.stores import path_of
from triaxcald.tables import arrow, clock
from triaxcald.tables.arrow import MOSTLY, Column
from triaxcald.tables.grid import Grid, grid_of_own, grid_of_parquet, grid_of_text, holds_text
from triaxcald.tables.layout import NUMBER
from triaxcald.tables.naming import (
    BY_NUMBER,
    ERRORS,
    INDEX,
    ISO,
    OUTPUTS,
    TIME,
    Name,
    Roles,
    Unclear,
    column_of,
    roles_of,
    seconds_and_rest,
)
from triaxcald.tables.native_csv import (
    REQUIRED,
    CsvSamples,
    blocks,
    header_of,
    is_applied,
    is_native,
    label_of,
    samples_of_blocks,
    whole_lines,
)

# Which column of a table is the time, in which unit, or by which rate its samples
# are counted.

SECONDS_MOST = 2**63 // 10**9
"""In nanoseconds they still fit 64 bits."""
RESTARTS = 10
"""A clock rises so many times as often as it starts again, at least."""


@dataclass(frozen=True)
class Timing:
    """``time_ns`` (n,), None where the samples are counted, by ``index`` where
    that is a column; ``column`` is the one that the times are of. ``said`` is
    what is to be said of it."""

    time_ns: NDArray[np.int64] | None
    column: int | None
    said: str
    rate: float = 0.0
    index: int | None = None


def timing_of(
    grid: Grid,
    roles: Roles,
    names: Sequence[Name],
    chosen: NDArray[np.bool_],
    *,
    rate: float | None,
    time_unit: str | None,
    pose_means: bool,
) -> Timing:
    """In the rows that are ``chosen``; ``rate`` in Hz, ``time_unit`` and
    ``pose_means`` are what the user says. Raises Unclear."""
    where = "--rate"
    if time_unit not in (None, INDEX) and rate is not None:
        raise Unclear(f"--rate, --time-unit {time_unit}: give one or the other")
    by_index = time_unit == INDEX
    candidates = [i for i in roles.time if _rises_at_all(grid.columns[i], chosen)]
    if not roles.time and grid.named:
        moments = [i for i, c in enumerate(grid.columns) if c.moments_ns is not None and _rises_at_all(c, chosen)]
        candidates = moments if len(moments) == 1 else []
    if TIME in roles.said:
        candidates = list(roles.time)
    if pose_means and rate is None and not candidates:
        return Timing(None, None, "one pose a second", 1.0)
    if rate is None and (by_index or not candidates):
        stated = clock.stated_rate(grid.head)
        if stated is None:
            raise Unclear(_no_time(grid, roles, by_index))
        rate, where = stated[0], f"'{td.hints.clipped(stated[1])}'"
    if rate is not None:
        counters = [*(roles.time[:1] if by_index or TIME in roles.said else ()), *roles.indices]
        index = next(iter(counters), None)
        return Timing(None, None, f"{tc.number_format.plain(rate, 6)} Hz by {where}", rate, index)
    return _timed(grid, candidates, names, time_unit, chosen)


def _wrong_rate(
    grid: Grid, roles: Roles, names: Sequence[Name], chosen: NDArray[np.bool_], rows: NDArray[np.intp], rate: float
) -> str:
    """By the times of a column, of samples that are counted at the user's ``rate``
    instead; empty where no column tells, or it tells the same."""
    columns = [] if TIME in roles.said else [i for i in roles.time if _rises_at_all(grid.columns[i], chosen)]
    try:
        timing = _timed(grid, columns, names, "s" if grid.is_native else None, chosen) if columns else None
        if timing is None or timing.time_ns is None:
            return ""
        if grid.is_native:
            clock.require_seconds(timing.time_ns[rows], "t_s")
    except Unclear:
        return ""
    time_ns, real = np.maximum.accumulate(timing.time_ns[rows]), SampleRate(rate)
    real.received(time_ns)
    real.decoded(np.arange(len(rows)), time_ns)
    if (rate_hz := real.wrong_hz()) is None:
        return ""
    return f"{rate_hz:.3g} Hz by the times, and --rate says {tc.number_format.plain(rate, 6)}"


def _no_time(grid: Grid, roles: Roles, by_index: bool) -> str:
    if by_index:
        return "--time-unit index: say how many samples a second it counts: --rate HZ"
    if roles.indices:
        return f"{grid.called(roles.indices[0])} is an index, and nothing states a rate: --rate HZ"
    for i in roles.time:
        if grid.columns[i].strange.any():
            row = int(np.flatnonzero(grid.columns[i].strange)[0])
            held = grid.columns[i].text(row)[:40]
            return _not_understood(grid, i, held)
        falls = np.flatnonzero(np.diff(grid.columns[i].numbers) < 0)
        if len(falls):
            where = f"{grid.line_of(int(falls[0]) + 1)}: {grid.called(i)}"
            return f"{where}: the time falls back, as a counter does that starts again; --rate HZ counts the samples"
    for i, column in enumerate(grid.columns):
        held = column.text(int(np.flatnonzero(column.strange)[0]))[:40] if column.strange.mean() > MOSTLY else ""
        if _CLOCK.search(held):
            return _not_understood(grid, i, held)
    which = "t=NAME" if grid.named else "t=NUMBER"
    return (
        f"no column of time; name it (--columns {which},…), or say how many samples a second there are: --rate HZ; "
        "if each row is the mean of a pose: --pose-means"
    )


def _not_understood(grid: Grid, i: int, held: str) -> str:
    return (
        f"{grid.called(i)}: '{held}' is a time or date that is not understood, expected one as 2026-01-31 12:00:00.25; "
        "convert it, or --rate HZ counts the samples"
    )


def _rises_at_all(column: Column, chosen: NDArray[np.bool_]) -> bool:
    rows = chosen & column.usable
    if rows.sum() * 2 < chosen.sum():
        return False
    values = column.moments_ns if column.moments_ns is not None else column.numbers
    held = values[rows]
    return len(held) < 2 or held[-1] > held[0]


def is_no_time(column: Column, name: Name, chosen: NDArray[np.bool_]) -> bool:
    """Of a column that may be either: a temperature falls as it rises, a clock
    at most where it starts again."""
    steps = np.diff(column.numbers[chosen & column.usable])
    return name.is_either and column.moments_ns is None and bool((steps < 0).sum() * RESTARTS > (steps > 0).sum())


def _timed(
    grid: Grid, candidates: Sequence[int], names: Sequence[Name], unit: str | None, chosen: NDArray[np.bool_]
) -> Timing:
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
        both = ", ".join(f"{grid.called(i)} {tc.number_format.plain(s)} s" for i, s in lasted.items())
        raise Unclear(f"columns of time that do not agree how long it took ({both}); choose one: --columns t=NAME")
    _, i, time_ns, known = rising[0]
    return Timing(time_ns, i, "dates" if known == ISO else known)


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


def times_of(
    grid: Grid, timing: Timing, rows: NDArray[np.intp], chosen: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], Timing]:
    """(n,) nanoseconds of these ``rows``; without the index, if that does not
    count them."""
    if timing.time_ns is not None:
        return timing.time_ns[rows], timing
    time_ns, by_index = _counted(grid, timing, rows, chosen)
    return time_ns, timing if by_index else replace(timing, index=None)


def _counted(
    grid: Grid, timing: Timing, rows: NDArray[np.intp], chosen: NDArray[np.bool_]
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


def with_joined_times(grid: Grid) -> Grid:
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


# Which rows of a table are samples: those of one sensor, with a number in each cell
# that is needed, at times that rise.

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
COUNTED = frozenset(("axis", "count", "counts", "activity", "cpm"))
"""Words in the names of counts of activity."""
RESTS_LEAST = 0.01
"""Counts are 0 on all axes at rest, which a wearer does in more epochs than so many."""
_CLOCK = re.compile(r"(?<!\d)\d{1,2}(?:[:.h_]|\s?Uhr\s?)\d\d(?!\d)|\d{8}T\d{4}", re.IGNORECASE)
"""In a text that tells a time of day."""
LENGTHS_MOST = 5
"""By so many times the lengths of accelerations never differ, from the tenth to the
ninetieth of a hundred: an offset as large as 1 g makes 3.7 times of the same 1 g."""
_EPOCH = re.compile(
    r"\bepoch[ _-]*(?:period|length|duration|interval|size)\b[^\d\n]{0,40}(\d+(?:[:.]\d+)*)", re.IGNORECASE
)
_SENSORS = re.compile(r"acc|gyr|mag|baro|grav|rotat|orient|linear", re.IGNORECASE)


def rows_where(grid: Grid, where: Mapping[str, str]) -> NDArray[np.bool_]:
    """(n,) those that have these values in these columns. Raises Unclear."""
    n = len(grid.columns[0].numbers) if grid.columns else 0
    chosen = np.ones(n, bool)
    for name, value in where.items():
        found = [i for i, held in enumerate(grid.names) if name in (held, Name.of(held).text)]
        if len(found) != 1:
            has = ", ".join(Name.of(held).text for held in grid.names) if grid.named else "no header"
            raise Unclear(
                f"--where {name}={value}: {len(found)} columns of that name; the table has {td.hints.clipped(has)}"
            )
        column = grid.columns[found[0]]
        chosen &= column.equals(value)
        if not chosen.any():
            raise Unclear(
                f"--where {name}={value}: no row has that; it has {td.hints.clipped(', '.join(_distinct(column)))}"
            )
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
                f"rows of several sensors in turn ({grid.called(i)}: {td.hints.clipped(', '.join(values))}); "
                "choose those of "
                f"one: --where {Name.of(grid.names[i]).text}={values[0]}"
            )
        if column.texts is None or column.moments_ns is not None or not column.strange[chosen].mean() > MOSTLY:
            continue
        texts = {column.text(int(row)) for row in np.flatnonzero(chosen)[:ROWS_LOOKED_AT]}
        if 1 < len(texts) <= 50 and sum(bool(_SENSORS.search(t)) for t in texts) > 1:
            wanted = next((t for t in sorted(texts) if re.search("acc", t, re.IGNORECASE)), min(texts))
            raise Unclear(
                f"rows of several sensors ({grid.called(i)}: {td.hints.clipped(', '.join(sorted(texts)))}); choose "
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
        if grid.columns[i].moments_ns is not None:
            expected = "a time of the date and form of the first (dates as 2026-01-31 may change)"
        faults.append(f"{grid.line_of(row)}: {grid.called(i)}: {what}, expected {expected}")
    for line, fields in grid.ragged[:1]:
        shown = td.hints.clipped(", ".join(Name.of(name).text for name in grid.names))
        unlike = f"not as the other lines, expected {shown}"
        faults.append(f"{line}: {unlike if grid.labelled else f'{fields} fields, expected {len(grid.columns)}'}")
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


# Which columns of a table are channels: quantities logged beside the outputs, such
# as a temperature.

VALUE_LIMIT = 1e100
"""Squares of values, and sums of them, have to be numbers too."""
COMPUTED_LEAST = 0.999
"""Correlation with the magnitude of the outputs above which a column is
computed from them; a temperature that is measured has not a thousandth of
it."""
CELSIUS = (-60.0, 150.0)
"""A thermometer of degrees Celsius beside a sensor shows no other; counts of a
converter are beyond."""


def channels_of(
    grid: Grid,
    roles: Roles,
    names: Sequence[Name],
    timing: Timing,
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
        if name in wanted and name not in channels and not (column.strange | column.gaps)[rows].any():
            channels[name] = values
            continue
        reason = _another_quantity(grid, roles, names[i], i, rows) or _unfit(column, rows, magnitude)
        if reason is None and (not name or name in (*OUTPUTS, "t_s") or name in channels):
            reason = "its name is taken" if name else "it has no name"
        if reason is not None:
            left_out.append(f"{name or f'column {i + 1}'} ({reason})")
            continue
        if [i] == celsius and "temp_c" not in channels and _as_celsius(values):
            name = "temp_c"
            renamed[name] = i
        channels[name] = values
    return channels, renamed, left_out


def _another_quantity(grid: Grid, roles: Roles, name: Name, i: int, rows: NDArray[np.intp]) -> str | None:
    """Why a column is none that an effect may go with, by its name and by how
    its numbers run; None where nothing speaks against it."""
    column, values = grid.columns[i], grid.columns[i].numbers[rows]
    clock_of_its_own = name.is_either and len(values) > 1 and bool((np.diff(values) > 0).all())
    if i in roles.time or clock_of_its_own or column.moments_ns is not None:
        return "another time"
    if i in roles.indices or _counts(column, rows):
        return "an index"
    if i in roles.rivals:
        return "other outputs"
    if grid.named and name.is_without_gravity:
        return "without gravity"
    if grid.named and name.is_uncertainty:
        return "an uncertainty; standard errors of pose means are called se_ux, se_uy, se_uz"
    if grid.named and name.is_computed:
        return "computed from the outputs"
    return None


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
    time. ``wrong_rate`` says how far the times are off the rate that the user
    gives."""

    samples: CsvSamples
    remarks: tuple[str, ...] = ()
    output_unit: str = ""
    beside: Mapping[str, Any] = field(default_factory=dict)
    wrong_rate: str = ""


def read_table(name: str, reading: Reading | None = None, *, beside: bool = False) -> Table:
    """Of a path, or of text on standard input (``-``); with ``beside`` the
    cells of all its columns are kept. Raises InputError: file, line, field,
    what was expected."""
    reading = reading or Reading()
    label = label_of(name)
    try:
        if name.endswith((".parquet", ".pq")):
            return _table_of(grid_of_parquet(path_of(name)), reading, beside)
        data = blocks(name, label)
        first = next(data, b"")
        if known := td.files.document_kind(first):
            raise Unclear(f"{known}, expected a recording (.mcap) or a table of samples")
        if how := td.files.converter(first):
            raise Unclear(f"{td.files.kind(first)}, expected a text table{how}")
        own = replace(reading, wanted=frozenset()) == Reading() and is_native(first)
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
        if not _is_file(name) or not is_applied(header_of(whole_lines(first), label)[1]):
            return None
        whole = b"".join(blocks(name, label))
        return grid_of_own(whole, label) if holds_text(whole) else None
    except InputError:
        return None


def _is_file(name: str) -> bool:
    """Not a pipe, which can be read once."""
    path = path_of(name)
    return path.is_file() if isinstance(path, Path) else True


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
    given, reading = reading, _as_own(reading) if grid.is_native else reading
    own = reading is not given
    chosen = rows_where(grid, reading.where)
    if grid.named and TIME not in reading.columns and not own:
        grid = with_joined_times(grid)
    asked = not grid.named and not {*OUTPUTS} <= set(reading.columns)
    suggested = _by_number(grid, chosen) if asked else BY_NUMBER
    roles = roles_of(grid.names, grid.units, reading.columns, named=grid.named, suggested=suggested)
    require_one_sensor(grid, chosen)
    for i in roles.outputs:
        require_numbers(grid, i, chosen)
    _require_no_counts(grid, roles.outputs, chosen)
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
    remarks += [f"left out: {n} lines as '{td.hints.clipped(line)}'" for line, n in grid.passed_over.items()]
    output_unit = _output_unit([names[i].unit for i in roles.outputs])
    kept = _beside(grid, roles, samples.channels, rows[once]) if beside else {}
    wrong = _wrong_rate(grid, roles, names, chosen, rows, reading.rate) if reading.rate is not None else ""
    return Table(samples, (*remarks, *skipped), output_unit, kept, wrong)


def _by_number(grid: Grid, chosen: NDArray[np.bool_]) -> str:
    """The option that names the columns of a table without a header, as far as
    the cells tell: the time rises throughout, and three columns of numbers
    follow it or stand alone."""
    time = next((i for i, c in enumerate(grid.columns) if _never_falls(c, chosen)), None)
    numbers = [i for i, c in enumerate(grid.columns) if c.share > MOSTLY and i != time]
    behind = [i for i in numbers if time is None or i > time]
    of = (behind if len(behind) >= len(OUTPUTS) else numbers)[: len(OUTPUTS)]
    if len(of) < len(OUTPUTS):
        return BY_NUMBER
    if _epoch(grid):
        _require_no_counts(grid, of, chosen)
    outputs = ",".join(f"{axis}={i + 1}" for axis, i in zip(OUTPUTS, of, strict=False))
    return f"--columns t={time + 1},{outputs}" if time is not None else f"--columns {outputs} --rate HZ"


def _never_falls(column: Column, chosen: NDArray[np.bool_]) -> bool:
    rows = chosen & column.usable
    values = (column.moments_ns if column.moments_ns is not None else column.numbers)[rows]
    return (
        rows.sum() * 2 > chosen.sum()
        and len(values) > 1
        and bool((np.diff(values) >= 0).all() and values[-1] > values[0])
    )


def _require_no_counts(grid: Grid, outputs: Sequence[int], chosen: NDArray[np.bool_]) -> None:
    """Counts of activity in epochs, as actigraphs write them, are whole numbers from
    0, and 0 where the unit rests. Gravity is in every acceleration: whole numbers
    from 0, as of a converter without a sign, keep their length within a few times.
    Raises Unclear."""
    columns = [grid.columns[i] for i in outputs]
    if any(c.whole is None or (c.numbers[chosen & c.usable] < 0).any() for c in columns):
        return
    usable = chosen & columns[0].usable & columns[1].usable & columns[2].usable
    lengths = np.linalg.norm([c.numbers[usable] for c in columns], axis=0)
    low, high = np.quantile(lengths, (0.1, 0.9)) if len(lengths) else (0.0, 0.0)
    epoch = _epoch(grid)
    called = all(set(Name.of(grid.names[i]).words) & COUNTED for i in outputs) and grid.named
    rests = len(lengths) > 0 and float((lengths == 0).mean()) >= RESTS_LEAST
    if epoch or (high > LENGTHS_MOST * low and (called or rests)):
        which = ", ".join(_shown(grid, i) for i in outputs)
        why = f"'{td.hints.clipped(epoch)}' stands above" if epoch else "gravity is not in them"
        raise Unclear(
            f"{which} hold whole numbers from 0, and {why}: counts of activity in epochs, which are not acceleration; "
            "export the raw samples (ActiGraph: the .gt3x file)"
        )


def _epoch(grid: Grid) -> str:
    """The line above the table that states an epoch; empty where none does. Raw
    samples have one of 0."""
    found = ((line, _EPOCH.search(line)) for line in grid.head)
    return next((line.strip() for line, m in found if m and re.search("[1-9]", m[1])), "")


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
    errors = {role: i for role, i in roles.channels.items() if role in ERRORS}
    parts += [f"{role} = {_shown(grid, i)}" for role, i in {**errors, **renamed}.items() if role != _shown(grid, i)]
    return f"read as {', '.join(parts)}" + ("" if set(reading.columns) >= {*OUTPUTS} else " (else: --columns)")


def _shown(grid: Grid, column: int) -> str:
    name = Name.of(grid.names[column]).text if grid.named else ""
    return td.hints.clipped(name) if name else f"column {column + 1}"
