"""Rate and remaining time, on a clock of our own."""

from __future__ import annotations

import pytest

from triaxcald.many import Pace
from triaxcald.many.progress import WINDOW, left


def test_rate_and_remaining_time_are_of_this_run_alone() -> None:
    pace = Pace(100, 10.0)
    pace.skip(40)
    assert pace.line("auditing") == "auditing: 40 of 100"
    for i in range(20):
        pace.another(10.0 + (i + 1) * 0.5)
    assert (pace.done, pace.share) == (60, 0.6)
    assert pace.rate_hz == pytest.approx(2.0)
    assert pace.line("auditing") == "auditing: 60 of 100, 2 a second, 20 s left"


def test_the_rate_follows_workers_that_come() -> None:
    pace = Pace(10_000, 0.0)
    for i in range(100):
        pace.another(float(i + 1))
    for i in range(WINDOW):
        pace.another(100.0 + (i + 1) / 10)
    assert pace.rate_hz == pytest.approx(10.0)


@pytest.mark.parametrize(
    ("seconds", "said"),
    [(0, "0 s"), (89, "89 s"), (120, "2 min"), (3600 * 1.6, "1 h 36 min"), (86400 * 4.25, "4 d 6 h")],
)
def test_remaining_time_in_words(seconds: float, said: str) -> None:
    assert left(seconds) == said
