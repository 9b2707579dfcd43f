"""How a number is written for a person: units, digits, uncertainty. What is
missing is an em dash."""

from __future__ import annotations

import numpy as np

import triaxcal as tc

MICRO_G = tc.units.ErrorUnit()
_LARGEST = 1e30
_SUPERSCRIPT = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")


def number(value: object) -> float | None:
    """`value` as a float when it is a finite number of a size that can be
    drawn, None for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        return None
    return float(value) if -_LARGEST < value < _LARGEST else None


def clean(value: object) -> str:
    """Text from data without characters that print as nothing or reorder their
    neighbours."""
    shown = "".join(
        c if c.isprintable() or c == tc.rounding.NARROW else " " if c.isspace() else "\ufffd" for c in str(value)
    )
    return " ".join(part for part in shown.split(" ") if part)


def fixed(value: float | None, decimals: int) -> str:
    if value is None:
        return tc.rounding.MISSING
    text = f"{value:.{decimals}f}"
    if float(text) == 0.0:
        text = text.lstrip("-")
    return text.replace("-", "−")


def digits(value: float | None, significant: int = 3) -> str:
    """`value` to so many significant digits, without an exponent where one can
    do without."""
    if value is None:
        return tc.rounding.MISSING
    if value == 0.0:
        return "0"
    mantissa, exponent = f"{value:.{significant - 1}e}".split("e")
    if not -4 <= int(exponent) < 7:
        return f"{mantissa} × {power(int(exponent))}".replace("-", "−")
    return fixed(value, max(0, significant - 1 - int(exponent)))


def micro(value_g: float | None, unit: tc.units.ErrorUnit = MICRO_G) -> str:
    """An error in the unit of the reference as a bare number of the small
    ``unit``, three digits."""
    if value_g is None:
        return tc.rounding.MISSING
    count = unit.count(value_g)
    return fixed(count, 2) if abs(count) < 0.1 else digits(count)


def micro_g(value_g: float | None, unit: tc.units.ErrorUnit = MICRO_G) -> str:
    if value_g is None:
        return tc.rounding.MISSING
    return f"{micro(value_g, unit)}{' ' if unit.name else ' × '}{unit_label(unit)}"


def unit_label(unit: tc.units.ErrorUnit) -> str:
    """As it stands beside an axis or over a column."""
    return unit.name or f"{power(unit.exponent)} {clean(unit.unit)}"


def in_full(value: float | None) -> str:
    """`value` with all the digits that documents have."""
    if value is None:
        return tc.rounding.MISSING
    mantissa, _, exponent = f"{value:.10g}".partition("e")
    return (mantissa + (f" × {power(int(exponent))}" if exponent else "")).replace("-", "−")


def power(exponent: int) -> str:
    return "10" + str(exponent).translate(_SUPERSCRIPT)


def unit_text(unit: str) -> str:
    for exponent in "234":
        unit = unit.replace(f"^{exponent}", exponent.translate(_SUPERSCRIPT))
    return unit


def p_value(p: float | None) -> str:
    if p is None:
        return tc.rounding.MISSING
    return f"< {power(-6)}" if p < 1e-6 else digits(p, 2)


def chance(p: float | None) -> str:
    """The probability that something acts, as the sentences have it."""
    return tc.rounding.MISSING if p is None else tc.text.advice.chance(p)


def plus_minus(value: float | None, standard_error: float | None, unit: str) -> str:
    """A coefficient to the place of its standard error; one whose error is not
    known says so."""
    known = standard_error is not None and standard_error > 0
    return tc.rounding.concise(value, standard_error, unit_text(unit)) + (
        "" if known or value is None else f" ± {tc.rounding.MISSING}"
    )


def expanded(value: float | None) -> str:
    """An expanded uncertainty."""
    return tc.rounding.MISSING if value is None else f"± {tc.rounding.concise_error(value)}"


def ratio(value: float | None) -> str:
    """What is known to some per cent: a number of standard errors, or of noise."""
    return tc.rounding.MISSING if value is None else digits(value, 2)
