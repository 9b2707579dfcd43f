"""Conditions that no single reading shows and a whole recording does: how fast its channels go, and their lags."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import lag_in, rate_of
from triaxcal.poses.conditions import behind

PARTS = 8
"""Averages in the time over which a rate is taken."""


def averages(t_s: Floats, values: Floats, over_s: float) -> tuple[Floats, Floats]:
    """Times and values (m,) averaged over `PARTS` to ``over_s``, of ascending times (n,)."""
    _, index, count = np.unique(np.floor(t_s * (PARTS / over_s)), return_inverse=True, return_counts=True)
    return np.bincount(index, t_s) / count, np.bincount(index, values) / count


def followed(condition: str) -> str:
    """The channel whose rate or lag this is; empty of any other condition."""
    lag = lag_in(condition)
    return lag[0] if lag else condition.removesuffix(rate_of("")) if condition.endswith(rate_of("")) else ""


@dataclass(frozen=True, eq=False)
class InStream:
    """Of each channel the averages (m,) at their times (m,). ``over_s`` is the time over which rates are taken."""

    channels: Mapping[str, tuple[Floats, Floats]]
    over_s: float

    def at(self, t_s: Floats, wanted: Iterable[str]) -> dict[str, Floats]:
        """(n,) those of the ``wanted`` conditions that are rates or lags of a channel here, by name: the slope of a
        straight line through the averages about each moment, and what `behind` gives. None where there is one average
        alone."""
        out: dict[str, Floats] = {}
        for name in wanted:
            times, values = self.channels.get(followed(name), (np.empty(0), np.empty(0)))
            if len(times) < 2:
                continue
            lag = lag_in(name)
            found = behind(times, values, lag[1]) if lag else _slopes(times, values, self.over_s)
            out[name] = np.interp(t_s, times, found)
        return out


def _slopes(t_s: Floats, values: Floats, over_s: float) -> Floats:
    """(m,) of the straight lines through all values within half of ``over_s``; zero where there is one
    alone."""
    first, last = np.searchsorted(t_s, t_s - over_s / 2), np.searchsorted(t_s, t_s + over_s / 2, side="right")
    t, v, count = t_s - t_s[0], values - values[0], last - first

    def summed(x: Floats) -> Floats:
        total = np.concatenate([[0.0], np.cumsum(x)])
        return np.asarray(total[last] - total[first])

    spread = summed(t * t) - summed(t) ** 2 / count
    along = summed(t * v) - summed(t) * summed(v) / count
    return np.where((count > 1) & (spread > 0), along / np.where(spread > 0, spread, 1.0), 0.0)
