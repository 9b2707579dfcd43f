"""What a reader of a log gives: frames, which of them have a moment, and an
account of what was in the log besides; the lines of a log that is text, and the
dates in them."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from enum import StrEnum, auto
from itertools import chain
from typing import BinaryIO, NamedTuple

from triaxcal_drivers.interface import RawFlag

EXTENDED, REMOTE, ERROR, FD, SWITCHED, SENT = (
    int(flag)
    for flag in (
        RawFlag.EXTENDED_ID,
        RawFlag.REMOTE,
        RawFlag.ERROR,
        RawFlag.FD,
        RawFlag.BIT_RATE_SWITCH,
        RawFlag.SENT,
    )
)
"""Whole numbers: a reader joins them for every frame."""
STANDARD_MOST, EXTENDED_MOST = 0x7FF, 0x1FFFFFFF
CLASSIC_MOST, FD_MOST = 8, 64  # bytes of a frame
OTHERS_MOST = 64  # kinds of records that are counted apart; ours have a handful
FD_LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
"""Bytes by the data length code (ISO 11898-1)."""


class LoggedFrame(NamedTuple):
    """A frame as a log has it. ``time_ns`` is since the epoch, or since the
    log's own start where it has no date; None where the log tells no times.
    ``source``, ``flags`` and ``data`` are as in `Frame`; ``channel`` is what
    the log calls the bus."""

    time_ns: int | None
    source: int
    flags: int
    data: bytes
    channel: str


class Remark(StrEnum):
    """What a reader of the recording ought to know."""

    NO_TIMES = auto()
    NO_DATE = auto()  # times count from the log's own start
    DATE_WITHOUT_ZONE = auto()  # taken for UTC
    TIMES_ADDED_UP = auto()  # each is since the line before


@dataclass
class Account:
    """What was met besides frames. ``damaged`` counts places that hold no
    record of the kind, ``damage`` says where the first is and what was
    expected; ``others`` counts records of which no frame is made, by their
    kind."""

    damaged: int = 0
    damage: str = ""
    others: Counter[str] = field(default_factory=Counter)
    remarks: set[Remark] = field(default_factory=set)

    def other(self, what: str, count: int = 1) -> None:
        """A record of which no frame is made."""
        self.others[what if what in self.others or len(self.others) < OTHERS_MOST else "further kinds"] += count

    def note(self, where: str, what: str) -> None:
        """A damaged place."""
        self.damaged += 1
        self.damage = self.damage or f"{where}: {what}"


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


BLOCK = 2**16  # bytes that are read at once
LINE_MOST = 4096  # bytes; a CAN FD frame of Vector's has some 400
BYTE_ORDER_MARK = b"\xef\xbb\xbf"  # of UTF-8, which editors of Windows put before the first line

_MONTHS = {
    name: number
    for names in (
        "jan feb mar apr may jun jul aug sep oct nov dec",
        "jan feb mär apr mai jun jul aug sep okt nov dez",
    )
    for number, name in enumerate(names.split(), 1)
}
_DATE = re.compile(
    r"(?:\w+\.?\s+)?(\w{3})\w*\.?\s+(\d{1,2})\s+(\d{1,2}):(\d\d):(\d\d)(?:\.(\d{1,9}))?\s*(am|pm)?\s+(\d{4})", re.I
)


def numbered(stream: BinaryIO, account: Account) -> Iterator[tuple[int, bytes]]:
    """Each line that is not empty with its number from 1, without blanks at its
    ends and a byte order mark. One that is too long is damage, and a last one
    without its end: nobody can tell what is missing from it."""
    number, rest, overlong = 0, b"", False
    while block := stream.read(BLOCK):
        lines = (rest + block).split(b"\n")
        rest = lines.pop()
        for line in lines:
            number += 1
            if number == 1:
                line = line.removeprefix(BYTE_ORDER_MARK)
            if overlong or len(line) > LINE_MOST:
                account.note(f"line {number}", f"more than {LINE_MOST} bytes")
                overlong = False
            elif bare := line.strip():
                yield number, bare
        if len(rest) > LINE_MOST:
            rest, overlong = b"", True
    if rest or overlong:
        account.note(f"line {number + 1}", "the file ends in the line")


def whole(text: str | bytes, base: int = 10) -> int:
    """Of digits alone: int() also takes signs, blanks, ``0x`` and underlines.
    Raises ValueError."""
    if not text.isalnum() or not text.isascii() or text[1:2] in ("x", "X", b"x", b"X"):
        raise ValueError("no whole number")
    return int(text, base)


def nanoseconds(seconds: bytes, fraction: bytes) -> int:
    """Of a decimal number's two parts."""
    return int(seconds) * 1_000_000_000 + int(fraction[:9].ljust(9, b"0") or 0)


def date_ns(text: str) -> int | None:
    """Nanoseconds since the epoch of "Wed Nov 25 04:38:43.125 pm 2026", taken
    for UTC; None where it is no such date."""
    match = _DATE.search(text)
    month = _MONTHS.get(match[1].lower()) if match else None
    if match is None or month is None:
        return None
    hour = int(match[3])
    if match[7]:
        hour = hour % 12 + (12 if match[7].lower() == "pm" else 0)
    time_ns = utc_ns(int(match[8]), month, int(match[2]), hour, int(match[4]), int(match[5]))
    return None if time_ns is None else time_ns + int((match[6] or "0").ljust(9, "0"))
