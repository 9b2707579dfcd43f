"""The shape of an effect, a time constant or the moment of a step, as the
posterior has it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.evidence.posterior import Posterior
from triaxcal.evidence.terms import Term

AT_AN_END = 0.5
"""If an end value of the grid holds more than this probability, the data do not
bound the shape. No standard error is given then."""


@dataclass(frozen=True)
class Shape:
    """Mean and standard deviation. ``standard_error`` is None where the poses
    do not tell it: it lies at an end of what was asked about."""

    value: float
    standard_error: float | None
    unit: str


def shapes_of(posterior: Posterior, name: str) -> Mapping[str, Shape]:
    """Of an effect, by the name of the shape, if that effect acts; none where
    it has none."""
    terms, weights = posterior.evidence.terms, posterior.term_probabilities
    mine = [i for i, term in enumerate(terms) if term.effect is not None and term.name == name]
    return shapes_by([terms[i] for i in mine], weights[mine]) if weights[mine].any() else {}


def shapes_by(terms: Sequence[Term], weights: Floats) -> Mapping[str, Shape]:
    """Of terms of one name, with their weights (n,)."""
    every = [{} if term.effect is None else term.effect.shape for term in terms]
    out = {}
    for name, unit in {name: unit for shape in every for name, (_, unit) in shape.items()}.items():
        some = [i for i, shape in enumerate(every) if name in shape]
        value, error = _spread(np.array([every[i][name][0] for i in some]), weights[some])
        out[name] = Shape(value, error, unit)
    return out


def _spread(values: Floats, weights: Floats) -> tuple[float, float | None]:
    """Each value of the grid stands for all that are nearer to it than to any
    other."""
    grid, which = np.unique(values, return_inverse=True)
    share = np.bincount(which, weights)
    share = share / share.sum()
    mean = float(share @ grid)
    if len(grid) == 1 or max(share[0], share[-1]) > AT_AN_END:
        return mean, None
    step = np.diff(grid)
    width = np.concatenate([step[:1], (step[1:] + step[:-1]) / 2, step[-1:]])
    return mean, float(np.sqrt(share @ ((grid - mean) ** 2 + width**2 / 12)))
