"""Which segments go, and in which order."""

from __future__ import annotations

import dataclasses

import pytest

from triaxcald.recording.manifest import Retention, Segment, surplus

DAY_S = 86_400
NOW_NS = 100 * DAY_S * 10**9


def segment(number: int, ended_days_ago: float, mib: int = 10) -> Segment:
    end_ns = NOW_NS - round(ended_days_ago * DAY_S * 1e9)
    return Segment(f"rec-{number}.mcap", number, 0, "closed", start_ns=0, end_ns=end_ns, bytes=mib * 2**20)


def age_ns(segment: Segment) -> int | None:
    return None if segment.end_ns is None else NOW_NS - segment.end_ns


FIVE = [segment(i, 10 - i) for i in range(1, 6)]  # 9, 8, 7, 6 and 5 days old


@pytest.mark.parametrize(("keep_days", "gone"), [(None, []), (9.5, []), (7.5, [1, 2]), (0, [1, 2, 3, 4, 5])])
def test_what_is_older_than_the_time_it_is_kept_goes(keep_days: float | None, gone: list[int]) -> None:
    keep = Retention(keep_s=None if keep_days is None else keep_days * DAY_S)
    found = surplus(FIVE, keep, age_ns=age_ns, free_bytes=0, kept=())
    assert [(s.segment.number, s.reason) for s in found] == [(n, "age") for n in gone]


@pytest.mark.parametrize(("free_mib", "gone"), [(100, []), (99, [1]), (90, [1]), (89, [1, 2]), (0, [1, 2, 3, 4, 5])])
def test_the_oldest_go_until_enough_is_free(free_mib: int, gone: list[int]) -> None:
    keep = Retention(free_bytes=100 * 2**20)
    found = surplus(FIVE, keep, age_ns=age_ns, free_bytes=free_mib * 2**20, kept=())
    assert [(s.segment.number, s.reason) for s in found] == [(n, "disk") for n in gone]


def test_what_goes_for_its_age_makes_room_too() -> None:
    keep = Retention(keep_s=8.5 * DAY_S, free_bytes=100 * 2**20)
    found = surplus(FIVE, keep, age_ns=age_ns, free_bytes=85 * 2**20, kept=())
    assert [(s.segment.number, s.reason) for s in found] == [(1, "age"), (2, "disk")]


def test_what_is_kept_and_what_is_being_written_stay_whatever_the_disk_has() -> None:
    open_one = dataclasses.replace(FIVE[4], state="open")
    keep = Retention(keep_s=1.0, free_bytes=2**60)
    found = surplus([*FIVE[:4], open_one], keep, age_ns=age_ns, free_bytes=0, kept={"rec-1.mcap", "rec-3.mcap"})
    assert [s.segment.number for s in found] == [2, 4]


def test_a_disk_that_does_not_say_what_is_free_takes_nothing_away() -> None:
    assert surplus(FIVE, Retention(free_bytes=2**60), age_ns=age_ns, free_bytes=None, kept=()) == []
