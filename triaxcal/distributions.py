"""Tails and quantiles of the usual distributions, by the functions that
``scipy.stats`` calls too; sums of likelihoods.

That package takes longer to import than most commands take for their work.
Degrees of freedom and shapes that are not above zero give NaN. Arguments may be
arrays, which broadcast.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import special

from triaxcal.arrays import Bools, Floats

DOF_MOST = 1e6
"""So many degrees of freedom are as good as more."""
Given = float | np.floating[Any] | np.integer[Any] | Floats


def normal_isf(q: Given) -> Floats:
    """What a standard normal variable exceeds with probability ``q``."""
    return -np.asarray(special.ndtri(q))


def t_ppf(q: Given, dof: Given) -> Floats:
    """Quantile ``q`` of Student's t."""
    return _defined(special.stdtrit(dof, q), np.greater(dof, 0))


def t_isf(q: Given, dof: Given) -> Floats:
    return -t_ppf(q, dof)


def chi2_cdf(x: Given, dof: Given) -> Floats:
    return _defined(special.chdtr(dof, np.maximum(x, 0.0)), np.greater(dof, 0))


def chi2_sf(x: Given, dof: Given) -> Floats:
    """Probability of a chi-square above ``x``."""
    return _defined(special.chdtrc(dof, np.maximum(x, 0.0)), np.greater(dof, 0))


def chi2_ppf(q: Given, dof: Given) -> Floats:
    return _defined(2 * special.gammaincinv(np.divide(dof, 2), q), np.greater(dof, 0))


def chi2_isf(q: Given, dof: Given) -> Floats:
    """What chi-square exceeds with probability ``q``."""
    return _defined(special.chdtri(dof, q), np.greater(dof, 0))


def f_sf(x: Given, above: Given, below: Given) -> Floats:
    """Probability of a ratio F above ``x``; degrees of freedom of its numerator
    and of its denominator."""
    return _defined(special.fdtrc(above, below, np.maximum(x, 0.0)), np.greater(above, 0) & np.greater(below, 0))


def gamma_sf(x: Given, shape: Given) -> Floats:
    """Probability of a gamma variable of scale 1 above ``x``."""
    return _defined(special.gammaincc(shape, np.maximum(x, 0.0)), np.greater(shape, 0))


def _defined(value: Any, where: Bools | np.bool_) -> Floats:
    return np.where(where, value, np.nan)


def log_sum_exp(log: Sequence[Any] | Floats, axis: int | tuple[int, ...] | None = None) -> Floats:
    """The logarithm of a sum of what is given by its logarithm, along axes; −∞
    counts nothing. SciPy's takes ten times as long for a few hundred values,
    and the posterior takes a thousand such sums."""
    values = np.asarray(log)
    largest = np.max(values, axis=axis, keepdims=True)
    largest = np.where(np.isfinite(largest), largest, 0.0)
    with np.errstate(divide="ignore"):
        found = np.log(np.sum(np.exp(values - largest), axis=axis)) + np.squeeze(largest, axis=axis)
    return np.asarray(found)


def softmax(log: Sequence[Any] | Floats, axis: int | None = None) -> Floats:
    """Probabilities that are given by their logarithms but for a constant; they
    add up to one along the axis."""
    values, total = np.asarray(log), log_sum_exp(log, axis=axis)
    return np.asarray(np.exp(values - (total if axis is None else np.expand_dims(total, axis))))
