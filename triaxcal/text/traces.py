"""Words of a trace (`triaxcal.evidence.partial_residuals.Trace`): its title, its
axes, and what it shows."""

from __future__ import annotations

from triaxcal.effects.contract import BEFORE, CHANGE, RUN, SCATTER, SINCE_START, TIME, channel_of, lag_in, rate_of
from triaxcal.effects.empirical import Empirical
from triaxcal.effects.runs import runs_named
from triaxcal.evidence.partial_residuals import POSE, PREDICTED, READINGS, Quantity, Trace, unit_of
from triaxcal.units import ErrorUnit, in_units_of

SMOOTH = Empirical().name
OF_AN_AXIS = {
    READINGS: "reading along {axis}",
    BEFORE: "reading along {axis} in the pose before",
    CHANGE: "change along {axis} since the pose before",
    SCATTER: "variance of the readings along {axis}",
}
OTHERS = {
    POSE: "pose",
    RUN: "recording",
    TIME: "time",
    SINCE_START: "time",
    PREDICTED: "contribution by the fit",
}


def effect_title(effect: str) -> str:
    """`channel_bias:supply_v` becomes `Channel bias: supply_v`."""
    if effect == SMOOTH:
        return "Smooth function of the direction"
    name, _, channel = effect.partition(":")
    title = name.replace("_order_", "-order ").replace("_", " ").capitalize()
    return f"{title}: {channel}" if channel else title


def title(trace: Trace) -> str:
    """What the panel is of."""
    every = trace.effect == SMOOTH  # dozens of coefficients, which mean nothing one by one
    listed = ", ".join(() if every else trace.coefficients)
    of_two = trace.quantity is Quantity.READING and trace.variable in READINGS  # it may act on either axis
    on = f", axis {trace.axis}" if trace.axis and not of_two else f", {listed}" if listed else ""
    runs = runs_named(trace.coefficients) if trace.variable != RUN else ()
    on += "".join(f", recording {run + 1}" for run in runs)
    if trace.effect:
        return effect_title(trace.effect) + on
    return "Residual" if trace.quantity is Quantity.STANDARD_ERRORS else f"Unexplained, by {variable(trace)}"


def variable(trace: Trace) -> str:
    """The variable in words, without its unit."""
    name = trace.variable
    for names, words in OF_AN_AXIS.items():
        if name in names:
            return words.format(axis=name[-1])
    if name in OTHERS:
        return OTHERS[name]
    lag = lag_in(name)
    if lag:
        return f"lag of {channel_of(lag[0])} at {lag[1]} s"
    bare = name.removesuffix(rate_of(""))
    return channel_of(name) if bare == name else f"rate of {channel_of(bare)}"


def x_label(trace: Trace, small: ErrorUnit) -> str:
    if trace.variable == PREDICTED:
        return f"{variable(trace)}, {small}"
    unit = in_units_of(unit_of(trace.variable), small.unit)
    return f"{variable(trace)}, {unit}" if unit and not unit.startswith("[") else variable(trace)


def y_label(trace: Trace, small: ErrorUnit) -> str:
    if trace.quantity is Quantity.STANDARD_ERRORS:
        return "residual, standard errors"
    of = "|a|" if trace.quantity is Quantity.MAGNITUDE else f"reading {trace.axis}"
    return f"partial residual of {of}, {small}"


def description(trace: Trace, small: ErrorUnit) -> str:
    """The panel in a sentence, for readers who cannot see the picture."""
    poses = f"{len(trace.x)} poses" + (f", {int(trace.excluded.sum())} excluded" if trace.excluded.any() else "")
    told = "" if trace.share is None else f"; a smooth curve takes {100 * max(trace.share, 0.0):.0f} % of it away"
    return f"{title(trace)}: {y_label(trace, small)} against {x_label(trace, small)}, {poses}{told}"
