"""The table: one row for each unit and figure."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np

import triaxcal as tc
from triaxcald.fleet.values import Fleet

COLUMNS: Final[Mapping[str, type]] = {
    "part_number": str, "serial": str, "figure": str, "unit": str, "value": float, "standard_error": float, "runs": int,
    "deviation": float, "outlier": int, "signal": str, "batch": str, "station": str, "fixture": str, "slot": str,
    "operator": str, "order": str, "run": str, "ended": str,
}  # fmt: skip
"""Of the unit's last run with the figure. ``runs`` have it; ``deviation`` is from the
median in robust standard deviations; ``signal`` names the charts in which the unit is
one: `limits`, `run`, `ewma`, `cusum`."""


def table_rows(fleets: Sequence[Fleet]) -> Iterator[list[Any]]:
    for fleet in fleets:
        for figure in fleet.figures.values():
            yield from _of_figure(fleet, figure.name)


def _of_figure(fleet: Fleet, name: str) -> Iterator[list[Any]]:
    figure = fleet.figures[name]
    last = fleet.last(figure.values)
    if not len(last):
        return
    values = figure.values[last]
    of = tc.population.distribution(values)
    signals, far = _signals(values), set(of.outliers)
    known = np.isfinite(figure.values) & (fleet.unit >= 0)
    count = np.bincount(fleet.unit[known], minlength=len(fleet.serials))
    for i, at in enumerate(last.tolist()):
        row = fleet.rows[at]
        value, error = float(values[i]), float(figure.errors[at])
        yield [
            fleet.part_number, fleet.serials[fleet.unit[at]], name, figure.unit, tc.rounding.number(value),
            tc.rounding.uncertainty(error), int(count[fleet.unit[at]]),
            tc.rounding.number((value - of.median) / of.robust_sd, 4) if of.robust_sd else None, int(i in far),
            " ".join(signals.get(i, ())) or None,
            *(row[column] for column in ("batch", "station", "fixture", "slot", "operator", "order", "run", "ended")),
        ]  # fmt: skip


def _signals(values: tc.Floats) -> dict[int, list[str]]:
    found: dict[int, list[str]] = {}
    of = tc.population.individuals(values)
    for i, why in enumerate(of.outside):
        if why is not None:
            found.setdefault(i, []).append(why)
    if of.sd and of.centre is not None:
        charts = {
            "ewma": tc.population.ewma(values, of.centre, of.sd).signals,
            "cusum": tc.population.cusum(values, of.centre, of.sd, restart=True).signals,
        }
        for name, signals in charts.items():
            for i in signals:
                found.setdefault(i, []).append(name)
    return found
