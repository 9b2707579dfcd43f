"""The calendar: the one place where the date of today enters."""

from __future__ import annotations

import time

DAY_S = 86_400


def days_since_1970(now_s: float | None = None) -> int:
    """Whole days since 1970-01-01 UTC, as `calibration_date` counts them."""
    return int((time.time() if now_s is None else now_s) // DAY_S)
