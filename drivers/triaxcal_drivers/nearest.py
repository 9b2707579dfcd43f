"""The right name nearest to a wrong one, as a hint in an error message."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from itertools import islice

LONGEST = 64  # characters; comparing takes their square, and nobody misspells a longer name
MOST = 20_000  # names compared, a fifth of a second; a vehicle's DBC has not many more
SHOWN = 12


def closest(name: str, known: Iterable[str]) -> str | None:
    """Whatever the case of letters."""
    by_lower = {n.lower(): n for n in reversed(_compared(known))}
    close = difflib.get_close_matches(name.lower(), by_lower, n=1, cutoff=0.5) if len(name) <= LONGEST else []
    return by_lower[close[0]] if close else None


def nearest(name: str, known: Iterable[str]) -> str:
    """Empty where nothing is known."""
    names = _compared(known)
    close = closest(name, names)
    if close is not None:
        return f"; did you mean '{close}'?"
    return f"; known: {', '.join(names[:SHOWN])}" if names else ""


def _compared(known: Iterable[str]) -> list[str]:
    return sorted(set(islice((n for n in map(str, known) if len(n) <= LONGEST), MOST)))


def clipped(text: object, most: int = LONGEST) -> str:
    """What somebody wrote, for a message."""
    shown = str(text)
    return shown if len(shown) <= most else f"{shown[:most]}…"
