"""Moments, and which frames of a log have one."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from itertools import chain

from triaxcal_drivers.logs.frames import Account, LoggedFrame, Remark

LONGEST_NS = 2**62
"""A hundred and forty-six years, since the epoch or between two times: what is
longer is damage."""
UNTIMED_MOST = 100_000
"""Frames without a time that are held back until one has a time, some tens of
MB."""

Placed = tuple[str, LoggedFrame | str]
"""A place in a log, and the frame there or what is wrong with it."""


def utc_ns(year: int, month: int, day: int, hour: int, minute: int, second: int) -> int | None:
    """Nanoseconds since the epoch; None where the calendar has no such moment,
    and for one before the epoch or beyond `LONGEST_NS`."""
    try:
        seconds = int(datetime(year, month, day, hour, minute, second, tzinfo=UTC).timestamp())
    except ValueError:
        return None
    return seconds * 1_000_000_000 if 0 <= seconds * 1_000_000_000 < LONGEST_NS else None


def timed(found: Iterator[Placed], account: Account) -> Iterator[LoggedFrame]:
    """The frames that have a time; one that has none is damage, wherever it
    stands. Only where no frame has a time (none of the first `UNTIMED_MOST`) it
    is a log without times: then all are given without, and that is remarked
    before the first."""
    first: list[Placed] = []
    for placed in found:
        first.append(placed)
        if _has_time(placed) or len(first) == UNTIMED_MOST:
            break
    without = any(isinstance(frame, LoggedFrame) for _, frame in first) and not any(map(_has_time, first[-1:]))
    if without:
        account.remarks.add(Remark.NO_TIMES)
    for where, frame in chain(first, found):
        if isinstance(frame, str):
            account.note(where, frame)
        elif without:
            yield frame._replace(time_ns=None)
        elif frame.time_ns is None:
            account.note(where, "a frame without a time, in a log that has times")
        else:
            yield frame


def _has_time(placed: Placed) -> bool:
    frame = placed[1]
    return isinstance(frame, LoggedFrame) and frame.time_ns is not None
