"""Remarks that put all the rest in doubt, by what they are known by."""

from __future__ import annotations

from collections.abc import Iterable

TIME_UNIT = "time_unit: "
SAME_UNIT, ANOTHER_UNIT = "the same unit?", "is it another unit"


def doubts_of(data_quality: Iterable[str], warnings: Iterable[str]) -> list[str]:
    """What to ask, each once."""
    times = any(TIME_UNIT in line for line in data_quality)
    unit = any(mark in line for line in warnings for mark in (SAME_UNIT, ANOTHER_UNIT))
    return ["are the times in seconds?"] * times + ["is it the same unit?"] * unit
