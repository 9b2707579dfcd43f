"""What a reader of a log gives: frames, and an account of what was in the log
besides."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from enum import StrEnum, auto
from typing import NamedTuple

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
