"""How good a line is: yield, causes, the distribution of each figure against its limit,
and control charts. From rows to documents, without I/O.

A row has the columns of `triaxcal results` that `COLUMNS` names, ``at_us`` (start in µs
since 1970, else end) and ``tried`` (whether it was an attempt at the unit). Rows are in
the order of time.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

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
        "first_pass_yield_interval": _rounded(tc.population.share_interval(sum(passed_first), len(passed_first))),
        "first_pass_units": len(passed_first),
        "yield": _share(passed),
        "yield_interval": _rounded(tc.population.share_interval(sum(passed), len(passed))),
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
    found = tc.population.individuals(values)
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
    mean = tc.population.mean_of(values)
    sd = float((values - values[0]).std(ddof=1)) if n > 1 else None
    ppk = tc.population.ppk_of(values, None, high)
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
        "ppk_interval": None if ppk is None else _rounded(tc.population.one_sided_interval(ppk, n)),
    }


def _share(passed: Sequence[bool]) -> float | None:
    return tc.rounding.number(sum(passed) / len(passed)) if passed else None


def _rounded(interval: tuple[float, float] | None) -> list[float | None] | None:
    return None if interval is None else [tc.rounding.number(end, 4) for end in interval]


def _point(name: str, chart: tc.population.Individuals, i: int, row: Row) -> dict[str, Any]:
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
