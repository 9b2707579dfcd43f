"""How far work at many recordings has come. No clock: times are arguments."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

WINDOW = 256
"""Completions by which the rate is told: it follows workers that come and go."""


@dataclass
class Pace:
    """``total`` recordings, of which ``done`` are through; ``began_s`` by the clock of
    the other times."""

    total: int
    began_s: float
    done: int = 0
    _times_s: deque[float] = field(default_factory=lambda: deque(maxlen=WINDOW))

    def skip(self, count: int) -> None:
        """These were through before; they tell nothing of the rate."""
        self.done += count

    def another(self, now_s: float) -> None:
        self.done += 1
        self._times_s.append(now_s)

    @property
    def share(self) -> float:
        return self.done / self.total if self.total else 1.0

    @property
    def rate_hz(self) -> float | None:
        """Recordings a second; None before the first."""
        if not self._times_s:
            return None
        full = len(self._times_s) == WINDOW
        since_s = self._times_s[0] if full else self.began_s
        count = len(self._times_s) - full
        elapsed_s = self._times_s[-1] - since_s
        return count / elapsed_s if elapsed_s > 0 else None

    def line(self, what: str) -> str:
        """ "auditing: 120 of 2000, 3.2 a second, 9 min left"."""
        rate = self.rate_hz
        if rate is None:
            return f"{what}: {self.done} of {self.total}"
        often = f"{rate:.2g} a second" if rate >= 1 else f"{rate * 60:.2g} a minute"
        return f"{what}: {self.done} of {self.total}, {often}, {left((self.total - self.done) / rate)} left"


def left(seconds: float) -> str:
    """ "40 s", "9 min", "3 h 20 min", "4 d 3 h"."""
    minutes = round(seconds / 60)
    if seconds < 90:
        return f"{seconds:.0f} s"
    if minutes < 90:
        return f"{minutes} min"
    hours = round(seconds / 3600)
    if hours < 48:
        return f"{minutes // 60} h {minutes % 60} min"
    return f"{hours // 24} d {hours % 24} h"
