"""Text that somebody else wrote, as a terminal may be given it.

Names, messages and values come from files and devices. Control characters
among them would steer the terminal, a newline would pass for a line of ours,
and marks of direction would show a line in another order.
"""

from __future__ import annotations

import re
import unicodedata


def printable(text: str) -> str:
    """``text`` on one line: each character that cannot be seen is written as
    its Python escape."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(c if _is_shown(c) else c.encode("unicode_escape").decode() for c in text)


def printable_lines(text: str) -> str:
    """The same of several lines, which end with ``\\\\n`` alone."""
    return "\n".join(map(printable, text.split("\n")))


def printable_json(text: str) -> str:
    """A JSON text that says the same and has no character that `printable`
    would escape, but the newlines between its values."""
    return _ESCAPED.sub(lambda c: c[0] if c[0] == "\n" or _is_shown(c[0]) else _in_json(c[0]), text)


_ESCAPED = re.compile(r"[^ -~]")


def _is_shown(c: str) -> bool:
    """Blanks other than the usual one are (category Zs), those that end a line
    (Zl, Zp) are not."""
    return c.isprintable() or unicodedata.category(c) == "Zs"


def _in_json(c: str) -> str:
    """Characters beyond the basic plane are a pair of surrogates there."""
    code = ord(c)
    if code < 0x10000:
        return f"\\u{code:04x}"
    return f"\\u{0xD800 + (code - 0x10000 >> 10):04x}\\u{0xDC00 + (code - 0x10000 & 0x3FF):04x}"
