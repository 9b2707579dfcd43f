"""PEAK's TRC, versions 1.0 to 2.1: text, a line for each message.

python-can's reader is not used: it ends at the first damaged line, and reads neither
error frames nor version 1.2.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from decimal import Decimal
from typing import BinaryIO

from triaxcal_drivers.logs.can_frames import (
    CLASSIC_MOST,
    ERROR,
    EXTENDED,
    EXTENDED_MOST,
    FD,
    FD_LENGTHS,
    FD_MOST,
    REMOTE,
    SENT,
    STANDARD_MOST,
    SWITCHED,
    Account,
    LoggedFrame,
    numbered,
    whole,
)
from triaxcal_drivers.logs.dates import LONGEST_NS

LINE = re.compile(rb"\s*\d+\)?\s+\d+(?:\.\d+)?\s+\S+\s+\S+")
HEAD = re.compile(rb";(?:\$FILEVERSION\s*=|\$STARTTIME\s*=|#{40})")
_MILLISECONDS = re.compile(r"(\d{1,15})(?:\.(\d{1,6})\d*)?$", re.A)  # with digits down to nanoseconds
_DAYS = re.compile(r"\d{1,6}(?:\.\d*)?$", re.A)
_DAY_ZERO = 25569  # days from the origin of TRC, 1899-12-30, to the epoch
_DAY_NS = 86_400_000_000_000
_COLUMNS: Mapping[str, str] = {
    "1.0": "NOIlD",
    "1.1": "NOdIlD",
    "1.2": "NOBdIlD",
    "1.3": "NOBdIRlD",
}
"""Columns by version, in the letters of ``$COLUMNS``, a line that files before 2.0 do
not have. In 1.x the direction may be ``Warng`` or ``Error``."""
_TYPES = {
    "DT": 0,
    "FD": FD,
    "FB": FD | SWITCHED,
    "FE": FD | SWITCHED | REMOTE,
    "BI": FD | REMOTE,
    "RR": REMOTE,
    "ER": ERROR,
}


def frames(stream: BinaryIO, account: Account) -> Iterator[LoggedFrame]:
    columns, start_ns = _COLUMNS["1.0"], None
    for number, line in numbered(stream, account):
        if line.startswith(b";"):
            text = line.decode("cp1252", "replace")
            if text.startswith(";$FILEVERSION"):
                columns = _COLUMNS.get(text.partition("=")[2].strip(), columns)
            elif text.startswith(";$STARTTIME"):
                started = text.partition("=")[2].strip()
                start_ns = _start_ns(started)
                account.date(start_ns, started, f"line {number}")
            elif text.startswith(";$COLUMNS"):
                columns = text.partition("=")[2].replace(",", "").strip()
        else:
            try:
                frame = _frame(line.decode("ascii"), columns, start_ns or 0, account)
            except (ValueError, KeyError, IndexError):
                account.note(f"line {number}", f"expected a message of the columns {','.join(columns)}")
                continue
            if frame is not None:
                yield frame
    account.without_date()


def _start_ns(text: str) -> int | None:
    days = text.replace(",", ".")
    if not _DAYS.match(days):
        return None
    time_ns = int((Decimal(days) - _DAY_ZERO) * _DAY_NS)
    return time_ns if 0 <= time_ns < LONGEST_NS else None


def _offset_ns(text: str) -> int:
    """Raises ValueError."""
    m = _MILLISECONDS.match(text)
    if m is None:
        raise ValueError("no time in milliseconds")
    return int(m[1] + (m[2] or "").ljust(6, "0"))


def _frame(line: str, columns: str, start_ns: int, account: Account) -> LoggedFrame | None:
    """Raises ValueError, KeyError, IndexError."""
    words = line.split(None, len(columns) - 1)
    at = dict(zip(columns, words, strict=False))
    kind, direction = at.get("T", "DT"), at.get("d", "Rx")
    if kind not in _TYPES or direction not in ("Rx", "Tx") or at["I"] == "FFFFFFFF":
        account.other(kind[:8] if kind != "DT" else "status")
        return None
    flags = _TYPES[kind] | (SENT if direction == "Tx" else 0)
    time_ns = start_ns + _offset_ns(at["O"])
    channel = at.get("B", "1")
    if flags & ERROR:
        return LoggedFrame(time_ns, 0, ERROR, b"", channel)
    source = whole(at["I"], 16)
    flags |= EXTENDED if len(at["I"]) > 4 else 0
    if source > (EXTENDED_MOST if flags & EXTENDED else STANDARD_MOST):
        raise ValueError(line)
    length = FD_LENGTHS[whole(at["L"])] if "L" in at else whole(at["l"])
    data = at.get("D", "")
    if flags & (REMOTE | FD) == REMOTE or data.startswith("RTR"):
        return LoggedFrame(time_ns, source, flags | REMOTE, bytes(min(length, CLASSIC_MOST)), channel)
    octets = bytes.fromhex("".join(data.split()[:length]))
    if len(octets) != length or length > FD_MOST:
        raise ValueError(line)
    return LoggedFrame(time_ns, source, flags, octets, channel)
