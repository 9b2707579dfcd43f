"""Which columns of a table are channels: quantities logged beside the outputs,
such as a temperature."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from triaxcald.tables.arrow import Column
from triaxcald.tables.grid import Grid
from triaxcald.tables.naming import OUTPUTS, Name, Roles
from triaxcald.tables.timing import Timing

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
