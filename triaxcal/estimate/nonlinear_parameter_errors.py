"""Standard errors of what the fit holds fixed: the shapes of effects
(`Effect.shape`), which the search has chosen."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from triaxcal.arrays import Bools, Floats
from triaxcal.effects.contract import DURATION, SINCE_START, Effect, reshaped
from triaxcal.estimate.likelihood import Problem, State, linearise_all, residual_chi2

UNLIKELY = 16.0
"""Chi-square over its minimum beyond which a value, and what is next to it,
needs no closer look."""
STRAIGHT = 1.0
"""The likelihood is looked at so closely that chi-square changes by no more
from one value to the next."""
HALVED_MOST = 8
"""Halvings of an interval, to 1/256: a likelihood that is steeper still is an
edge."""
PARTS = 20
"""Parts of an interval in the sum that stands for an integral: chi-square
changes by about `STRAIGHT` over it, so that the weight changes little over a
part."""
NOTHING_LIKE = 1e300
"""In place of infinity, between which and the next nothing could be
interpolated."""


def shape_errors(
    problem: Problem, state: State, columns: Floats, thousandths: Floats, birge_ratio: float
) -> dict[str, float]:
    """By "effect.name"; none of a shape that moves nothing at all.

    ``columns`` (n,m) are the derivatives of the residuals by the shapes,
    ``thousandths`` (m,) the standard errors by these, in thousandths of the
    shapes' values, raised by the ``birge_ratio`` already.
    """
    out = {}
    named = [(i, name, value) for i, e in enumerate(state.effects) for name, (value, _) in e.shape.items()]
    for (i, name, value), column, thousandth in zip(named, columns.T, thousandths, strict=True):
        error = _by_likelihood(problem, state, i, name, birge_ratio) if has_edges(state.effects[i]) else None
        if error is None and np.any(column):
            error = 1e-3 * abs(value) * float(thousandth)
        if error is not None:
            out[f"{state.effects[i].name}.{name}"] = error
    return out


def has_edges(effect: Effect) -> bool:
    """Whether it changes at the edges of poses, as a step does: the likelihood
    of its shape has kinks there, and is flat between two poses, so that its
    curvature tells nothing."""
    return DURATION in effect.needs


def spread(value: float, chi2_at: Callable[[float], float], tried: Sequence[float], edges: Floats) -> float | None:
    """The rms distance from a shape's ``value`` to what it may be, each
    weighted by its likelihood, from the lowest to the highest of those
    ``tried``; ``edges`` are those of the poses. None where only one was tried.

    Of a step between two poses that is the rectangular distribution over the
    time between them (JCGM 100, 4.3.7), with shoulders where it may have been
    inside a pose, and other gaps where the directions of the poses hide it.
    """
    profile = _Profile(chi2_at)
    profile.look_at(np.unique([value, *tried]))
    if len(profile.x) < 2:
        return None
    profile.look_at(profile.where_likely(edges))
    profile.look_closer()
    return profile.spread_about(value)


def edges_of(problem: Problem) -> Floats:
    """When poses begin and end, in seconds since the start."""
    middle, half = problem.covariates[SINCE_START], problem.covariates[DURATION] / 2
    return np.concatenate([middle - half, middle + half])


def _by_likelihood(problem: Problem, state: State, i: int, name: str, birge_ratio: float) -> float | None:
    effect = state.effects[i]
    tried = [v.shape[name][0] for v in effect.variants(problem.covariates) if name in v.shape]

    def chi2_at(value: float) -> float:
        return _left(problem, state, i, name, value) / birge_ratio**2

    return spread(effect.shape[name][0], chi2_at, tried, edges_of(problem))


class _Profile:
    """Chi-square (m,) at ascending values ``x`` (m,) of a shape."""

    def __init__(self, chi2_at: Callable[[float], float]) -> None:
        self._chi2_at = chi2_at
        self.x, self.chi2 = np.empty(0), np.empty(0)

    def look_at(self, more: Floats) -> None:
        rows = np.searchsorted(self.x, more)
        self.chi2 = np.insert(self.chi2, rows, [min(self._chi2_at(float(v)), NOTHING_LIKE) for v in more])
        self.x = np.insert(self.x, rows, more)

    @property
    def _likely(self) -> Bools:
        """(m−1,) the intervals of which one end is."""
        return np.asarray(np.minimum(self.chi2[:-1], self.chi2[1:]) < self.chi2.min() + UNLIKELY)

    def where_likely(self, more: Floats) -> Floats:
        """Of further values those in intervals that are likely."""
        more = np.setdiff1d(more, self.x)
        more = more[(self.x[0] < more) & (more < self.x[-1])]
        return np.asarray(more[self._likely[np.searchsorted(self.x, more) - 1]])

    def look_closer(self) -> None:
        """Halves the likely intervals along which chi-square changes."""
        for _ in range(HALVED_MOST):
            coarse = self._likely & (np.abs(np.diff(self.chi2)) > STRAIGHT)
            if not coarse.any():
                return
            self.look_at((self.x[:-1] + self.x[1:])[coarse] / 2)

    def spread_about(self, value: float) -> float:
        """The rms distance from a value, each weighted by its likelihood, of
        which the logarithm is straight between two."""
        wide = np.diff(self.x)
        at = (self.x[:-1, None] + wide[:, None] * (np.arange(PARTS) + 0.5) / PARTS).ravel()
        weight = np.repeat(wide, PARTS) * np.exp((self.chi2.min() - np.interp(at, self.x, self.chi2)) / 2)
        return float(np.sqrt(np.sum(weight * (at - value) ** 2) / np.sum(weight)))


def _left(problem: Problem, state: State, i: int, name: str, value: float) -> float:
    """Chi-square with another value of a shape, everything else fitted again,
    in linear reckoning."""
    other = reshaped(state.effects[i], name, value)
    with np.errstate(over="ignore", invalid="ignore"):
        return residual_chi2(
            linearise_all(problem, State(state.theta, (*state.effects[:i], other, *state.effects[i + 1 :])))
        )
