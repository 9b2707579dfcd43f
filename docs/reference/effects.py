"""Writes docs/reference/effects.md from what the effects say of themselves: `python docs/reference/effects.py`."""

from __future__ import annotations

from itertools import groupby
from pathlib import Path

from triaxcal.effects import CATALOGUE, effect_named
from triaxcal.effects.channel import BIAS, SCALE_FACTOR
from triaxcal.effects.contract import BEFORE, CHANGE, CLOCKS, RUN, SCATTER, Coefficient, Effect, lag_in, rate_of
from triaxcal.effects.runs import BETWEEN_RUNS

PAGE = Path(__file__).with_suffix(".md")
NAME = "NAME"
HEAD = """# Effects

An effect adds e to the reading of an axis, in g: u = K (s + b + e), where s is the specific force along that axis, and q its coefficients. A channel, a time or a temperature counts from its reference. Made from the effects by `docs/reference/effects.py`. [How to add an effect](../how-to/add-an-effect.md).

| name | what it is | coefficients | formula | needs |
|---|---|---|---|---|
"""  # noqa: E501


def listed() -> tuple[Effect, ...]:
    """Those of the catalogue, of any channel, and between recordings."""
    return (*CATALOGUE, effect_named(BIAS + NAME), effect_named(SCALE_FACTOR + NAME), *BETWEEN_RUNS)


def page() -> str:
    return HEAD + "".join(map(_row, listed()))


def _row(effect: Effect) -> str:
    meaning = effect.meaning
    assert meaning is not None, f"{effect.name} says nothing of itself"
    formula = f"{meaning.formula}; {meaning.symbols}" if meaning.symbols else meaning.formula
    cells = (f"`{effect.name}`", meaning.clause, _coefficients(effect), formula, _needs(effect.needs))
    return "| " + " | ".join(c.replace("{c}", NAME).replace("|", r"\|") for c in cells) + " |\n"


def _coefficients(effect: Effect) -> str:
    forms = " or ".join(dict.fromkeys(_units(form.coefficients) for form in effect.forms))
    return "; ".join([forms, *(f"{name} [{unit}]" for name, (_, unit) in effect.shape.items())])


def _units(coefficients: tuple[Coefficient, ...]) -> str:
    runs = [(unit, [c.name for c in group]) for unit, group in groupby(coefficients, key=lambda c: c.unit)]
    return ", ".join(f"{', '.join(names)} [{unit}]" for unit, names in runs)


def _needs(needs: tuple[str, ...]) -> str:
    return ", ".join(dict.fromkeys(map(_need, needs))) or "directions"


def _need(name: str) -> str:
    if name in CLOCKS:
        return "time"
    if name in (*BEFORE, *CHANGE):
        return "the order of the poses"
    if name in SCATTER:
        return "scatter that differs from pose to pose"
    if name == RUN:
        return "several recordings"
    if lag := lag_in(name):
        return f"channel `{lag[0]}`"
    rate = rate_of("")
    return f"channel `{name.removesuffix(rate)}`" + (", moving inside poses" if name.endswith(rate) else "")


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
