"""What shaking does to a pose that is quiet besides: parts that its mean is
better without, and moves that the shaking hid.

A shaken part is joined to the quiet one beside it where their means agree
within what the shaking explains. That is little to ask: the shaking of a hand
explains a turn by one degree. Where a pose is quiet before the shaking and after
it, these two parts are compared by the noise of the quiet ones. And a part that
scatters a hundred times as much as the rest makes the mean worse, however long
it is.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from triaxcal.arrays import Floats, Ints
from triaxcal.poses.stillness.allan_deviations import SCALES, NoiseScales, contrasts
from triaxcal.poses.stillness.shaken import MOVE_SIGMA
from triaxcal.poses.stillness.windows import Windows

MUCH = 9.0
"""Times the variance of the quiet part: less is not worth a word."""
LOUD = 3.0
"""Times the usual scatter, from which on a window counts as shaken."""
LASTING_S = 0.45
"""A disturbance of so many shaken windows is no knock: these are over in less.
Half a second, but for the rounding of windows."""
BLOCKS = 4
"""Averages that a part holds at least of those that tell how its means
scatter."""


def parted(w: Windows, pieces: Sequence[Ints], quiet: Sequence[bool], noise: NoiseScales) -> list[list[Ints]]:
    """The pieces of what was taken for one pose, in order of time, as one list
    or, where moves lie between its ``quiet`` pieces, as several. Shaken pieces
    between those are in none of them: they hold the move.
    """
    known = [i for i, still in enumerate(quiet) if still]
    begins = [0]
    ends: list[int] = []
    for here, there in itertools.pairwise(known):
        if there > here + 1 and _moved_between(w, pieces[here], pieces[there], noise):
            ends.append(here + 1)
            begins.append(there)
    ends.append(len(pieces))
    return [list(pieces[a:b]) for a, b in zip(begins, ends, strict=True)]


def _moved_between(w: Windows, before: Ints, after: Ints, noise: NoiseScales) -> bool:
    """Whether the means of two quiet pieces differ by more than their noise,
    that being a random walk at worst, and a creep that both show."""
    scale = max(s for s in SCALES if s <= min(len(before), len(after)))
    here, there = before[-scale:], after[:scale]
    change = w.mean[there].mean(axis=0) - w.mean[here].mean(axis=0)
    crept = _climb(w, before, after) * (there.mean() - here.mean())
    change = change - np.clip(change, np.minimum(crept, 0), np.maximum(crept, 0))
    # Averages over s windows of a random walk, g windows apart, differ by a
    # variance of g + 2s/3 steps; side by side by 2s/3.
    apart = 1 + 1.5 * (there[0] - here[-1] - 1) / scale
    return bool((np.abs(change) > MOVE_SIGMA * np.sqrt(apart) * noise.step[scale]).any())


def _climb(w: Windows, *pieces: Ints) -> Floats:
    """(3,) slope a window that pieces of one pose have in common."""
    x = [p - p.mean() for p in pieces]
    u = [w.mean[p] - w.mean[p].mean(axis=0) for p in pieces]
    return np.asarray(np.concatenate(x) @ np.concatenate(u) / sum(float(i @ i) for i in x))


def worth_keeping(w: Windows, shaken: Ints, quiet: Ints, noise: NoiseScales) -> bool:
    """Whether the mean over both parts of a pose is better than that over the
    ``quiet`` windows, or not worse by much.

    With variances v/n of the means over n windows, a part of n windows makes
    the mean of m better where its v is below 2 + n/m times the other's.
    """
    usual = np.maximum(SCALES[-1] * noise.step[SCALES[-1]] ** 2 / 2, _spread(w, quiet))
    return bool(np.mean(_spread(w, shaken) / usual) < max(MUCH, 2 + len(shaken) / len(quiet)))


def disturbances(w: Windows, used: Ints, shaken: Ints) -> Ints:
    """(j,) the windows of a pose's disturbances, of which ``used`` has none:
    its ``shaken`` parts with the windows beside them, and bumps that last for
    longer than a knock."""
    without = np.union1d(np.setdiff1d(np.arange(used[0], used[-1] + 1), used), shaken)
    loud = (w.variance[without] > LOUD**2 * w.variance[used].mean(axis=0)).any(axis=1)
    least = LASTING_S / (w.period_ns * 1e-9)
    parts = np.split(np.arange(len(without)), np.flatnonzero(np.diff(without) > 1) + 1)
    lasting = [without[p] for p in parts if loud[p].sum() >= least or np.isin(without[p], shaken).any()]
    return np.concatenate([np.zeros(0, dtype=np.int64), *lasting])


def _spread(w: Windows, part: Ints) -> Floats:
    """(3,) variance of a mean over n windows times n, by how averages over a
    few of them differ."""
    n = len(part)
    scale = max((s for s in SCALES if n >= BLOCKS * s), default=1)
    together = w.joined[part] & (np.diff(part, prepend=part[0] - 1) == 1)
    differences = contrasts(w.mean[part], np.ones(n, dtype=bool), together, scale, scale)[1]
    return np.asarray(scale * (differences**2).mean(axis=0) / 2) if len(differences) else np.zeros(3)
