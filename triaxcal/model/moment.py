"""Which moment of its recording a calibration holds for."""

from __future__ import annotations

from enum import StrEnum


class Moment(StrEnum):
    """By name; `SECONDS` where it is a number."""

    END = "end"
    MEAN = "mean"
    SECONDS = "seconds"
