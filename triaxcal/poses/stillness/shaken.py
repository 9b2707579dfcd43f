"""Poses during which a machine shakes the stand: the outputs scatter as much as
in a move, but their mean stays put.

A move carries the means of the windows away; shaking leaves them where they
are, but for what of it a window does not average out. That is bounded. Shaking
without a rhythm adds a random part, the variance of a sample over the samples.
A tone of frequency f adds to an average over T at most its amplitude over πfT,
also where the windows fall in step with it and the means wander slowly; from 5
Hz on two neighbouring averages over s windows of 0.1 s so differ by at most 2.3
times the scatter inside a window, over s. Neither grows with s as the way of a
move does."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy

from triaxcal.arrays import Bools, Floats, Ints
from triaxcal.poses.stillness.noise_scales import SCALES, NoiseScales, contrast, contrasts, trimmed
from triaxcal.poses.stillness.windows import Windows

LEAST_S = 1.0
"""A shorter rest between shaking is not told from a hand that hesitates."""
ALONE_S = 1.5
"""A span that is shaken throughout lasts longer than a hand hesitates; a part
of one need not."""
MOVE_SIGMA = 5.0
"""Of a difference of averages: noise passes it once in two million. Less would
cut poses in pieces; more lets slight moves pass."""
TONE = 0.5
"""The bound for tones over `MOVE_SIGMA`, about: a standard deviation to judge
by."""
LONGEST = 16
"""Windows in the longest averages compared: jitter of a hand hides a slow turn
from shorter ones."""
ABOUT = 7
"""Windows over which the usual scatter is taken."""
UNEVEN = 5.0
"""A window belongs to a move or a knock if the median variance around it
exceeds that of the run by this factor, or its own variance by the square."""
SHARE = 0.03
"""Shaking makes the outputs scatter by no more than this share of the range of
the poses."""


def shaken_noise(noise: NoiseScales, variance: Floats, size: int) -> NoiseScales:
    """Of averages over windows of ``size`` samples that scatter with
    ``variance`` (3,), where that is more than the quiet noise makes.
    """
    excess = np.maximum(variance - noise.scatter**2, 0.0)
    return replace(
        noise,
        step={s: np.sqrt(v**2 + excess * _share(s, size)) for s, v in noise.step.items()},
        edge={s: np.sqrt(v**2 + excess * _share(s, size) / 1.6) for s, v in noise.edge.items()},
    )


def _share(scale: int, size: int) -> float:
    """Of the variance inside windows that remains in the difference of averages
    over ``scale`` of them."""
    return 2 / (size * scale) + (TONE / scale) ** 2


def shaken_runs(w: Windows, taken: list[Ints], noise: NoiseScales) -> list[Ints]:
    """Runs, trimmed, among the windows outside the quiet runs ``taken``, in
    which the mean stands still.

    Only what is small beside the differences of poses can be distinguished from
    a hand that shakes the unit.
    """
    if len(taken) < 2:
        return []
    levels = np.array([w.mean[run].mean(axis=0) for run in taken])
    most = (SHARE * float(np.linalg.norm(np.ptp(levels, axis=0)))) ** 2
    rest = np.asarray((w.variance <= most).all(axis=1))
    for quiet in taken:
        rest[max(quiet[0] - 1, 0) : quiet[-1] + 2] = False
    level = _level(w)
    found = []
    # What scatters otherwise is something else: the end of a move, which is
    # slow, is no part of what comes after it.
    total = np.maximum(level.sum(axis=1), 1e-300)
    alike = w.joined & (np.abs(np.diff(np.log(total), prepend=np.log(total[0]))) < np.log(UNEVEN))
    for run in runs(_staying(w, rest, alike, level, noise), alike):
        usual = np.median(w.variance[run], axis=0)
        even = np.asarray(((level[run] < UNEVEN * usual) & (w.variance[run] < UNEVEN**2 * usual)).all(axis=1))
        for part in runs(even, np.ones(len(run), dtype=bool)):
            part = run[part]
            piece = trimmed(w, part, shaken_noise(noise, w.variance[part].mean(axis=0), w.size))
            if len(piece) and (w.end_ns[piece[-1]] - w.start_ns[piece[0]]) * 1e-9 >= LEAST_S:
                found.append(piece)
    return found


def _level(w: Windows) -> Floats:
    """(m,3) the usual variance about each window: a window that is shorter than
    a swing shows now more, now less."""
    return np.asarray(scipy.ndimage.median_filter(w.variance, size=(ABOUT, 1), mode="nearest"))


def _staying(w: Windows, rest: Bools, alike: Bools, level: Floats, noise: NoiseScales) -> Bools:
    """Those of the windows at which no difference of neighbouring averages is
    more than shaking explains."""
    staying = rest.copy()
    excess = np.maximum(level - noise.scatter**2, 0.0)
    for scale in (*SCALES, LONGEST):
        at, difference = contrasts(w.mean, staying, alike, scale, scale)
        after = contrast(excess, at, 0, scale)
        before = contrast(excess, at, scale, 0)
        quiet = noise.step[min(scale, SCALES[-1])]
        sigma = quiet**2 + (after - before) / 2 * _share(scale, w.size)
        moved = at[(difference**2 > MOVE_SIGMA**2 * sigma).any(axis=1)]
        half = max(scale // 2, 1)
        for shift in range(-half, half):
            staying[moved + shift] = False
    return staying


def runs(still: Bools, joined: Bools) -> list[Ints]:
    """Indices of unbroken runs of still windows."""
    index = np.flatnonzero(still)
    if not len(index):
        return []
    breaks = np.flatnonzero((np.diff(index) > 1) | ~joined[index[1:]]) + 1
    return [np.asarray(run, dtype=np.int64) for run in np.split(index, breaks)]


# What shaking does to a pose that is quiet besides: parts that its mean is better
# without, and moves that the shaking hid.

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
