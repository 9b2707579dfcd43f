"""How good a line is: yield, causes, the distribution of each figure against its limit,
and control charts. From rows to documents, without I/O.

A row has the columns of `triaxcal results` that `COLUMNS` names, ``at_us`` (start in µs
since 1970, else end) and ``tried`` (whether it was an attempt at the unit). Rows are in
the order of time.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy import special
from scipy.optimize import brentq

import triaxcal as tc
from triaxcald.schema.codes import Verdict
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
    "run", "serial", "work_serial", "ended", "verdict", "code",
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

Row = Mapping[str, Any]
Floats = NDArray[np.float64]


@dataclass
class _Unit:
    """A unit's attempts in the order of time."""

    rows: list[Row] = field(default_factory=list)

    def judged(self) -> Iterator[Row]:
        return (row for row in self.rows if row["verdict"] in (Verdict.PASS, Verdict.FAIL))

    def last(self) -> Row | None:
        """The last attempt that says something about the unit."""
        return next((row for row in reversed(self.rows) if row["verdict"] != Verdict.NOT_JUDGED), None)

    def last_with(self, name: str) -> Row | None:
        return next((row for row in reversed(self.rows) if row[name] is not None), None)


def quality_of(rows: Iterable[Row], first_judged_us: Mapping[str, int] | None = None) -> dict[str, Any]:
    """`triaxcal.quality/1` of these rows. ``first_judged_us`` has the time of the first
    judged attempt at a unit, by plain serial number, also where that is not among the
    rows."""
    attempts = _attempts(rows)
    units = _units(attempts)
    counted = {serial: unit for serial, unit in units.items() if unit.last() is not None}
    passed = sum(unit.last()["verdict"] == Verdict.PASS for unit in counted.values())  # type: ignore[index]
    before = first_judged_us or {}
    first = [next(unit.judged(), None) for serial, unit in counted.items() if not _judged_before(unit, serial, before)]
    passed_first = sum(row is not None and row["verdict"] == Verdict.PASS for row in first)
    codes = Counter(row["code"] for row in attempts if row["code"] is not None)
    return {
        "format": "triaxcal.quality/1",
        "units": len(units),
        "first_pass_yield": _share(passed_first, len(first)),
        "first_pass_yield_interval": _rounded(share_interval(passed_first, len(first))),
        "first_pass_units": len(first),
        "yield": _share(passed, len(counted)),
        "yield_interval": _rounded(share_interval(passed, len(counted))),
        "yield_units": len(counted),
        "attempts": len(attempts),
        "codes": dict(sorted(codes.items(), key=lambda item: (-item[1], item[0]))),
        "characteristics": [found for name in UNITS if (found := _characteristic(name, units)) is not None],
    }


def chart_of(rows: Iterable[Row], name: str, most: int) -> dict[str, Any]:
    """`triaxcal.chart/1` of a characteristic, with the last ``most`` values as points.
    Raises KeyError for a name that is none of `UNITS`."""
    unit = UNITS[name]
    measured = _measured(name, _units(_attempts(rows)))
    found = individuals([float(row[name]) for row in measured])
    low = None if found.low is None or (name in FIGURES and found.low < 0) else found.low
    start = max(0, len(measured) - most)
    return {
        "format": "triaxcal.chart/1",
        "name": name,
        "unit": unit,
        "n": len(measured),
        "points": [_point(name, found, i, measured[i]) for i in range(start, len(measured))],
        **{
            key: tc.rounding.number(value)
            for key, value in (
                ("centre", found.centre), ("low", low), ("high", found.high), ("mr_mean", found.mr_mean),
                ("mr_high", found.mr_high), ("limit", _limit(name, measured[-1]) if measured else None),
            )
        },
    }  # fmt: skip


def _attempts(rows: Iterable[Row]) -> list[Row]:
    """Each once: the folder may hold a copy of an outcome."""
    seen: set[str] = set()
    found = []
    for row in rows:
        if row["tried"] and row["run"] not in seen:
            found.append(row)
            if row["run"] is not None:
                seen.add(row["run"])
    return found


def _units(attempts: Iterable[Row]) -> dict[str, _Unit]:
    """By plain serial number: that of the work, else the one that the unit reported.
    Without either, nobody knows the unit."""
    found: dict[str, _Unit] = {}
    for row in attempts:
        serial = row["serial"] if row["work_serial"] is None else row["work_serial"]
        if serial is not None:
            found.setdefault(plain_serial(serial), _Unit()).rows.append(row)
    return found


def _judged_before(unit: _Unit, serial: str, first_judged_us: Mapping[str, int]) -> bool:
    here = next(unit.judged(), unit.rows[0])
    return bool(first_judged_us.get(serial, here["at_us"]) < here["at_us"])


def _measured(name: str, units: Mapping[str, _Unit]) -> list[Row]:
    """The attempt that gives each unit's value, in the order of their ends."""
    found = [row for unit in units.values() if (row := unit.last_with(name)) is not None]
    return sorted(found, key=lambda row: (row["ended"], row["run"] or ""))


def _limit(name: str, row: Row) -> float | None:
    column = FIGURES.get(name)
    return None if column is None else row[column]


def _characteristic(name: str, units: Mapping[str, _Unit]) -> dict[str, Any] | None:
    """None where no unit has the figure."""
    measured = _measured(name, units)
    if not measured:
        return None
    values = np.array([row[name] for row in measured], dtype=float)
    limits = [_limit(name, row) for row in measured]
    high, n = limits[-1], len(values)
    mean, sd = float(values.mean()), float(values.std(ddof=1)) if n > 1 else None
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


def _share(count: int, of: int) -> float | None:
    return tc.rounding.number(count / of) if of else None


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


def individuals(values: Sequence[float]) -> Individuals:
    """Limits from the mean moving range of all values, which drifts and steps widen
    little."""
    x = np.asarray(values, dtype=float)
    if len(x) < 2:
        centre = float(x[0]) if len(x) else None
        return Individuals(x, np.empty(0), centre, None, None, None, None, (None,) * len(x))
    ranges = np.abs(np.diff(x))
    centre, mean = float(x.mean()), float(ranges.mean())
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
        "serial": row["serial"] if row["work_serial"] is None else row["work_serial"],
        "time": row["ended"],
        "value": row[name],
        "moving_range": tc.rounding.number(moved),
        "outside": chart.outside[i],
        "moving_range_outside": moved is not None and chart.mr_high is not None and moved > chart.mr_high,
        "limit": _limit(name, row),
    }
