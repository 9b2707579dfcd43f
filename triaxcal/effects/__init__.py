"""The effects that are known: our own, those of other packages, and those of
any logged channel."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.catalogue import CATALOGUE, package_of, plugins
from triaxcal.effects.channel import BIAS, SCALE_FACTOR, ChannelBias, ChannelScaleFactor
from triaxcal.effects.contract import (
    BEFORE,
    CHANGE,
    CLOCKS,
    DERIVED,
    IN_ONE_RUN,
    RUN,
    SCATTER,
    SINCE_START,
    TIME,
    Coefficient,
    Effect,
    Meaning,
    channel_of,
    covariate_of,
    is_derived,
    lag_in,
    rate_of,
)
from triaxcal.effects.empirical import Empirical
from triaxcal.effects.runs import BETWEEN_RUNS, InRuns, of_clocks, runs_named

TEMPERATURE = "temp_c"
OWN: tuple[Effect, ...] = (*CATALOGUE, *BETWEEN_RUNS, Empirical())
"""All effects of this package that have a name of their own, those of old
documents among them."""


def catalogue_for(covariates: Collection[str]) -> tuple[Effect, ...]:
    """All effects that a recording with these covariates might show: the
    catalogue, the plugins, and bias and scale factor by every other channel.
    """
    effects = (*CATALOGUE, *plugins()[0])
    # A channel that an effect of somebody else needs is that effect's business,
    # and may be any other's too.
    others = sorted(channel_of(c) for c in covariates if c != TEMPERATURE and not is_derived(c))
    return (*effects, *(made(c) for c in others for made in (ChannelBias, ChannelScaleFactor)))


def effect_named(name: str) -> Effect:
    """Raises KeyError."""
    for prefix, made in ((BIAS, ChannelBias), (SCALE_FACTOR, ChannelScaleFactor)):
        if name.startswith(prefix) and len(name) > len(prefix):
            return made(name[len(prefix) :])
    return {effect.name: effect for effect in (*plugins()[0], *CATALOGUE, Empirical())}[name]


def meaning_of(name: str) -> Meaning | None:
    """What an effect says that it is; None where it says nothing, or is not
    known."""
    between = next((e for e in BETWEEN_RUNS if e.name == name), None)
    try:
        return (between or effect_named(name)).meaning
    except KeyError:
        return None


def effect_of(name: str, values: Mapping[str, float]) -> tuple[Effect, Floats]:
    """An effect by its name and its coefficients and shape by theirs;
    coefficients not given are zero.

    Raises KeyError for a name that is not known.
    """
    between = next((e.named(values) for e in BETWEEN_RUNS if e.name == name), None)
    whole = between or effect_named(name)
    runs = runs_named(values)
    for form in (*whole.forms, *(InRuns(form, runs) for form in whole.forms if runs)):
        own = [c.name for c in form.coefficients]
        if set(values) <= {*own, *form.shape}:
            shaped = form.shaped({n: values.get(n, v) for n, (v, _) in form.shape.items()}) if form.shape else form
            return shaped, np.array([values.get(n, 0.0) for n in own])
    known = {n for form in whole.forms for n in (*(c.name for c in form.coefficients), *form.shape)}
    raise KeyError(f"{name}.{next((n for n in values if n not in known), ', '.join(values))}")


__all__ = [
    "BEFORE",
    "BETWEEN_RUNS",
    "BIAS",
    "CATALOGUE",
    "CHANGE",
    "CLOCKS",
    "DERIVED",
    "IN_ONE_RUN",
    "OWN",
    "RUN",
    "SCALE_FACTOR",
    "SCATTER",
    "SINCE_START",
    "TEMPERATURE",
    "TIME",
    "Coefficient",
    "Effect",
    "Empirical",
    "Meaning",
    "catalogue_for",
    "channel_of",
    "covariate_of",
    "effect_named",
    "effect_of",
    "is_derived",
    "lag_in",
    "meaning_of",
    "of_clocks",
    "package_of",
    "plugins",
    "rate_of",
]
