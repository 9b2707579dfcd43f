"""Numbers as they stand in documents, and as people read them (`concise`).

In documents they are rounded far below any noise, and far above the last bits
in which processors and linear algebra libraries differ, so that an audit on
another machine gets the same bytes.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.units import SMALLEST

DIGITS, UNCERTAINTY_DIGITS, PROBABILITY_DIGITS, CHANCE_DIGITS = 10, 6, 4, 4
"""Significant digits of coefficients, of standard errors, of p-values; decimals
of a posterior's probabilities. Some five more than noise warrants, some five
fewer than the arithmetic has, so that an audit can compare bytes (decision
0007)."""
REGISTER_DIGITS = 12
"""So many tell any two float32 apart, and any two integers of a register."""
KNOWN_TO = 0.1
"""A standard uncertainty is itself known to a tenth at best: its relative
uncertainty is 1/√(2ν), and ν is seldom above 50 (GUM, E.4.3)."""
GRID_G = 1e-11
"""Errors of the magnitude are differences of numbers near 1 g: beyond this they
differ from processor to processor. Of numbers near another reference, as much
finer or coarser as that is smaller or larger, in powers of ten."""

MISSING = "—"
NARROW = "\u202f"
"""The narrow space between groups of three digits."""
LEAST_PLAIN, MOST_PLAIN = 0.1, 1e7
"""Between these figures stand without a power of ten."""
_SUPERSCRIPT = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")


class Printed(float):
    """A figure as it stands in a document.

    ``exact`` is what was rounded and ``step`` the distance to the next figure
    that could stand there. ``known_to`` is the figure's own uncertainty, None
    where its kind does not tell one. An audit on another processor needs them:
    its figure may be rounded to the other side.
    """

    __slots__ = ("exact", "known_to", "step")

    exact: float
    step: float
    known_to: float | None

    def __new__(cls, value: float, exact: float, step: float, known_to: float | None = None) -> Printed:
        made = super().__new__(cls, value)
        made.exact, made.step, made.known_to = exact, step, known_to
        return made

    def __getnewargs__(self) -> tuple[float, float, float, float | None]:  # type: ignore[override]
        return float(self), self.exact, self.step, self.known_to


def number(value: float | None, digits: int = DIGITS) -> float | None:
    """A float as it stands in a document; None where there is none."""
    if value is None or not math.isfinite(value):
        return None
    return _to_digits(float(value), digits)


def error(value: float | None, reference: float = 1.0) -> float | None:
    """An error of the magnitude, in the unit of the ``reference``."""
    if value is None or not math.isfinite(value):
        return None
    grid = GRID_G * 10.0 ** round(math.log10(max(reference, SMALLEST)))
    on_grid = _to_digits(float(round(value / grid) * grid), DIGITS)
    return Printed(on_grid, float(value), max(grid, on_grid.step))


def uncertainty(value: float | None) -> float | None:
    """A standard error, or a figure that is a ratio to one."""
    found = number(value, UNCERTAINTY_DIGITS)
    return _as_uncertainty(found) if isinstance(found, Printed) else found


def in_standard_errors(value: float | None) -> float | None:
    """A residual in standard errors, or a mean of such: it is known to about
    one, however small it is."""
    found = number(value, UNCERTAINTY_DIGITS)
    return Printed(found, found.exact, found.step, 1.0) if isinstance(found, Printed) else found


def probability(value: float | None) -> float | None:
    return number(value, PROBABILITY_DIGITS)


def chance(p: float) -> float:
    """A probability that a posterior gives, to a ten-thousandth: its model is
    not as certain as more digits say."""
    printed = _to_decimals(p, CHANCE_DIGITS)
    return Printed(min(printed, 1.0 - printed.step), printed.exact, printed.step)


def numbers(values: Any, digits: int = DIGITS) -> list[Any]:
    """An array of any shape as nested lists."""
    array = np.asarray(values, dtype=float)
    if array.ndim > 1:
        return [numbers(row, digits) for row in array]
    return [uncertainty(float(v)) if digits == UNCERTAINTY_DIGITS else number(float(v), digits) for v in array]


def reaches(p: float, least: float) -> bool:
    """Whether a probability, as it is printed, is so large: a decision that its
    reader can repeat, and no last bit makes."""
    return chance(float(p)) >= least


def correlation(covariance: Floats) -> list[Any]:
    """(p,p) from a covariance, to a millionth: near zero the digits beyond
    differ from processor to processor."""
    deviation = np.sqrt(np.diag(covariance))
    deviation = np.where(deviation > 0, deviation, 1.0)
    exact = covariance / np.outer(deviation, deviation)
    printed = np.round(exact, 6) + 0.0
    return [
        [Printed(*pair, 1e-6) for pair in zip(*rows, strict=True)]
        for rows in zip(printed.tolist(), exact.tolist(), strict=True)
    ]


def direction(unit_vector: Floats) -> list[float]:
    """To a billionth: its small components are differences of large ones, as
    errors are."""
    return [_to_decimals(float(v), 9) for v in unit_vector]


def degrees(value: float) -> float:
    """To a tenth of a degree."""
    return _to_decimals(value, 1)


def known_to(value: float, uncertainty: float, reference: float = 1.0) -> float | None:
    """An error of the magnitude, as `error` has it, that is itself known with
    this standard uncertainty."""
    found = error(value, reference)
    return Printed(found, found.exact, found.step, uncertainty) if isinstance(found, Printed) else found


def concise(value: float | None, standard_error: float | None, unit: str = "") -> str:
    """A figure for people, in the concise notation of the GUM (7.2.2):
    `−2.410 594(24) V/g`, the error to two digits in the last places of the
    value. Both are taken times a power of a thousand where they are very small
    or large: `6.255(16) × 10⁻³ rad`. Without an error six digits of the
    value."""
    if value is None or not math.isfinite(value):
        return MISSING
    known = standard_error if standard_error and math.isfinite(standard_error) and standard_error > 0 else 0.0
    power = _power(max(abs(value), known))
    value, known = value / 10.0**power, known / 10.0**power
    if known:
        last = int(f"{known:.1e}".partition("e")[2]) - 1
    else:
        last = math.floor(math.log10(abs(value))) - 5 if value else 0
    decimals = max(-last, 0)
    text = _grouped(f"{round(value, -last) + 0.0:.{decimals}f}")
    if known:
        digits = round(known, -last)
        text += f"({digits:.{decimals}f})" if digits >= 1 or not decimals else f"({digits * 10.0**decimals:.0f})"
    return f"{text}{_times(power)} {unit}".rstrip()


def concise_error(value: float | None, unit: str = "") -> str:
    """An uncertainty for people: two digits."""
    if value is None or not math.isfinite(value):
        return MISSING
    power = _power(abs(value))
    scaled = value / 10.0**power
    last = int(f"{scaled:.1e}".partition("e")[2]) - 1
    text = _grouped(f"{round(scaled, -last) + 0.0:.{max(-last, 0)}f}")
    return f"{text}{_times(power)} {unit}".rstrip()


def _power(scale: float) -> int:
    """Of ten, in threes, by which figures of this size are written."""
    return 0 if scale == 0.0 or LEAST_PLAIN <= scale < MOST_PLAIN else 3 * math.floor((math.log10(scale) + 1) / 3)


def _times(power: int) -> str:
    return f" × 10{str(power).translate(_SUPERSCRIPT)}" if power else ""


def _grouped(number: str) -> str:
    """Digits in threes from the decimal point either way (ISO 80000-1, 7.3.2),
    by spaces at which no line breaks."""
    whole, point, part = number.removeprefix("-").partition(".")
    head = len(whole) % 3
    of_whole = [whole[:head]] * bool(head) + [whole[i : i + 3] for i in range(head, len(whole), 3)]
    of_part = [part[i : i + 3] for i in range(0, len(part), 3)]
    return "−" * number.startswith("-") + NARROW.join(of_whole) + point + NARROW.join(of_part)


def _to_digits(value: float, digits: int) -> Printed:
    """To so many significant digits."""
    text = f"{value:.{digits - 1}e}"
    step = 10.0 ** (int(text.partition("e")[2]) - digits + 1)
    return Printed(float(text) + 0.0, value, step)


def _to_decimals(value: float, decimals: int) -> Printed:
    return Printed(round(value, decimals) + 0.0, value, 10.0**-decimals)


def _as_uncertainty(of: Printed) -> Printed:
    return Printed(of, of.exact, of.step, KNOWN_TO * abs(of))
