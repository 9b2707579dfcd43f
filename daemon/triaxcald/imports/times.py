"""What is said of the times of a log, which stay as they are."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass

PAUSE_S = 1.0
PERIODS = 10
"""A pause is longer than this many periods, and than `PAUSE_S`."""


@dataclass
class Times:
    """Of records or samples, in their order."""

    period_ns: float
    first_ns: int | None = None
    latest_ns: int = 0
    back: int = 0  # those whose time is before that of one that came earlier
    furthest_back_ns: int = 0
    equal: int = 0  # those whose time is that of the one before
    pauses: int = 0
    longest_pause_ns: int = 0

    def note(self, time_ns: int) -> None:
        if self.first_ns is None:
            self.first_ns = self.latest_ns = time_ns
            return
        step_ns = time_ns - self.latest_ns
        if step_ns < 0:
            self.back += 1
            self.furthest_back_ns = max(self.furthest_back_ns, -step_ns)
            return
        if step_ns == 0:
            self.equal += 1
        elif self.is_pause(step_ns):
            self.pauses += 1
            self.longest_pause_ns = max(self.longest_pause_ns, step_ns)
        self.latest_ns = time_ns

    def is_pause(self, step_ns: int) -> bool:
        return step_ns > max(PERIODS * self.period_ns, PAUSE_S * 1e9)

    @property
    def seconds(self) -> float:
        """From the first to the latest."""
        return 0.0 if self.first_ns is None else (self.latest_ns - self.first_ns) / 1e9

    def document(self) -> dict[str, float | int]:
        return {
            "back": self.back,
            "furthest_back_s": self.furthest_back_ns / 1e9,
            "equal": self.equal,
            "pauses": self.pauses,
            "longest_pause_s": self.longest_pause_ns / 1e9,
        }


class Ticks:
    """Times for a log that tells none: a period later each time the message
    that leads comes again."""

    def __init__(self, period_ns: float) -> None:
        self._period_ns = period_ns
        self._lead: Hashable = None
        self._ticks = 0

    def of(self, key: Hashable, leads: bool) -> int:
        """``leads``: it may be the one, where it is the first of those."""
        if self._lead is None and leads:
            self._lead = key
        elif key == self._lead:
            self._ticks += 1
        return round(self._ticks * self._period_ns)
