"""Units, figures and factors from rows of runs: one `Fleet` for each part number, as
units of several products have nothing in common."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import triaxcal as tc
from triaxcald.fleet.reading import Certified, Row, Runs
from triaxcald.schema.codes import Verdict
from triaxcald.service.golden import is_check
from triaxcald.service.quality import COEFFICIENTS, FIGURES, UNITS
from triaxcald.work import plain_serial

UNCERTAINTIES: Final = {
    "uncertainty_this_fit_g": "this_fit",
    "uncertainty_another_day_g": "another_day",
}
"""Expanded uncertainties of |a|, and their keys in `expanded_uncertainty_g`."""
FACTORS: Final = ("batch", "station", "fixture", "slot", "operator", "order")
TIME: Final = "time"
FAILED: Final = (Verdict.FAIL, Verdict.ABORTED)
"""Verdicts of runs that say nothing of how a measurement repeats: what failed may have
been a part of it."""
EFFECT_LEAST: Final = 5
"""Units in which an effect is corrected, from which its coefficients are figures."""
DAY_US: Final = 86_400_000_000
PERIODS: Final = ((730, "%Y"), (60, "%Y-%m"), (2, "%Y-%m-%d"), (0, "%Y-%m-%d %H h"))
"""Span of the runs in days from which they are grouped by such a period of their
start, UTC: by year, month, day or hour."""


@dataclass(frozen=True)
class Figure:
    """``values`` and ``errors`` (n,) of each run, NaN for a gap; ``unit`` of both."""

    name: str
    unit: str
    values: tc.Floats
    errors: tc.Floats


@dataclass(frozen=True)
class Fleet:
    """Runs (n,) of units of one part number, in the order of time. ``unit`` (n,)
    numbers the units of ``serials``, −1 where nobody knows the unit. ``days`` (n,) are
    times since the first run. ``factors`` have the place of each run, None where it is
    not known. ``effects`` has the probability (n,) of each effect, NaN without a
    certificate; 1 of a finding whose probability is not calibrated."""

    part_number: str | None
    rows: Sequence[Row]
    certified: Sequence[Certified | None]
    unit: tc.Ints
    serials: Sequence[str]
    days: tc.Floats
    figures: Mapping[str, Figure]
    factors: Mapping[str, Sequence[str | None]]
    effects: Mapping[str, tc.Floats]

    def last(self, values: tc.Floats) -> tc.Ints:
        """Index of the last run with a value of each unit, by the end of the runs; an
        aborted run stands for a unit only where no other does."""
        having = np.isfinite(values) & (self.unit >= 0)
        aborted = self.with_verdict(Verdict.ABORTED)
        judged, other = self._last(having & ~aborted), self._last(having & aborted)
        found = np.where(judged >= 0, judged, other)
        return np.sort(found[found >= 0])

    def _last(self, having: NDArray[np.bool_]) -> tc.Ints:
        found = np.full(len(self.serials), -1, dtype=np.int64)
        rows = np.flatnonzero(having)
        np.maximum.at(found, self.unit[rows], rows)
        return found

    def with_verdict(self, *verdicts: str) -> NDArray[np.bool_]:
        """(n,) runs that ended with one of these."""
        return np.array([row["verdict"] in verdicts for row in self.rows], dtype=bool)

    def groups(self, factor: str) -> tuple[tc.Ints, list[str]]:
        """Number (n,) of the group of each run, −1 without one, and the names of the
        groups, in their order."""
        labels = self.factors[factor]
        names = sorted({label for label in labels if label is not None})
        number = {name: i for i, name in enumerate(names)}
        return np.array([-1 if label is None else number[label] for label in labels], dtype=np.int64), names

    def limit(self, figure: str) -> float | None:
        """Of the last run that has one."""
        column = FIGURES.get(figure)
        return None if column is None else next((r[column] for r in reversed(self.rows) if r[column] is not None), None)


def fleets_of(runs: Runs) -> list[Fleet]:
    """By part number, that with most runs first. An attempt that measured nothing, the
    check of a golden unit, and the copy of an outcome are none of their runs."""
    by_part: dict[str | None, list[Row]] = {}
    seen: set[str] = set()
    for row in runs.rows:
        measured = any(row[name] is not None for name in (*FIGURES, *COEFFICIENTS))
        if not row["tried"] or not measured or is_check(row) or row["run"] in seen:
            continue
        if row["run"] is not None:
            seen.add(row["run"])
        by_part.setdefault(row["part_number"], []).append(row)
    order = sorted(by_part, key=lambda part: (-len(by_part[part]), part or ""))
    return [_fleet(part, by_part[part], runs.certified) for part in order]


def _fleet(part_number: str | None, rows: list[Row], certified: Mapping[str, Certified]) -> Fleet:
    rows = sorted(rows, key=lambda row: (row["ended_us"], row["run"] or ""))
    papers = [certified.get(row["outcome"]) for row in rows]
    serials: list[str] = []
    number: dict[str, int] = {}
    unit = []
    for row in rows:
        told = row["serial"] if row["work_serial"] is None else row["work_serial"]
        if told is None:
            unit.append(-1)
            continue
        plain = plain_serial(told)
        if plain not in number:
            number[plain] = len(serials)
            serials.append(told)
        unit.append(number[plain])
    units = np.array(unit, dtype=np.int64)
    ended = np.array([row["ended_us"] for row in rows], dtype=np.int64)
    days = (ended - ended[0]) / DAY_US
    figures = {figure.name: figure for figure in (*_columns(rows), *_of_certificates(papers, units))}
    return Fleet(
        part_number, rows, papers, units, serials, days, figures, _factors(rows, float(days[-1])),
        _effects(papers),
    )  # fmt: skip


def _columns(rows: Sequence[Row]) -> list[Figure]:
    found = []
    for name, unit in UNITS.items():
        values = _array(row[name] for row in rows)
        error = f"{name}_standard_error"
        errors = _array(row[error] for row in rows) if name in COEFFICIENTS else np.full(len(rows), np.nan)
        if np.isfinite(values).any():
            found.append(Figure(name, unit, values, errors))
    return found


def _of_certificates(papers: Sequence[Certified | None], unit: tc.Ints) -> list[Figure]:
    gap = np.full(len(papers), np.nan)
    found = []
    for name, key in UNCERTAINTIES.items():
        values = _array(None if paper is None else paper.uncertainty.get(key) for paper in papers)
        if np.isfinite(values).any():
            found.append(Figure(name, "g", values, gap))
    units: Counter[tuple[str, str, str]] = Counter()
    for paper in papers:
        for effect, seen in paper.effects.items() if paper else ():
            units.update((effect, name, of[2]) for name, of in seen.coefficients.items())
    for (effect, name, of_unit), count in sorted(units.items()):
        if count < EFFECT_LEAST:
            continue
        both = [_coefficient(paper, effect, name) for paper in papers]
        figure = Figure(
            f"{effect}.{name}", of_unit, _array(value for value, _ in both), _array(error for _, error in both)
        )
        if len(np.unique(unit[np.isfinite(figure.values)])) >= EFFECT_LEAST:
            found.append(figure)
    return found


def _coefficient(paper: Certified | None, effect: str, name: str) -> tuple[float | None, float | None]:
    seen = None if paper is None else paper.effects.get(effect)
    return (None, None) if seen is None else seen.coefficients.get(name, (None, None, ""))[:2]


def _effects(papers: Sequence[Certified | None]) -> dict[str, tc.Floats]:
    names = sorted({effect for paper in papers if paper for effect in paper.effects})
    found = {}
    for name in names:
        seen = [None if paper is None else paper.effects.get(name) for paper in papers]
        found[name] = np.array([
            np.nan if paper is None else 0.0 if of is None else 1.0 if of.probability is None else of.probability
            for paper, of in zip(papers, seen, strict=True)
        ])  # fmt: skip
    return found


def _factors(rows: Sequence[Row], span_days: float) -> dict[str, list[str | None]]:
    """Those with two places or more, and the time."""
    found: dict[str, list[str | None]] = {name: [row[name] for row in rows] for name in FACTORS}
    # A slot is that of a station: its name may be the same at each.
    several = len({row["station"] for row in rows}) > 1
    if several:
        found["slot"] = [None if row["slot"] is None else f"{row['station']}/{row['slot']}" for row in rows]
    period = next(form for least, form in PERIODS if span_days >= least)
    found[TIME] = [datetime.fromtimestamp(row["at_us"] / 1e6, UTC).strftime(period) for row in rows]
    return {name: labels for name, labels in found.items() if len({label for label in labels if label}) > 1}


def _array(values: Any) -> tc.Floats:
    return np.array([np.nan if value is None else value for value in values], dtype=float)
