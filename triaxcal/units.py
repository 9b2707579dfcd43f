"""How units are written: small errors of the magnitude, and coefficients where
the reference is not in g."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from triaxcal.number_format import micro_g, plain, three_digits

SMALLEST = 1e-250
"""Of references: beyond it powers of ten end."""
SMALL = 0.1
"""Of the small unit: below it two decimals do."""
UNNAMED = "reference unit"
"""What stands in documents where nobody named the unit of the reference."""
_MICRO_G = re.compile(r"(?<![\w.])([+-]?\d+(?:\.\d+)?(?:e[+-]?\d+)?) µg(?!\w)")
_CHANNEL = re.compile(r"(\[.*\])")
_G = re.compile(r"(?<![A-Za-zµ_])g(?![A-Za-z_])")


@dataclass(frozen=True)
class ErrorUnit:
    """The unit in which errors of the magnitude are reported to people:
    ``unit``, that of the reference vector, times ten to the ``exponent``. µg as
    it is; where nobody named the unit, ppm of the reference, whose magnitude is
    ``whole``.
    """

    unit: str = "g"
    exponent: int = -6
    whole: float = 1.0

    @classmethod
    def of(cls, reference_unit: str, reference: float) -> ErrorUnit:
        """About a millionth of the reference, by a power of a thousand: 1e-6 µT
        of 50 µT, 1e-12 T of 5e-5 T."""
        if reference_unit == "g" or not 0 < reference < math.inf:
            return cls(reference_unit)
        if reference_unit == UNNAMED:
            return cls(reference_unit, whole=max(reference, SMALLEST))
        return cls(reference_unit, 3 * math.floor((math.log10(max(reference, SMALLEST)) + 0.5) / 3) - 6)

    @property
    def name(self) -> str:
        """Empty where it has none of its own."""
        return {"g": "µg", UNNAMED: "ppm of the reference"}.get(self.unit, "")

    def __str__(self) -> str:
        return self.name or f"1e{self.exponent} {self.unit}"

    def count(self, value: float) -> float:
        """A ``value`` in the reference's unit as a number of these."""
        return value / self.whole * 10.0**-self.exponent

    def written(self, value: float | None) -> str:
        """To three digits: no error of the magnitude is known better than to
        some per cent. Less than a hundredth of the unit is nothing."""
        if value is None:
            return "—"
        count = self.count(value)
        return f"{count:.2f}" if abs(count) < SMALL else three_digits(count)

    def in_full(self, value: float | None) -> str:
        return self._behind(self.written(value))

    def figure(self, value: float) -> str:
        """A ``value`` in the reference's unit as sentences have it."""
        return self.in_words(micro_g(value))

    def in_words(self, text: str) -> str:
        """What the metrology says in words, where it writes µg for a millionth
        of the reference's unit."""
        return text if self.unit == "g" else _MICRO_G.sub(self._instead, text)

    def _instead(self, found: re.Match[str]) -> str:
        number = found[1]
        if self.exponent != -6 or self.whole != 1.0 or "e" in number:
            number = plain(self.count(float(number) * 1e-6), sign="+" if number[0] == "+" else "")
        return self._behind(number)

    def _behind(self, number: str) -> str:
        """`20.1e-6 m/s^2`, not `20.1 1e-6 m/s^2`; a number that has an exponent
        keeps it."""
        joined = not self.name and number[-1].isdecimal() and "e" not in number
        return f"{number}e{self.exponent} {self.unit}" if joined else f"{number} {self}"


def in_units_of(unit: str, reference_unit: str) -> str:
    """A coefficient's unit, which the metrology writes with g for the unit of
    the reference vector, and with the names of channels in brackets."""
    if reference_unit == "g":
        return unit
    if unit == "g":
        return reference_unit
    parts = _CHANNEL.split(unit)
    return "".join(p if p.startswith("[") else _G.sub(lambda _: grouped(reference_unit), p) for p in parts)


def grouped(unit: str) -> str:
    """A unit as it stands below a fraction bar."""
    return f"({unit})" if set(unit) & set(" /") else unit


def same_unit(one: str, other: str) -> bool:
    """However they are spelled: m/s², m/s^2 and M/S2 are one."""
    return _spelled(one) == _spelled(other)


def _spelled(unit: str) -> str:
    folded = unit.casefold().replace("²", "2").replace("μ", "µ")
    bare = re.sub(r"[\s^*·\[\]()]", "", folded)
    return {"m/s/s": "m/s2", "ms-2": "m/s2", "gn": "g", "g0": "g", "count": "counts"}.get(bare, bare)


def reference_unit_of(reference: float) -> str:
    """g where the magnitude can be gravity in units of g, else what the caller
    did not name."""
    return "g" if 0.9 <= reference <= 1.1 else UNNAMED
