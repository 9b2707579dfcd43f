"""Remarks that put all the rest in doubt, by their names in documents."""

from __future__ import annotations

from collections.abc import Iterable

TIME_UNIT = "time_unit: "
"""How a line of ``data_quality`` begins."""
UNIT = "unit"
"""Under ``doubts``: recordings, or a calibration and a recording, may not be of one unit."""


def doubts_of(data_quality: Iterable[str], doubts: Iterable[str]) -> list[str]:
    """What to ask, each once."""
    times = any(TIME_UNIT in line for line in data_quality)
    return ["are the times in seconds?"] * times + ["is it the same unit?"] * (UNIT in doubts)
