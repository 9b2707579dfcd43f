"""How a page writes numbers and effects for a person."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

import triaxcal as tc

# How a number is written for a person: units, digits, uncertainty. What is missing
# is an em dash.

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


# What an effect says that it is (`triaxcal.effects.contract.Meaning`), by the names
# that stand in the documents. One that says nothing, or is not installed, is shown by
# its name and its coefficients alone.


@dataclass(frozen=True)
class Told:
    """A meaning of one effect of a document, with its channel and its
    references put in."""

    title: str
    clause: str
    because: str
    formula: str
    symbols: str


QUALITY = {
    "saturation": "Readings at the end of the range",
    "stuck_output": "Output frozen",
    "missing_samples": "Samples missing",
    "rate": "Sample rate not the declared one",
    "bursts": "Samples in bursts",
    "duplicate_samples": "Samples that came twice",
    "out_of_order_samples": "Samples out of order",
    "bus_errors": "Errors on the bus",
    "malformed_records": "Records not as the profile defines them",
    "mains_pickup": "Mains hum",
    "coarse_quantization": "Steps of the output too coarse",
    "disturbed_pose": "Pose shaken",
    "merged_poses": "Move hidden by shaking",
    "creeping_pose": "Outputs creep while the pose is held",
    "unknown_noise": "Noise of the pose means not known",
}
WORDS = {"rate", "bursts"}
"""Names that are words too: only before their colon they are names."""
_NAME = re.compile(
    rf"\b(?:(?:{tc.effects.BIAS}|{tc.effects.SCALE_FACTOR})[^\s,;]+?(?=[:,;.]?(?:\s|$))|"
    + "|".join(
        sorted(
            (
                *(e.name for e in tc.effects.OWN),
                tc.effects.BIAS.rstrip(":"),
                tc.effects.SCALE_FACTOR.rstrip(":"),
                *(QUALITY.keys() - WORDS),
            ),
            key=len,
            reverse=True,
        )
    )
    + r")(?!\w)"
)
_RUN = re.compile(r"(.+)_run([1-9]\d{0,3})(_alone)?")
_TIMES = re.compile(r"(?<![\w.])(\d+(?:\.\d+)?)(?: 1)?e([+-]\d{1,3})(?= \S)")
_EXPONENT = re.compile(r"(?<![\w.])(?<!\d )(\d(?:\.\d{1,8})?)e[+-]\d{1,2}(?![\w.])")


def told(effect: str, references: Mapping[str, float | None]) -> Told:
    """``references`` are the values from which the conditions count, by
    channel."""
    meaning, channel = _meaning(effect)
    title = tc.text.traces.effect_title(effect)
    if meaning is None:
        return Told(title, title.lower(), "", "", "")
    letter, name = meaning.reference or ("", "")
    value = references.get(name.replace("{c}", tc.effects.covariate_of(channel)))
    where = [meaning.symbols] if meaning.symbols else []
    if letter == "t₀" and tc.effects.RUN in references:
        where.append("t₀: the middle of each recording's poses")
    elif letter and value is not None:
        where.append(f"{letter} = {value:.6g}".replace("-", "−"))
    clause, because, formula, symbols = (
        text.replace("{c}", channel) for text in (meaning.clause, meaning.because, meaning.formula, "; ".join(where))
    )
    return Told(title, clause, because, formula, symbols)


def factor(effect: str, coefficient: str) -> tuple[str, str]:
    """The axis that a coefficient acts on, and what it is multiplied by; empty
    where that is not known."""
    meaning, _ = _meaning(effect)
    coefficient, run, alone = run_of(coefficient)
    axis, by = _factor(meaning.factors if meaning else {}, coefficient)
    if meaning is None or run is None or not by:
        return axis, by
    return axis, (tc.effects.IN_ONE_RUN if alone else meaning.in_run).format(by=by, n=run)


def run_of(coefficient: str) -> tuple[str, int | None, bool]:
    """A coefficient's name without the recording that it names (the first is 1,
    None where it names none), and whether that differs from all others, which
    are alike."""
    found = _RUN.fullmatch(coefficient)
    return (found[1], int(found[2]), bool(found[3])) if found else (coefficient, None, False)


def _factor(factors: Mapping[str, str], coefficient: str) -> tuple[str, str]:
    if coefficient in factors:
        return (coefficient[0] if re.fullmatch(r"[xyz]_[xyz]{2}", coefficient) else ""), factors[coefficient]
    for axis in "xyz":
        for pattern, by in factors.items():
            if "*" in pattern and coefficient == pattern.replace("*", axis):
                return axis, by
    return "", ""


def in_plain(text: str, *, begins: bool = True) -> str:
    """A sentence of a document with names and powers of ten as people write
    them; ``begins``: with a capital."""
    said = _EXPONENT.sub(lambda found: _written_out(found[0], found[1]), text)
    said = _TIMES.sub(lambda found: f"{found[1]} × {power(int(found[2]))}", said)
    said = _NAME.sub(lambda found: _plain(found[0]), said)
    return said[:1].upper() + said[1:] if begins else said


def _written_out(number: str, mantissa: str) -> str:
    """`1e-12` as 10⁻¹², with as many digits as it has."""
    text = digits(float(number), len(mantissa.replace(".", "")))
    return text.removeprefix("1 × ")


def _plain(name: str) -> str:
    if name in QUALITY:
        return name.replace("_", " ")
    head, _, channel = tc.text.traces.effect_title(name).partition(":")
    return head.lower() + (f":{channel}" if channel else "")


def _meaning(effect: str) -> tuple[tc.effects.Meaning | None, str]:
    return tc.effects.meaning_of(effect), clean(effect.partition(":")[2])
