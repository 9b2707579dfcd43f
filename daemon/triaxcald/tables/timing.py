"""Which column of a table is the time, in which unit, or by which rate its
samples are counted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

import triaxcal as tc
from triaxcal_drivers.hints import clipped
from triaxcald.tables import clock
from triaxcald.tables.arrow import Column
from triaxcald.tables.grid import Grid
from triaxcald.tables.naming import INDEX, ISO, TIME, Name, Roles, Unclear, seconds_and_rest

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
        rate, where = stated[0], f"'{clipped(stated[1])}'"
    if rate is not None:
        counters = [*(roles.time[:1] if by_index or TIME in roles.said else ()), *roles.indices]
        index = next(iter(counters), None)
        return Timing(None, None, f"{tc.number_format.plain(rate, 6)} Hz by {where}", rate, index)
    return _timed(grid, candidates, names, time_unit, chosen)


def _no_time(grid: Grid, roles: Roles, by_index: bool) -> str:
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
