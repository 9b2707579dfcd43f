"""Remarks that put all the rest in doubt, by their names in documents."""

from __future__ import annotations

from collections.abc import Iterable

UNIT = "unit"
"""Under ``doubts``: recordings, or a calibration and a recording, may not be of
one unit."""


def doubts_of(doubts: Iterable[str]) -> list[str]:
    """What to ask, each once."""
    return ["is it the same unit?"] * (UNIT in doubts)
