"""The times of a table's samples, in nanoseconds: from numbers whose unit is
known, dates, an index or a rate."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

import triaxcal as tc
from triaxcald.tables.arrow import Column
from triaxcald.tables.naming import ISO, Name, Unclear
from triaxcald.tables.naming import NANOSECONDS as UNITS

STEP_MOST_S, STEP_LEAST_S = 0.2, 2e-4
"""Numbers with a fraction in steps between these are seconds: a logger takes
from five to five thousand samples a second. Shorter steps may be minutes, hours
or a spreadsheet's days, longer ones milliseconds."""
OWN_MOST_S, OWN_LEAST_S = 1.0, 1e-5
"""The same of our own layout, whose times are seconds."""
_RATE = re.compile(
    r"(?:sampl\w*[ _-]*(?:rate|freq\w*)|(?:update|data|output|acquisition|measurement)[ _-]*(?:rate|freq\w*)|\brate\b|"
    r"\bfreq(?:uency)?\b|\bodr\b|abtast(?:rate|frequenz)\w*|messrate)[^\d\n]{0,25}?(?P<plain>\d+(?:[.,]\d+)?)"
    r"(?P<unit>\s*[^\s\d,;)\]]*)|"
    r"(?:\bfs\b|\bf_s\b)\D{0,5}(?P<fs>\d+(?:[.,]\d+)?)\s*(?P<fs_unit>k?hz|sps|1/s)|"
    r"\bat (?P<at>\d+(?:[.,]\d+)?) ?(?P<at_unit>k?hz)\b",
    re.IGNORECASE,
)
_GROUPS = (("plain", "unit"), ("fs", "fs_unit"), ("at", "at_unit"))
"""Of the figure and of its unit, by the ways to state a rate."""
_HERTZ = re.compile(r"\s*(k?)(?:hz|sps|1/s|samples/s(?:ec)?)\W*", re.IGNORECASE)
_OTHER_RATE = re.compile(r"baud|bit ?rate|filter|cut-?off|bandwidth|range|refresh|heart", re.IGNORECASE)
_PERIOD = re.compile(r"\b[mµu]?s\b", re.IGNORECASE)
"""In front of a number that is no sample rate in hertz."""
_THOUSANDS = re.compile(r"\d{1,3},\d{3}")


def stated_rate(remarks: Sequence[str]) -> tuple[float, str] | None:
    """In hertz, as the lines before the header state it, with the line; None
    where they state none, or two."""
    found: dict[float, str] = {}
    for line in remarks:
        for m in _RATE.finditer(line):
            if _OTHER_RATE.search(line[: m.end()]) or _PERIOD.search(m[0]):
                continue
            figure, unit = next((m[n], m[u]) for n, u in _GROUPS if m[n])
            hertz = _HERTZ.fullmatch(unit or "")
            if _THOUSANDS.fullmatch(figure) or (hertz is None and re.search(r"\w", unit or "")):
                continue
            value = float(figure.replace(",", ".")) * (1000 if hertz and hertz[1] else 1)
            if value > 0:
                found.setdefault(value, line.strip().strip("#%/").strip())
    return next(iter(found.items())) if len(found) == 1 else None


def nanoseconds(column: Column, name: Name, unit: str | None) -> tuple[NDArray[np.int64], str]:
    """(n,) and their unit. Only usable cells count. Raises Unclear where
    nothing states the unit."""
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
    """(n,) for samples evenly spaced by 1/``rate`` s, and whether an index
    counted them.

    An index that rises in steps of 1 shows lost samples as gaps; another, or
    one that starts again, counts no samples.
    """
    counted = np.arange(n)
    if column is not None and column.whole is not None and column.usable.all() and n > 1:
        steps = np.diff(column.whole)
        if (steps > 0).all() and np.median(steps) == 1:
            counted = column.whole - column.whole[0]
            return _evenly(counted, rate), True
    return _evenly(counted, rate), False


def require_seconds(time_ns: NDArray[np.int64], column: str) -> None:
    """Raises Unclear where times that were taken for seconds could be in
    another unit."""
    whole = bool((time_ns % UNITS["s"] == 0).all())
    _evident(np.asarray(time_ns * 1e-9), whole, Name.of(column), OWN_LEAST_S, OWN_MOST_S)


def _evenly(counted: NDArray[np.int64], rate: float) -> NDArray[np.int64]:
    if len(counted) and counted[-1] / rate > 9.2e9:
        raise Unclear(
            f"--rate {tc.number_format.plain(rate)}: {len(counted)} samples would take longer than can be counted"
        )
    return np.asarray(np.rint(counted * (UNITS["s"] / rate)).astype(np.int64))


def _evident(
    times: NDArray[np.float64] | NDArray[np.int64],
    whole: bool,
    name: Name,
    least_s: float = STEP_LEAST_S,
    most_s: float = STEP_MOST_S,
) -> str:
    if name.other_time_unit:
        raise Unclear(f"{_called(name)} is in {name.other_time_unit}; convert it to seconds, or give --rate HZ")
    steps = np.diff(times)
    rising = steps[steps > 0]
    if not len(rising):
        return "s"
    step = float(np.median(rising))
    if not whole and least_s <= step < most_s and not name.unknown_unit and not _are_clock_figures(times, steps):
        return "s"
    kind = "integers" if whole else "numbers"
    options = ", ".join(f"{u} would be {_rate(step * UNITS[u] / UNITS['s'])}" for u in UNITS)
    raise Unclear(
        f"{_called(name)}: {kind} in steps of {tc.number_format.plain(step)} in a unit that nothing states; say which: "
        f"--time-unit s, ms, us or ns ({options}), or --time-unit index --rate HZ"
    )


def _are_clock_figures(times: NDArray[np.float64] | NDArray[np.int64], steps: NDArray[Any]) -> bool:
    """Whether they are times of day as HHMMSS.ss: of hundreds and ten thousands
    no more than 59 are there, and the hundreds jump on from 60."""
    seconds, minutes = times % 100, times // 100 % 100
    jumps = np.abs(steps - 40) < 1
    return bool((seconds < 60).all() and (minutes < 60).all() and jumps.any() and times.max(initial=0) >= 100)


def _rate(step_s: float) -> str:
    hertz = 1 / step_s
    for factor, unit in ((1e9, "GHz"), (1e6, "MHz"), (1e3, "kHz"), (1.0, "Hz"), (1e-3, "mHz")):
        if hertz >= factor:
            return f"{tc.number_format.plain(hertz / factor)} {unit}"
    return f"a sample every {step_s:.3g} s"


def _scaled(column: Column, name: Name, unit: str) -> NDArray[np.int64]:
    scale = UNITS[unit]
    usable = column.usable
    held = np.where(usable, column.numbers, 0.0)
    if np.abs(held).max(initial=0.0) >= 2**63 / scale:
        raise Unclear(
            f"{_called(name)} goes to {tc.number_format.plain(float(np.abs(held).max()))}, which are too many {unit}"
        )
    if column.whole is not None:
        return np.where(usable, column.whole, 0) * scale
    whole = np.floor(held)  # apart, so that seconds since 1970 keep their nanoseconds as far as a float has them
    return np.asarray(whole.astype(np.int64) * scale + np.rint((held - whole) * scale).astype(np.int64))


def _called(name: Name) -> str:
    return f"column {name.text}" if name.text else "the column of time"
