"""Results of the log readers: frames, and an account of the other contents of a log.
Also the lines of text logs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import StrEnum, auto
from itertools import chain
from typing import BinaryIO, NamedTuple

from triaxcal_drivers.hints import clipped
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
"""Integers, as a reader combines flags for every frame."""
STANDARD_MOST, EXTENDED_MOST = 0x7FF, 0x1FFFFFFF
CLASSIC_MOST, FD_MOST = 8, 64  # bytes of a frame
OTHERS_MOST = 64  # kinds of other records that are counted separately; usual logs have a handful
FD_LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
"""Number of bytes by the data length code (ISO 11898-1)."""


class LoggedFrame(NamedTuple):
    """A frame of a log. ``time_ns`` counts from the epoch, or from the start of a log
    without a date; None in a log without times. ``source``, ``flags`` and ``data``
    are as in `Frame`. ``channel`` is the log's name of the bus."""

    time_ns: int | None
    source: int
    flags: int
    data: bytes
    channel: str


class Remark(StrEnum):
    """A property of the log that a user of the recording should know."""

    NO_TIMES = auto()
    NO_DATE = auto()  # times count from the start of the log
    DATE_NOT_UNDERSTOOD = auto()  # `Account.unread_date` has it
    DATE_WITHOUT_ZONE = auto()  # interpreted as UTC
    TIMES_ADDED_UP = auto()  # each counts from the previous line


@dataclass
class Account:
    """Contents of a log other than frames. ``damaged`` counts places without a valid
    record; ``damage`` tells the first of them and the expected record. ``others``
    counts records that make no frame, by their kind. ``unread_date`` is the first date
    that is not understood, as the log has it, with its place."""

    damaged: int = 0
    damage: str = ""
    unread_date: str = ""
    others: Counter[str] = field(default_factory=Counter)
    remarks: set[Remark] = field(default_factory=set)

    def other(self, what: str, count: int = 1) -> None:
        """Counts a record that makes no frame."""
        self.others[what if what in self.others or len(self.others) < OTHERS_MOST else "further kinds"] += count

    def date(self, time_ns: int | None, text: str, where: str) -> None:
        """Tells whether a date of the log is understood. ``text`` is the date as it
        stands there."""
        self.remarks.add(Remark.DATE_NOT_UNDERSTOOD if time_ns is None else Remark.DATE_WITHOUT_ZONE)
        if time_ns is None and not self.unread_date:
            self.unread_date = f"{where}: '{clipped(text)}'"

    def without_date(self) -> None:
        """At the end of a log: it may have had none."""
        if not self.remarks & {Remark.DATE_NOT_UNDERSTOOD, Remark.DATE_WITHOUT_ZONE}:
            self.remarks.add(Remark.NO_DATE)

    def note(self, where: str, what: str) -> None:
        """Counts a damaged place."""
        self.damaged += 1
        self.damage = self.damage or f"{where}: {what}"


UNTIMED_MOST = 100_000
"""Most frames without a time that wait for one with a time, some tens of MB."""

Placed = tuple[str, LoggedFrame | str]
"""A place in a log, and its frame or the description of its damage."""


def timed(found: Iterator[Placed], account: Account) -> Iterator[LoggedFrame]:
    """Frames with a time. A frame without one is damage, unless none of the first
    `UNTIMED_MOST` frames has a time: then the log has no times, every frame comes
    without one, and the account has that remark before the first frame."""
    # Wait for the first frame with a time.
    first: list[Placed] = []
    for placed in found:
        first.append(placed)
        if _has_time(placed) or len(first) == UNTIMED_MOST:
            break
    # No such frame: the log has no times.
    without = any(isinstance(frame, LoggedFrame) for _, frame in first) and not any(map(_has_time, first[-1:]))
    if without:
        account.remarks.add(Remark.NO_TIMES)
    # Pass on all frames, with or without times.
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


BLOCK = 2**16  # bytes of one read
LINE_MOST = 4096  # bytes; a CAN FD frame of Vector's has some 400
BYTE_ORDER_MARK = b"\xef\xbb\xbf"  # of UTF-8, which editors of Windows put before the first line


def numbered(stream: BinaryIO, account: Account) -> Iterator[tuple[int, bytes]]:
    """Each line that is not empty, with its number from 1, without outer blanks and
    byte order mark. A line that is too long is damage. So is a last line without its
    end, as its missing part is unknown."""
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
    """The integer of digits alone; int() also accepts signs, blanks, ``0x`` and
    underscores. Raises ValueError."""
    if not text.isalnum() or not text.isascii() or text[1:2] in ("x", "X", b"x", b"X"):
        raise ValueError("no whole number")
    return int(text, base)


def nanoseconds(seconds: bytes, fraction: bytes) -> int:
    """Nanoseconds by the two parts of a decimal number of seconds."""
    return int(seconds) * 1_000_000_000 + int(fraction[:9].ljust(9, b"0") or 0)
