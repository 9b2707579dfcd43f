"""Output of candump (can-utils): the log of ``-l`` and ``-L``, and the text on the
terminal, with or without times.

python-can reads only the log, and ends at the first damaged line.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import chain, islice
from typing import BinaryIO

from triaxcal_drivers.logs.can_frames import (
    CLASSIC_MOST,
    ERROR,
    EXTENDED,
    EXTENDED_MOST,
    FD,
    FD_MOST,
    REMOTE,
    SENT,
    SWITCHED,
    Account,
    LoggedFrame,
    Placed,
    Remark,
    nanoseconds,
    numbered,
    timed,
)
from triaxcal_drivers.logs.dates import utc_ns

LOG = re.compile(
    rb"\((\d{1,12})\.(\d{1,9})\)\s+(\S{1,64})\s+([0-9A-Fa-f]{8}|[0-9A-Fa-f]{3})#"
    rb"(?:(R)(\d?)\w{0,2}|#([0-9A-Fa-f])((?:[0-9A-Fa-f]{2}){0,64})|((?:[0-9A-Fa-f]{2}){0,8})(?:_[0-9A-Fa-f])?)"
    rb"(?:\s+([RrTt]))?$"
)
SHOWN = re.compile(
    rb"(?:\(([-0-9 :]*?)(\d{1,12})\.(\d{1,9})\)\s+)?(\S{1,64})\s+(?:(RX|TX)\s+([B-])\s+([E-])\s+)?"
    rb"([0-9A-Fa-f]{8}|[0-9A-Fa-f]{3})\s+(?:\[(\d\d?)\]|\{\w\})\s*"
    rb"(?:(remote request)|((?:[0-9A-Fa-f]{2}(?:\s+|$)){0,64}))(?:\s*ERRORFRAME|\s*'.*)?$"
)
_DAY = re.compile(rb"(\d{4})-(\d\d)-(\d\d) (\d\d):(\d\d):$")
_ERROR_BIT = 0x20000000
_BRS, _ESI = 1, 2  # bits of the digit after ##
EPOCH_FROM_NS = 10**17  # in 1973: times since the epoch are later, times since the start earlier
LOOKED_AT = 1000  # lines that tell times since the start from times since the previous line
NEAR, NEAR_LEAST = 8, 16
"""A line is compared with lines nearer than an eighth of all lines looked at, so that
few pairs have a new start between them where several logs were joined. In a short
log all pairs are compared."""
RISING = 0.75  # share of rising pairs, midway between those of the two kinds of times


def frames(stream: BinaryIO, account: Account) -> Iterator[LoggedFrame]:
    """**Time.** Times count from the epoch, from the start (``-t z``) or from the
    previous line (``-t d``). Times from the start rise from nearly every line to the
    following ones, even if a few go back. Times from the previous line have no
    trend: of two lines, either has the larger one equally often, or they are
    equal."""
    found = timed(_frames(stream, account), account)
    head = list(islice(found, LOOKED_AT))
    times = [f.time_ns for f in head if f.time_ns is not None]
    if times and sorted(times)[len(times) // 2] < EPOCH_FROM_NS:
        account.remarks.add(Remark.NO_DATE)
        if not _rise(times[1:]):  # the first is zero in both cases
            account.remarks.add(Remark.TIMES_ADDED_UP)
            yield from _added_up(chain(head, found))
            return
    yield from head
    yield from found


def _rise(times: list[int]) -> bool:
    """Whether the times rise; True for fewer than two."""
    score = pairs = 0  # a pair that rises counts two, one of equals one
    for apart in range(1, max(len(times) // NEAR, NEAR_LEAST)):
        score += sum((b > a) + (b >= a) for a, b in zip(times, times[apart:], strict=False))
        pairs += max(0, len(times) - apart)
    return score >= 2 * RISING * pairs


def _added_up(found: Iterator[LoggedFrame]) -> Iterator[LoggedFrame]:
    time_ns = 0
    for frame in found:
        time_ns += frame.time_ns or 0
        yield frame._replace(time_ns=time_ns)


def _frames(stream: BinaryIO, account: Account) -> Iterator[Placed]:
    for number, line in numbered(stream, account):
        frame = _logged(LOG.match(line)) or _shown(SHOWN.match(line), account)
        yield f"line {number}", frame or "expected a frame as candump writes it"


_Match = re.Match[bytes] | None


def _logged(m: _Match) -> LoggedFrame | None:
    if m is None:
        return None
    seconds, fraction, channel, identifier, remote, asked, bits, fd, data, direction = m.groups()
    flags = SENT if direction in (b"T", b"t") else 0
    octets = bytes.fromhex((fd if bits else data or b"").decode())
    if bits:
        flags |= FD | _fd_flags(int(bits, 16))
    elif remote:
        flags |= REMOTE
        octets = bytes(min(int(asked or 0), CLASSIC_MOST))
    return _frame(nanoseconds(seconds, fraction), identifier, flags, octets, channel)


def _shown(m: _Match, account: Account) -> LoggedFrame | None:
    if m is None:
        return None
    day, seconds, fraction, channel, direction, switched, passive, identifier, length, remote, data = m.groups()
    octets = bytes.fromhex((data or b"").decode())
    flags = SENT if direction == b"TX" else 0
    if length is None or (not remote and int(length) != len(octets)):
        return None
    if int(length) > CLASSIC_MOST or len(length) == 2:  # candump gives the length of an FD frame two digits
        flags |= FD | (SWITCHED if switched == b"B" else 0) | (REMOTE if passive == b"E" else 0)
        if len(octets) > FD_MOST:
            return None
    elif remote:
        flags |= REMOTE
        octets = bytes(int(length))
    time_ns = _time_ns(day, seconds, fraction, account) if seconds else None
    return None if seconds and time_ns is None else _frame(time_ns, identifier, flags, octets, channel)


def _time_ns(day: bytes, seconds: bytes, fraction: bytes, account: Account) -> int | None:
    """Time [ns]; None if the date is invalid."""
    time_ns = nanoseconds(seconds, fraction)
    if not day.strip():
        return time_ns
    found = _DAY.match(day)
    if found is None or int(seconds) > 60:  # a leap second is one
        return None
    year, month, date, hour, minute = map(int, found.groups())
    day_ns = utc_ns(year, month, date, hour, minute, 0)
    if day_ns is None:
        return None
    account.remarks.add(Remark.DATE_WITHOUT_ZONE)
    return day_ns + time_ns


def _fd_flags(bits: int) -> int:
    return (SWITCHED if bits & _BRS else 0) | (REMOTE if bits & _ESI else 0)


def _frame(time_ns: int | None, identifier: bytes, flags: int, octets: bytes, channel: bytes) -> LoggedFrame:
    source = int(identifier, 16)
    if len(identifier) == 8:
        flags = ERROR if source & _ERROR_BIT else flags | EXTENDED
    return LoggedFrame(time_ns, source & EXTENDED_MOST, flags, octets, channel.decode("utf-8", "replace"))


def recognises(line: bytes) -> bool:
    return bool(LOG.match(line) or SHOWN.match(line))
