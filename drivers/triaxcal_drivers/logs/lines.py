"""Lines of a log that is text, and the dates in them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import BinaryIO

from triaxcal_drivers.logs.frames import Account
from triaxcal_drivers.logs.times import utc_ns

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
