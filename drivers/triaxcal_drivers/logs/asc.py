"""Vector's ASC: text, a line for each event.

python-can's reader is not used: it ends at the first damaged line, adds up no
relative times, and has no symbolic names.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
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
    Remark,
    nanoseconds,
    numbered,
    whole,
)
from triaxcal_drivers.logs.dates import date_ns, text_of

HEAD = re.compile(
    rb"(?:date\s+\w+\s+\w+|date\s.*\d:\d\d:\d\d|base\s+(?:hex|dec)|begin\s+triggerblock|//\s*version\s+\d)", re.I
)
_DATE = re.compile(rb"(?:date|begin\s+triggerblock)\s+(.*)", re.I)
_BASE = re.compile(rb"base\s+(hex|dec)(?:\s+timestamps\s+(absolute|relative))?", re.I)
_EVENT = re.compile(rb"(\d{1,12})\.(\d{1,9})\s+(.*)")
_CLASSIC = re.compile(rb"(\d{1,3})\s+(\S+)\s+(Rx|Tx|TxRq)\s+([dDrR])(?:\s+([0-9A-Fa-f]{1,2}))?(?:\s+(.*))?$", re.I)
_ERROR = re.compile(rb"(?:CANFD\s+)?(\d{1,3})\s+(?:(?:Rx|Tx)\s+)?ErrorFrame\b", re.I)
_FD = re.compile(
    rb"CANFD\s+(\d{1,3})\s+(Rx|Tx|TxRq)\s+([0-9A-Fa-f]+)(x?)\s+(?:\S+\s+)??([01])\s+([01])\s+([0-9A-Fa-f])\s+(\d{1,2})"
    rb"(?:\s+(.*))?$",
    re.I,
)
_WORDS = re.compile(rb"[^\d:=]+")
_ALMOST = re.compile(rb"\d{1,3}\s+\S+\s+(?:Rx|Tx)\b|CANFD\b", re.I)
_IDENTIFIER = re.compile(rb"([0-9A-Fa-f]+)(x?)$", re.I)
_DECLARED = re.compile(rb"\bID\s*=\s*(\d{1,10})(x?)", re.I)
_PASSED_OVER = re.compile(
    rb"(?://|;|date\b|base\b|(?:no\s+)?internal\s+events|begin\b|end\b|previous\s+log)", re.I
)  # head of a file, and lines between events


def frames(stream: BinaryIO, account: Account) -> Iterator[LoggedFrame]:
    reader = _Reader(account)
    for number, line in numbered(stream, account):
        event = _EVENT.match(line)
        if event is None:
            if not reader.head(line, f"line {number}"):
                account.note(f"line {number}", "expected an event of an ASC log")
            continue
        frame = reader.event(event, f"line {number}")
        if frame is not None:
            yield frame
    account.without_date()


@dataclass
class _Reader:
    """**Time.** Absolute times count from the start, relative times from the previous
    event. The start is the last date before the first event: that of the head, or
    that of the trigger block.

    The date of a later block is the time at which that block begins. The block's
    times count from that date if the measurement was started again; else they
    continue. The block's first event tells which: the correct time is near the date
    and does not go back. Going back counts twice, as dates are often in whole
    seconds and in local time.
    """

    account: Account
    base: int = 16
    relative: bool = False
    begun: bool = False  # whether the first event has come
    start_ns: int = 0
    now_ns: int = 0
    date_ns: int | None = None  # date without an event after it
    framed: bool = False  # whether the first frame has come
    start_words: bytes = b""

    def head(self, line: bytes, where: str) -> bool:
        """Reads a line that is no event; whether the format allows it."""
        if base := _BASE.match(line):
            self.base = 16 if base[1].lower() == b"hex" else 10
            self.relative = (base[2] or b"").lower() == b"relative"
            if self.relative:
                self.account.remarks.add(Remark.TIMES_ADDED_UP)
        elif date := _DATE.match(line):
            text = text_of(date[1])
            found = date_ns(text)
            self.account.date(found, text, where)
            self.date_ns = self.date_ns if found is None else found
        return _PASSED_OVER.match(line) is not None

    def event(self, event: re.Match[bytes], where: str) -> LoggedFrame | None:
        written_ns = nanoseconds(event[1], event[2])
        self._advance(written_ns)
        what = event[3]
        if fd := _FD.match(what):
            return self._fd(fd, where)
        if classic := _CLASSIC.match(what):
            return self._classic(classic, where)
        if error := _ERROR.match(what):
            return LoggedFrame(self.now_ns, 0, ERROR, b"", error[1].decode())
        if _ALMOST.match(what):
            self.account.note(where, "a frame that cannot be read")
        elif not self._is_start(what, written_ns):
            self.account.other("event")
        return None

    def _is_start(self, what: bytes, written_ns: int) -> bool:
        """Whether an event is the start of a measurement: its words, in the language
        of the program, come at time zero before all frames."""
        if not self.framed and written_ns == 0 and _WORDS.fullmatch(what):
            self.start_words = what
        return what in (self.start_words, b"Start of measurement")

    def _advance(self, written_ns: int) -> None:
        """Sets the time of the next event."""
        now_ns = (self.now_ns if self.relative else self.start_ns) + written_ns
        date_ns, self.date_ns = self.date_ns, None
        # After a date, choose between a new start and the old one.
        if date_ns is not None:
            restarted_ns = date_ns + written_ns
            if not self.begun or self._implausibility(restarted_ns, date_ns) < self._implausibility(now_ns, date_ns):
                self.start_ns, now_ns = date_ns, restarted_ns
        self.begun, self.now_ns = True, now_ns

    def _implausibility(self, time_ns: int, date_ns: int) -> int:
        return abs(time_ns - date_ns) + 2 * max(0, self.now_ns - time_ns)

    def _classic(self, m: re.Match[bytes], where: str) -> LoggedFrame | None:
        channel, name, direction, kind, dlc, rest = m.groups()
        if dlc is None and kind.lower() != b"r":
            self.account.note(where, "a frame without its length")
            return None
        if dlc is not None and self.base == 10 and not dlc.isdigit():
            self.account.note(where, f"a length of '{dlc.decode()}', expected a decimal one")
            return None
        length = FD_LENGTHS[min(int(dlc or b"0", self.base), 15)]
        found = self._identifier(name, rest or b"")
        if found is None:
            self.account.note(where, f"'{name[:32].decode('ascii', 'replace')}' is no identifier")
            return None
        flags = found[1] | (0 if direction.lower() == b"rx" else SENT)
        if kind.lower() == b"r":
            data: bytes | None = bytes(min(length, CLASSIC_MOST))
            flags |= REMOTE
        else:
            data = self._octets(rest or b"", min(length, CLASSIC_MOST))
        return self._frame(found[0], flags, data, channel, where)

    def _fd(self, m: re.Match[bytes], where: str) -> LoggedFrame | None:
        channel, direction, identifier, x, switched, passive, dlc, length, rest = m.groups()
        source = int(identifier, self.base if self.base == 16 or identifier.isdigit() else 16)
        flags = (EXTENDED if x else 0) | (0 if direction.lower() == b"rx" else SENT)
        words = (rest or b"").split()
        count = int(length)
        bits = _hexadecimal(words[count + 2]) if len(words) > count + 2 else 0x1000
        if bits & 0x1000 or count > CLASSIC_MOST:
            flags |= FD | (SWITCHED if switched == b"1" else 0) | (REMOTE if passive == b"1" else 0)
        elif bits & 0x10:
            flags |= REMOTE
            return self._frame(source, flags, bytes(FD_LENGTHS[min(int(dlc, 16), 8)]), channel, where)
        return self._frame(source, flags, self._octets(rest or b"", min(count, FD_MOST)), channel, where)

    def _frame(self, source: int, flags: int, data: bytes | None, channel: bytes, where: str) -> LoggedFrame | None:
        if data is None or source > (EXTENDED_MOST if flags & EXTENDED else STANDARD_MOST):
            self.account.note(where, "a frame that cannot be read")
            return None
        self.framed = True
        return LoggedFrame(self.now_ns, source, flags, data, channel.decode())

    def _identifier(self, name: bytes, rest: bytes) -> tuple[int, int] | None:
        """Identifier and flag by digits, or by a symbolic name with ``ID = …`` after
        the data."""
        m = _IDENTIFIER.match(name)
        declared = _DECLARED.search(rest)
        if declared is not None and (m is None or len(m[1]) > 8):
            return int(declared[1]), EXTENDED if declared[2] else 0
        if m is None or (self.base == 10 and not m[1].isdigit()) or len(m[1]) > 10:
            return None
        return int(m[1], self.base), EXTENDED if m[2] else 0

    def _octets(self, text: bytes, count: int) -> bytes | None:
        words = text.split(None, count)[:count]
        try:
            if count:
                whole(b"".join(words), self.base)  # each word must be of digits alone
            return bytes(int(word, self.base) for word in words) if len(words) == count else None
        except ValueError:
            return None


def _hexadecimal(word: bytes) -> int:
    try:
        return int(word, 16)
    except ValueError:
        return 0x1000
