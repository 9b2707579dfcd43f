"""Names of array types, and what is done to arrays in several rooms."""

from __future__ import annotations

from collections.abc import Sequence
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


GROWN = 2**15
"""Rows by which `Columns` grow: a megabyte or less each."""


class Columns:
    """Arrays of equally many rows that grow at their end, in place where nobody holds
    them: a long stream's summaries are never there twice."""

    def __init__(self) -> None:
        self._held: list[NDArray[Any]] = []
        self._rows = 0

    def __len__(self) -> int:
        return self._rows

    def add(self, rows: Sequence[NDArray[Any]]) -> None:
        """The next rows of each array. A type that does not hold them gives way to one
        that does."""
        until = self._rows + len(rows[0])
        self._held = self._held or [np.zeros((0, *new.shape[1:]), new.dtype) for new in rows]
        for place, new in enumerate(rows):
            held = self._held.pop(place)
            if not np.can_cast(new.dtype, held.dtype):
                held = held.astype(np.promote_types(held.dtype, new.dtype))
            held = _grown(held, until)
            held[self._rows : until] = new
            self._held.insert(place, held)
            del held
        self._rows = until

    def arrays(self) -> tuple[NDArray[Any], ...]:
        """Rows that are added later are in none of them."""
        return tuple(held[: self._rows] for held in self._held)


def _grown(held: NDArray[Any], rows: int) -> NDArray[Any]:
    if rows <= len(held):
        return held
    shape = (-(-rows // GROWN) * GROWN, *held.shape[1:])
    try:
        held.resize(shape)
    except ValueError:  # somebody holds a part of it
        larger = np.zeros(shape, held.dtype)
        larger[: len(held)] = held
        return larger
    return held
