"""Poses under vibration: the outputs scatter as in a move, but their mean is
constant.

A move changes the means of the windows. Vibration leaves them unchanged except for
the part that a window does not average out, and this is bounded. Random vibration
adds the variance of a sample over the number of samples. A tone of frequency f and
amplitude A changes an average over T by at most A/(πfT), also where it beats with the
windows and the means wander slowly; from 5 Hz on, two neighbouring averages over s
windows of 0.1 s differ by at most 2.3 times the scatter inside a window, over s.
Neither bound grows with s as the path of a move does.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy

from triaxcal.arrays import Bools, Floats, Ints
from triaxcal.poses.stillness.windows import SCALES, NoiseScales, Windows, contrast, contrasts, trimmed

LEAST_S = 1.0
"""A shorter rest between vibrations is not distinguished from a pause of the hand."""
ALONE_S = 1.5
"""Least duration of a span with vibration throughout, longer than a pause of the
hand; a part of a pose may be shorter."""
MOVE_SIGMA = 5.0
"""Standard deviations of a difference of averages: noise exceeds this once in two
million. A lower limit would split poses; a higher one would miss small moves."""
TONE = 0.5
"""Bound for tones over `MOVE_SIGMA`, approximately: an equivalent standard
deviation."""
LONGEST = 16
"""Windows in the longest averages: hand tremor hides a slow rotation from shorter
ones."""
ABOUT = 7
"""Windows in the running median of the scatter."""
UNEVEN = 5.0
"""Factor by which the median variance around a window exceeds that of the run, or by
whose square its own variance does, if it belongs to a move or a knock."""
SHARE = 0.03
"""Largest scatter under vibration as a share of the range of the poses."""


def vibration_noise(noise: NoiseScales, variance: Floats, size: int) -> NoiseScales:
    """Noise of averages over windows of ``size`` samples with the ``variance`` (3,),
    where this exceeds the quiet noise."""
    excess = np.maximum(variance - noise.scatter**2, 0.0)
    return replace(
        noise,
        step={s: np.sqrt(v**2 + excess * _share(s, size)) for s, v in noise.step.items()},
        edge={s: np.sqrt(v**2 + excess * _share(s, size) / 1.6) for s, v in noise.edge.items()},
    )


def _share(scale: int, size: int) -> float:
    """Share of the variance inside windows that remains in the difference of averages
    over ``scale`` of them: 2/(n s) of random vibration, and the bound for tones."""
    return 2 / (size * scale) + (TONE / scale) ** 2


def vibrating_runs(w: Windows, taken: list[Ints], noise: NoiseScales) -> list[Ints]:
    """Trimmed runs with a constant mean, among the windows outside the quiet runs
    ``taken``.

    Only vibration that is small compared with the differences of poses can be
    distinguished from a hand that shakes the unit.
    """
    if len(taken) < 2:
        return []
    # Windows outside the quiet runs, with a scatter below the limit.
    levels = np.array([w.mean[run].mean(axis=0) for run in taken])
    most = (SHARE * float(np.linalg.norm(np.ptp(levels, axis=0)))) ** 2
    rest = np.asarray((w.variance <= most).all(axis=1))
    for quiet in taken:
        rest[max(quiet[0] - 1, 0) : quiet[-1] + 2] = False
    level = _level(w)
    found = []
    # A sudden change of the scatter separates runs: the slow end of a move does not
    # belong to the pose after it.
    total = np.maximum(level.sum(axis=1), 1e-300)
    alike = w.joined & (np.abs(np.diff(np.log(total), prepend=np.log(total[0]))) < np.log(UNEVEN))
    # Runs with a constant mean; in them, parts with even scatter, trimmed.
    for run in runs(_staying(w, rest, alike, level, noise), alike):
        usual = np.median(w.variance[run], axis=0)
        even = np.asarray(((level[run] < UNEVEN * usual) & (w.variance[run] < UNEVEN**2 * usual)).all(axis=1))
        for part in runs(even, np.ones(len(run), dtype=bool)):
            part = run[part]
            piece = trimmed(w, part, vibration_noise(noise, w.variance[part].mean(axis=0), w.size))
            if len(piece) and (w.end_ns[piece[-1]] - w.start_ns[piece[0]]) * 1e-9 >= LEAST_S:
                found.append(piece)
    return found


def _level(w: Windows) -> Floats:
    """(m,3) running median of the variance: a window shorter than a period shows more
    or less of it."""
    return np.asarray(scipy.ndimage.median_filter(w.variance, size=(ABOUT, 1), mode="nearest"))


def _staying(w: Windows, rest: Bools, alike: Bools, level: Floats, noise: NoiseScales) -> Bools:
    """Windows without a difference of neighbouring averages that vibration does not
    explain."""
    staying = rest.copy()
    excess = np.maximum(level - noise.scatter**2, 0.0)
    for scale in (*SCALES, LONGEST):
        # Compare squared differences with quiet noise and the remaining vibration.
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
    """Indices of uninterrupted runs of still windows."""
    index = np.flatnonzero(still)
    if not len(index):
        return []
    breaks = np.flatnonzero((np.diff(index) > 1) | ~joined[index[1:]]) + 1
    return [np.asarray(run, dtype=np.int64) for run in np.split(index, breaks)]


# Vibration in otherwise quiet poses: parts that are better excluded from the mean,
# and moves hidden by the vibration.

MUCH = 9.0
"""In variances of the quiet part: a smaller excess is not reported."""
VIBRATING = 3.0
"""In usual scatters: a window with more counts as vibrating."""
LASTING_S = 0.45
"""Duration of vibrating windows that distinguishes a disturbance from a knock: half a
second, less the rounding to windows."""
BLOCKS = 4
"""Least number of averages in a part, for the scatter of its means."""


def parted(w: Windows, pieces: Sequence[Ints], quiet: Sequence[bool], noise: NoiseScales) -> list[list[Ints]]:
    """The pieces of one pose in order of time, as one list, or as several where moves
    lie between its ``quiet`` pieces. Vibrating pieces between those are in none: they
    contain the move."""
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
    """Whether the means of two quiet pieces differ by more than noise (at worst a
    random walk) and the creep that both show."""
    scale = max(s for s in SCALES if s <= min(len(before), len(after)))
    here, there = before[-scale:], after[:scale]
    # Change of the mean, less the change by the common slope.
    change = w.mean[there].mean(axis=0) - w.mean[here].mean(axis=0)
    crept = _climb(w, before, after) * (there.mean() - here.mean())
    change = change - np.clip(change, np.minimum(crept, 0), np.maximum(crept, 0))
    # For a random walk, averages over s windows with a gap of g differ by the
    # variance of g + 2s/3 steps; without a gap, of 2s/3.
    apart = 1 + 1.5 * (there[0] - here[-1] - 1) / scale
    return bool((np.abs(change) > MOVE_SIGMA * np.sqrt(apart) * noise.step[scale]).any())


def _climb(w: Windows, *pieces: Ints) -> Floats:
    """(3,) common least-squares slope of pieces of one pose, a window."""
    x = [p - p.mean() for p in pieces]
    u = [w.mean[p] - w.mean[p].mean(axis=0) for p in pieces]
    return np.asarray(np.concatenate(x) @ np.concatenate(u) / sum(float(i @ i) for i in x))


def worth_keeping(w: Windows, vibrating: Ints, quiet: Ints, noise: NoiseScales) -> bool:
    """Whether the mean over both parts of a pose is better than that over the
    ``quiet`` windows, or hardly worse.

    With variances v/n of means over n windows, a part of n windows improves the mean
    of m if its v is below 2 + n/m times the other's.
    """
    usual = np.maximum(SCALES[-1] * noise.step[SCALES[-1]] ** 2 / 2, _spread(w, quiet))
    return bool(np.mean(_spread(w, vibrating) / usual) < max(MUCH, 2 + len(vibrating) / len(quiet)))


def disturbances(w: Windows, used: Ints, vibrating: Ints) -> Ints:
    """(j,) windows of a pose's disturbances, none of them in ``used``: its
    ``vibrating`` parts with the windows next to them, and bumps longer than a
    knock."""
    without = np.union1d(np.setdiff1d(np.arange(used[0], used[-1] + 1), used), vibrating)
    strong = (w.variance[without] > VIBRATING**2 * w.variance[used].mean(axis=0)).any(axis=1)
    least = LASTING_S / (w.period_ns * 1e-9)
    parts = np.split(np.arange(len(without)), np.flatnonzero(np.diff(without) > 1) + 1)
    lasting = [without[p] for p in parts if strong[p].sum() >= least or np.isin(without[p], vibrating).any()]
    return np.concatenate([np.zeros(0, dtype=np.int64), *lasting])


def _spread(w: Windows, part: Ints) -> Floats:
    """(3,) variance of a mean over n windows times n, from differences of averages
    over a few of them."""
    n = len(part)
    scale = max((s for s in SCALES if n >= BLOCKS * s), default=1)
    together = w.joined[part] & (np.diff(part, prepend=part[0] - 1) == 1)
    differences = contrasts(w.mean[part], np.ones(n, dtype=bool), together, scale, scale)[1]
    return np.asarray(scale * (differences**2).mean(axis=0) / 2) if len(differences) else np.zeros(3)
