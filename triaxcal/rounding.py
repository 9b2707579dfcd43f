"""Numbers as they stand in documents.

They are rounded far below any noise, and far above the last bits in which
processors and linear algebra libraries differ, so that an audit on another
machine gets the same bytes.
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
GRID_G = 1e-11
"""Errors of the magnitude are differences of numbers near 1 g: beyond this they
differ from processor to processor. Of numbers near another reference, as much
finer or coarser as that is smaller or larger, in powers of ten."""


def number(value: float | None, digits: int = DIGITS) -> float | None:
    """A float as it stands in a document; None where there is none."""
    if value is None or not math.isfinite(value):
        return None
    return float(f"{value:.{digits}g}") + 0.0


def error(value: float | None, reference: float = 1.0) -> float | None:
    """An error of the magnitude, in the unit of the ``reference``."""
    if value is None or not math.isfinite(value):
        return None
    grid = GRID_G * 10.0 ** round(math.log10(max(reference, SMALLEST)))
    return number(round(value / grid) * grid)


def uncertainty(value: float | None) -> float | None:
    """A standard error, or a figure that is a ratio to one."""
    return number(value, UNCERTAINTY_DIGITS)


def probability(value: float | None) -> float | None:
    return number(value, PROBABILITY_DIGITS)


def chance(p: float) -> float:
    """A probability that a posterior gives, to a ten-thousandth: its model is
    not as certain as more digits say."""
    return min(round(p, CHANCE_DIGITS) + 0.0, 1.0 - 10.0**-CHANCE_DIGITS)


def numbers(values: Any, digits: int = DIGITS) -> list[Any]:
    """An array of any shape as nested lists."""
    array = np.asarray(values, dtype=float)
    return [number(float(v), digits) for v in array] if array.ndim == 1 else [numbers(row, digits) for row in array]


def correlation(covariance: Floats) -> list[Any]:
    """(p,p) from a covariance, to a millionth: near zero the digits beyond
    differ from processor to processor."""
    deviation = np.sqrt(np.diag(covariance))
    deviation = np.where(deviation > 0, deviation, 1.0)
    return list((np.round(covariance / np.outer(deviation, deviation), 6) + 0.0).tolist())


def direction(unit_vector: Floats) -> list[float]:
    """To a billionth: its small components are differences of large ones, as
    errors are."""
    return [round(float(v), 9) + 0.0 for v in unit_vector]
