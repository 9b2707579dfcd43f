"""Times as text, against values of `date -u -d`."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

from triaxcald.utc import file_stamp, iso_time

NOON_S = 1_772_366_400


@pytest.fixture(params=["UTC", "Asia/Tokyo"])
def _zone(request: pytest.FixtureRequest) -> Iterator[None]:
    """Of the computer."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TZ", request.param)
        time.tzset()
        yield
    time.tzset()


@pytest.mark.usefixtures("_zone")
def test_times_are_in_utc_whatever_the_zone_of_the_computer() -> None:
    time_ns = NOON_S * 10**9 + 250_999_000
    assert iso_time(time_ns) == "2026-03-01T12:00:00.250+00:00"
    assert iso_time(time_ns, "seconds") == "2026-03-01T12:00:00+00:00"
    assert file_stamp(time_ns) == "20260301T120000Z"


def test_a_stamp_has_the_second_that_has_begun() -> None:
    assert file_stamp(NOON_S * 10**9) == "20260301T120000Z"
    assert file_stamp(NOON_S * 10**9 - 1) == "20260301T115959Z"
