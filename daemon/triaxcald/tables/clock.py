"""The times of a table's samples, in nanoseconds: from numbers whose unit is known, dates, an index or a rate."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from triaxcal.figures import plain
from triaxcald.tables.arrow import Column
from triaxcald.tables.naming import ISO, Name, Unclear
from triaxcald.tables.naming import NANOSECONDS as UNITS

STEP_MOST_S, STEP_LEAST_S = 1.0, 1e-5
"""Numbers with a fraction in steps between these are seconds: a logger takes more than a sample a second, and none
takes one in 10 µs; steps as short are a spreadsheet's days."""
_RATE = re.compile(
    r"(?:sampl\w*[ _-]*(?:rate|freq\w*)|(?:update|data|output|acquisition|measurement)[ _-]*(?:rate|freq\w*)|\brate\b|"
    r"\bfreq(?:uency)?\b|\bfs\b|\bf_s\b|\bodr\b|abtast\w*|messrate)[^\d\n]{0,25}?(\d+(?:[.,]\d+)?)\s*(k?)(?:hz|sps|1/s)?|"
    r"\bat (\d+(?:[.,]\d+)?) ?(k?)hz\b",
    re.IGNORECASE,
)


def stated_rate(remarks: Sequence[str]) -> tuple[float, str] | None:
    """In hertz, as the lines before the header state it, with the line; None where they state none, or two."""
    found: dict[float, str] = {}
    for line in remarks:
        for m in _RATE.finditer(line):
            figure, kilo = (m[1], m[2]) if m[1] else (m[3], m[4])
            value = float(figure.replace(",", ".")) * (1000 if kilo else 1)
            if value > 0:
                found.setdefault(value, line.strip().strip("#%/").strip())
    return next(iter(found.items())) if len(found) == 1 else None


def nanoseconds(column: Column, name: Name, unit: str | None) -> tuple[NDArray[np.int64], str]:
    """(n,) and their unit. Only usable cells count. Raises Unclear where nothing states the unit."""
    usable = column.usable
    if column.moments_ns is not None:
        if unit not in (None, ISO):
            raise Unclear(f"--time-unit {unit}: {_called(name)} holds dates or times of day; they need no unit")
        return column.moments_ns, ISO
    if unit == ISO:
        raise Unclear(f"--time-unit iso: {_called(name)} holds numbers, no dates as 2026-01-31 12:00:00.25")
    if unit is None and name.time_unit is None:
        numbers = column.numbers if column.whole is None else column.whole
        unit = _evident(numbers[usable], column.whole is not None, name)
    unit = unit or name.time_unit or "s"
    return _scaled(column, name, unit), unit


def of_index(column: Column | None, n: int, rate: float) -> tuple[NDArray[np.int64], bool]:
    """(n,) for samples evenly spaced by 1/``rate`` s, and whether an index counted them.

    An index that rises in steps of 1 shows lost samples as gaps; another, or one that starts again, counts no samples.
    """
    counted = np.arange(n)
    if column is not None and column.whole is not None and column.usable.all() and n > 1:
        steps = np.diff(column.whole)
        if (steps > 0).all() and np.median(steps) == 1:
            counted = column.whole - column.whole[0]
            return _evenly(counted, rate), True
    return _evenly(counted, rate), False


def require_seconds(time_ns: NDArray[np.int64], column: str) -> None:
    """Raises Unclear where times that were taken for seconds could be in another unit."""
    _evident(np.asarray(time_ns * 1e-9), bool((time_ns % UNITS["s"] == 0).all()), Name.of(column))


def _evenly(counted: NDArray[np.int64], rate: float) -> NDArray[np.int64]:
    if len(counted) and counted[-1] / rate > 9.2e9:
        raise Unclear(f"--rate {plain(rate)}: {len(counted)} samples would take longer than can be counted")
    return np.asarray(np.rint(counted * (UNITS["s"] / rate)).astype(np.int64))


def _evident(times: NDArray[np.float64] | NDArray[np.int64], whole: bool, name: Name) -> str:
    if name.other_time_unit:
        raise Unclear(f"{_called(name)} is in {name.other_time_unit}; convert it to seconds, or give --rate HZ")
    steps = np.diff(times)
    rising = steps[steps > 0]
    if not len(rising):
        return "s"
    step = float(np.median(rising))
    if not whole and STEP_LEAST_S <= step < STEP_MOST_S:
        return "s"
    kind = "integers" if whole else "numbers"
    options = ", ".join(f"{u} would be {_rate(step * UNITS[u] / UNITS['s'])}" for u in UNITS)
    raise Unclear(
        f"{_called(name)}: {kind} in steps of {plain(step)} in a unit that nothing states; say which: "
        f"--time-unit s, ms, us or ns ({options}), or --time-unit index --rate HZ"
    )


def _rate(step_s: float) -> str:
    hertz = 1 / step_s
    for factor, unit in ((1e9, "GHz"), (1e6, "MHz"), (1e3, "kHz"), (1.0, "Hz"), (1e-3, "mHz")):
        if hertz >= factor:
            return f"{plain(hertz / factor)} {unit}"
    return f"a sample every {step_s:.3g} s"


def _scaled(column: Column, name: Name, unit: str) -> NDArray[np.int64]:
    scale = UNITS[unit]
    usable = column.usable
    held = np.where(usable, column.numbers, 0.0)
    if np.abs(held).max(initial=0.0) >= 2**63 / scale:
        raise Unclear(f"{_called(name)} goes to {plain(float(np.abs(held).max()))}, which are too many {unit}")
    if column.whole is not None:
        return np.where(usable, column.whole, 0) * scale
    whole = np.floor(held)  # apart, so that seconds since 1970 keep their nanoseconds as far as a float has them
    return np.asarray(whole.astype(np.int64) * scale + np.rint((held - whole) * scale).astype(np.int64))


def _called(name: Name) -> str:
    return f"column {name.text}" if name.text else "the column of time"
