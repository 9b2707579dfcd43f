"""How good a line is: yield, causes, the distribution of each figure against its limit,
and control charts. From rows to documents, without I/O.

A row has the columns of `triaxcal results` that `COLUMNS` names, ``at_us`` (start in µs
since 1970, else end) and ``tried`` (whether it was an attempt at the unit). Rows are in
the order of time.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy import special
from scipy.optimize import brentq

import triaxcal as tc
from triaxcald.schema.codes import Verdict
from triaxcald.service.golden import is_check
from triaxcald.work import plain_serial

FIGURES: Final = {
    "rms_g": "rms_limit_g",
    "cross_validated_rms_g": "cross_validated_rms_limit_g",
    "verification_rms_g": "verification_rms_limit_g",
}
"""Columns of the figures with an upper limit, and of the limit."""
COEFFICIENTS: Final = {
    f"{kind}_{axis}": unit
    for kind, unit in (("scale_factor", "output/g"), ("misalignment", "rad"), ("bias", "g"))
    for axis in "xyz"
}
UNITS: Final = {**dict.fromkeys(FIGURES, "g"), **COEFFICIENTS}
"""Unit of each characteristic."""
COLUMNS: Final = (
    "run", "serial", "work_serial", "part_number", "ended", "verdict", "code",
    *FIGURES, *FIGURES.values(), *COEFFICIENTS,
)  # fmt: skip

LEVEL: Final = 0.95
PPK_LEAST: Final = 30
"""Units below which Ppk is not stated."""
INDIVIDUALS, RANGES = 2.66, 3.267
"""3/d2 and D4 for ranges of two values: limits of individuals and of moving ranges in
mean moving ranges (ASTM E2587)."""
RUN_OF: Final = 8
"""Values in a row on one side of the centre (Western Electric rule 4)."""

JUDGED: Final = (Verdict.PASS, Verdict.FAIL)

Row = Mapping[str, Any]
Unit = tuple[str, str | None]
"""Plain serial number, and part number: products may be numbered each for itself."""
Floats = NDArray[np.float64]


class _Attempts:
    """The attempts among rows, and the unit of each."""

    def __init__(self, rows: Iterable[Row]) -> None:
        self.rows: list[Row] = []
        self.by_unit: dict[Unit, list[Row]] = {}
        """By the serial number of the work, else the one that the unit reported.
        Without either, nobody knows the unit."""
        seen: set[str] = set()
        number: dict[Unit, int] = {}
        units = []
        for row in rows:
            # The folder may hold copies of outcomes; a golden unit checks the station.
            if not row["tried"] or row["run"] in seen or is_check(row):
                continue
            if row["run"] is not None:
                seen.add(row["run"])
            self.rows.append(row)
            serial = _serial(row)
            if serial is None:
                units.append(-1)
                continue
            unit = plain_serial(serial), row["part_number"]
            self.by_unit.setdefault(unit, []).append(row)
            units.append(number.setdefault(unit, len(number)))
        self._units = np.array(units, dtype=np.intp)
        order = sorted(range(len(units)), key=lambda i: (self.rows[i]["ended"], self.rows[i]["run"] or ""))
        self._rank = np.empty(len(units), dtype=np.intp)
        self._rank[order] = np.arange(len(units))

    def measured(self, name: str) -> tuple[list[Row], Floats]:
        """The attempt that gives each unit's value, its last one with the figure, in
        the order of their ends; and the values."""
        values = np.array([row[name] for row in self.rows], dtype=float)  # NaN for None
        having = np.flatnonzero(np.isfinite(values) & (self._units >= 0))
        last = np.full(len(self.by_unit), -1, dtype=np.intp)
        np.maximum.at(last, self._units[having], having)
        chosen = last[last >= 0]
        chosen = chosen[np.argsort(self._rank[chosen])]
        return [self.rows[i] for i in chosen.tolist()], values[chosen]


def quality_of(rows: Iterable[Row], first_judged_us: Mapping[Unit, int] | None = None) -> dict[str, Any]:
    """`triaxcal.quality/1` of these rows. ``first_judged_us`` has the time of the first
    judged attempt at a unit, also where that is not among the rows."""
    attempts, before = _Attempts(rows), first_judged_us or {}
    passed, passed_first = [], []
    for unit, of_unit in attempts.by_unit.items():
        if (last := _last(of_unit)) is None:
            continue
        passed.append(last["verdict"] == Verdict.PASS)
        first = next((row for row in of_unit if row["verdict"] in JUDGED), None)
        at_us = (first or of_unit[0])["at_us"]
        if before.get(unit, at_us) >= at_us:
            passed_first.append(first is not None and first["verdict"] == Verdict.PASS)
    codes = Counter(row["code"] for row in attempts.rows if row["code"] is not None)
    return {
        "format": "triaxcal.quality/1",
        "units": len(attempts.by_unit),
        "first_pass_yield": _share(passed_first),
        "first_pass_yield_interval": _rounded(share_interval(sum(passed_first), len(passed_first))),
        "first_pass_units": len(passed_first),
        "yield": _share(passed),
        "yield_interval": _rounded(share_interval(sum(passed), len(passed))),
        "yield_units": len(passed),
        "attempts": len(attempts.rows),
        "codes": dict(sorted(codes.items(), key=lambda item: (-item[1], item[0]))),
        "characteristics": [found for name in UNITS if (found := _characteristic(name, attempts)) is not None],
    }


def chart_of(rows: Iterable[Row], name: str, most: int) -> dict[str, Any]:
    """`triaxcal.chart/1` of a characteristic, with the last ``most`` values as points.
    Raises KeyError for a name that is none of `UNITS`."""
    unit = UNITS[name]
    measured, values = _Attempts(rows).measured(name)
    found = individuals(values)
    low = None if found.low is None or (name in FIGURES and found.low < 0) else found.low
    limits = {
        "centre": found.centre, "low": low, "high": found.high, "mr_mean": found.mr_mean, "mr_high": found.mr_high,
        "limit": _limit(name, measured[-1]) if measured else None,
    }  # fmt: skip
    return {
        "format": "triaxcal.chart/1",
        "name": name,
        "unit": unit,
        "n": len(measured),
        "points": [_point(name, found, i, measured[i]) for i in range(max(0, len(measured) - most), len(measured))],
        **{key: tc.rounding.number(value) for key, value in limits.items()},
    }


def _serial(row: Row) -> str | None:
    found: str | None = row["serial"] if row["work_serial"] is None else row["work_serial"]
    return found


def _last(of_unit: Sequence[Row]) -> Row | None:
    """The last attempt that says something about the unit."""
    return next((row for row in reversed(of_unit) if row["verdict"] != Verdict.NOT_JUDGED), None)


def _limit(name: str, row: Row) -> float | None:
    column = FIGURES.get(name)
    return None if column is None else row[column]


def _characteristic(name: str, attempts: _Attempts) -> dict[str, Any] | None:
    """None where no unit has the figure."""
    measured, values = attempts.measured(name)
    if not measured:
        return None
    limits = [_limit(name, row) for row in measured]
    high, n = limits[-1], len(values)
    mean, sd = _mean(values), float((values - values[0]).std(ddof=1)) if n > 1 else None
    ppk = None if high is None or not sd or n < PPK_LEAST else (high - mean) / (3 * sd)
    return {
        "name": name,
        "unit": UNITS[name],
        "n": n,
        "mean": tc.rounding.number(mean),
        "sd": tc.rounding.number(sd),
        "low": None,
        "high": high,
        "limits_changed": len(set(limits)) > 1,
        "outside": None if high is None else int((values > high).sum()),
        "ppk": tc.rounding.number(ppk, 4),
        "ppk_interval": None if ppk is None else _rounded(one_sided_interval(ppk, n)),
    }


def _mean(values: Floats) -> float:
    """Exact for equal values: rounding of their sum would pass for a scatter."""
    return float(values[0] + (values - values[0]).mean())


def _share(passed: Sequence[bool]) -> float | None:
    return tc.rounding.number(sum(passed) / len(passed)) if passed else None


def _rounded(interval: tuple[float, float] | None) -> list[float | None] | None:
    return None if interval is None else [tc.rounding.number(end, 4) for end in interval]


# Intervals.


def share_interval(count: int, of: int, level: float = LEVEL) -> tuple[float, float] | None:
    """Of a probability, after ``count`` of ``of`` trials: Clopper and Pearson,
    Biometrika 26 (1934) 404. None without a trial."""
    if not of:
        return None
    tail = (1 - level) / 2
    low = float(special.betaincinv(count, of - count + 1, tail)) if count else 0.0
    high = float(special.betaincinv(count + 1, of - count, 1 - tail)) if count < of else 1.0
    return low, high


def one_sided_interval(ppk: float, n: int, level: float = LEVEL) -> tuple[float, float]:
    """Of the Ppk of a normal distribution with one limit, estimated as ``ppk`` from
    ``n`` values: 3 √n ``ppk`` has a noncentral t distribution with n − 1 degrees of
    freedom and the noncentrality 3 √n Ppk (Owen, Technometrics 10 (1968) 445)."""
    scale, tail = 3 * math.sqrt(n), (1 - level) / 2
    spread, probability = _chi_over_root_dof(n - 1)
    t = scale * ppk

    def reached(noncentrality: float) -> float:
        """Probability of an estimate up to this one."""
        return float(probability @ special.ndtr(t * spread - noncentrality))

    # By the variance of the estimate, ten times over.
    reach = 10 * math.sqrt(1 + t * t / (2 * (n - 1)))

    def end(wanted: float) -> float:
        return float(brentq(lambda d: reached(d) - wanted, t - reach, t + reach)) / scale

    return end(1 - tail), end(tail)


def _chi_over_root_dof(dof: int) -> tuple[Floats, Floats]:
    """Values of √(χ²/dof) and their probabilities, which add up to one: sums over them
    are integrals to ten digits from 10 degrees of freedom on."""
    width = 9 / math.sqrt(2 * dof)
    spread = np.linspace(max(1e-9, 1 - width), 1 + width, 1001)
    log = (dof - 1) * np.log(spread) - dof * (spread**2 - 1) / 2
    density = np.exp(log - log.max())
    return spread, density / density.sum()


# Control charts.


@dataclass(frozen=True)
class Individuals:
    """Control chart of single values. ``low`` … ``mr_high`` are None below two
    values; ``moving_ranges`` has one less than there are values."""

    values: Floats
    moving_ranges: Floats
    centre: float | None
    low: float | None
    high: float | None
    mr_mean: float | None
    mr_high: float | None
    outside: tuple[str | None, ...]
    """By value: `limits` or `run` for one that breaks a rule."""


def individuals(values: Sequence[float] | Floats) -> Individuals:
    """Limits from the mean moving range of all values, which drifts and steps widen
    little."""
    x = np.asarray(values, dtype=float)
    if len(x) < 2:
        centre = float(x[0]) if len(x) else None
        return Individuals(x, np.empty(0), centre, None, None, None, None, (None,) * len(x))
    ranges = np.abs(np.diff(x))
    centre, mean = _mean(x), float(ranges.mean())
    low, high = centre - INDIVIDUALS * mean, centre + INDIVIDUALS * mean
    beyond = (x < low) | (x > high)
    outside: list[str | None] = []
    side, row = 0, 0
    for value, far in zip(np.sign(x - centre).astype(int).tolist(), beyond.tolist(), strict=True):
        row = row + 1 if value == side else 1
        side = value
        outside.append("limits" if far else "run" if side and row >= RUN_OF else None)
    return Individuals(x, ranges, centre, low, high, mean, RANGES * mean, tuple(outside))


def _point(name: str, chart: Individuals, i: int, row: Row) -> dict[str, Any]:
    moved = float(chart.moving_ranges[i - 1]) if i else None
    return {
        "run": row["run"],
        "serial": _serial(row),
        "time": row["ended"],
        "value": row[name],
        "moving_range": tc.rounding.number(moved),
        "outside": chart.outside[i],
        "moving_range_outside": moved is not None and chart.mr_high is not None and moved > chart.mr_high,
        "limit": _limit(name, row),
    }
