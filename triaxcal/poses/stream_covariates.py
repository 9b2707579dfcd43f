"""Covariates that no single reading shows and a whole recording does: how fast
its channels go, and their lags."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import lag_in, rate_of
from triaxcal.poses.covariates import lag_deviation

PARTS = 8
"""Averages in the time over which a rate is taken."""


def followed(covariate: str) -> str:
    """The channel whose rate or lag this is; empty of any other covariate."""
    lag = lag_in(covariate)
    return lag[0] if lag else covariate.removesuffix(rate_of("")) if covariate.endswith(rate_of("")) else ""


@dataclass(frozen=True, eq=False)
class InStream:
    """``covariates`` are those that a recording shows: times (m,) in s, and the
    values (m,) there."""

    covariates: Mapping[str, tuple[Floats, Floats]]

    @classmethod
    def of(
        cls, pieces: Iterable[tuple[Floats, Mapping[str, Floats]]], wanted: Sequence[str], over_s: float
    ) -> InStream:
        """Of the ``wanted`` covariates those that are rates or lags of a
        channel here. A recording comes in ``pieces``, ascending times (n,) with
        the channels (n,) each; a rate is the slope of a straight line through
        ``over_s``."""
        held: dict[str, list[tuple[Floats, Floats]]] = {followed(name): [] for name in wanted}
        for t_s, channels in pieces if wanted else ():
            for name in held.keys() & channels.keys():
                held[name].append(_averages(t_s, channels[name], over_s))
        found = {}
        for name in wanted:
            pairs = held[followed(name)]
            times, values = (np.concatenate([np.empty(0), *(pair[k] for pair in pairs)]) for k in (0, 1))
            if len(times) > 1:
                lag = lag_in(name)
                found[name] = times, lag_deviation(times, values, lag[1]) if lag else _slopes(times, values, over_s)
        return cls(found)

    def at(self, t_s: Floats) -> dict[str, Floats]:
        """(n,) of each covariate at times (n,)."""
        return {name: np.interp(t_s, times, values) for name, (times, values) in self.covariates.items()}


def _averages(t_s: Floats, values: Floats, over_s: float) -> tuple[Floats, Floats]:
    """Times and values (m,) averaged over `PARTS` to ``over_s``, of ascending
    times (n,)."""
    _, index, count = np.unique(np.floor(t_s * (PARTS / over_s)), return_inverse=True, return_counts=True)
    return np.bincount(index, t_s) / count, np.bincount(index, values) / count


def _slopes(t_s: Floats, values: Floats, over_s: float) -> Floats:
    """(m,) of the straight lines through all values within half of ``over_s``;
    zero where there is one alone. Sums are about each moment: those from the
    start of a long recording lose their digits."""
    count, t, v, tt, tv = np.zeros((5, len(t_s)))
    here = np.arange(len(t_s))
    for step in range(-PARTS, PARTS + 1):
        there = np.clip(here + step, 0, len(t_s) - 1)
        dt, dv = t_s[there] - t_s, values[there] - values
        inside = (there == here + step) & (np.abs(dt) <= over_s * (0.5 + 0.5 / PARTS))  # no rounding decides the last
        count, t, v = count + inside, t + inside * dt, v + inside * dv
        tt, tv = tt + inside * dt * dt, tv + inside * dt * dv
    spread = tt - t * t / count
    return np.where(count > 1, (tv - t * v / count) / np.where(count > 1, spread, 1.0), 0.0)
