"""Names of array types, and what is done to arrays in several rooms."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

READING_MOST = 1e100
"""Squares of readings, and sums of them, have to be numbers too."""

Numbers = TypeVar("Numbers", Floats, Ints)


def rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


def evenly_spread(values: Numbers, most: int) -> Numbers:
    """All values, or ``most`` of them, the first and the last among these."""
    return values if len(values) <= most else values[np.linspace(0, len(values) - 1, most).astype(np.int64)]


def joined(parts: list[tuple[Any, ...]]) -> tuple[Any, ...]:
    """The arrays of all parts, place by place one after the other. ``parts`` is
    emptied, and what is joined is given up at once: a long stream's summaries
    are never there twice."""
    columns = [list(column) for column in zip(*parts, strict=True)]
    parts.clear()
    found = []
    while columns:
        found.append(np.concatenate(columns.pop(0)))
    return tuple(found)
