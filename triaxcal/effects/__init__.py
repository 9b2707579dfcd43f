"""The known effects: our own, those of other packages, and those of any logged
channel."""

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
"""All effects of this package that have a fixed name, with those of old documents."""


def catalogue_for(covariates: Collection[str]) -> tuple[Effect, ...]:
    """All effects that a recording with these covariates can show: the catalogue,
    the plugins, and a bias and a scale factor by every other channel.
    """
    effects = (*CATALOGUE, *plugins()[0])
    # A channel that a plugin needs may act in other ways, too.
    others = sorted(channel_of(c) for c in covariates if c != TEMPERATURE and not is_derived(c))
    return (*effects, *(kind(c) for c in others for kind in (ChannelBias, ChannelScaleFactor)))


def effect_named(name: str) -> Effect:
    """The effect of this name, in its default form. Raises KeyError."""
    for prefix, kind in ((BIAS, ChannelBias), (SCALE_FACTOR, ChannelScaleFactor)):
        if name.startswith(prefix) and len(name) > len(prefix):
            return kind(name[len(prefix) :])
    return {effect.name: effect for effect in (*plugins()[0], *CATALOGUE, Empirical())}[name]


def meaning_of(name: str) -> Meaning | None:
    """The effect's own description. None for an unknown effect, or one without."""
    between = next((e for e in BETWEEN_RUNS if e.name == name), None)
    try:
        return (between or effect_named(name)).meaning
    except KeyError:
        return None


def effect_of(name: str, values: Mapping[str, float]) -> tuple[Effect, Floats]:
    """The effect of this name with its coefficients (p,), from the ``values`` of its
    coefficients and shape by name. Missing coefficients are zero.

    Raises KeyError for an unknown name.
    """
    between = next((e.named(values) for e in BETWEEN_RUNS if e.name == name), None)
    effect = between or effect_named(name)
    runs = runs_named(values)
    # The form that has all these values: alike in all recordings, or in some of them.
    for form in (*effect.forms, *(InRuns(form, runs) for form in effect.forms if runs)):
        own = [c.name for c in form.coefficients]
        if set(values) <= {*own, *form.shape}:
            shaped = form.shaped({n: values.get(n, v) for n, (v, _) in form.shape.items()}) if form.shape else form
            return shaped, np.array([values.get(n, 0.0) for n in own])
    known = {n for form in effect.forms for n in (*(c.name for c in form.coefficients), *form.shape)}
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
