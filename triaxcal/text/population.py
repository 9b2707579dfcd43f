"""Effects of places, in words."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from triaxcal.number_format import plain
from triaxcal.population.figures import FigureKind
from triaxcal.population.hypotheses import COMMON_FACTOR, SEVERAL, THERMOMETER, Form
from triaxcal.population.runs import PlaceKind
from triaxcal.population.statements import Change, Pattern, Place, PlacedEffects, Statement, Verdict
from triaxcal.text.advice import chance

SHOWN = 3
"""Figures of a pattern of several that a line has: the largest."""
NAMES: Mapping[str, str] = {COMMON_FACTOR: "common factor"}
MEANINGS: Mapping[str, str] = {
    COMMON_FACTOR: "as with a wrong magnitude of the reference",
    THERMOMETER: "in proportion to each unit's coefficients of temperature, as with a wrong thermometer",
}


def place(found: Place) -> str:
    """ "fixture F2"; "all runs"."""
    match found.kind:
        case PlaceKind.EVERYWHERE:
            return "all runs"
        case PlaceKind.HOUR:
            return f"hours {found.name} UTC"
        case _:
            return f"{found.kind.value} {found.name}"


def pattern(found: Pattern) -> str:
    """What changes."""
    if found.form is Form.FREQUENCY:
        return f"more units with {found.name}"
    form = {Form.SHIFT: "a shift of", Form.DRIFT: "a drift of", Form.SCATTER: "more scatter of"}[found.form]
    match found.kind:
        case FigureKind.DIRECTIONS if found.name == SEVERAL:
            of = "the directions of all poses by one rotation"
        case FigureKind.CONVERTER:
            of = f"|a| that goes with the reading ({found.name})"
        case FigureKind.POSES:
            of = "|a| that goes with the direction"
        case FigureKind.EFFECT:
            of = f"{found.group}, {found.name}"
        case _ if found.name == COMMON_FACTOR:
            of = "all scale factors by one factor"
        case _ if found.name == THERMOMETER and found.kind is FigureKind.COEFFICIENTS:
            of = "the coefficients"
        case _ if found.name == SEVERAL:
            of = f"several {found.group}"
        case _:
            of = found.name
    meaning = MEANINGS.get(found.name) if found.kind is FigureKind.COEFFICIENTS else None
    return f"{form} {of}" + (f", {meaning}" if meaning else "")


def line(found: Statement, day: Callable[[float], str]) -> str:
    """One line; ``day`` writes a time in seconds as a date."""
    where = " or ".join(map(place, found.places))
    certain = "" if found.verdict is not Verdict.CANDIDATE else f" (probability {chance(found.probability)})"
    when = f" since {day(found.since_s)}{_between(found, day)}" if found.since_s is not None else ""
    when += f" until {day(found.until_s)}" if found.until_s is not None else ""
    return f"{where}{when}: {pattern(found.pattern)}{certain}; {sizes(found)}; {found.runs} runs"


def _between(found: Statement, day: Callable[[float], str]) -> str:
    ends = [] if found.since_interval_s is None else [day(end) for end in found.since_interval_s]
    return f" (95 %: {' to '.join(ends)})" if len(set(ends)) > 1 else ""


def sizes(found: Statement) -> str:
    """The largest changes; shares, and relative changes of scale factors, in per
    cent."""
    return "; ".join(_size(found.pattern, name, change) for name, change in [*found.sizes.items()][:SHOWN])


def lines(found: PlacedEffects, day: Callable[[float], str]) -> list[str]:
    """Each statement, then each candidate."""
    return [line(statement, day) for statement in (*found.statements, *found.candidates)]


def _size(of: Pattern, name: str, change: Change) -> str:
    if of.form is Form.SCATTER:
        return f"scatter {_measured(change, 1)} times as large"
    if of.form is Form.FREQUENCY:
        return f"in {_measured(change, 100)} % of units"
    name = NAMES.get(name, name)
    if of.kind is FigureKind.COEFFICIENTS and change.unit in ("", "1"):
        return f"{name} {_measured(change, 100)} %"
    unit = f" {change.unit}" if change.unit not in ("", "1") else ""
    return f"{name} {_measured(change, 1)}{unit}"


def _measured(change: Change, times: int) -> str:
    return f"{plain(times * change.value, 3)} ± {plain(times * change.uncertainty, 2)}"
