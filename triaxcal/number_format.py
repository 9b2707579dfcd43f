"""How numbers are written in sentences: without an exponent where one can do
without."""

from __future__ import annotations

P_LEAST = 1e-12
"""Below this a probability says how well the noise is known, and no more."""


def number_of(count: int, what: str) -> str:
    """With the noun that is counted, whose plural ends in s."""
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def plain(value: float, digits: int = 3, sign: str = "") -> str:
    """To so many significant digits, and with all those before the point;
    ``sign`` "+" also for what is positive."""
    text = f"{value:{sign}.{digits}g}"
    return f"{value:{sign}.0f}" if "e+" in text and abs(value) < 1e15 else text


def three_digits(value: float, sign: str = "") -> str:
    """With its zeros at the end, and with all digits before the point; without
    an exponent up to a quadrillion."""
    exponent = int(f"{value:.2e}".partition("e")[2])
    return f"{value:{sign}.{max(2 - exponent, 0)}f}" if exponent < 15 else f"{value:{sign}.2e}"


def micro_g(value: float | None, sign: str = "") -> str:
    """A number of g in µg, to three digits."""
    if value is None:
        return "unknown"
    count = value * 1e6
    return f"{three_digits(count, sign) if abs(count) >= 10 else plain(count, sign=sign)} µg"


def probability(p: float | None) -> str:
    """As it stands behind a "p"; a dash where there is none."""
    if p is None:
        return "—"
    return f"< {P_LEAST:.0e}" if p < P_LEAST else f"{p:.2g}"
