"""Dates as text logs have them, in the languages of the programs that write them."""

from __future__ import annotations

import re
import unicodedata
from datetime import UTC, datetime

LONGEST_NS = 2**62
"""A hundred and forty-six years. A longer time, since the epoch or between two times,
is damage."""

_STEMS = (
    "jan ene gen ian sty led oca tammi янв",
    "feb fev lut uno sub helmi фев",
    "mar maart mrz mrt bre maalis мар",
    "apr avr abr kwi dub nis huhti апр",
    "may mai mag mei maj kve touko маи мая",
    "jun juin giu iun cze cvn cerven cervna haz kesa июн",
    "jul juil lug iul lip cvc cervenec cervenc tem heina июл",
    "aug aou ago sie srp agu elo авг",
    "sep set szep wrz zar eyl syys сен",
    "oct okt ott out paz rij eki loka окт",
    "nov noi lis kas marras ноя",
    "dec dez dic des gru pro ara joulu дек",
)
"""How the names of the months begin, short and long: English, German, French, Spanish,
Italian, Portuguese, Dutch, Swedish, Danish, Norwegian, Polish, Czech, Turkish, Finnish,
Russian, Hungarian and Romanian (CLDR), as `_plain` leaves them. The longest beginning
counts; no two months share one."""
_MONTHS = {stem: month for month, stems in enumerate(_STEMS, 1) for stem in stems.split()}
_MORNING = frozenset(("am", "vorm", "vm", "fm", "dop", "de", "ap", "oo", "上午", "午前", "오전"))
_AFTERNOON = frozenset(("pm", "nachm", "nm", "em", "odp", "du", "ip", "os", "下午", "午後", "오후"))
"""The halves of the day, of a clock of twelve hours."""
_TIME = r"(?P<hour>\d{1,2}):(?P<minute>\d\d):(?P<second>\d\d)(?:[.,:](?P<fraction>\d{1,9}))?"
_HALF = r"(?:\s*(?P<half>[^\d\s][^\d]*?))?"
_WORD = r"[^\W\d_]+\.?,?"
_FORMS = (
    re.compile(
        rf"(?:{_WORD}\s+)?(?P<month>{_WORD}|\d{{1,2}}[月월]?)\s+(?P<day>\d{{1,2}})\.?,?\s+{_TIME}{_HALF}\s+(?P<year>\d{{4}})"
    ),
    re.compile(rf"(?:{_WORD}\s+)?(?P<day>\d{{1,2}})\.?\s+(?P<month>{_WORD})\s+(?P<year>\d{{4}})\s+{_TIME}{_HALF}"),
    re.compile(rf"(?:{_WORD}\s+)?(?P<day>\d{{1,2}})\.?\s+(?P<month>{_WORD})\s+{_TIME}{_HALF}\s+(?P<year>\d{{4}})"),
    re.compile(rf"(?P<year>\d{{4}})-(?P<month>\d\d)-(?P<day>\d\d)[T ]\s*{_TIME}Z?"),
    re.compile(rf"(?P<day>\d{{1,2}})\.(?P<month>\d{{1,2}})\.(?P<year>\d{{4}})\s+{_TIME}{_HALF}"),
)
"""Wed Nov 25 04:38:43.125 pm 2026; 25 Nov 2026 16:38:43; 25 Nov 16:38:43 2026;
2026-11-25T16:38:43; 25.11.2026 16:38:43."""


def utc_ns(year: int, month: int, day: int, hour: int, minute: int, second: int) -> int | None:
    """Nanoseconds since the epoch; None if the calendar has no such moment, or if it is
    before the epoch or beyond `LONGEST_NS`."""
    try:
        seconds = int(datetime(year, month, day, hour, minute, second, tzinfo=UTC).timestamp())
    except ValueError:
        return None
    return seconds * 1_000_000_000 if 0 <= seconds * 1_000_000_000 < LONGEST_NS else None


def date_ns(text: str) -> int | None:
    """Nanoseconds since the epoch of a date like "Wed Nov 25 04:38:43.125 pm 2026",
    interpreted as UTC; None for another text."""
    match = next((m for form in _FORMS if (m := form.fullmatch(text.strip()))), None)
    month = None if match is None else _month(match["month"])
    if match is None or month is None:
        return None
    hour = _hour(int(match["hour"]), match.groupdict().get("half") or "")
    if hour is None:
        return None
    time_ns = utc_ns(int(match["year"]), month, int(match["day"]), hour, int(match["minute"]), int(match["second"]))
    return None if time_ns is None else time_ns + int((match["fraction"] or "0").ljust(9, "0"))


def _month(text: str) -> int | None:
    name = _plain(text)
    if number := re.fullmatch(r"(\d{1,2})[月월]?", name):
        return int(number[1])
    beginnings = [name[:length] for length in range(len(name), 2, -1)]
    return next((_MONTHS[start] for start in beginnings if start in _MONTHS), None)


def _hour(hour: int, half: str) -> int | None:
    """Of 24; None if the half of the day is not understood, or has no such hour."""
    word = _plain(half)
    if not word:
        return hour
    if word not in _MORNING | _AFTERNOON or not 0 <= hour <= 23:
        return None
    if hour > 12:  # some programs name the half beside 24 hours
        return hour if word in _AFTERNOON else None
    return hour % 12 + (12 if word in _AFTERNOON else 0)


def _plain(text: str) -> str:
    """Without accents, points, blanks and capitals."""
    apart = unicodedata.normalize("NFKD", text.casefold())
    bare = "".join(c for c in apart if not unicodedata.combining(c) and c not in ".,")
    return unicodedata.normalize("NFC", "".join(bare.split()))


def text_of(data: bytes) -> str:
    """Of a line in UTF-8, else in Windows-1252."""
    try:
        return data.decode()
    except UnicodeDecodeError:
        return data.decode("cp1252", "replace")
