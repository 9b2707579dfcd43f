"""Under which conditions a calibration's nine parameters are all of a reading."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from triaxcal.effects import TEMPERATURE
from triaxcal.effects.contract import (
    DERIVED,
    DURATION,
    RUN,
    SINCE_START,
    TIME,
    Effect,
    channel_of,
    is_derived,
    lag_in,
    rate_of,
)
from triaxcal.estimate.calibration import ReferenceEpoch
from triaxcal.model.samples import Moment
from triaxcal.number_format import plain


def holds(effects: Iterable[Effect], reference: Mapping[str, float], *, several: bool = False) -> tuple[str, ...]:
    """The conditions under which a reading has nothing of these effects, so
    that scale factor, misalignment and bias are all of it. ``reference`` is
    whence the conditions count; ``several``: recordings, each with its own
    clock."""
    out: list[str] = []
    for effect in effects:
        of_conditions = (_at(n, reference.get(n, 0.0), several) for n in effect.needs if n != RUN)
        out += [effect.absent] if effect.absent else of_conditions
    return tuple(dict.fromkeys(out))


def as_at(moment: ReferenceEpoch) -> str:
    """The moment of a recording for which a correction holds that knows no
    time."""
    which = {Moment.END: "the end", Moment.MEAN: "the mean of the poses"}.get(moment.moment)
    return f"as at {plain(moment.t_s, 6)} s of the recording" + (f" ({which})" if which else "")


def use(effects: Iterable[Effect], *, linear_only: bool) -> str:
    """How readings u become specific force a. ``linear_only``: the best linear
    calibration is in the document too."""
    if not tuple(effects):
        return "a = matrix (u - centre)"
    linear = "; linear_only is the best linear calibration" if linear_only else ""
    return f"matrix and centre alone are not the calibration: it has effects, which triaxcal apply adds{linear}"


def _at(name: str, value: float, several: bool) -> str:
    if name == SINCE_START:
        return "long after the start"
    if name == TIME and several:
        return "at the middle of each recording's poses"
    if name in DERIVED:
        unit = {TIME: " s", DURATION: " s"}.get(name, "")
        return f"at {name} = {plain(value, 6)}{unit}"
    if is_derived(name):
        lag = lag_in(name)
        return f"while {channel_of(lag[0] if lag else name.removesuffix(rate_of('')))} does not change"
    return f"at {channel_of(name)} = {plain(value, 6)}{' °C' if name == TEMPERATURE else ''}"
