"""What is counted of a log's times."""

from triaxcald.imports.importing import Ticks, Times

MS = 1_000_000


def test_steps_back_and_pauses_are_counted_and_the_largest_kept() -> None:
    times = Times(period_ns=10 * MS)
    for time_ms in (1000, 1010, 1005, 1020, 900, 1030, 3000, 3010, 10_000):
        times.note(time_ms * MS)
    assert times.document() == {
        "back": 2, "furthest_back_s": 0.12, "equal": 0, "pauses": 2, "longest_pause_s": 6.99
    }  # fmt: skip
    assert times.seconds == 9.0


def test_equal_times_are_counted() -> None:
    times = Times(period_ns=10 * MS)
    for time_ms in (0, 10, 10, 10, 20, 20):
        times.note(time_ms * MS)
    assert times.document()["equal"] == 3


def test_a_slow_stream_pauses_after_ten_periods() -> None:
    times = Times(period_ns=1000 * MS)
    for time_s in (0, 9, 20):
        times.note(time_s * 1000 * MS)
    assert times.document()["pauses"] == 1


def test_ticks_go_on_with_the_first_message_that_may_lead() -> None:
    ticks = Ticks(period_ns=10 * MS)
    assert [ticks.of(key, key in "ab") for key in "cabcaacb"] == [n * MS for n in (0, 0, 0, 0, 10, 20, 20, 20)]
